"""Bodies of a robot: hulls of its links, pairs that can collide, and the face of a striking link."""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from impactopt.arrays import Array
from impactopt.bodies.convex_hulls import Piece, file_pieces, is_too_large, pieces_of
from impactopt.robots.build import neutral, parent_body
from impactopt.robots.robot import Robot

Pair = tuple[int, int]
# [m] Neighbours no farther apart than this in the start posture count as touching: they are made to fit, as a
# joint in its fork, and constraints know the shapes of two links no better (`separation.THIN`, of each).
# Rounding would decide one on a share of so small a distance: Fourier's N1, whose shoulders are 0.6 mm apart,
# took 581 iterations with them, and takes 55 without; iCub Erzelli02 (1.25 mm) 731 and 220.
FITTED = 2e-3
# Links with fewer joints between them are always near.
NEIGHBOUR_JOINTS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotBodies:
    """Collision geometry of a robot.

    pieces : exact hulls of links.  source : description of their source.
    rest (nq,) : configuration with all joints at or near zero.
    too_large : shapes of its file that are left out, as they are too large.
    """

    model: pin.Model  # not the robot, which the cache of `bodies_of` would keep for ever
    rest: Array
    pieces: tuple[Piece, ...]
    source: str
    too_large: tuple[Piece, ...] = ()

    @cached_property
    def hash(self) -> str:
        """Hexadecimal hash of the hulls' extents in many directions, to the micrometre.

        It does not depend on the order of links and vertices, nor on rounding: in which vertices a hull has,
        of points that are nearly on its surface, Qhull's versions differ.
        """
        height, wide, turn = _lattice(np.pi)
        directions = np.array([wide * np.cos(turn), wide * np.sin(turn), height])
        extents = ((p.link, (1e6 * p.vertices @ directions).max(axis=0)) for p in self.pieces)
        hulls = sorted((link, (np.round(extent) + 0.0).tolist()) for link, extent in extents)
        return hashlib.sha256(repr(hulls).encode()).hexdigest()[:16]

    @cached_property
    def joints(self) -> tuple[int, ...]:
        """Joints that move pieces, in the model's order."""
        return tuple(sorted({piece.joint for piece in self.pieces}))

    @cached_property
    def of_joint(self) -> dict[int, tuple[Piece, ...]]:
        """Pieces by the joint that moves them."""
        return {j: tuple(p for p in self.pieces if p.joint == j) for j in self.joints}

    @cached_property
    def connected(self) -> tuple[Pair, ...]:
        """Pairs of a joint and its parent that both move pieces: their bodies always touch."""
        parents = ((j, parent_body(self.model, j)) for j in self.joints)
        return tuple((j, parent) for j, parent in parents if parent in self.joints)

    @cached_property
    def faces(self) -> dict[Any, StrikerFace | None]:
        """Cache of `striker_face`, which terms ask for with every program that is built."""
        return {}

    @cached_property
    def balls(self) -> dict[int, tuple[Array, float]]:
        """Bounding ball of each joint's pieces: centre (3,) and radius [m]."""
        return {
            j: bounding_ball(np.concatenate([p.vertices for p in pieces]))
            for j, pieces in self.of_joint.items()
        }

    @cached_property
    def _names(self) -> dict[int, str]:
        def size(piece: Piece) -> float:
            return float(np.prod(np.ptp(piece.vertices, axis=0)))

        return {j: max(pieces, key=size).link for j, pieces in self.of_joint.items()}

    def name(self, joint: int) -> str:
        """Name of the body that a joint moves, for messages: its largest link."""
        return self._names[joint]

    def joints_between(self, one: int, other: int) -> int:
        """Number of joints on the path in the tree between the bodies that two joints move."""
        return len(self._chains[one] ^ self._chains[other])

    @cached_property
    def _chains(self) -> list[set[int]]:
        """Joints from the root to each joint."""
        return [set(joints) for joints in self.model.supports]

    def piece_pairs(
        self, q: Array, disabled: Iterable[frozenset[str]] = ()
    ) -> tuple[dict[Pair, tuple[tuple[Piece, Piece], ...]], list[tuple[str, str]]]:
        """Pairs of pieces that can collide, by their two joints; and names of the links that touch at ``q``.

        Left out are links that a joint connects, those of ``disabled`` (names of two links each), and those
        whose hulls touch in the start posture ``q`` (nq,), or nearly (`FITTED`) if few joints are between
        them, as neighbours beyond a short link always do.
        """
        # Copies of a problem, such as one with other prices, have the same start posture.
        key, known = (q.tobytes(), frozenset(disabled)), self._known_pairs
        found = known.get(key)
        if found is None:
            found = self._piece_pairs(q, key[1])
            known.clear()
            known[key] = found
        return found

    @cached_property
    def _known_pairs(self) -> dict[Any, Any]:
        """The last result of `piece_pairs`, by its arguments."""
        return {}

    def _piece_pairs(
        self, q: Array, excluded: frozenset[frozenset[str]]
    ) -> tuple[dict[Pair, tuple[tuple[Piece, Piece], ...]], list[tuple[str, str]]]:
        model, data = self.model, self.model.createData()
        pin.forwardKinematics(model, data, q)
        places = {j: transform(data.oMi[j].rotation, data.oMi[j].translation) for j in self.joints}
        out: dict[Pair, tuple[tuple[Piece, Piece], ...]] = {}
        touching = []
        for n, a in enumerate(self.joints):
            for b in self.joints[:n]:
                if (a, b) in self.connected:
                    continue
                kept = []
                (centre_a, radius_a), (centre_b, radius_b) = self.balls[a], self.balls[b]
                # Balls first: most pairs are far apart, and exact distances of all pairs of
                # pieces would take much longer.
                between = np.linalg.norm(data.oMi[a].act(centre_a) - data.oMi[b].act(centre_b))
                # a hand that begins near a thigh is not made to fit it, and keeps its clearance
                near = FITTED if self.joints_between(a, b) < NEIGHBOUR_JOINTS else 0.0
                far = between > radius_a + radius_b + near
                for one in self.of_joint[a]:
                    for two in self.of_joint[b]:
                        if frozenset((one.link, two.link)) in excluded:
                            continue
                        if not far and distance(one.shape, places[a], two.shape, places[b]) <= near:
                            touching.append((one.link, two.link))
                        else:
                            kept.append((one, two))
                if kept:
                    out[a, b] = tuple(kept)
        return out, touching

    def overlaps(self, touching: Iterable[tuple[str, str]]) -> set[frozenset[str]]:
        """Pairs of links of ``touching``, no neighbours, that do not touch with all joints at or near zero.

        Hulls that are too large for their links touch there, too.
        """
        found = self._distant(touching)
        return found - self._distant(self._touching_at_rest) if found else found

    def _distant(self, pairs: Iterable[tuple[str, str]]) -> set[frozenset[str]]:
        joint = {piece.link: piece.joint for piece in self.pieces}
        return {
            frozenset((one, two))
            for one, two in pairs
            if self.joints_between(joint[one], joint[two]) >= NEIGHBOUR_JOINTS
        }

    @cached_property
    def _touching_at_rest(self) -> list[tuple[str, str]]:
        return self.piece_pairs(self.rest)[1]


