"""Clearance constraints of the controller: bodies that come near each other slow down before they touch."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Index
from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids
from impactopt.simulation.result import cross

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
    `-MAX_CLOSING_ACCELERATION`, by bounds on how far one body has moved in the other's frame since the last
    computation, and on its speed there.

    period [s] : from one call of `constraints` to the next.
    """

    def __init__(self, model: Any, solids: Solids, *, period: float) -> None:
        self._model, self._solids, self._period = model, solids.solids, period
        pairs = [p for p in solids.pairs if FLOOR not in p and not any(solids.solids[k].of_target for k in p)]
        self._pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        self._joints = np.array([s.joint for s in self._solids], dtype=np.intp)
        self._shapes = {int(k): _shape(self._solids[k]) for k in np.unique(self._pairs)}
        # largest distance [m] of a body's points from its joint's origin
        balls = [solid.ball() for solid in self._solids]
        reach = np.array([np.linalg.norm(centre) + radius for centre, radius in balls])[self._pairs]
        # of each pair the body with the smaller reach moves, in the frame of the other
        joints, moving = self._joints[self._pairs], reach.argmin(axis=1)[:, None]
        from_to = np.hstack([np.take_along_axis(joints, k, axis=1) for k in (1 - moving, moving)])
        # pairs of joints, and the index of each pair of bodies among them
        self._joint_pairs, self._index = np.unique(from_to, axis=0, return_inverse=True)
        self._reach = reach.min(axis=1)
        # of each pair of bodies: lower bound [m] on the distance, and upper bound [m] on the last motion
        self._least_distance, self._moved = np.zeros((2, len(self._pairs)))
        self._last: tuple[Array, Array] | None = None  # rotations and translations of the pairs of joints
        self._request = coal.DistanceRequest()

    def constraints(self, data: Any) -> tuple[Array, Array]:
        """J (k, nv) [m/rad] and c (k,) [m/s^2], J a >= c, of accelerations a (nv,); k <= `MAX_CONSTRAINTS`.

        data : Pinocchio's, with the joints' placements, velocities, Jacobians, and with accelerations for
            a = 0.
        """
        origins = self._update_bounds(data)
        # with the least distance and the largest closing speed that these bounds permit
        bound = _least_second_rate(self._least_distance, -self._moved / self._period)
        near = np.flatnonzero(bound > -MAX_CLOSING_ACCELERATION)
        if not len(near):
            return np.zeros((0, self._model.nv)), np.zeros(0)
        pairs = self._pairs[near]
        results = self._distances(data, pairs)
        distance = np.array([result.min_distance for result in results])
        self._least_distance[near] = distance
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
        # n . (v + omega x arm) = n . v + (arm x n) . omega
        moments = cross(arms, normals[:, None])
        for row, k in zip(jacobian, chosen, strict=True):
            for joint, moment, sign in zip(joints[k].tolist(), moments[k], (-1.0, 1.0), strict=True):
                if joint:  # joint 0 is the world
                    J = pin.getJointJacobian(self._model, data, joint, _AXES)
                    row += sign * (normals[k] @ J[:3] + moment @ J[3:])
        return jacobian, lower[chosen]

    def _update_bounds(self, data: Any) -> Array:
        """Updates the bounds of all pairs, and returns the origins (joints, 3) [m] of all joints.

        In the other's frame a body has moved by at most the displacement of its joint's origin and the chord
        of its rotation.
        """
        places = data.oMi
        rotations = np.array([place.rotation for place in places])
        origins = np.array([place.translation for place in places])
        other, moving = self._joint_pairs.T
        into = rotations[other].transpose(0, 2, 1)
        rotation = into @ rotations[moving]
        translation = (into @ (origins[moving] - origins[other])[:, :, None])[:, :, 0]
        if self._last is not None:
            displacement = np.linalg.norm(translation - self._last[1], axis=1)
            # Frobenius norm of the difference of two rotations by an angle: sqrt(2) * 2 sin(angle / 2)
            chord = np.linalg.norm(rotation - self._last[0], axis=(1, 2)) / np.sqrt(2.0)
            self._moved = displacement[self._index] + self._reach * chord[self._index]
            self._least_distance -= self._moved
        self._last = rotation, translation
        return origins

    def _distances(self, data: Any, pairs: Index) -> list[Any]:
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


def _of_points(data: Any, joints: Index, arms: Array) -> tuple[Array, Array]:
    """Velocities and accelerations (k, 2, 3) of points fixed to joints (k, 2), in world axes.

    arms (k, 2, 3) : from the joints' origins to the points, in world axes.
    """
    rotations = np.array([place.rotation for place in data.oMi])

    def world(motions: Any) -> tuple[Array, Array]:
        local = np.array([motion.vector for motion in motions]).reshape(-1, 2, 3, 1)
        vectors = (rotations[:, None] @ local)[joints, ..., 0]
        return vectors[:, :, 0], vectors[:, :, 1]

    (linear, angular), (spatial, angular_acceleration) = world(data.v), world(data.a)
    velocity = linear + cross(angular, arms)
    # classical acceleration of a point from the joint's spatial one: omega x velocity is added
    acceleration = spatial + cross(angular_acceleration, arms) + cross(angular, velocity)
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
