"""Visual shapes of a robot and of the scene around it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from impactopt.arrays import Array
from impactopt.bodies.convex_hulls import ROD, bare_joints, inertia_box, is_too_large, tool_solids
from impactopt.bodies.file_shapes import geoms_of, numbers, shapes_of, urdf_elements
from impactopt.bodies.solids import Solid, box, cylinder, joined, sphere
from impactopt.bodies.world import WorldBody
from impactopt.robots.attachments import Tool
from impactopt.robots.robot import Robot, Striker

GREY = (0.72, 0.74, 0.77)  # default colour
JOINT, BONE = (0.35, 0.37, 0.40), (0.55, 0.57, 0.60)
THIN, THICK = ROD, 0.028  # [m] radii of a bone, and of the ball at its joint


@dataclass(frozen=True, kw_only=True)
class Visual:
    """Solid in the frame of a joint, by index, with its colour (red, green, blue) in [0, 1]."""

    joint: int
    solid: Solid
    colour: tuple[float, float, float] = GREY


def visuals_of(robot: Robot) -> list[Visual]:
    """Visual shapes of the robot; tools are rods, with a bar across the end of a hammer.

    Boxes of the links' inertia and bones between the joints replace shapes that are too large or whose meshes
    are missing, and all shapes of a robot without any.
    """
    found = _from_urdf(robot) if robot.mjcf is None else _from_mjcf(robot, robot.mjcf)
    known = {visual.joint for visual in found}
    found = [v for v in found if not is_too_large(robot.model, v.joint, v.solid.vertices)]
    if not found:
        return _from_inertia(robot)
    bare = bare_joints(robot, known) | (known - {visual.joint for visual in found})
    found += [visual for visual in _from_inertia(robot) if visual.joint in bare] if bare else []
    return [*found, *(visual for tool in robot.tools for visual in _of_tool(robot, tool))]


def joined_visuals(robot: Robot) -> dict[tuple[int, tuple[float, float, float]], Solid]:
    """Visual shapes of the robot, joined to one solid for each joint and colour."""
    groups: dict[tuple[int, tuple[float, float, float]], list[Solid]] = {}
    for visual in visuals_of(robot):
        groups.setdefault((visual.joint, visual.colour), []).append(visual.solid)
    return {key: joined(solids) for key, solids in groups.items()}


def _from_urdf(robot: Robot) -> list[Visual]:
    colours = {m.get("name", ""): _colour(m) for m in urdf_elements(robot.urdf, "material")}
    found = []
    for shape in shapes_of(robot.model, robot.urdf, "visual"):
        material = shape.element.find("material")
        colour = None if material is None else _colour(material) or colours.get(material.get("name", ""))
        found.append(Visual(joint=shape.joint, solid=shape.solid, colour=colour or GREY))
    return found


def _from_mjcf(robot: Robot, mjcf: str) -> list[Visual]:
    """Visual geoms of each link; its collision geoms if it has none."""
    geoms = geoms_of(robot.model, mjcf)
    seen = {geom.link for geom in geoms if not geom.collides}
    return [
        Visual(joint=geom.joint, solid=geom.solid, colour=geom.colour)
        for geom in geoms
        if not geom.collides or geom.link not in seen
    ]


def _colour(material: ElementTree.Element) -> tuple[float, float, float] | None:
    """Colour of a <material>; None if it has none, or none that can be read."""
    colour = material.find("color")
    try:
        red, green, blue, _ = numbers("" if colour is None else colour.get("rgba", ""), 4).tolist()
    except ValueError:
        return None
    return red, green, blue


def _from_inertia(robot: Robot) -> list[Visual]:
    model, found = robot.model, []
    for j in range(1, model.njoints):
        inertia = model.inertias[j]
        if inertia.mass > 0:
            found.append(Visual(joint=j, solid=inertia_box(inertia)))
        parent = int(model.parents[j])
        if parent or not robot.floating:
            found.append(Visual(joint=j, solid=sphere(THICK), colour=JOINT))
        # No bone to the world, nor to a free-flyer's joint.
        if parent > robot.floating:
            found += _bone(parent, np.array(model.jointPlacements[j].translation))
    return found + _bones_to(robot, robot.strikers.values())


def _of_tool(robot: Robot, tool: Tool) -> Iterator[Visual]:
    """Visuals of a tool, with a ball at a rod's end."""
    frame = robot.model.frames[robot.model.getFrameId(tool.own_frame)]
    solids = tool_solids(tool)
    if tool.bar is None:
        solids.append(sphere(THIN).moved(np.eye(3), np.asarray(tool.head)))
    for solid in solids:
        moved = solid.moved(frame.placement.rotation, frame.placement.translation)
        yield Visual(joint=int(frame.parentJoint), solid=moved, colour=JOINT)


