"""Striking points, found at the ends of limbs: by tool frames, else by the shapes of the last links."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.convex_hulls import Piece, inertia_box, is_far
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb
from impactopt.robots.attachments import Striker
from impactopt.robots.couplings import axis_of

__all__ = ["find_edge", "find_striker", "first_link"]

Array = NDArray[np.float64]
# the conventions of ROS-Industrial (tool0), of makers and of MuJoCo's menagerie (sites), the surest first
_TOOLS = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"(^|_)tcp($|_)",
        r"^tool0$|(?<!ft)(^|_)tool(_?(0|tip|frame|point|center|centre|link))?$",
        r"link_eef$|(^|_)eef?(_?(link|frame|site|tip))?$|end_?effector",
        r"grip_?site|gripper_?(frame|tip|cent(er|re))|pinch|attachment_?site|(^|_)grasp",
    )
)
APART = 0.01  # [m] two places are apart, and a shape's middle is ahead of its joint
SHORT = 0.06  # [m] a link so short at most, as a flange is, never folds back over the link before it
EDGE = 5e-3  # [m] above its lowest point: what of a hand is its edge
LONG = 0.12  # [m] a hand sticks out so far from a tool's frame at least
ROLLS = np.cos(np.radians(25))  # least cosine between a joint's axis and what turns about it
ASLANT = np.cos(np.radians(60))  # least cosine for a shape that is behind its joint rather than beside it
STRAIGHT = np.cos(np.radians(20))  # least cosine for a limb that points along an axis of its link


def find_striker(
    model: pin.Model, limb: Limb, name: str, pieces: Mapping[int, tuple[Piece, ...]]
) -> tuple[Striker, Array]:
    """The end of a limb, and the direction (3,) in which its last link points there, in that joint's frame.

    A frame that is named as tools are is on the axis of the striking point; else the middle of the last
    link's shapes is. The point is where these end, away from the arm; of a tool's frame at the joint itself
    where a long hand ends. In place of shapes that are far from their link there is the box of its inertia.
    """
    own = pieces.get(limb.tip, ())
    points = [p.vertices for p in own if not is_far(model, p, own)]
    if own and not points:
        points = [inertia_box(model.inertias[limb.tip]).vertices]
    away, tool = _away(model, limb), _tool(model, limb.tip)
    if tool is not None:
        place = tool.placement
        axes = np.column_stack([place.rotation, -place.rotation])
        reach = np.max([np.zeros(6), *(((p - place.translation) @ axes).max(axis=0) for p in points)], axis=0)
        way = place.translation + away * APART
        if np.linalg.norm(way) <= 3 * APART:  # at the joint itself: to where a hand is, else as the arm goes
            way = axes[:, int(np.argmax(reach))] if reach.max() > LONG else away
        k = int(np.argmax(axes.T @ way))
        axis, ahead = axes[:, k], float(reach[k])
        local = place.rotation.T @ (axis * ahead)
        return Striker(name=name, frame=str(tool.name), point=np.round(local, 4) + 0.0), axis
    parent, above = first_link(model, limb.tip)
    frames = [f.placement.translation for f in model.frames if f.parentJoint == limb.tip]
    axis = _axis(model, limb, points, frames, away)
    everything = np.concatenate([*points, np.array(frames).reshape(-1, 3)])
    point = axis * max(float((everything @ axis).max()), 0.0)
    return Striker(name=name, frame=parent, point=np.round(above.actInv(point), 4) + 0.0), axis


def find_edge(
    model: pin.Model, limb: Limb, name: str, pieces: Mapping[int, tuple[Piece, ...]], axis: Array, q: Array
) -> tuple[Striker, Array]:
    """The side of a limb's last link that is below in a configuration (nq,), and its direction (3,), in the
    joint's frame.

    axis (3,) : in which the link points; the direction is square to it.

    Raises
    ------
    InputError : the link has no shape.
    """
    points = [p.vertices for p in pieces.get(limb.tip, ())]
    if not points:
        raise InputError(f"the link of {model.names[limb.tip]} has no shape, so no edge to strike with")
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    below = -np.array(data.oMi[limb.tip].rotation)[2]
    below = _straightened(below - (below @ axis) * axis)
    vertices = np.concatenate(points)
    deep = vertices @ below
    edge = vertices[deep > deep.max() - EDGE].mean(axis=0)
    edge += (deep.max() - edge @ below) * below
    parent, above = first_link(model, limb.tip)
    return Striker(name=name, frame=parent, point=np.round(above.actInv(edge), 4) + 0.0), below


def first_link(model: pin.Model, joint: int) -> tuple[str, pin.SE3]:
    """The first link that a joint moves, and its placement."""
    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
            return str(frame.name), frame.placement
    return str(model.names[joint]), pin.SE3.Identity()


def _tool(model: pin.Model, joint: int) -> pin.Frame | None:
    """The frame of a tool that a joint moves, the surest; None: there is none."""
    kinds = (pin.FrameType.BODY, pin.FrameType.OP_FRAME)
    own = [f for f in model.frames if f.parentJoint == joint and f.type in kinds]
    return next((f for pattern in _TOOLS for f in own if pattern.search(str(f.name))), None)


def _away(model: pin.Model, limb: Limb) -> Array:
    """The direction (3,) from the arm to its last joint, in that joint's frame, where the arm is straight."""
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    tip = data.oMi[limb.tip]
    for joint in reversed(limb.path[:-1]):
        step = tip.translation - data.oMi[joint].translation
        if np.linalg.norm(step) > APART:
            return np.asarray(tip.rotation.T @ step / np.linalg.norm(step))
    return np.array([0.0, 0.0, 1.0])


def _axis(
    model: pin.Model, limb: Limb, points: Sequence[Array], frames: Sequence[Array], away: Array
) -> Array:
    """The direction (3,) in which a last link points."""
    middle = np.mean([(p.max(axis=0) + p.min(axis=0)) / 2 for p in points], axis=0) if points else np.zeros(3)
    axis = middle if np.linalg.norm(middle) > APART else np.array(max(frames, key=np.linalg.norm))
    size = float(np.linalg.norm(axis))
    if size < 1e-6:  # nothing sticks out: on as the link before does
        return away
    axis = axis / size
    turns = axis_of(model, limb.tip).subspace[3:]  # zero of a joint that slides
    onwards = float(axis @ away)
    if onwards < -STRAIGHT and (size < SHORT or abs(float(axis @ turns)) > ROLLS):
        axis = -axis  # the link ends at its joint, and its shapes are behind that
    elif onwards < -ASLANT and size < SHORT:
        axis = turns * np.sign(turns @ away) if abs(turns @ away) > ASLANT else away
    return _straightened(axis)


def _straightened(axis: Array) -> Array:
    """The unit vector (3,) along an axis of the frame, where that is near."""
    axis = axis / np.linalg.norm(axis)
    k = int(np.argmax(np.abs(axis)))
    return np.eye(3)[k] * np.sign(axis[k]) if abs(axis[k]) > STRAIGHT else np.asarray(axis)
