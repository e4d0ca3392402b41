"""Clearance constraints of the controller: bodies that come near each other slow down before they touch."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids

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
        places = self._follow(data)
        gap = self._known - (self._moved[self._pairs].sum(axis=1) - self._then)
        speed = self._moves[self._pairs].sum(axis=1) / self._period
        looked = np.flatnonzero(_least(gap, -speed) > -HARDEST)
        if not len(looked):
            return np.zeros((0, self._model.nv)), np.zeros(0)
        pairs = self._pairs[looked]
        found = self._distances(data, pairs)
        distance = np.array([result.min_distance for result in found])
        self._known[looked], self._then[looked] = distance, self._moved[pairs].sum(axis=1)
        normals = np.array([result.normal for result in found])  # from the one to the other
        points = np.array([(r.getNearestPoint1(), r.getNearestPoint2()) for r in found])
        joints = self._joints[pairs]
        arms = points - places[joints]
        velocity, acceleration = _of_points(data, joints, arms)
        rate = (normals * (velocity[:, 1] - velocity[:, 0])).sum(axis=1)
        drift = (normals * (acceleration[:, 1] - acceleration[:, 0])).sum(axis=1)
        least = _least(distance, rate) - drift
        chosen = [k for k in np.argsort(-least)[:MOST] if least[k] > -HARDEST]
        rows = np.zeros((len(chosen), self._model.nv))
        for row, k in zip(rows, chosen, strict=True):
            for joint, arm, sign in zip(joints[k], arms[k], (-1.0, 1.0), strict=True):
                if joint:
                    J = pin.getJointJacobian(self._model, data, int(joint), _AXES)
                    row += sign * (normals[k] @ J[:3] + np.cross(arm, normals[k]) @ J[3:])
        return rows, least[chosen]

    def _follow(self, data: Any) -> Array:
        """Adds what the bodies have moved: the middle's way, and the farthest point's turn about it. Places
        (joints, 3) [m].
        """
        turns = np.array([place.rotation for place in data.oMi])[self._joints]
        origins = np.array([place.translation for place in data.oMi])
        middles = origins[self._joints] + (turns @ self._middles[:, :, None])[:, :, 0]
        if self._last is not None:
            way = np.linalg.norm(middles - self._last[1], axis=1)
            chord = np.linalg.norm(turns - self._last[0], axis=(1, 2)) / np.sqrt(2.0)
            self._moves = way + self._radii * chord
            self._moved += self._moves
        self._last = turns, middles
        return origins

    def _distances(self, data: Any, pairs: NDArray[np.intp]) -> list[Any]:
        at = {}
        for k in map(int, np.unique(pairs)):
            place = data.oMi[int(self._joints[k])] * self._shapes[k][1]
            at[k] = coal.Transform3s(place.rotation, place.translation)
        found = []
        for one, other in pairs.tolist():
            found.append(coal.DistanceResult())
            (a, _), (b, _) = self._shapes[one], self._shapes[other]
            coal.distance(a, at[one], b, at[other], self._asked, found[-1])
        return found


def _of_points(data: Any, joints: NDArray[np.intp], arms: Array) -> tuple[Array, Array]:
    """Velocities and accelerations (k, 2, 3) of points that joints (k, 2) carry, at ends of arms (k, 2, 3)
    from their origins, in world axes.
    """
    turns = np.array([place.rotation for place in data.oMi])

    def world(motions: Any) -> tuple[Array, Array]:
        own = np.array([motion.vector for motion in motions]).reshape(-1, 2, 3, 1)
        linear, angular = np.moveaxis((turns[:, None] @ own)[..., 0], 1, 0)
        return linear[joints], angular[joints]

    (linear, angular), (spatial, turning) = world(data.v), world(data.a)
    velocity = linear + np.cross(angular, arms)
    # of a point that moves with the joint: its spatial acceleration, and omega x v of where it is
    acceleration = spatial + np.cross(turning, arms) + np.cross(angular, velocity)
    return velocity, acceleration


def _least(distance: Any, rate: Any) -> Any:
    """Least second rate [m/s^2] of distances [m] that have a rate [m/s]."""
    return -2 * BANDWIDTH * rate - BANDWIDTH**2 * (distance - LEAST)


def _shape(solid: Solid) -> tuple[Any, Any]:
    """Shape for coal, and its placement in its joint's frame."""
    if solid.vertices is not None:
        return solid.hull, pin.SE3.Identity()
    assert solid.half is not None and solid.place is not None and solid.rotation is not None
    place = pin.SE3(np.asarray(solid.rotation), np.asarray(solid.place))
    if not solid.radius:
        return coal.Box(*(2 * solid.half)), place
    capsule = solid.half[2] > 0
    return (coal.Capsule(solid.radius, 2 * solid.half[2]) if capsule else coal.Sphere(solid.radius)), place
