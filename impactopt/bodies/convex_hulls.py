"""Convex hulls of a robot's links, from its files or the links' inertia, and checks of their plausibility."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from impactopt.arrays import Array, Index
from impactopt.bodies.file_shapes import Geom, LinkShape, geoms_of, lost_meshes, shapes_of
from impactopt.bodies.solids import Solid, cached_arrays, cylinder, rounded_box
from impactopt.robots.model import principal_moments
from impactopt.robots.robot import Robot, Tool
from impactopt.robots.tools import without

ROD = 0.012  # [m] radius of a tool
_SHORTEST_SIDE = 0.02  # [m] of a box of inertia
# [kg/m3] Least mean density of a link, half of a light foam's. The inertia of many files, such as 0.001 kg m2
# for 10 g, stands for none: its box, of 0.8 m, would be in the way of any motion.
LEAST_DENSITY = 10.0
# a shape is too large above both this size [m] and this multiple of the box of its inertia
_LARGE, _LARGE_RATIO = 1.0, 8.0
# length of collision shapes, over that of the visual ones, below which they only stand for a link
STAND_IN = 0.5
MAX_PIECES = 8  # of a link; more, as of one that is exported screw by screw, become one
_MAX_NEIGHBOURS = 200  # of a vertex: coal counts them in a byte
_MERGE_DISTANCE = 1e-4  # [m] of vertices of hulls with more neighbours; doubled until there are few enough


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """Convex hull of a shape of a link.

    joint : index in the model of the joint that moves it.
    vertices (k, 3) [m], triangles (m, 3) : in the joint's frame, counter-clockwise seen from outside.
    assumed : it is a box of the link's inertia, as no shape is known.
    """

    link: str
    joint: int
    vertices: Array
    triangles: Index
    assumed: bool = False

    @cached_property
    def shape(self) -> Any:
        """The hull in coal."""
        return convex(self.vertices, self.triangles)

    def depth(self, point: Array) -> float:
        """Distance [m] of a point (3,) inside the hull to its surface; < 0 outside."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        out = np.cross(b - a, c - a)
        lengths = np.linalg.norm(out, axis=1)
        flat = lengths <= 1e-12  # [m2] facets without area have no normal
        return float(np.min((((a - point) * out).sum(axis=1) / np.where(flat, 1.0, lengths))[~flat]))


def convex(vertices: Array, triangles: Index) -> Any:
    """Hull as a coal.Convex."""
    points, facets = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    points.extend(list(vertices))
    facets.extend([coal.Triangle(*t) for t in triangles.tolist()])
    return coal.Convex(points, facets)


def pieces_of(robot: Robot, known: Sequence[Piece] | None = None) -> tuple[tuple[Piece, ...], str]:
    """Pieces of a robot, and a description of their source; known : its `file_pieces`, if already read.

    They are hulls of the collision shapes in its URDF or MJCF, or of the visual shapes of links without
    collision shapes; one hull for a link of many shapes. Rounded boxes of the links' inertia replace shapes
    that are too large or whose meshes are missing, and all shapes of a robot without any. Tools are rods to
    their heads.
    """
    known = file_pieces(robot) if known is None else known
    found = [piece for piece in known if not is_too_large(robot.model, piece.joint, piece.vertices)]
    source = f"collision shapes of its {'URDF' if robot.mjcf is None else 'MJCF'}"
    if not found:
        found, source = list(_from_inertia(robot)), "boxes of its links' inertia"
    else:
        bare = bare_joints(robot, {piece.joint for piece in known})
        # A joint that keeps one plausible shape needs no box.
        large = {piece.joint for piece in known} - {piece.joint for piece in found}
        found += [piece for piece in _from_inertia(robot) if piece.joint in bare | large]
        source += f", and boxes of the inertia of {len(bare)} that have lost their meshes" if bare else ""
        source += f", and boxes of the inertia of {len(large)} whose shapes are too large" if large else ""
    found = [*_few(found), *(piece for tool in robot.tools for piece in _of_tool(robot, tool))]
    return tuple(found), source


def _few(pieces: Iterable[Piece]) -> Iterator[Piece]:
    """The pieces, with one hull for a link of more than `MAX_PIECES`."""
    of_links: dict[tuple[str, int], list[Piece]] = {}
    for piece in pieces:
        of_links.setdefault((piece.link, piece.joint), []).append(piece)
    for (link, joint), several in of_links.items():
        whole = None
        if len(several) > MAX_PIECES:
            vertices = np.concatenate([piece.vertices for piece in several])
            whole = _hull(link, joint, Solid(vertices=vertices, triangles=np.zeros((0, 3), dtype=np.intp)))
        yield from several if whole is None else [whole]


def file_pieces(robot: Robot) -> tuple[Piece, ...]:
    """Hulls of the shapes in a robot's URDF or MJCF, plausible or not."""
    return tuple(_from_urdf(robot) if robot.mjcf is None else _from_mjcf(robot, robot.mjcf))


