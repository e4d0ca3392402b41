"""A robot's bodies: the hulls of its links, and which of them can meet."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.convex_hulls import Piece, pieces_of
from impactopt.robots.robot import Robot

__all__ = ["RobotBodies", "bodies_of", "distance", "transform"]

Array = NDArray[np.float64]
Pair = tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotBodies:
    """Collision geometry of a robot.

    pieces : hulls of links, exact.  source : where they are from, in words.
    """

    robot: Robot
    pieces: tuple[Piece, ...]
    source: str

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
        parents = self.robot.model.parents
        return tuple((j, int(parents[j])) for j in self.joints if int(parents[j]) in self.joints)

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
        pieces, source = pieces_of(robot)
        _KNOWN[robot] = RobotBodies(robot=robot, pieces=pieces, source=source)
    return _KNOWN[robot]


def transform(rotation: Array, translation: Array) -> Any:
    """A coal.Transform3s."""
    return coal.Transform3s(np.asarray(rotation), np.asarray(translation))


def distance(one: Any, at_one: Any, two: Any, at_two: Any) -> float:
    """Distance of two coal shapes at these places [m]; below zero: depth of the penetration."""
    return float(coal.distance(one, at_one, two, at_two, _REQUEST, coal.DistanceResult()))


_REQUEST = coal.DistanceRequest()
