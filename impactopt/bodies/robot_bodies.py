"""Bodies of a robot: hulls of its links, pairs that can meet, and the face of a link that strikes."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt.bodies.convex_hulls import Piece, file_pieces, pieces_of
from impactopt.robots.build import parent_body
from impactopt.robots.robot import Robot

__all__ = ["Pair", "RobotBodies", "StrikerFace", "bodies_of", "distance", "striker_face", "transform"]

Array = NDArray[np.float64]
Pair = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotBodies:
    """Collision geometry of a robot.

    pieces : hulls of links, exact.  source : where they are from, in words.  too_large : shapes of its file
        that are none of them.
    """

    robot: Robot
    pieces: tuple[Piece, ...]
    source: str
    too_large: tuple[Piece, ...] = ()

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """The joints that move anything, in the model's order."""
        return tuple(sorted({piece.joint for piece in self.pieces}))

    @cached_property
    def of_joint(self) -> dict[int, tuple[Piece, ...]]:
        """The pieces that a joint moves."""
        return {j: tuple(p for p in self.pieces if p.joint == j) for j in self.joints}

    @cached_property
    def connected(self) -> tuple[Pair, ...]:
        """Each joint that moves something, with its parent if that does too: their bodies always touch."""
        parents = ((j, parent_body(self.robot.model, j)) for j in self.joints)
        return tuple((j, parent) for j, parent in parents if parent in self.joints)

    @cached_property
    def balls(self) -> dict[int, tuple[Array, float]]:
        """Bounding ball of each joint's pieces: centre (3,) and radius [m]."""
        out = {}
        for j, pieces in self.of_joint.items():
            points = np.concatenate([p.vertices for p in pieces])
            centre = (points.max(axis=0) + points.min(axis=0)) / 2
            out[j] = centre, float(np.linalg.norm(points - centre, axis=1).max())
        return out

    @cached_property
    def _names(self) -> dict[int, str]:
        def size(piece: Piece) -> float:
            return float(np.prod(np.ptp(piece.vertices, axis=0)))

        return {j: max(pieces, key=size).link for j, pieces in self.of_joint.items()}

    def name(self, joint: int) -> str:
        """Name of the body that a joint moves, in messages: its largest link."""
        return self._names[joint]

    def piece_pairs(
        self, q: Array, disabled: Iterable[frozenset[str]] = ()
    ) -> tuple[dict[Pair, tuple[tuple[Piece, Piece], ...]], list[tuple[str, str]]]:
        """Pairs of joints whose bodies can meet, with their pairs of pieces; and links that touch at ``q``.

        Left out are links that a joint connects, those of ``disabled`` (names of two links each), and those
        whose hulls touch in the start posture ``q`` (nq,): neighbours beyond a short link always do.
        """
        model, data = self.robot.model, self.robot.model.createData()
        pin.forwardKinematics(model, data, q)
        places = {j: transform(data.oMi[j].rotation, data.oMi[j].translation) for j in self.joints}
        out: dict[Pair, tuple[tuple[Piece, Piece], ...]] = {}
        touching, without = [], set(disabled)
        for n, a in enumerate(self.joints):
            for b in self.joints[:n]:
                if (a, b) in self.connected:
                    continue
                left = []
                (centre_a, radius_a), (centre_b, radius_b) = self.balls[a], self.balls[b]
                apart = np.linalg.norm(data.oMi[a].act(centre_a) - data.oMi[b].act(centre_b))
                far = apart > radius_a + radius_b
                for one in self.of_joint[a]:
                    for two in self.of_joint[b]:
                        if frozenset((one.link, two.link)) in without:
                            continue
                        if not far and distance(one.shape, places[a], two.shape, places[b]) <= 0:
                            touching.append((one.link, two.link))
                        else:
                            left.append((one, two))
                if left:
                    out[a, b] = tuple(left)
        return out, touching


_KNOWN: weakref.WeakKeyDictionary[Robot, RobotBodies] = weakref.WeakKeyDictionary()


