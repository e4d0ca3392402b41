"""Soles that turn about one axis: the robot is the same, but for a joint that nothing drives."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs
from support.small_robots import biped

from impactopt import InputError, Robot, Sole

PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.02, 0.01, -0.05]))


def walker(folder: Path, **sole: Any) -> Robot:
    """Of a URDF, with soles on frames that look elsewhere than their links."""
    path = folder / "walker.urdf"
    path.write_text(urdfs.biped(without="ankle_roll"))
    soles = [
        Sole.box(
            name=side,
            frame=f"{side}_sole",
            length=0.2,
            width=0.1,
            parent=f"{side}_ankle_pitch_link",
            placement=PLACE,
            **sole,
        )
        for side in ("left", "right")
    ]
    bent = {"left_knee": 0.4, "right_hip_yaw": 0.2}
    return Robot.from_urdf(path, soles=soles, postures={"bent": bent}, armature=0.01, kp={"left_knee": 5.0})


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_at_zero_the_robot_is_the_one_without_hinges(tmp_path: Path, axis: str) -> None:
    robot, plain = walker(tmp_path, hinge=axis), walker(tmp_path)
    assert robot.n == plain.n + 2
    assert [name for name, k in zip(robot.joint_names, robot.hinges, strict=True) if k] == [
        "left_hinge",
        "right_hinge",
    ]
    own = np.append(np.arange(6), 6 + np.flatnonzero(~robot.hinges))
    for name in ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper", "armature"):
        np.testing.assert_array_equal(getattr(robot, name)[~robot.hinges], getattr(plain, name))
    q, p, v = robot.posture("bent"), plain.posture("bent"), np.random.default_rng(0).normal(size=plain.nv)
    wide = np.zeros(robot.nv)
    wide[own] = v
    one, other = robot.model.createData(), plain.model.createData()
    inertia, wanted = pin.crba(robot.model, one, q), pin.crba(plain.model, other, p)
    np.testing.assert_allclose(np.triu(inertia)[np.ix_(own, own)], np.triu(wanted), atol=1e-12)
    np.testing.assert_allclose(
        pin.nle(robot.model, one, q, wide)[own], pin.nle(plain.model, other, p, v), atol=1e-10
    )
    pin.framesForwardKinematics(robot.model, one, q)
    pin.framesForwardKinematics(plain.model, other, p)
    for sole in robot.soles:
        here = one.oMf[robot.model.getFrameId(sole.frame)]
        np.testing.assert_allclose(
            here.homogeneous, other.oMf[plain.model.getFrameId(sole.frame)].homogeneous, atol=1e-12
        )


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_the_foot_turns_about_that_axis_of_the_sole_through_its_origin(tmp_path: Path, axis: str) -> None:
    robot = walker(tmp_path, hinge=axis)
    at = robot.joint_index("left_hinge")
    data, frame = robot.model.createData(), robot.model.getFrameId("left_sole")
    q = robot.posture("bent")
    q[7 + at] = 0.3
    jac = pin.computeFrameJacobian(robot.model, data, q, frame, pin.LOCAL)[:, 6 + at]
    np.testing.assert_allclose(jac, np.eye(6)[3 + "xyz".index(axis)], atol=1e-12)
    assert robot.passive[at] and not robot.sprung[at] and robot.kp[at] == robot.kd[at] == 0


def test_what_is_no_hinge_is_refused(tmp_path: Path) -> None:
    for sole, told in (
        ({"hinge": "roll"}, "hinge is 'roll'"),
        ({"hinge": "x", "hinge_range": 0.0}, "hinge_range is 0 rad"),
        ({"hinge": "x", "hinge_range": 1.0}, "at most 0.5"),
    ):
        with pytest.raises(InputError, match=told):
            walker(tmp_path, **sole)
    plain = biped()
    soles = tuple(dataclasses.replace(sole, hinge="x") for sole in plain.soles)
    with pytest.raises(InputError, match="'left' has a hinge, and the model no joint for it"):
        dataclasses.replace(plain, soles=soles)
    model = biped(5, hinge=None).model.copy()
    held = Sole.box(name="left", frame="universe", length=0.2, width=0.1, hinge="x")
    limits = {"torque_limit": 9.0, "velocity_limit": 9.0, "position_limit": np.tile([-2.0, 2.0], (13, 1))}
    with pytest.raises(InputError, match="no joint moves its frame 'universe'"):
        Robot.from_model(model, soles=[held], **limits)