def bare_joints(robot: Robot, shown: Collection[int]) -> set[int]:
    """Joints whose shapes are all missing meshes; shown : joints with at least one shape."""
    return set(lost_meshes(robot.model, robot.urdf, without=shown))


def _from_urdf(robot: Robot) -> Iterator[Piece]:
    solid = list(shapes_of(robot.model, robot.urdf, "collision"))
    # Visual shapes stand in link by link, where a link has no collision shape.
    seen = shapes_of(robot.model, robot.urdf, "visual", without={shape.link for shape in solid})
    yield from _hulls([*solid, *seen])


def _from_mjcf(robot: Robot, mjcf: str) -> Iterator[Piece]:
    geoms = geoms_of(robot.model, mjcf)
    bodied = {geom.link for geom in geoms if geom.collides}
    yield from _hulls(geom for geom in geoms if geom.collides or geom.link not in bodied)


def seen_pieces(robot: Robot, joint: int) -> tuple[Piece, ...]:
    """Hulls of shapes of a joint's links that are only seen.

    In an MJCF all visual geoms, which Unitree's files have for hands; in a URDF the visual shapes, if the
    collision shapes are much smaller: files for reinforcement learning have a ball for a forearm.
    """
    model = robot.model
    if robot.mjcf is not None:
        geoms = geoms_of(model, robot.mjcf)
        return tuple(_hulls(geom for geom in geoms if geom.joint == joint and not geom.collides))
    others = {str(frame.name) for frame in model.frames if frame.parentJoint != joint}
    solid, seen = (
        tuple(_hulls(shapes_of(model, robot.urdf, kind, without=others))) for kind in ("collision", "visual")
    )
    return seen if solid and seen and _length(solid) < STAND_IN * _length(seen) else ()


def _length(pieces: Sequence[Piece]) -> float:
    """Diagonal [m] of the box around pieces of one joint."""
    return float(np.linalg.norm(np.ptp(np.concatenate([piece.vertices for piece in pieces]), axis=0)))


def _hulls(shapes: Iterable[LinkShape | Geom]) -> Iterator[Piece]:
    """Hulls of the shapes of a file; shapes without volume are left out."""
    for shape in shapes:
        piece = _hull(shape.link, shape.joint, shape.solid)
        if piece is not None:
            yield piece


def _from_inertia(robot: Robot) -> Iterator[Piece]:
    """Boxes of the inertia of all links, without their tools."""
    model = robot.model
    of_tools = [pin.Inertia.Zero() for _ in range(model.njoints)]
    for tool in robot.tools:
        frame = model.frames[model.getFrameId(tool.own_frame)]
        own = pin.Inertia(tool.mass, tool.center, tool.inertia)
        of_tools[frame.parentJoint] += frame.placement.act(own)
    for j in range(1, model.njoints):
        inertia = model.inertias[j]
        if of_tools[j].mass > 0:
            inertia = without(inertia, of_tools[j])
        if inertia.mass > 1e-6:
            piece = _hull(model.names[j], j, inertia_box(inertia))
            if piece is not None:
                yield replace(piece, assumed=True)


def inertia_box(inertia: Any) -> Solid:
    """Rounded box of the same mass, centre and inertia, m (b^2 + c^2) / 12 about its first axis.

    If it were lighter than `LEAST_DENSITY`, it is scaled down to that.
    """
    sides, axes = inertia_sides(inertia)
    least = np.cbrt(min(inertia.mass / (np.prod(sides) * LEAST_DENSITY), 1.0))
    return rounded_box(np.maximum(least * sides, _SHORTEST_SIDE)).moved(axes, np.array(inertia.lever))


def inertia_sides(inertia: Any) -> tuple[Array, Array]:
    """Sides (3,) [m] and axes (3, 3) of the box that has a mass and an inertia."""
    _, second, axes = principal_moments(inertia.inertia)
    squares = 12.0 / inertia.mass * second  # along a side a the second moment is m a^2 / 12
    # eigh's axes may be left-handed, and a reflection would turn the solid inside out.
    axes = axes if np.linalg.det(axes) > 0 else -axes
    return np.sqrt(np.maximum(squares, _SHORTEST_SIDE**2)), axes


def _of_tool(robot: Robot, tool: Tool) -> Iterator[Piece]:
    frame = robot.model.frames[robot.model.getFrameId(tool.own_frame)]
    place = frame.placement
    for solid in tool_solids(tool):
        piece = _hull(tool.name, int(frame.parentJoint), solid.moved(place.rotation, place.translation))
        assert piece is not None  # a rod has a hull
        yield piece


def tool_solids(tool: Tool) -> list[Solid]:
    """Solids of a tool in its own frame: a rod to its striking point, or to a hammer's bar, and the bar."""
    if tool.bar is None:
        return [_rod(np.zeros(3), np.asarray(tool.head), ROD)]
    back, middle = tool.head - tool.bar, tool.head - tool.bar / 2
    return [_rod(np.zeros(3), middle, ROD), _rod(back, np.asarray(tool.head), tool.bar_width / 2)]


