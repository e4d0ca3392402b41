"""Script that plays an exported scene, with MuJoCo and NumPy only."""

from __future__ import annotations

from collections.abc import Mapping

from impactopt.contact.laws import ContactLaw, HertzDamped, HuntCrossley, KelvinVoigt, SpringDamper
from impactopt.contact.targets import Board, Nail
from impactopt.problem.problem import ImpactProblem

# contact force [N] at a penetration x [m] and its rate [m/s]; negative values are replaced by zero
LAWS: Mapping[type[ContactLaw], str] = {
    SpringDamper: "stiffness * x + damping * rate * (rate > 0)",
    KelvinVoigt: "stiffness * x + damping * rate",
    HuntCrossley: "stiffness * x**exponent * (1 + 1.5 * dissipation * rate)",
    HertzDamped: "stiffness * x**1.5 + damping * x**0.25 * rate",
}
PLAYER = '''\
"""Plays a planned impact motion. Needs mujoco and numpy. Run: python play.py, or python play.py missing"""

import sys
from pathlib import Path

import mujoco
import numpy as np

here, missing = Path(__file__).parent, "missing" in sys.argv[1:]
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data, ref = mujoco.MjData(model), np.load(here / "reference.npz")
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
of = "missed_" if missing and "missed_time" in ref else ""  # the same until the target is missed
time, table = ref[of + "time"], np.hstack([ref[of + x] for x in ("position", "velocity", "effort")])
joints, kp, kd, impulse = [model.joint(name) for name in ref["joints"]], ref["kp"], ref["kd"], 0.0
place, dof, n = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints], len(joints)
{numbers}

while data.time < time[-1] + 0.5:
{before}    mujoco.mj_step1(model, data)
    i = min(int(np.searchsorted(time, data.time, side="right")), len(time) - 1)
    s = min((data.time - time[i - 1]) / (time[i] - time[i - 1]), 1.0)
    q, v, effort = np.split((1 - s) * table[i - 1] + s * table[i], 3)
    data.ctrl[:n] = effort + kp * (q - data.qpos[place]) + kd * (v - data.qvel[dof])
    x, rate = data.actuator_length[n], data.actuator_velocity[n]  # how deep, and how fast deeper
    force = 0.0 if missing or x < 0 else max(0.0, {law})
    data.ctrl[n], impulse = -force, impulse + force * model.opt.timestep
    mujoco.mj_step2(model, data)
print(f"impulse {{impulse:.3f}} N s, planned {{float(ref['impulse']):.3f}} N s")
{after}'''
NAIL = """\
    model.joint("target").frictionloss = resistance + hardening * (depth + data.joint("target").qpos)
"""
BOARD = """\
    if stiffness_board * data.joint("target").qpos[0] > breaking_force:  # from then on two free halves
        model.joint("target").stiffness = model.joint("target").damping = 0.0
"""
BASE = """\
print(f"root link at the end: {data.qpos[2]:.3f} m high, planned {ref[of + 'base_position'][-1, 2]:.3f} m")
"""


def player(problem: ImpactProblem) -> str:
    """The text of `play.py` for a problem whose law is one of `LAWS`."""
    numbers, before, target = dict(problem.law.parameters), "", problem.target
    if isinstance(target, Nail) and target.hardening:
        before = NAIL
        numbers |= {name: target.parameters[name] for name in ("resistance", "hardening", "depth")}
    if isinstance(target, Board):
        before = BOARD
        numbers |= {"stiffness_board": target.stiffness, "breaking_force": target.breaking_force}
    return PLAYER.format(
        numbers=f"{', '.join(numbers)} = {', '.join(repr(float(x)) for x in numbers.values())}",
        before=before,
        law=LAWS[type(problem.law)],
        after=BASE if problem.robot.floating else "",
    )
