"""Values of a `pin.Model`: joint angles in its configurations, and its mass matrix.

Pinocchio has the cosine and sine of a continuous joint in place of its angle, and its mass matrix lacks some
entries of followers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


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
        angles = np.array(q[..., self._place])
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