def _rod(start: Array, end: Array, radius: float) -> Solid:
    """Cylinder from one point to another [m]; at least 24 mm long."""
    length = max(float(np.linalg.norm(end - start)), 2 * ROD)
    # A point has no direction, and so short a rod none that matters: then it is upright.
    along = (end - start) / length if length > 2 * ROD else np.array([0.0, 0.0, 1.0])
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return cylinder(radius, length).moved(np.eye(3), np.array([0.0, 0.0, length / 2])).moved(turn, start)


_HULLS: dict[str, dict[str, Any]] = {}
_MOST_HULLS = 1000  # of some 10 kB


def _hull(link: str, joint: int, solid: Solid) -> Piece | None:
    """Hull of a solid, cached here and on disk; None if it has no volume."""
    digest = hashlib.sha256(np.round(solid.vertices, 9).tobytes() + b"thinned").hexdigest()
    # A draft reads its robot's shapes ten times.
    hull = _HULLS.get(digest)
    if hull is None:
        hull = cached_arrays("hull", digest, lambda: _hull_of(solid.vertices))
        if len(_HULLS) >= _MOST_HULLS:
            _HULLS.clear()
        _HULLS[digest] = hull
    return Piece(link=link, joint=joint, **hull) if len(hull["triangles"]) else None


def _hull_of(points: Array) -> dict[str, NDArray[Any]]:
    """Vertices and triangles of the hull of points (k, 3); empty if it has no volume."""
    near = _MERGE_DISTANCE
    while True:
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            return {"vertices": np.zeros((0, 3)), "triangles": np.zeros((0, 3), dtype=np.intp)}
        if np.bincount(hull.simplices.ravel()).max() <= _MAX_NEIGHBOURS:
            break
        # One point a cell of a grid, coarser each time, until no vertex has too many neighbours.
        points = points[np.unique(np.round(points / near), axis=0, return_index=True)[1]]
        near *= 2
    index = np.full(len(points), -1)  # of each point among the hull's vertices
    index[hull.vertices] = np.arange(len(hull.vertices))
    triangles = index[hull.simplices]
    # Qhull does not order a facet's corners: reverse those whose normal points inwards
    vertices = points[hull.vertices]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    # Qhull's equations have outward normals.
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return {"vertices": vertices, "triangles": triangles}


# [m] A shape is far from its link if its distance exceeds this and the shape's own size.
FAR = 0.1


def is_far(model: pin.Model, piece: Piece, beside: Sequence[Piece]) -> bool:
    """True if a shape is far from its link; beside : all shapes that the joint moves."""
    return distance_to_link(model, piece, beside) > max(FAR, size_of(piece))


def size_of(piece: Piece) -> float:
    """Diagonal of a shape's bounds [m]."""
    return _diagonal(piece.vertices)


def _diagonal(points: ArrayLike) -> float:
    """Diagonal of the bounds of points (k, 3) [m]."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def is_too_large(model: pin.Model, joint: int, vertices: Array) -> bool:
    """True if a shape is larger than the robot, and much larger than its link's inertia suggests.

    So are meshes in millimetres that are read as metres.
    """
    size, inertia = _diagonal(vertices), model.inertias[joint]
    if size < _LARGE or not inertia.mass:
        return False
    box = _diagonal(inertia_box(inertia).vertices)
    return size > _LARGE_RATIO * box and size > 2 * _kinematic_size(model)


def _kinematic_size(model: pin.Model) -> float:
    """Diagonal [m] of the bounds of all joints' origins, with all positions zero."""
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    return _diagonal([place.translation for place in data.oMi])


def distance_to_link(model: pin.Model, piece: Piece, beside: Sequence[Piece]) -> float:
    """Distance [m] of a shape to the nearest other feature of its link.

    Features are its joint, centre of mass, frames, child joints, and other shapes.
    """
    own = piece.joint
    places = [np.zeros(3), np.array(model.inertias[own].lever)]
    places += [
        np.array(f.placement.translation) for f in model.frames if f.parentJoint == own and _is_link(f)
    ]
    places += [
        np.array(model.jointPlacements[j].translation)
        for j in range(1, model.njoints)
        if int(model.parents[j]) == own
    ]
    # coal has no point.
    shapes = [(coal.Sphere(1e-9), coal.Transform3s(np.eye(3), place)) for place in places]
    shapes += [(other.shape, coal.Transform3s()) for other in beside if other is not piece]
    return min(_distance(piece, shape, at) for shape, at in shapes)


def _is_link(frame: pin.Frame) -> bool:
    return frame.type in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT)


def _distance(piece: Piece, shape: object, at: object) -> float:
    found = coal.DistanceResult()
    coal.distance(piece.shape, coal.Transform3s(), shape, at, coal.DistanceRequest(), found)
    return max(float(found.min_distance), 0.0)
