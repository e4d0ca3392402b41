"""What a robot looks like: the shapes in its URDF, or, where there is none, boxes of its links' inertia."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.report.solids import Solid, box, cylinder, rounded_box, sphere
from impactopt.robot import Robot, Striker

__all__ = ["Visual", "visuals_of"]

Array = NDArray[np.float64]
GREY = (0.72, 0.74, 0.77)  # of what has no colour of its own
JOINT, BONE = (0.35, 0.37, 0.40), (0.55, 0.57, 0.60)
THIN, THICK = 0.012, 0.028  # [m] radii of a bone, and of the ball at its joint
SIDE = 0.02  # [m] least side of a box of inertia


@dataclass(frozen=True, kw_only=True)
class Visual:
    """A solid in the frame of the joint of that index, and its colour (red, green, blue) in [0, 1]."""

    joint: int
    solid: Solid
    colour: tuple[float, float, float] = GREY


def visuals_of(robot: Robot) -> list[Visual]:
    """The robot's visual shapes; links whose mesh files are missing or damaged are left out.

    Tools are rods. If nothing is left, boxes of the links' inertia, and bones between the joints.
    """
    found = [] if robot.urdf is None else _from_urdf(robot, Path(robot.urdf))
    tools = robot.source.tools if robot.source is not None else ()
    return [*found, *_bones_to(robot, [tool.striker for tool in tools])] if found else _from_inertia(robot)


def _from_urdf(robot: Robot, urdf: Path) -> list[Visual]:
    try:
        root = ElementTree.parse(urdf).getroot()
    except (OSError, ElementTree.ParseError):
        return []
    colours = {m.get("name", ""): _colour(m) for m in root.findall("material")}
    model, found = robot.model, []
    for link in root.findall("link"):
        if not model.existFrame(link.get("name", ""), pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(link.get("name", ""), pin.FrameType.BODY)]
        for visual in link.findall("visual"):
            solid = _solid(visual.find("geometry"), urdf)
            if solid is None:
                continue
            material = visual.find("material")
            colour = None if material is None else _colour(material) or colours.get(material.get("name", ""))
            place = frame.placement * _origin(visual.find("origin"))
            found.append(
                Visual(
                    joint=int(frame.parentJoint),
                    solid=solid.moved(place.rotation, place.translation),
                    colour=colour or GREY,
                )
            )
    return found


def _solid(geometry: ElementTree.Element | None, urdf: Path) -> Solid | None:
    """The solid of a <geometry>; None if it is none, or its mesh cannot be read."""
    for shape in geometry if geometry is not None else ():
        with contextlib.suppress(ValueError, RuntimeError, OSError, KeyError):
            if shape.tag == "box":
                return box(_numbers(shape.attrib["size"]))
            if shape.tag == "cylinder":
                return cylinder(float(shape.attrib["radius"]), float(shape.attrib["length"]))
            if shape.tag == "sphere":
                return sphere(float(shape.attrib["radius"]))
            if shape.tag == "mesh":
                scale = _numbers(shape.get("scale", "1 1 1"))
                return read_mesh(find_mesh(shape.attrib["filename"], urdf), scale)
    return None


def find_mesh(name: str, urdf: Path) -> Path:
    """The file of a mesh: a path from the URDF, or package://NAME/..., where a folder above it holds NAME.

    Raises
    ------
    FileNotFoundError : there is none.
    """
    path = Path(name.removeprefix("package://").removeprefix("file://"))
    above = [*urdf.resolve().parents]
    places = [folder / path for folder in above]
    if name.startswith("package://"):  # the folder may be called otherwise than the package
        places += [folder.joinpath(*path.parts[1:]) for folder in above]
    for place in places if not path.is_absolute() else [path]:
        if place.is_file():
            return place
    raise FileNotFoundError(name)


def read_mesh(path: Path, scale: Array) -> Solid:
    """The triangles of a mesh file: STL, or another kind that coal reads, such as Collada and OBJ."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if path.suffix.lower() == ".stl" and len(data) == 84 + 50 * count:  # binary; coal takes seconds for it
        facets = np.frombuffer(data, offset=84, dtype=[("at", "<f4", (4, 3)), ("attribute", "<u2")])
        vertices = facets["at"][:, 1:].reshape(-1, 3).astype(float)
        return Solid(vertices=scale * vertices, triangles=np.arange(3 * count).reshape(-1, 3))
    mesh = coal.MeshLoader().load(str(path), scale)
    corners = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return Solid(
        vertices=np.array(mesh.vertices()), triangles=np.array([[t[0], t[1], t[2]] for t in corners])
    )


def _origin(origin: ElementTree.Element | None) -> pin.SE3:
    if origin is None:
        return pin.SE3.Identity()
    xyz, rpy = (_numbers(origin.get(key, "0 0 0")) for key in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)


def _colour(material: ElementTree.Element) -> tuple[float, float, float] | None:
    colour = material.find("color")
    if colour is None:
        return None
    red, green, blue, *_ = _numbers(colour.get("rgba", "")).tolist()
    return red, green, blue


def _numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])


def _from_inertia(robot: Robot) -> list[Visual]:
    model, found = robot.model, []
    for j in range(1, model.njoints):
        inertia = model.inertias[j]
        if inertia.mass > 0:
            found.append(Visual(joint=j, solid=_inertia_box(inertia)))
        parent = int(model.parents[j])
        if parent or not robot.floating:
            found.append(Visual(joint=j, solid=sphere(THICK), colour=JOINT))
        if parent > robot.floating:
            found += _bone(parent, np.array(model.jointPlacements[j].translation))
    return found + _bones_to(robot, robot.strikers.values())


def _bones_to(robot: Robot, strikers: Iterable[Striker]) -> list[Visual]:
    """From the frame that each is given in to the striking point, with a ball there."""
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


def _inertia_box(inertia: pin.Inertia) -> Solid:
    """The solid box of the same mass, centre and inertia, m (b^2 + c^2) / 12 about its first axis."""
    moments, axes = np.linalg.eigh(np.array(inertia.inertia))
    squares = 6.0 / inertia.mass * (moments.sum() - 2 * moments)
    axes = axes if np.linalg.det(axes) > 0 else -axes
    sides = np.sqrt(np.maximum(squares, SIDE**2))
    return rounded_box(sides).moved(axes, np.array(inertia.lever))
