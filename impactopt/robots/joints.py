"""Joints that a robot's file does not have, such as a soft grip's: put in, with numbers for all joints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.checks import check_frame

__all__ = ["hung", "mapped"]

Array = NDArray[np.float64]


def hung(
    model: pin.Model, frame: str, placement: Any, joint: tuple[str, float, float, float], mark: str, body: Any
) -> pin.Model:
    """The model with one more joint, that turns about z of `placement` (pin.SE3) in a frame.

    Joints are in depth-first order, as Pinocchio has to have them.

    joint : its name, largest torque [N m] and speed [rad/s], and reach [rad] to both sides.  mark : name of a
    frame that moves with it, and is where `frame` is at zero.  body : pin.Inertia that moves so, in `mark`.
    """
    name, torque, speed, reach = joint
    one, back = pin.Model(), placement.inverse()
    bounds = [np.array([x]) for x in (torque, speed, -reach, reach)]
    index = one.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), name, *bounds)
    one.appendBodyToJoint(index, body, back)
    one.addFrame(pin.Frame(mark, index, 0, back, pin.FrameType.BODY))
    one.gravity = model.gravity
    whole = pin.appendModel(model, one, check_frame(model, frame, name), placement)
    whole.name = model.name
    for old_name, old in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):  # it leaves them
        at = whole.joints[whole.getJointId(old_name)].idx_v
        whole.armature[at : at + old.nv] = model.armature[old.idx_v : old.idx_v + old.nv]
    return whole


def mapped(old: pin.Model, new: pin.Model, q: Array) -> Array:
    """A configuration of a model with fewer joints: the others are at zero."""
    out = pin.neutral(new)
    for name, joint in zip(list(old.names)[1:], list(old.joints)[1:], strict=True):
        at = new.joints[new.getJointId(name)].idx_q
        out[at : at + joint.nq] = q[joint.idx_q : joint.idx_q + joint.nq]
    return out
