"""Values of a `pin.Model`: coordinates of its configurations, mass matrix, axes and placements of joints.

Pinocchio has the cosine and sine of a continuous joint in place of its angle, and its mass matrix lacks some
entries of followers. Its forward kinematics takes 5 us per configuration, but copying the placements to
Python, joint by joint, takes 60: `ForwardKinematics` computes those of many configurations at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array

MIMIC = "JointModelMimic"  # Pinocchio's name of a follower's joint


class JointAngles:
    """Angles [rad] (travel [m] of a prismatic joint) of joints with one degree of freedom, read and written.

    joints : (n,) Pinocchio's joint models.
    continuous : indices of the continuous ones among them.
    """

    def __init__(self, joints: Sequence[Any]) -> None:
        self._place = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        self.continuous = np.flatnonzero([joint.nq == 2 for joint in joints])

    def of(self, q: Array) -> Array:
        """Angles (..., n) of configurations (..., nq); those of continuous joints in [-pi, pi]."""
        angles = q.take(self._place, axis=-1)
        for k in self.continuous:
            at = self._place[k]
            angles[..., k] = np.arctan2(q[..., at + 1], q[..., at])
        return angles

    def put(self, q: Array, angles: ArrayLike) -> Array:
        """Writes angles (..., n) to configurations (..., nq) in place, and returns these."""
        angles = np.asarray(angles, dtype=np.float64)
        q[..., self._place] = angles
        for k in self.continuous:
            at = self._place[k]
            q[..., at], q[..., at + 1] = np.cos(angles[..., k]), np.sin(angles[..., k])
        return q


class RpyCoordinates:
    """Coordinates of a model with one for each velocity: base position, roll, pitch, yaw, and joint angles.

    Without a free-flyer they are the joint angles alone.
    """

    def __init__(self, model: pin.Model) -> None:
        joints = list(model.joints)[1:]
        self._nq, self._base = model.nq, 6 if joints and joints[0].nv == 6 else 0
        self._angles = JointAngles([joint for joint in joints if joint.nv == 1])

    def from_pin(self, q: Array) -> Array:
        """Coordinates (nv,) of Pinocchio's configuration (nq,); angles of continuous joints in [-pi, pi]."""
        angles = self._angles.of(q)
        if not self._base:
            return angles
        return np.concatenate([q[:3], pin.rpy.matrixToRpy(pin.XYZQUATToSE3(q[:7]).rotation), angles])

    def to_pin(self, coordinates: Array) -> Array:
        """Pinocchio's configurations (..., nq) of coordinates (..., nv)."""
        q = np.empty((*coordinates.shape[:-1], self._nq))
        if self._base:
            half_angles = np.moveaxis(coordinates[..., 3:6] / 2, -1, 0)
            q[..., :3], q[..., 3:7] = coordinates[..., :3], _quaternions(*half_angles)
        return self._angles.put(q, coordinates[..., self._base :])


