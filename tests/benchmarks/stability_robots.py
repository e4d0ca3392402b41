"""Small robots at the edges of what numbers can hold, to stress collision models with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot, Sole, Striker

_KINDS = {"x": pin.JointModelRX, "y": pin.JointModelRY, "z": pin.JointModelRZ}


def make_robot(name: str) -> Robot:
    """By name: "slider", "arm", "bare arm" (no armature), "whip" and "mace" (links from 1e3 to 1e-3 kg, and
    the other way round), "walker", "planar walker" (legs of three joints), or one of the presets."""
    if name == "slider":
        model = pin.Model()
        joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "rail")
        model.appendBodyToJoint(joint, pin.Inertia.FromSphere(2.0, 0.05), pin.SE3.Identity())
        _mark(model, joint, (0.0, 0.0, 0.0), "tip")
        return _robot(model, name, armature=0.0, kd=20.0)
    if name in _ARMS:
        masses, armature = _ARMS[name]
        model = pin.Model()
        _mark(model, _chain(model, 0, "yyy", (0.0, 0.0, 1.0), masses), (0.0, 0.0, 0.3), "tip")
        # gains in proportion to the inertia that a servo feels
        model.armature[:] = armature
        upper = np.triu(pin.crba(model, model.createData(), pin.neutral(model)))
        felt = 1.0 / np.diag(np.linalg.inv(upper + np.triu(upper, 1).T))
        return _robot(model, name, kd=100.0 * felt, torque_limit=500.0 * felt)
    if name in _LEGS:
        return _walker(name)
    return load_robot(name)


_ARMS = {
    "arm": ((3.0, 2.0, 1.0), 0.05),
    "bare arm": ((3.0, 2.0, 1.0), 0.0),
    "whip": ((1e3, 1.0, 1e-3), 0.0),
    "mace": ((1e-3, 1.0, 1e3), 1e-6),
}
_LEGS = {"walker": "zxyyyx", "planar walker": "yyy"}


def _robot(model: Any, name: str, **options: Any) -> Robot:
    settings = {
        "name": name,
        "torque_limit": 100.0,
        "velocity_limit": 10.0,
        "position_limit": np.tile([-3.0, 3.0], (model.njoints - 1 - int(model.nq != model.nv), 1)),
        "strikers": [Striker(name="tip", frame="tip", point=np.zeros(3))],
        **options,
    }
    return Robot.from_model(model, **settings)


def _walker(name: str) -> Robot:
    model = pin.Model()
    trunk = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.appendBodyToJoint(trunk, pin.Inertia.FromBox(20.0, 0.2, 0.3, 0.5), _at(0.0, 0.0, 0.2))
    axes = _LEGS[name]
    soles = []
    for side, y in (("left", 0.1), ("right", -0.1)):
        masses = np.linspace(3.0, 1.0, len(axes))
        foot = _chain(model, trunk, axes, (0.0, y, 0.0), masses, down=True, name=side)
        _mark(model, foot, (0.0, 0.0, -0.05), f"{side} sole")
        soles.append(Sole.box(name=side, frame=f"{side} sole", length=0.2, width=0.1))
    hand = _chain(model, trunk, "yyz", (0.0, -0.2, 0.4), (2.0, 1.5, 0.5), name="arm")
    _mark(model, hand, (0.0, 0.0, 0.3), "tip")
    return _robot(model, name, armature=0.05, kd=50.0, soles=soles)


def _chain(
    model: Any,
    parent: int,
    axes: str,
    at: tuple[float, float, float],
    masses: Sequence[float] | Any,
    *,
    down: bool = False,
    name: str = "arm",
) -> int:
    """Links one after the other along z; the last joint."""
    sign = -1.0 if down else 1.0
    place = _at(*at)
    for i, (axis, mass) in enumerate(zip(axes, masses, strict=True)):
        parent = model.addJoint(parent, _KINDS[axis](), place, f"{name} {i}")
        body = pin.Inertia.FromBox(float(mass), 0.06, 0.06, 0.3)
        model.appendBodyToJoint(parent, body, _at(0.0, 0.0, 0.15 * sign))
        place = _at(0.0, 0.0, 0.3 * sign)
    return int(parent)


def _at(x: float, y: float, z: float) -> Any:
    return pin.SE3(np.eye(3), np.array([x, y, z]))


def _mark(model: Any, joint: int, at: tuple[float, float, float], name: str) -> None:
    model.addFrame(pin.Frame(name, joint, 0, _at(*at), pin.FrameType.OP_FRAME))