def _bones_to(robot: Robot, strikers: Iterable[Striker]) -> list[Visual]:
    """Bones from the frame of each striker to its striking point, with a ball there."""
    model, found = robot.model, []
    for striker in strikers:
        frame = model.frames[model.getFrameId(striker.frame)]
        joint, place = int(frame.parentJoint), frame.placement
        ball = sphere(THIN).moved(np.eye(3), place.act(striker.point))
        rod = _bone(joint, np.array(striker.point))
        found += [replace(v, solid=v.solid.moved(place.rotation, place.translation)) for v in rod]
        found.append(Visual(joint=joint, solid=ball, colour=JOINT))
    return found


def _bone(joint: int, end: Array) -> list[Visual]:
    length = float(np.linalg.norm(end))
    if length < THIN:
        return []
    solid = cylinder(THIN, length).moved(np.eye(3), np.array([0.0, 0.0, length / 2]))
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end / length).matrix()
    return [Visual(joint=joint, solid=solid.moved(turn, np.zeros(3)), colour=BONE)]


LARGE = 0.6  # [m] fixed targets with a longer side are drawn transparent, as they would hide the robot


class Hinge(NamedTuple):
    """Line through ``place`` (3,) [m] along ``axis`` (3,); ``arm`` [m] is its distance from the hit point."""

    place: Array
    axis: Array
    arm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Solid in the world, at its place before contact.

    kind : "target" for a target that moves; "held" for its supports, or a fixed target; "obstacle".
    moves : moves along the normal with the target; with a hinge it turns about that instead.
    clear : is drawn transparent.
    """

    kind: str
    solid: Solid
    moves: bool = False
    hinge: Hinge | None = None
    clear: bool = False

    def placed(self, travel: float, normal: Array, aside: Array | float = 0.0) -> Array:
        """Its vertices (k, 3) [m] after a `travel` [m] of the target along the normal, and `aside` across."""
        vertices = self.solid.vertices
        if self.hinge is None:
            return vertices + travel * normal + aside if self.moves else vertices
        turn = Rotation.from_rotvec(np.arctan2(travel, self.hinge.arm) * self.hinge.axis).as_matrix()
        return np.asarray((vertices - self.hinge.place) @ turn.T + self.hinge.place)


def surroundings_of(world: Sequence[WorldBody]) -> list[Part]:
    """Drawable parts of `ImpactProblem.world`: all except the ground and the cores of targets.

    A board on two supports is drawn as two halves. Each turns about the inner edge of its support as
    far as the middle has moved: the board bends a little, and opens when it breaks.
    """
    parts: list[Part] = []
    for body in world:
        if body.ground or body.core:
            continue
        supports = [b for b in world if b.of_target and not (b.moves or b.core)] if body.before else []
        if supports:
            parts += [_half(body, support) for support in supports]
            continue
        kind = "target" if body.moves else "held" if body.of_target else "obstacle"
        clear = not body.of_target or (not body.moves and 2 * float(body.half.max()) > LARGE)
        parts.append(Part(kind=kind, solid=body.solid, moves=body.moves, clear=clear))
    return parts


def _half(board: WorldBody, support: WorldBody) -> Part:
    """Half of a board that lies on this support."""
    # Half sides; `box` takes sides, so a width of `wide` is half of the board.
    wide, high, thick = board.half
    # In the board's axes: across, up, deep (`target_bodies`).
    across, _, _ = board.rotation.T @ (support.place - board.place)
    side = float(np.sign(across))
    edge = float(abs(across) - support.half[0])
    middle, inner = np.array([side * wide / 2, 0.0, 0.0]), np.array([side * edge, 0.0, thick])
    solid = box([wide, 2 * high, 2 * thick]).moved(board.rotation, board.place + board.rotation @ middle)
    hinge = Hinge(board.place + board.rotation @ inner, side * board.rotation[:, 1], edge)
    return Part(kind="target", solid=solid, moves=True, hinge=hinge)
