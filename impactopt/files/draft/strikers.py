"""Striking points at the ends of limbs, from tool frames, else from the shapes of the last links."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.convex_hulls import Piece, inertia_box, is_far
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb
from impactopt.robots.attachments import Sole, Striker
from impactopt.robots.model import axis_of

# names of tool frames by ROS-Industrial (tool0), manufacturers and MuJoCo Menagerie (sites), the most
# reliable first
_TOOLS = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"(^|_)tcp($|_)",
        r"^tool0$|(?<!ft)(^|_)tool(_?(0|tip|frame|point|center|centre|link))?$",
        r"link_eef$|(^|_)eef?(_?(link|frame|site|tip))?$|end_?effector",
        r"grip_?site|gripper_?(frame|tip|cent(er|re))|pinch|attachment_?site|(^|_)grasp",
    )
)
APART = 0.01  # [m] least distance of two points that defines a direction
SHORT = 0.06  # [m]: a link so short, such as a flange, does not fold back over the link before it
EDGE = 5e-3  # [m]: the part so near to a hand's lowest plane is its edge, to a foot's front its toe
TOE = 0.02  # [m] height of a toe's striking point above the sole, if the toe has such a point
LONG = 0.12  # [m] least length of a hand from a tool's frame
# least cosines of angles between
ROLLS = np.cos(np.radians(25))  # a joint's axis and a link that rolls about it
ASLANT = np.cos(np.radians(60))  # the arm's reverse direction and a link behind its joint, not beside it
STRAIGHT = np.cos(np.radians(20))  # a limb and an axis of its frame that it is taken to be along


def find_striker(
    model: pin.Model, limb: Limb, name: str, pieces: Mapping[int, tuple[Piece, ...]]
) -> tuple[Striker, Array]:
    """Striker at the end of a limb, and the direction (3,) of its last link, in that joint's frame.

    The striking point is on an axis of the tool frame, if there is one; else on a line from the joint through
    the centre of the last link's shapes. It is at the end of the shapes, away from the arm. For a tool frame
    at the joint itself it is at the end of a long hand. Shapes that are far from their link are replaced by
    the box of its inertia.
    """
    own = pieces.get(limb.tip, ())
    points = [p.vertices for p in own if not is_far(model, p, own)]
    if own and not points:
        points = [inertia_box(model.inertias[limb.tip]).vertices]
    # a link without shapes reaches to its centre of mass at least
    ends = points or [np.array(model.inertias[limb.tip].lever)[None]]
    away, tool = _away(model, limb), _tool(model, limb.tip)
    if tool is not None:
        place = tool.placement
        axes = np.column_stack([place.rotation, -place.rotation])
        reach = np.max([np.zeros(6), *(((p - place.translation) @ axes).max(axis=0) for p in ends)], axis=0)
        way = place.translation + away * APART
        if np.linalg.norm(way) <= 3 * APART:  # at the joint itself: towards a long hand, else along the arm
            way = axes[:, int(np.argmax(reach))] if reach.max() > LONG else away
        k = int(np.argmax(axes.T @ way))
        axis, ahead = axes[:, k], float(reach[k])
        local = place.rotation.T @ (axis * ahead)
        return Striker(name=name, frame=str(tool.name), point=np.round(local, 4) + 0.0), axis
    parent, above = first_link(model, limb.tip)
    frames = [f.placement.translation for f in model.frames if f.parentJoint == limb.tip]
    axis = _axis(model, limb, points, frames if points else [*frames, *ends[0]], away)
    everything = np.concatenate([*ends, np.array(frames).reshape(-1, 3)])
    point = axis * max(float((everything @ axis).max()), 0.0)
    return Striker(name=name, frame=parent, point=np.round(above.actInv(point), 4) + 0.0), axis


def find_edge(
    model: pin.Model, limb: Limb, name: str, pieces: Mapping[int, tuple[Piece, ...]], axis: Array, q: Array
) -> tuple[Striker, Array]:
    """Striker on the lower side of a limb's last link in a configuration (nq,), and the direction (3,) of
    that side, in the joint's frame.

    axis (3,) : direction of the link, to which that of the side is perpendicular.

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