def _quaternions(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Quaternions (..., 4), scalar last and not negative, of Rz(2 yaw) Ry(2 pitch) Rx(2 roll) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = (tuple(map(f, (roll, pitch, yaw))) for f in (np.cos, np.sin))
    parts = (sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy)
    out = np.stack([*parts, cr * cp * cy + sr * sp * sy], axis=-1)
    return np.where(out[..., 3:] < 0.0, -out, out)


def principal_moments(inertia: ArrayLike) -> tuple[Array, Array, Array]:
    """Moments of an inertia (3, 3) [kg m2], second moments of mass, and the principal axes (3, 3) as columns.

    The second moments (3,) are the integrals of x^2 dm along the axes. Those of a body are positive, which is
    the triangle inequality of its moments of inertia; each of these is the sum of the other two axes'.
    """
    moments, axes = np.linalg.eigh(np.asarray(inertia))
    return moments, moments.sum() / 2 - moments, axes


def mass_matrix(model: pin.Model, data: Any, q: Array) -> Array:
    """H (nv, nv), symmetric, at q (nq), with armature on its diagonal, by `pin.crba`.

    For a model with followers the columns are the forces of unit accelerations, by `pin.rnea`: `pin.crba` of
    Pinocchio 4.1 leaves entries out if several branches hang on a follower.
    """
    if getattr(model, "nvExtended", model.nv) == model.nv:
        return np.array(pin.crba(model, data, q))
    own, zero = model.createData(), np.zeros(model.nv)  # its own data, so that `data` keeps its velocities
    weight = np.array(pin.computeGeneralizedGravity(model, own, q))
    columns = [pin.rnea(model, own, q, zero, unit) - weight for unit in np.eye(model.nv)]
    half = 0.5 * np.array(columns)
    return np.asarray(half + half.T)


class Axis(NamedTuple):
    """Placement and axis of a joint, at zero of its coordinate.

    placement : pin.SE3 in the parent's frame.  subspace (6,) : unit twist [linear; angular] of the joint.
    ratio : derivative of the joint's angle by its coordinate; 1 unless it is a follower.
    """

    placement: Any
    subspace: Array
    ratio: float


def axis_of(model: pin.Model, joint: int) -> Axis:
    """Axis of a joint with one degree of freedom, or of a follower."""
    kind = model.joints[joint]
    data, ratio = kind.createData(), 1.0
    kind.calc(data, pin.neutral(model))
    if kind.shortname() == MIMIC:
        ratio = float(kind.extract().scaling)
    subspace = np.asarray(data.S, dtype=float).reshape(6) / ratio
    return Axis(model.jointPlacements[joint] * data.M, subspace, ratio)


class ForwardKinematics:
    """Forward kinematics of a model of revolute and prismatic joints, with or without a free-flyer.

    Arrays of length `joints` are without the universe: joint j of the model is at j - 1.
    """

    def __init__(self, model: pin.Model) -> None:
        joints = range(1, model.njoints)
        self._free = [j for j in joints if model.joints[j].nv == 6]  # the free-flyer, or none
        axes = {j: axis_of(model, j) for j in joints if j not in self._free}
        fixed = [axes[j].placement if j in axes else model.jointPlacements[j] for j in joints]
        self._rotation = np.array([place.rotation for place in fixed]).reshape(-1, 3, 3)
        self._translation = np.array([place.translation for place in fixed]).reshape(-1, 3)
        self._q = np.array([model.joints[j].idx_q for j in joints], dtype=np.intp)
        self._unbounded = np.array([model.joints[j].nq == 2 for j in joints], dtype=bool)
        turn, slide = np.zeros((len(joints), 3)), np.zeros((len(joints), 3))
        for k, j in enumerate(joints):
            if j in axes:
                slide[k], turn[k] = np.split(axes[j].subspace, 2)
        self._ratio = np.array([axes[j].ratio if j in axes else 1.0 for j in joints])
        self._slide = np.einsum("jab,jb->ja", self._rotation, slide)
        # Rodrigues' formula about the axis a: R (a a' + c (1 - a a') + s [a]x), three constant matrices of
        # which an angle gives the factors
        along, turned = np.einsum("ja,jb->jab", turn, turn), np.array([pin.skew(a) for a in turn])
        self._parts = [self._rotation @ part for part in (along, np.eye(3) - along, turned)]
        self._turns = turn.any(axis=1)
        parents = np.array(list(model.parents))
        depth = np.zeros(model.njoints, dtype=np.intp)
        for j in joints:
            depth[j] = depth[parents[j]] + 1
        # joints of equal depth in the tree are computed together, after their parents
        levels = (np.flatnonzero(depth == level) for level in range(1, depth.max(initial=0) + 1))
        self._levels = [(own, parents[own]) for own in levels]

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Rotations (k, joints, 3, 3) and translations (k, joints, 3) [m] at configurations q (k, nq)."""
        position = self._ratio * q[:, self._q]  # (k, joints) angle or travel, unused for the free-flyer
        angle = np.where(self._turns, position, 0.0)
        cosine, sine = np.cos(angle), np.sin(angle)
        # a continuous joint has its cosine and sine in q
        cosine[:, self._unbounded] = q[:, self._q[self._unbounded]]
        sine[:, self._unbounded] = q[:, self._q[self._unbounded] + 1]
        # placement of each joint in its parent: local (k, joints, 3, 3), shift (k, joints, 3)
        along, across, turned = self._parts
        local = along + cosine[:, :, None, None] * across + sine[:, :, None, None] * turned
        shift = self._translation + self._slide * position[:, :, None]
        for j in self._free:
            at = int(self._q[j - 1])
            local[:, j - 1] = self._rotation[j - 1] @ _of_quaternions(q[:, at + 3 : at + 7])
            shift[:, j - 1] = self._translation[j - 1] + q[:, at : at + 3] @ self._rotation[j - 1].T
        rotation = np.zeros((len(q), len(self._q) + 1, 3, 3))
        translation = np.zeros((len(q), len(self._q) + 1, 3))
        rotation[:, 0] = np.eye(3)
        for own, parents in self._levels:
            above = rotation[:, parents]
            rotation[:, own] = above @ local[:, own - 1]
            translation[:, own] = translation[:, parents] + (above @ shift[:, own - 1, :, None])[..., 0]
        return rotation, translation


def _of_quaternions(q: Array) -> Array:
    """Rotations (k, 3, 3) of unit quaternions (k, 4), the scalar last."""
    x, y, z, w = q.T
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(entries, axis=1).reshape(-1, 3, 3)
