"""A punch by Crocoddyl: the same reach with its rigid impulse, as a reference for our replays.

Crocoddyl's wheels need one version of Pinocchio, which is not ours. So it runs in an environment of its own,
by `crocoddyl_plan.py`; the robot and the task go there, and the plan comes back, as numbers in files.
"""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.contact import FreeMass
from impactopt.errors import InputError
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, PositionLimit, TorqueLimit, VelocityLimit
from impactopt.robots.tools import inside
from impactopt.transcription.plan import Trajectory

Array = NDArray[np.float64]
TIME_LIMIT = 600.0  # [s] of the other process
_AXES = {"JointModelRX": (1, 0, 0), "JointModelRY": (0, 1, 0), "JointModelRZ": (0, 0, 1)}


@dataclass(frozen=True, kw_only=True)
class CrocoddylPlan:
    """What Crocoddyl plans.

    impulse [N s] : of its rigid blow against a wall, had the target its own mass.  seconds, iterations : of
    its solver, box-FDDP.  solved : whether it says so.
    """

    reference: Trajectory
    impulse: float
    seconds: float
    iterations: int
    solved: bool


def crocoddyl_plan(problem: ImpactProblem, python: Path) -> CrocoddylPlan:
    """Plan the problem's reach by Crocoddyl.

    python : an interpreter with crocoddyl.

    Raises
    ------
    InputError : a robot or target that its plan does not know; crocoddyl cannot be run there, or fails.
    """
    task = _task(problem)
    with tempfile.TemporaryDirectory() as name:
        np.savez(Path(name) / "task.npz", **task)
        script = Path(__file__).with_name("crocoddyl_plan.py")
        try:
            done = subprocess.run(
                [python, "-I", script, name], capture_output=True, text=True, timeout=TIME_LIMIT, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"{python} does not run crocoddyl: {error}") from None
        if done.returncode:
            why = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            raise InputError(
                f"{python} does not run crocoddyl: {why}; its wheel needs the Pinocchio that it was made "
                "with (docs/benchmarks.md, baselines)"
            )
        with np.load(Path(name) / "plan.npz") as file:
            plan = dict(file)
    wall, hit = float(plan["impulse"]), int(plan["before"])
    return CrocoddylPlan(
        reference=_reference(problem, plan["states"], plan["torques"], hit, float(plan["step"])),
        impulse=_against_target(problem, wall, plan["states"][hit]),
        seconds=float(plan["seconds"]),
        iterations=int(plan["iterations"]),
        solved=bool(plan["solved"]),
    )


def _task(problem: ImpactProblem) -> dict[str, Any]:
    """Robot and task in numbers, as `crocoddyl_plan.py` reads them."""
    p, robot, model = problem, problem.robot, problem.robot.model
    joints = list(model.joints)[1:]
    kinds = [joint.shortname() for joint in joints]
    if kinds[0] != "JointModelFreeFlyer" or not set(kinds[1:]) <= _AXES.keys() or p.coordinates.hands:
        raise InputError("Crocoddyl's plan is of robots with revolute joints that stand on soles alone")
    if not isinstance(p.target, FreeMass) or p.second is not None:
        raise InputError("Crocoddyl's plan is of one hand against a free mass")
    names = [*p.stance.sole_frames(robot), robot.striker(p.striker).model_frame]
    frames = [model.frames[model.getFrameId(name)] for name in names]
    cone = p.term(ContactWrenchCone)
    free, rates = np.full(6, np.inf), p.term(VelocityLimit).fraction * robot.velocity_limit
    lower, upper = inside(robot, p.term(PositionLimit).margin)
    # its cones have a rectangle about the frame: the largest in all soles
    half = np.min([np.minimum(-s.polygon.min(0), s.polygon.max(0)) for s in p.stance.soles(robot)], axis=0)
    bodies = list(model.inertias)[1:]
    return {
        "parents": list(model.parents)[1:],
        "axes": np.array([_AXES.get(kind, (0, 0, 0)) for kind in kinds], dtype=float),
        "places": [place.homogeneous for place in list(model.jointPlacements)[1:]],
        "masses": [body.mass for body in bodies],
        "levers": [body.lever for body in bodies],
        "inertias": [body.inertia for body in bodies],
        "armature": np.array(model.armature),
        "frames": names,
        "frame_joints": [frame.parentJoint for frame in frames],
        "frame_places": [frame.placement.homogeneous for frame in frames],
        "q0": p.start_posture,
        "soles": names[:-1],
        "striker": names[-1],
        "normal": p.normal,
        "point": p.point,
        "lower": np.concatenate([-free, lower, -free, -rates]),
        "upper": np.concatenate([free, upper, free, rates]),
        "torque": p.term(TorqueLimit).fraction * robot.torque_limit,
        "friction": cone.friction,
        "least": cone.minimum_force,
        "box": 2 * (half - cone.margin),
        "swing": float(np.mean(p.swing.duration)),
        "follow": float(np.mean(p.follow.duration)),
    }


def _against_target(problem: ImpactProblem, wall: float, state: Array) -> float:
    """What a blow of an impulse against a wall [N s] gives a free mass, with the restitution that the problem
    has for rigid ones.
    """
    assert isinstance(problem.target, FreeMass)
    robot = problem.robot
    model, data = robot.model, robot.model.createData()
    q, v = state[: model.nq], state[model.nq :]
    pin.forwardKinematics(model, data, q, v)
    frame = model.getFrameId(robot.striker(problem.striker).model_frame)
    speed = float(problem.normal @ pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear)
    if not (wall > 0 and speed > 0):
        return 0.0
    mass = problem.target.mass
    return (1 + problem.coefficient_of_restitution) * speed / (speed / wall + 1 / mass)


def _reference(problem: ImpactProblem, states: Array, torques: Array, hit: int, step: float) -> Trajectory:
    """Its states (k + 1, nq + nv), the one at contact and the one after it at the same instant, and torques
    (k - 1, n) of the steps between them, as a servo's reference.
    """
    model, data = problem.robot.model, problem.robot.model.createData()
    q, v = np.split(states, [model.nq], axis=1)
    count = len(states)
    time = step * np.array([*range(hit + 1), *range(hit, count - 1)])
    phase = np.where(np.arange(count) <= hit, 0, 2)
    # of each state, the step that begins there; of the last of a phase, the one that ends there
    begins = np.minimum(np.arange(count), np.where(phase == 0, hit - 1, count - 2))
    a = (v[begins + 1] - v[begins]) / step
    torque = torques[begins - (phase == 2)]
    ground = np.zeros((count, 6))
    for k in range(count):
        base = pin.Force(np.array(pin.rnea(model, data, q[k], v[k], a[k]))[:6])
        ground[k] = data.oMi[1].act(base).vector
    end = float(time[hit])
    return Trajectory(
        time=time,
        phase=phase,
        q=q,
        v=v,
        a=a,
        torque=torque,
        ground=ground,
        contact_start=end,
        contact_end=end,
        end=float(time[-1]),
    )