def find_toe(model: pin.Model, joint: int, sole: Sole, pieces: Mapping[int, tuple[Piece, ...]]) -> Striker:
    """Striker at the front of a foot, which may be ahead of its sole.

    joint : that moves the foot, whose first link is the sole's parent.
    """
    parent, above = first_link(model, joint)
    place = above * sole.placement
    points = np.concatenate([p.vertices for p in pieces[joint]])
    points = (points - place.translation) @ place.rotation
    x, y, z = points[points[:, 0] > points[:, 0].max() - EDGE].T
    front = np.array([x.max(), (y.min() + y.max()) / 2, np.clip(TOE, z.min(), z.max())])
    return Striker(name=f"{sole.name}_toe", frame=parent, point=np.round(sole.placement.act(front), 4) + 0.0)


def first_link(model: pin.Model, joint: int) -> tuple[str, pin.SE3]:
    """The first link of a joint, and its placement there."""
    for frame in model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
            return str(frame.name), frame.placement
    return str(model.names[joint]), pin.SE3.Identity()


def _tool(model: pin.Model, joint: int) -> pin.Frame | None:
    """The most reliable tool frame of a joint; None if there is none."""
    kinds = (pin.FrameType.BODY, pin.FrameType.OP_FRAME)
    own = [f for f in model.frames if f.parentJoint == joint and f.type in kinds]
    return next((f for pattern in _TOOLS for f in own if pattern.search(str(f.name))), None)


def _away(model: pin.Model, limb: Limb) -> Array:
    """Direction (3,) of the zero posture's arm towards its last joint, in that joint's frame."""
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    tip = data.oMi[limb.tip]
    for joint in reversed(limb.path[:-1]):
        step = tip.translation - data.oMi[joint].translation
        if np.linalg.norm(step) > APART:
            return np.asarray(tip.rotation.T @ step / np.linalg.norm(step))
    slides = axis_of(model, limb.tip).subspace[:3]  # zero for a revolute joint
    if not slides.any():
        return np.array([0.0, 0.0, 1.0])
    # a ram pushes along its joint, ahead or down, whichever way the joint's axis points
    return np.array(slides if (tip.rotation @ slides) @ (1.0, 0.0, -1.0) >= 0 else -slides)


def _axis(
    model: pin.Model, limb: Limb, points: Sequence[Array], frames: Sequence[Array], away: Array
) -> Array:
    """Direction (3,) of a limb's last link, in its joint's frame.

    points, frames : vertices of its shapes, (k, 3) each, and origins of its frames.  away : as of `_away`.
    """
    middle = np.mean([(p.max(axis=0) + p.min(axis=0)) / 2 for p in points], axis=0) if points else np.zeros(3)
    axis = middle if np.linalg.norm(middle) > APART else np.array(max(frames, key=np.linalg.norm))
    size = float(np.linalg.norm(axis))
    if size < 1e-6:  # no shapes or frames away from the joint: the direction of the link before
        return away
    axis = axis / size
    turns = axis_of(model, limb.tip).subspace[3:]  # zero for a prismatic joint
    onwards = float(axis @ away)
    if onwards < -STRAIGHT and (size < SHORT or abs(float(axis @ turns)) > ROLLS):
        axis = -axis  # the link ends at its joint, with its shapes behind
    elif onwards < -ASLANT and size < SHORT:
        axis = turns * np.sign(turns @ away) if abs(turns @ away) > ASLANT else away
    return _straightened(axis)


def _straightened(axis: Array) -> Array:
    """The unit vector (3,) of a direction, rounded to an axis of the frame if that is near."""
    axis = axis / np.linalg.norm(axis)
    k = int(np.argmax(np.abs(axis)))
    return np.eye(3)[k] * np.sign(axis[k]) if abs(axis[k]) > STRAIGHT else np.asarray(axis)
