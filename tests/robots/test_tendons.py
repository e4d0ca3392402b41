"""Fixed tendons with a range: lengths as MuJoCo's, refusals, plans inside them, replays outside."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.small_plans import Planned, planned, transcribed

from impactopt import ImpactProblem, InputError, PositionLimit, Robot
from impactopt.files.verify import motion_of_record
from impactopt.robots.couplings import Tendon
from impactopt.simulation import simulate

mujoco = pytest.importorskip("mujoco")

LINKS = "".join(
    f'<body name="b{k}" pos="0 0 .3"><joint name="j{k}" axis="0 {k % 2} 1" range="-170 170" ref="{5 * k}"/>'
    '<geom size=".05 .1" type="capsule"/>'
    for k in range(4)
)
CHAIN = f"""<mujoco><worldbody>{LINKS}{"</body>" * 4}</worldbody>
<equality><joint joint1="j3" joint2="j1" polycoef=".2 -.5 0 0 0"/></equality>
<tendon><fixed name="cord" range="-.4 .9">
<joint joint="j0" coef=".5"/><joint joint="j1" coef="-.3"/><joint joint="j2" coef="2"/>
<joint joint="j3" coef=".7"/></fixed></tendon></mujoco>"""
LIMITS: dict[str, Any] = {"torque_limit": 50.0, "velocity_limit": 4.0}


def chain(folder: Path, text: str = CHAIN, **options: Any) -> Robot:
    path = folder / "chain.xml"
    path.write_text(text)
    return Robot.from_mjcf(path, **{**LIMITS, **options})


@pytest.mark.parametrize("locked", [{}, {"j2": 0.3}, {"j0": -0.2, "j2": 0.1}])
def test_a_tendon_is_as_far_from_its_ends_as_in_mujoco(tmp_path: Path, locked: dict[str, float]) -> None:
    """Of joints that are locked or follow, too."""
    robot = chain(tmp_path, locked=locked)
    mj = mujoco.MjModel.from_xml_path(str(tmp_path / "chain.xml"))
    there, draw = mujoco.MjData(mj), np.random.default_rng(0)
    (low, high), n = mj.tendon_range[0], robot.n
    for _ in range(5):
        angle = dict(zip(robot.joint_names, draw.uniform(-1, 1, n), strict=True))
        every = {**locked, **angle, "j3": robot.couplings["j3"].ratio * angle["j1"]}
        every["j3"] += robot.couplings["j3"].offset
        there.qpos[:] = [every[mj.joint(k).name] for k in range(4)]
        mujoco.mj_fwdPosition(mj, there)
        (own,) = robot.ranges.positions(np.array(list(angle.values())))[n:]
        assert own - robot.ranges.lower[n] == pytest.approx(there.ten_length[0] - low)
        assert robot.ranges.upper[n] - own == pytest.approx(high - there.ten_length[0])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('range="-.4 .9"', 'range="-.4 .9" stiffness="3"'),
        ('range="-.4 .9"', 'range="-.4 .9" damping="3"'),
        ('range="-.4 .9"', 'range="-.4 .9" frictionloss="3"'),
        ("</mujoco>", '<actuator><motor tendon="cord"/></actuator></mujoco>'),
        ('<joint name="j0" axis="0 0 1" range="-170 170"', '<joint name="j0" axis="0 0 1"'),
    ],
)
def test_a_tendon_that_does_more_is_refused_by_name(tmp_path: Path, old: str, new: str) -> None:
    assert old in CHAIN
    with pytest.raises(InputError, match="tendon 'cord' acts on j0, j1, j2, j3"):
        chain(tmp_path, CHAIN.replace(old, new))


def test_angles_that_a_tendon_does_not_let_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"posture 'bent'.*'tendon cord' at 2\.\d+ \(limits"):
        chain(tmp_path, postures={"bent": {"j2": 1.2}})
    with pytest.raises(InputError, match="tendon 'cord' is out of its range at the angles"):
        text = CHAIN.replace('<joint joint="j3" coef=".7"/>', "")
        chain(tmp_path, text, locked={"j0": 0.0, "j1": 0.0, "j2": 1.2})
    model = chain(tmp_path).model
    with pytest.raises(InputError, match="tendon 't': no joint 'j9'"):
        tendon = Tendon(name="t", coefficients={"j9": 1.0}, lower=0.0, upper=1.0)
        Robot.from_model(model, **LIMITS, tendons=[tendon])
    with pytest.raises(InputError, match="tendon 't': its range is 1 to 1"):
        tendon = Tendon(name="t", coefficients={"j0": 1.0}, lower=1.0, upper=1.0)
        Robot.from_model(model, **LIMITS, tendons=[tendon])


def sums(plan: Planned) -> np.ndarray:
    """Of the first two joints [rad], in the arm's motion outside of contact."""
    way = plan.trajectory
    angles = plan.problem.robot.joint_positions(way.q[way.phase != 1])
    return np.asarray(angles[:, :2].sum(axis=1))


def tied(problem: ImpactProblem, upper: float) -> ImpactProblem:
    """The sum of the first two joints' angles kept below an end [rad]."""
    first = dict.fromkeys(problem.robot.joint_names[:2], 1.0)
    tendon = Tendon(name="cord", coefficients=first, lower=-10.0, upper=upper)
    robot = dataclasses.replace(problem.robot, tendons=(tendon,))
    return dataclasses.replace(problem, robot=robot)


@pytest.mark.slow
def test_a_plan_keeps_a_tendon_in_its_range(arm_plan: Planned) -> None:
    free = arm_plan.problem
    most, start = sums(arm_plan).max(), sums(arm_plan)[0]
    upper = float(start + 0.5 * (most - start))
    problem, margin = tied(free, upper), free.term(PositionLimit).margin
    assert problem.hash != free.hash
    assert any("cord" in line for line in problem.describe()["tendons"])
    plan = planned(transcribed(problem))
    assert plan.result.status.usable
    t = plan.transcription
    nodes = np.array([t.posture(plan.result.x, slots) for _, slots in t.body_spots])
    nodes = problem.robot.joint_positions(nodes)[:, :2].sum(axis=1)
    assert nodes.max() == pytest.approx(upper - margin, abs=1e-6)  # the bound is active, and kept
    assert sums(plan).max() < upper
    assert plan.plan.impulse < arm_plan.plan.impulse


@pytest.mark.slow
def test_motions_out_of_a_tendons_range_are_told(arm_plan: Planned) -> None:
    """By the replay, and by the checks of a record."""
    beyond = 0.1
    problem = tied(arm_plan.problem, float(sums(arm_plan).max()) - beyond)
    way = arm_plan.trajectory
    found = simulate(problem, way)
    summary = found.summary(
        torque_limit=problem.robot.torque_limit, polygon=np.zeros((0, 2)), planned_impulse=1.0
    )
    assert summary["beyond_range"] == "tendon cord"
    assert summary["beyond_range_rad"] == pytest.approx(beyond, abs=0.02)
    assert simulate(arm_plan.problem, way).beyond_range == ("", 0.0)
    arrays = {f"reference_{k}": getattr(way, k) for k in ("time", "phase", "q", "v", "a", "torque")}
    off = [
        (by, where)
        for name, by, where in motion_of_record(problem, arrays)
        if name.endswith("position limit")
    ]
    assert max(off)[0] == pytest.approx(beyond, abs=1e-9) and "tendon cord" in max(off)[1]
