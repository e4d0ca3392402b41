"""Shapes of links in a robot's URDF or MJCF."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.solids import Solid, box, capsule, cylinder, find_mesh, lack_of, read_mesh, sphere
from impactopt.errors import FARTHEST, InputError
from impactopt.robots.mjcf import compile_mjcf
from impactopt.robots.urdf import parse_urdf


@dataclass(frozen=True, kw_only=True)
class LinkShape:
    """Shape of a link in a URDF: ``joint`` of the model that moves it, ``solid`` in that joint's frame [m].

    element : the <collision> or <visual>.
    """

    link: str
    joint: int
    solid: Solid
    element: ElementTree.Element


def urdf_elements(urdf: str | None, tag: str) -> list[ElementTree.Element]:
    """Elements of a URDF with this tag; none without a URDF, or if it cannot be read."""
    try:
        return [] if urdf is None else _parsed(urdf, Path(urdf).read_bytes()).findall(tag)
    except (OSError, InputError):
        return []


@lru_cache(maxsize=1)
def _parsed(urdf: str, _content: bytes) -> ElementTree.Element:
    return parse_urdf(urdf)


def shapes_of(
    model: Any, urdf: str | None, kind: str, *, without: Collection[str] = (), far: bool = False
) -> Iterator[LinkShape]:
    """Readable shapes of a ``kind``, "collision" or "visual", of the links that a pin.Model has.

    Malformed shapes, and meshes that are missing or damaged, are left out.

    without : names of links to leave out.  far : those that are too far to be part of a robot, which are left
        out else.
    """
    for link in urdf_elements(urdf, "link"):
        name = link.get("name", "")
        if name in without or not model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        for element in link.findall(kind):
            solid = _urdf_solid(element.find("geometry"), Path(str(urdf)))
            origin = _origin(element.find("origin"))
            if solid is not None and origin is not None:
                # A link's frame may be fixed to the joint at a distance, as Pinocchio
                # merges links of fixed joints.
                place = frame.placement * origin
                moved = solid.moved(place.rotation, place.translation)
                # as are those whose vertices are not finite
                if bool((np.abs(moved.vertices) <= FARTHEST).all()) is not far:
                    yield LinkShape(link=name, joint=int(frame.parentJoint), solid=moved, element=element)


def lost_meshes(model: Any, urdf: str | None, *, without: Collection[int] = ()) -> dict[int, dict[str, str]]:
    """Missing or unreadable meshes of a URDF with the reason, by the joint that moves their link.

    without : joints to leave out.
    """
    lost: dict[int, dict[str, str]] = {}
    for link in urdf_elements(urdf, "link"):
        name = link.get("name", "")
        if not model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        if int(frame.parentJoint) in without:
            continue
        # Of collision and visual shapes alike.
        for mesh in link.iterfind("*/geometry/mesh"):
            file = mesh.get("filename", "")
            if reason := lack_of(file, Path(str(urdf))):
                lost.setdefault(int(frame.parentJoint), {})[file] = reason
    return lost


def malformed_shapes(urdf: str | None) -> Iterator[tuple[str, ElementTree.Element]]:
    """Links of a URDF, and the element of each of their shapes whose numbers cannot be read or are negative,
    or whose kind is unknown.
    """
    for link in urdf_elements(urdf, "link"):
        for element in (*link.findall("collision"), *link.findall("visual")):
            origin = element.find("origin")
            if origin is not None and _origin(origin) is None:
                yield link.get("name", ""), origin
            shape = element.find("geometry/*")
            if shape is None or ":" in shape.tag:  # of another tool
                continue
            try:
                if shape.tag == "mesh":  # its file may be lost for reasons of its own
                    numbers(shape.get("scale", "1 1 1"))
                elif _primitive(shape) is None:
                    raise ValueError(shape.tag)
            except (ValueError, KeyError):
                yield link.get("name", ""), shape


def numbers(text: str, count: int = 3) -> Array:
    """Finite numbers of a text, separated by spaces; ValueError unless there are `count` of them."""
    found = np.array([float(word) for word in text.split()])
    if len(found) != count or not np.all(np.isfinite(found)):
        raise ValueError(f"{text!r} are no {count} finite numbers")
    return found


def _urdf_solid(geometry: ElementTree.Element | None, urdf: Path) -> Solid | None:
    """Solid of a <geometry>; None if it has none, or its mesh cannot be read."""
    for shape in geometry if geometry is not None else ():
        with contextlib.suppress(ValueError, RuntimeError, OSError, KeyError):
            if shape.tag == "mesh":
                scale = numbers(shape.get("scale", "1 1 1"))
                return read_mesh(find_mesh(shape.attrib["filename"], urdf), scale)
            if (solid := _primitive(shape)) is not None:
                return solid
    return None


def _primitive(shape: ElementTree.Element) -> Solid | None:
    """Solid of a shape that is no mesh; None of an unknown kind.

    Raises
    ------
    ValueError, KeyError : its numbers cannot be read, or are negative; one is missing.
    """

    def sizes(key: str, count: int = 1) -> Array:
        found = numbers(shape.attrib[key], count)
        if (found < 0).any():
            raise ValueError(f"{shape.attrib[key]!r} is negative")
        return found

    if shape.tag == "box":
        return box(sizes("size", 3))
    if shape.tag == "sphere":
        return sphere(sizes("radius").item())
    if shape.tag in ("cylinder", "capsule"):
        make = cylinder if shape.tag == "cylinder" else capsule
        return make(sizes("radius").item(), sizes("length").item())
    return None


def _origin(origin: ElementTree.Element | None) -> Any:
    """Placement (pin.SE3) of an <origin>, the identity without one; None if it is malformed."""
    if origin is None:
        return pin.SE3.Identity()
    try:
        xyz, rpy = (numbers(origin.get(key, "0 0 0")) for key in ("xyz", "rpy"))
    except ValueError:
        return None
    return pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)


@dataclass(frozen=True, kw_only=True)
class Geom:
    """Geom of a body in an MJCF: ``joint`` of the model that moves it, ``solid`` in that joint's frame [m].

    collides : it is a collision geom, else a visual one.  colour : red, green, blue.
    """

    link: str
    joint: int
    solid: Solid
    collides: bool
    colour: tuple[float, float, float]


def geoms_of(model: Any, mjcf: str) -> list[Geom]:
    """Geoms of a pin.Model's bodies; planes, height fields and signed distance fields are left out."""
    return list(_geoms(model, compile_mjcf(mjcf)))