def bodies_of(robot: Robot) -> RobotBodies:
    """The robot's bodies, made once."""
    if robot not in _KNOWN:
        known = file_pieces(robot)
        pieces, source = pieces_of(robot, known)
        too_large = tuple(piece for piece in known if piece not in pieces)
        _KNOWN[robot] = RobotBodies(robot=robot, pieces=pieces, source=source, too_large=too_large)
    return _KNOWN[robot]


def transform(rotation: Array, translation: Array) -> Any:
    """A coal.Transform3s."""
    return coal.Transform3s(np.asarray(rotation), np.asarray(translation))


def distance(one: Any, at_one: Any, two: Any, at_two: Any) -> float:
    """Distance of two coal shapes at these places [m]; below zero: depth of the penetration."""
    return float(coal.distance(one, at_one, two, at_two, _REQUEST, coal.DistanceResult()))


_REQUEST = coal.DistanceRequest()


CONE = np.pi / 3  # [rad] about the face's normal: corners that lead in none of these directions never do
DIRECTIONS = 400
MERGED = 0.004  # [m] corners nearer to each other than this count as one
FLAT = 0.9  # cosine: facets turned less belong to the face that the striking point lies on


class StrikerFace(NamedTuple):
    """Face of a striking link about its striking point, in the frame of the striker.

    normal (3,) : outward unit vector.  corners (k, 3) [m] : of the link's hull, from the striking point on.
    """

    normal: Array
    corners: Array

    @property
    def ahead(self) -> float:
        """Distance [m] by which the link sticks out beyond its striking point along the normal."""
        return float(max(0.0, (self.corners @ self.normal).max()))


def striker_face(
    robot: Robot, striker: str, axis: Array | None = None, *, assumed: bool = False
) -> StrikerFace | None:
    """The face of one of a robot's strikers; None for a link without a known shape.

    axis (3,) : its outward unit vector in the striker's frame, if known. Else it is that of the hull's facets
    next to the striking point; facets count by their areas.  assumed : boxes of links' inertia count too.
    """
    hit = robot.striker(striker)
    model, bodies = robot.model, bodies_of(robot)
    frame = model.frames[model.getFrameId(hit.frame)]
    every = bodies.of_joint.get(int(frame.parentJoint), ())
    pieces = [piece for piece in every if assumed or not piece.assumed]
    if not pieces:
        return None
    to_frame = frame.placement.inverse()
    vertices = np.concatenate([p.vertices for p in pieces]) @ to_frame.rotation.T + to_frame.translation
    away = vertices - np.asarray(hit.point)
    hull = ConvexHull(away)
    if axis is not None:
        return StrikerFace(np.asarray(axis, dtype=float), _leading(away[hull.vertices], np.asarray(axis)))
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    nearest = normals[np.argmax(offsets)]  # the facet that the point is least inside of, or farthest outside
    corners = away[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    same = (normals @ nearest > FLAT) & (np.abs(offsets - offsets.max()) < MERGED)
    normal = (normals * areas[:, None])[same].sum(axis=0)
    normal /= np.linalg.norm(normal)
    return StrikerFace(normal, _leading(away[hull.vertices], normal))


def _leading(points: Array, normal: Array) -> Array:
    """The points that lie farthest ahead in some direction within a cone about the normal."""
    # a Fibonacci lattice on the cap covers it evenly
    k = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - (1 - np.cos(CONE)) * k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    wide = np.sqrt(1 - height**2)
    across = np.linalg.svd(normal[None])[2][1:]
    directions = height[:, None] * normal + wide[:, None] * (
        np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    )
    farthest, chosen = set((points @ directions.T).argmax(axis=0).tolist()), list[Array]()
    for index in np.argsort(-(points @ normal)):
        if index in farthest and all(np.linalg.norm(points[index] - c) > MERGED for c in chosen):
            chosen.append(points[index])
    return np.array(chosen)
