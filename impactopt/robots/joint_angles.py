"""Angles of joints in Pinocchio's configurations, which have the cosine and sine of a continuous joint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
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