_KNOWN: weakref.WeakKeyDictionary[Robot, RobotBodies] = weakref.WeakKeyDictionary()


def bodies_of(robot: Robot) -> RobotBodies:
    """Bodies of the robot, cached."""
    if robot not in _KNOWN:
        known = file_pieces(robot)
        pieces, source = pieces_of(robot, known)
        too_large = tuple(p for p in known if is_too_large(robot.model, p.joint, p.vertices))
        zero = neutral(robot.model)
        rest = robot.angles.put(zero, np.clip(robot.joint_positions(zero), robot.lower, robot.upper))
        _KNOWN[robot] = RobotBodies(
            model=robot.model, rest=rest, pieces=pieces, source=source, too_large=too_large
        )
    return _KNOWN[robot]


def bounding_ball(points: Array) -> tuple[Array, float]:
    """Centre (3,) and radius [m] of a ball that contains points (k, 3)."""
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def transform(rotation: Array, translation: Array) -> Any:
    """Placement as a coal.Transform3s."""
    return coal.Transform3s(np.asarray(rotation), np.asarray(translation))


def distance(one: Any, at_one: Any, two: Any, at_two: Any) -> float:
    """Distance of two coal shapes at these placements [m]; below zero: minus the depth of penetration."""
    return float(coal.distance(one, at_one, two, at_two, _REQUEST, coal.DistanceResult()))