def _geoms(model: Any, mj: Any) -> Iterator[Geom]:
    for g in range(mj.ngeom):
        name = mj.body(int(mj.geom_bodyid[g])).name or f"body{int(mj.geom_bodyid[g])}"
        solid = _mjcf_solid(mj, g)
        if solid is None or not model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        # MuJoCo's quaternions have w first, as pin.Quaternion's constructor; its `coeffs` has it last.
        w, x, y, z = (float(a) for a in mj.geom_quat[g])
        place = frame.placement * pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.array(mj.geom_pos[g]))
        material = int(mj.geom_matid[g])
        red, green, blue, _ = (mj.geom_rgba[g] if material < 0 else mj.mat_rgba[material]).tolist()
        yield Geom(
            link=name,
            joint=int(frame.parentJoint),
            solid=solid.moved(place.rotation, place.translation),
            collides=bool(mj.geom_contype[g] or mj.geom_conaffinity[g]),
            colour=(red, green, blue),
        )


def _mjcf_solid(mj: Any, g: int) -> Solid | None:
    """Solid of a geom in its own frame; None for planes, height fields and signed distance fields."""
    import mujoco

    kind, kinds = int(mj.geom_type[g]), mujoco.mjtGeom
    a, b, c = (float(x) for x in mj.geom_size[g])
    if kind == int(kinds.mjGEOM_SPHERE):
        return sphere(a)
    # MuJoCo's sizes are halves; a capsule's length is that of its cylinder.
    if kind == int(kinds.mjGEOM_CAPSULE):
        return capsule(a, 2 * b)
    if kind == int(kinds.mjGEOM_CYLINDER):
        return cylinder(a, 2 * b)
    if kind == int(kinds.mjGEOM_BOX):
        return box([2 * a, 2 * b, 2 * c])
    if kind == int(kinds.mjGEOM_ELLIPSOID):
        ball = sphere(1.0)
        return Solid(vertices=ball.vertices * [a, b, c], triangles=ball.triangles)
    if kind == int(kinds.mjGEOM_MESH):
        m = int(mj.geom_dataid[g])
        points, faces = int(mj.mesh_vertadr[m]), int(mj.mesh_faceadr[m])
        return Solid(
            vertices=np.array(mj.mesh_vert[points : points + mj.mesh_vertnum[m]], dtype=np.float64),
            triangles=np.array(mj.mesh_face[faces : faces + mj.mesh_facenum[m]], dtype=np.intp),
        )
    return None
