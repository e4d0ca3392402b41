"""The two ends of a servo's gains: a robot whose joints are free, and one whose joints are locked.

Published experiments with a stiffly controlled arm find it near the second (arXiv 2202.12646).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from benchmarks.gains import LAW, ONLY_SERVO, TARGET, impulse_of
from numpy.typing import NDArray

from impactopt import SDC, BothSoles, FixedBase, Robot, Sole, Striker, arm7, striking_velocity

Array = NDArray[np.float64]
NORMAL = np.array([0.6, 0.0, -0.8])
VIRTUAL = BothSoles(base_mass=5.0, base_inertia=0.4)


def rider() -> Robot:
    """A free body of 8 kg with a sole, and an arm of two joints on it."""
    model, axes = pin.Model(), (pin.JointModelRY(), pin.JointModelRX())
    parent = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.appendBodyToJoint(parent, pin.Inertia.FromBox(8.0, 0.3, 0.4, 0.5), pin.SE3.Identity())
    below = pin.SE3(np.eye(3), np.array([0.02, 0.0, -0.3]))
    model.addFrame(pin.Frame("sole", parent, 0, below, pin.FrameType.OP_FRAME))
    for k, axis in enumerate(axes):
        at = pin.SE3(np.eye(3), np.array([0.1, 0.05, 0.25]))
        parent = model.addJoint(parent, axis, at, f"joint {k}")
        model.addJointFrame(parent)
        model.appendBodyToJoint(parent, pin.Inertia.FromBox(1.5, 0.06, 0.06, 0.3), pin.SE3.Identity())
    return Robot.from_model(
        model,
        name="rider",
        armature=0.05,
        torque_limit=50.0,
        velocity_limit=5.0,
        position_limit={"joint 0": (-2.0, 2.0), "joint 1": (-2.0, 2.0)},
        soles=[Sole.box(name="sole", frame="sole", length=0.3, width=0.3)],
        strikers=[Striker(name="fist", frame="joint 1", point=np.array([0.0, 0.02, 0.3]))],
        postures={"start": {"joint 0": 0.7, "joint 1": 0.3}},
    )


def effective_mass(robot: Robot, q: Array, striker: str, stance: Any, locked: bool) -> float:
    """[kg] of the striking point, by Pinocchio: with all joints free, or of one rigid body."""
    model = robot.model
    if locked:
        model = pin.buildReducedModel(model, list(range(2, model.njoints)), q)
        q = q[:7]
    data, axes = model.createData(), pin.LOCAL_WORLD_ALIGNED
    upper = np.triu(pin.crba(model, data, q))
    inertia = upper + np.triu(upper, 1).T
    for name in stance.constraint_frames(robot):  # the virtual base moves with the sole
        J = pin.computeFrameJacobian(model, data, q, model.getFrameId(name), axes)
        inertia += J.T @ np.diag([VIRTUAL.base_mass] * 3 + [VIRTUAL.base_inertia] * 3) @ J
    row = NORMAL @ pin.computeFrameJacobian(model, data, q, model.getFrameId(striker), axes)[:3]
    return float(1 / (row @ np.linalg.solve(inertia, row)))


def impulse(robot: Robot, stance: Any, q: Array, v: Array, striker: str, factor: float) -> float:
    model = SDC(
        robot=robot,
        striker=striker,
        normal=NORMAL,
        law=LAW,
        target=TARGET,
        stance=stance,
        effects=ONLY_SERVO,
        kp=factor * robot.kp,
        kd=factor * robot.kd,
        accuracy=None,
    )
    return float(model.collide(q, v).impulse)


@pytest.mark.parametrize("kind", ["arm on a fixed base", "body on a virtual base"])
def test_gains_lead_from_free_joints_to_one_rigid_body(kind: str) -> None:
    fixed = kind == "arm on a fixed base"
    robot, stance = (arm7(), FixedBase()) if fixed else (rider(), VIRTUAL)
    striker, q = ("hammer", robot.posture("ready")) if fixed else ("fist", robot.posture("start"))
    v = np.zeros(robot.nv)
    if fixed:
        v = striking_velocity(robot, q, striker, NORMAL, 1.0)
    else:  # its base alone moves: what is locked does so too
        rotation = pin.XYZQUATToSE3(q[:7]).rotation
        v[:3] = rotation.T @ NORMAL
    frame = robot.striker(striker).model_frame
    free = impulse_of(effective_mass(robot, q, frame, stance, False))
    locked = impulse_of(1e12 if fixed else effective_mass(robot, q, frame, stance, True))
    assert locked > 1.05 * free
    found = [impulse(robot, stance, q, v, striker, factor) for factor in (0.0, 1e-2, 1.0, 1e2, 1e8)]
    assert found[0] == pytest.approx(free, rel=1e-6)
    assert found[-1] == pytest.approx(locked, rel=1e-6)
    assert np.all(np.diff(found) > 0)