_REQUEST = coal.DistanceRequest()


# [rad] half angle, about the face's normal, of the directions in which corners may be the foremost
CONE = np.pi / 3
DIRECTIONS = 400  # of a lattice
MERGED = 0.004  # [m] corners nearer to each other than this count as one
FLAT = 0.9  # cosine of the largest angle between facets of one face


class StrikerFace(NamedTuple):
    """Face of a striking link about its striking point, in the frame of the striker.

    normal (3,) : outward unit vector.  corners (k, 3) [m] : of the link's hull, relative to the striking
        point.
    """

    normal: Array
    corners: Array

    @property
    def ahead(self) -> float:
        """Distance [m] by which the link extends beyond its striking point along the normal."""
        return float(max(0.0, (self.corners @ self.normal).max()))


def striker_face(
    robot: Robot, striker: str, axis: Array | None = None, *, assumed: bool = False
) -> StrikerFace | None:
    """Face of a striker; None for a link without a known shape.

    axis (3,) : its outward unit vector in the striker's frame, if known. Else it is the mean normal, weighted
        by area, of the hull's facets next to the striking point.  assumed : also use boxes of links' inertia.
    """
    known, key = bodies_of(robot).faces, (striker, None if axis is None else tuple(axis), assumed)
    if key not in known:
        known[key] = _striker_face(robot, striker, axis, assumed)
    return known[key]


def _striker_face(robot: Robot, striker: str, axis: Array | None, assumed: bool) -> StrikerFace | None:
    hit = robot.striker(striker)
    model, bodies = robot.model, bodies_of(robot)
    frame = model.frames[model.getFrameId(hit.frame)]
    every = bodies.of_joint.get(int(frame.parentJoint), ())
    pieces = [piece for piece in every if assumed or not piece.assumed]
    if not pieces:
        return None
    to_frame = frame.placement.inverse()
    # From the joint's frame to the striker's, then relative to the striking point.
    vertices = np.concatenate([p.vertices for p in pieces]) @ to_frame.rotation.T + to_frame.translation
    away = vertices - np.asarray(hit.point)
    hull = ConvexHull(away)
    if axis is not None:
        return StrikerFace(np.asarray(axis, dtype=float), _leading(away[hull.vertices], np.asarray(axis)))
    # Qhull: normal . p + offset <= 0 inside; at the striking point, the origin, that is the offset.
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    nearest = normals[np.argmax(offsets)]  # the facet that the point is least inside of, or farthest outside
    corners = away[hull.simplices]
    # Twice the areas, which as weights are the same.
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    same = (normals @ nearest > FLAT) & (np.abs(offsets - offsets.max()) < MERGED)
    normal = (normals * areas[:, None])[same].sum(axis=0)
    normal /= np.linalg.norm(normal)
    return StrikerFace(normal, _leading(away[hull.vertices], normal))


def _lattice(half_angle: float) -> tuple[Array, Array, Array]:
    """Fibonacci lattice of unit vectors, which covers a cone's cap evenly.

    Each vector's part along the cone's axis and across it, and its angle about the axis [rad].
    """
    k = np.arange(DIRECTIONS) + 0.5
    # Heights in equal steps are rings of equal area (Archimedes); the golden angle spreads them around.
    height, turn = 1 - (1 - np.cos(half_angle)) * k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    return height, np.sqrt(1 - height**2), turn


def _leading(points: Array, normal: Array) -> Array:
    """Points that are foremost in some direction of a cone about the normal, without near duplicates."""
    height, wide, turn = _lattice(CONE)
    across = np.linalg.svd(normal[None])[2][1:]
    directions = height[:, None] * normal + wide[:, None] * (
        np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    )
    left, chosen = points[np.unique((points @ directions.T).argmax(axis=0))], list[Array]()
    # The foremost first, so that it stays of near duplicates.
    left = left[np.argsort(-(left @ normal))]
    while len(left):
        chosen.append(left[0])
        left = left[np.linalg.norm(left - left[0], axis=1) > MERGED]
    return np.array(chosen)
