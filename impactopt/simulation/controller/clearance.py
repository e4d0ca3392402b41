"""Clearance constraints of the controller: bodies that come near each other slow down before they touch."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.simulation.solids import FLOOR, Solid, Solids

__all__ = ["Clearance"]

Array = NDArray[np.float64]
LEAST = 2e-3  # [m] that is kept between them: plans keep more, but for half a millimetre between their nodes
BANDWIDTH = 40.0  # [rad/s] of the barrier: a tenth of what 1 kHz and a millisecond of delay follow
HARDEST = 30.0  # [m/s^2] of two bodies towards each other, before they are looked at again
MOST = 8  # constraints at a time: the most urgent ones
_AXES = pin.LOCAL_WORLD_ALIGNED


class Clearance:
    """Constraints d'' >= -2 w d' - w^2 (d - LEAST) on distances d of near pairs, linear in accelerations.

    An exponential control barrier function (Nguyen, Sreenath, "Exponential control barrier functions for
    enforcing high relative-degree safety-critical constraints", ACC 2016). Distances and nearest points are
    those of the exact convex hulls. d'' is that of the nearest points as parts of their bodies: what turns
    the normal adds to it, and is left out. Pairs are links of the robot, and a link and a body of the world
    that stands still and is no part of the target, whose place the controller does not know.

    A pair is looked at only where its constraint may be more than -`HARDEST`, by what its bodies have moved
    at most since the last time, and by how fast they go: others cost nothing.

    period [s] : from one call of `constraints` to the next.
    """

    def __init__(self, model: Any, solids: Solids, *, period: float) -> None:
        self._model, self._solids, self._period = model, solids.solids, period
        pairs = [p for p in solids.pairs if FLOOR not in p and not any(solids.solids[k].of_target for k in p)]
        self._pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        self._joints = np.array([s.joint for s in self._solids], dtype=np.intp)
        self._middles, self._radii = np.zeros((len(self._solids), 3)), np.zeros(len(self._solids))
        for k, solid in enumerate(self._solids):
            self._middles[k], self._radii[k] = solid.ball()
        self._shapes = {int(k): _shape(self._solids[k]) for k in np.unique(self._pairs)}
        # how far each body has moved at most, and in the last period; and how far that was when the pair's
        # distance was known
        self._moved, self._moves = np.zeros((2, len(self._solids)))
        self._known, self._then = np.zeros(len(self._pairs)), np.zeros(len(self._pairs))
        self._last: tuple[Array, Array] | None = None
        self._asked = coal.DistanceRequest()

    def constraints(self, data: Any) -> tuple[Array, Array]:
        """J (k, nv) [m/rad] and c (k,) [m/s^2], J a >= c, of accelerations a (nv,); k <= `MOST`.

        data : Pinocchio's, with the joints' placements, velocities, Jacobians, and with accelerations for
            a = 0.
        """
        self._follow(data)
        gap = self._known - (self._moved[self._pairs].sum(axis=1) - self._then)
        speed = self._moves[self._pairs].sum(axis=1) / self._period
        found = []
        for i in np.flatnonzero(_least(gap, -speed) > -HARDEST):
            pair = [int(k) for k in self._pairs[i]]
            result = self._distance(data, *pair)
            self._known[i], self._then[i] = result.min_distance, self._moved[pair].sum()
            found.append(self._constraint(data, *pair, result))
        found = sorted((row for row in found if row[1] > -HARDEST), key=lambda row: -row[1])[:MOST]
        rows = np.reshape([row for row, _ in found], (len(found), self._model.nv))
        return rows, np.array([least for _, least in found])

    def _follow(self, data: Any) -> None:
        """Adds what the bodies have moved: the middle's way, and the farthest point's turn about it."""
        turns = np.array([place.rotation for place in data.oMi])[self._joints]
        places = np.array([place.translation for place in data.oMi])[self._joints]
        places = places + (turns @ self._middles[:, :, None])[:, :, 0]
        if self._last is not None:
            way = np.linalg.norm(places - self._last[1], axis=1)
            chord = np.linalg.norm(turns - self._last[0], axis=(1, 2)) / np.sqrt(2.0)
            self._moves = way + self._radii * chord
            self._moved += self._moves
        self._last = turns, places

    def _distance(self, data: Any, one: int, other: int) -> Any:
        result = coal.DistanceResult()
        (a, place_a), (b, place_b) = (self._shapes[k] for k in (one, other))
        at = [data.oMi[int(self._joints[k])] * place for k, place in ((one, place_a), (other, place_b))]
        coal.distance(
            a,
            coal.Transform3s(at[0].rotation, at[0].translation),
            b,
            coal.Transform3s(at[1].rotation, at[1].translation),
            self._asked,
            result,
        )
        return result

    def _constraint(self, data: Any, one: int, other: int, found: Any) -> tuple[Array, float]:
        """The row of a pair, and the least of its second rate beyond what it has without accelerations."""
        normal = np.array(found.normal)  # from the one to the other
        row, rate, drift = np.zeros(self._model.nv), 0.0, 0.0
        for k, point, sign in ((one, found.getNearestPoint1(), -1.0), (other, found.getNearestPoint2(), 1.0)):
            joint = int(self._joints[k])
            if joint == 0:
                continue
            arm = np.array(point) - data.oMi[joint].translation
            J = pin.getJointJacobian(self._model, data, joint, _AXES)
            v = pin.getVelocity(self._model, data, joint, _AXES)
            a = pin.getClassicalAcceleration(self._model, data, joint, _AXES)
            row += sign * (normal @ J[:3] + np.cross(arm, normal) @ J[3:])
            rate += sign * float(normal @ (v.linear + np.cross(v.angular, arm)))
            turn = np.cross(a.angular, arm) + np.cross(v.angular, np.cross(v.angular, arm))
            drift += sign * float(normal @ (a.linear + turn))
        return row, _least(found.min_distance, rate) - drift


def _least(distance: Any, rate: Any) -> Any:
    """Least second rate [m/s^2] of distances [m] that have a rate [m/s]."""
    return -2 * BANDWIDTH * rate - BANDWIDTH**2 * (distance - LEAST)


def _shape(solid: Solid) -> tuple[Any, Any]:
    """As coal has it, and where it is in its joint's frame."""
    if solid.vertices is not None:
        return solid.hull, pin.SE3.Identity()
    assert solid.half is not None and solid.place is not None and solid.rotation is not None
    place = pin.SE3(np.asarray(solid.rotation), np.asarray(solid.place))
    if not solid.radius:
        return coal.Box(*(2 * solid.half)), place
    capsule = solid.half[2] > 0
    return (coal.Capsule(solid.radius, 2 * solid.half[2]) if capsule else coal.Sphere(solid.radius)), place
