"""Clearance constraints of the controller: bodies that come near each other slow down before they touch."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids

Array = NDArray[np.float64]
MIN_DISTANCE = 2e-3  # [m]: plans keep more, but for half a millimetre between their nodes
BANDWIDTH = 40.0  # [rad/s] of the barrier: a tenth of what 1 kHz and a millisecond of delay follow
# [m/s^2] largest closing acceleration of two bodies before their distance is computed again
MAX_CLOSING_ACCELERATION = 30.0
MAX_CONSTRAINTS = 8  # at a time: the most urgent ones
_AXES = pin.LOCAL_WORLD_ALIGNED


class Clearance:
    """Constraints d'' >= -2 w d' - w^2 (d - MIN_DISTANCE) on distances d of near pairs, with w = BANDWIDTH.

    They are an exponential control barrier function (Nguyen, Sreenath, "Exponential control barrier functions
    for enforcing high relative-degree safety-critical constraints", ACC 2016), linear in the accelerations.
    Distances and nearest points are those of the exact convex hulls. d'' is that of the nearest points as
    parts of their bodies; the contribution of the normal's rotation is neglected.

    Pairs are two links of the robot, or a link and a body of the world that stands still. Bodies of the
    target are left out, because the controller does not know its position.

    The distance of a pair is computed only when its constraint may exceed
    `-MAX_CLOSING_ACCELERATION`, by bounds on how far its bodies have moved since the last computation, and on
    their speed.

    period [s] : from one call of `constraints` to the next.
    """

    def __init__(self, model: Any, solids: Solids, *, period: float) -> None:
        self._model, self._solids, self._period = model, solids.solids, period
        pairs = [p for p in solids.pairs if FLOOR not in p and not any(solids.solids[k].of_target for k in p)]
        self._pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        self._joints = np.array([s.joint for s in self._solids], dtype=np.intp)
        # enclosing balls
        self._centres, self._radii = np.zeros((len(self._solids), 3)), np.zeros(len(self._solids))
        for k, solid in enumerate(self._solids):
            self._centres[k], self._radii[k] = solid.ball()
        self._shapes = {int(k): _shape(self._solids[k]) for k in np.unique(self._pairs)}
        # bounds [m] on how far each body has moved in total, and in the last period
        self._moved, self._moved_last = np.zeros((2, len(self._solids)))
        # of each pair: the last computed distance, and the sum of its bodies' `_moved` at that time
        self._distance, self._moved_then = np.zeros(len(self._pairs)), np.zeros(len(self._pairs))
        self._last: tuple[Array, Array] | None = None  # rotations of the joints and centres of the balls
        self._request = coal.DistanceRequest()

    def constraints(self, data: Any) -> tuple[Array, Array]:
        """J (k, nv) [m/rad] and c (k,) [m/s^2], J a >= c, of accelerations a (nv,); k <= `MAX_CONSTRAINTS`.

        data : Pinocchio's, with the joints' placements, velocities, Jacobians, and with accelerations for
            a = 0.
        """
        origins = self._update_bounds(data)
        least_distance = self._distance - (self._moved[self._pairs].sum(axis=1) - self._moved_then)
        most_speed = self._moved_last[self._pairs].sum(axis=1) / self._period
        # with the least distance and the largest closing speed that these bounds permit
        near = np.flatnonzero(_least_second_rate(least_distance, -most_speed) > -MAX_CLOSING_ACCELERATION)
        if not len(near):
            return np.zeros((0, self._model.nv)), np.zeros(0)
        pairs = self._pairs[near]
        results = self._distances(data, pairs)
        distance = np.array([result.min_distance for result in results])
        self._distance[near], self._moved_then[near] = distance, self._moved[pairs].sum(axis=1)
        normals = np.array([result.normal for result in results])  # from the first body to the second
        points = np.array([(r.getNearestPoint1(), r.getNearestPoint2()) for r in results])
        joints = self._joints[pairs]
        arms = points - origins[joints]
        velocity, acceleration = _of_points(data, joints, arms)
        rate = (normals * (velocity[:, 1] - velocity[:, 0])).sum(axis=1)
        drift = (normals * (acceleration[:, 1] - acceleration[:, 0])).sum(axis=1)
        lower = _least_second_rate(distance, rate) - drift
        chosen = [k for k in np.argsort(-lower)[:MAX_CONSTRAINTS] if lower[k] > -MAX_CLOSING_ACCELERATION]
        jacobian = np.zeros((len(chosen), self._model.nv))
        for row, k in zip(jacobian, chosen, strict=True):
            for joint, arm, sign in zip(joints[k], arms[k], (-1.0, 1.0), strict=True):
                if joint:  # joint 0 is the world
                    J = pin.getJointJacobian(self._model, data, int(joint), _AXES)
                    # n . (v + omega x arm) = n . v + (arm x n) . omega
                    row += sign * (normals[k] @ J[:3] + np.cross(arm, normals[k]) @ J[3:])
        return jacobian, lower[chosen]

    def _update_bounds(self, data: Any) -> Array:
        """Updates the bounds on the bodies' motion, and returns the origins (joints, 3) [m] of all joints.

        A body has moved by at most the displacement of its ball's centre and the chord of its rotation.
        """
        rotations = np.array([place.rotation for place in data.oMi])[self._joints]
        origins = np.array([place.translation for place in data.oMi])
        centres = origins[self._joints] + (rotations @ self._centres[:, :, None])[:, :, 0]
        if self._last is not None:
            displacement = np.linalg.norm(centres - self._last[1], axis=1)
            # Frobenius norm of the difference of two rotations by an angle: sqrt(2) * 2 sin(angle / 2)
            chord = np.linalg.norm(rotations - self._last[0], axis=(1, 2)) / np.sqrt(2.0)
            self._moved_last = displacement + self._radii * chord
            self._moved += self._moved_last
        self._last = rotations, centres
        return origins

    def _distances(self, data: Any, pairs: NDArray[np.intp]) -> list[Any]:
        """Results of coal for pairs (k, 2) of solids."""
        placements = {}
        for k in map(int, np.unique(pairs)):
            place = data.oMi[int(self._joints[k])] * self._shapes[k][1]
            placements[k] = coal.Transform3s(place.rotation, place.translation)
        results = []
        for one, other in pairs.tolist():
            results.append(coal.DistanceResult())
            (a, _), (b, _) = self._shapes[one], self._shapes[other]
            coal.distance(a, placements[one], b, placements[other], self._request, results[-1])
        return results


def _of_points(data: Any, joints: NDArray[np.intp], arms: Array) -> tuple[Array, Array]:
    """Velocities and accelerations (k, 2, 3) of points fixed to joints (k, 2), in world axes.

    arms (k, 2, 3) : from the joints' origins to the points, in world axes.
    """
    rotations = np.array([place.rotation for place in data.oMi])

    def world(motions: Any) -> tuple[Array, Array]:
        local = np.array([motion.vector for motion in motions]).reshape(-1, 2, 3, 1)
        linear, angular = np.moveaxis((rotations[:, None] @ local)[..., 0], 1, 0)
        return linear[joints], angular[joints]

    (linear, angular), (spatial, angular_acceleration) = world(data.v), world(data.a)
    velocity = linear + np.cross(angular, arms)
    # classical acceleration of a point from the joint's spatial one: omega x velocity is added
    acceleration = spatial + np.cross(angular_acceleration, arms) + np.cross(angular, velocity)
    return velocity, acceleration


def _least_second_rate(distance: Any, rate: Any) -> Any:
    """Least second rate [m/s^2] that the barrier permits at distances [m] and their rates [m/s]."""
    return -2 * BANDWIDTH * rate - BANDWIDTH**2 * (distance - MIN_DISTANCE)


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
