"""Soles that may turn about one of their axes: a joint between foot and sole that nothing drives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots import build
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Sole
from impactopt.robots.checks import check_frame
from impactopt.robots.joints import hung, mapped

__all__ = ["check_held", "check_sole", "hinged", "inside", "with_hinges"]

Array = NDArray[np.float64]
SHARE = 0.5  # of the foot's mass that goes with the sole
SPEED = 20.0  # [rad/s]: no bound of a strike
SINGULAR = 1e-3  # a leg's Jacobian's least singular value [m], at least
LEVER = 0.1  # [m] by which the weight makes the torque that numbers of a hinge are reported in


def hinged(model: pin.Model, soles: Sequence[Sole]) -> pin.Model:
    """The model with a joint for each sole that has a hinge, which then moves the sole's frame.

    Soles and hinge turn about the frame's origin. The sole takes half of its link's mass with it, spread as
    the link's is.
    """
    torque = hinge_torque(model)
    for sole in soles:
        if sole.hinge is None:
            continue
        if sole.hinge_joint in build.joint_names(model):
            raise InputError(
                f"sole {sole.name!r}: the robot has a joint {sole.hinge_joint!r} already; rename the sole"
            )
        at = check_frame(model, sole.frame, f"sole {sole.name!r}")
        foot, place = int(model.frames[at].parentJoint), model.frames[at].placement
        if foot == 0:
            raise InputError(
                f"sole {sole.name!r}: no joint moves its frame {sole.frame!r}, so leave out the hinge"
            )
        place, whole = pin.SE3(place), pin.Inertia(model.inertias[foot])  # they outlive their model
        model = model.copy()
        model.inertias[foot] = _part(whole, 1 - SHARE)
        turn, mark = pin.SE3(_to_axis("xyz".index(sole.hinge)), np.zeros(3)), f"sole:{sole.name}"
        joint, body = (sole.hinge_joint, torque, SPEED, sole.hinge_range), place.actInv(_part(whole, SHARE))
        model = hung(model, sole.frame, turn, joint, mark, body)
        moved, its = model.frames[model.getFrameId(sole.frame)], model.getFrameId(mark)
        moved.parentJoint, moved.placement = model.frames[its].parentJoint, model.frames[its].placement
        moved.parentFrame = its
    return model


def with_hinges(
    model: pin.Model, soles: Sequence[Sole], numbers: dict[str, Any], postures: dict[str, Array]
) -> tuple[pin.Model, dict[str, Any], dict[str, Array]]:
    """Model with hinges (`hinged`), and numbers by joint, drives and postures of all joints."""
    whole, torque = hinged(model, soles), hinge_torque(model)
    known: dict[str, dict[str, Any]] = {}
    for sole in soles:
        own: dict[str, Any] = {"kp": 0.0, "kd": 0.0, "torque_limit": torque, "velocity_limit": SPEED}
        own |= {"lower": -sole.hinge_range, "upper": sole.hinge_range, "actuators": Actuator()}
        known[sole.hinge_joint] = own
    for k, joint in enumerate(build.joint_names(model)):
        known[joint] = {key: values[k] for key, values in numbers.items()}
    numbers = {key: [known[joint][key] for joint in build.joint_names(whole)] for key in numbers}
    return whole, numbers, {name: mapped(model, whole, q) for name, q in postures.items()}


def check_sole(model: pin.Model, sole: Sole) -> None:
    """InputError for a sole whose frame or hinge the model has not."""
    check_frame(model, sole.frame, f"sole {sole.name!r}")
    if sole.hinge is not None and sole.hinge_joint not in build.joint_names(model):
        raise InputError(
            f"sole {sole.name!r} has a hinge, and the model no joint for it: give the sole to "
            "Robot.from_urdf, from_mjcf or from_model, which make one"
        )


def check_held(model: pin.Model, sole: Sole, q: Array, columns: Any) -> None:
    """InputError where the joints of these columns of v, the sole's hinge among them, cannot hold it at q."""
    frame = model.getFrameId(sole.frame)
    jac = pin.computeFrameJacobian(model, model.createData(), q, frame, pin.LOCAL)[:, columns]
    if sole.hinge is not None and np.linalg.svd(jac, compute_uv=False)[-1] < SINGULAR:
        raise InputError(
            f"sole {sole.name!r} cannot be held: its hinge about {sole.hinge} turns as joints of its leg do; "
            "give the axis that they lack, or a posture with bent knees"
        )


def inside(robot: Any, margin: float) -> tuple[Array, Array]:
    """(n,) lower and upper position limits [rad] of a `Robot`, less a margin; of hinges, whose range is
    small, less a quarter of it.
    """
    less = np.where(robot.hinges, np.minimum(margin, (robot.upper - robot.lower) / 8), margin)
    return robot.lower + less, robot.upper - less


def hinge_torque(model: pin.Model) -> float:
    """Torque [N m] in which those of hinges are reported: the weight at a lever."""
    return LEVER * 9.81 * float(sum(body.mass for body in model.inertias))


def _part(body: Any, share: float) -> Any:
    return pin.Inertia(share * body.mass, body.lever, share * np.array(body.inertia))


def _to_axis(k: int) -> Array:
    """The rotation (3, 3) whose z is the k-th axis."""
    return np.roll(np.eye(3), k - 2, axis=0) if k < 2 else np.eye(3)
