"""Friction of the striking points in an engine, with the deflections of its bristles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.friction import ContactFriction, deflection_rate, lean

Array = NDArray[np.float64]


class SlidingPoints:
    """Striking points with friction on the target, in the state that `update` sets.

    Deflections (h, 3) [m] of the h points' bristles and normal forces (h,) [N] are given to each method;
    friction without `bristles` does not depend on them.
    """

    def __init__(self, friction: ContactFriction) -> None:
        self.friction, self.bristles = friction, friction.bristles
        self._normal, self._v = np.zeros(3), np.zeros(0)
        self._jacobians: Sequence[Array] = ()

    def update(self, normal: Array, jacobians: Sequence[Array], v: Array) -> None:
        """Sets the normal (3,), the points' Jacobians (3, nv) and v (nv,)."""
        self._normal, self._jacobians, self._v = normal, jacobians, v

    def force_map(self, deflections: Array, forces: Array) -> Array:
        """Generalized forces (h, nv) of a unit of normal force at each point, with its friction."""
        n, v = self._normal, self._v
        if not self.bristles:
            return np.array([self.friction.way(n, J @ v) @ J for J in self._jacobians])
        points = zip(self._jacobians, deflections, forces, strict=True)
        return np.array([self.friction.way(n, J @ v, z, f) @ J for J, z, f in points])

    def deflected(self, deflections: Array, forces: Array, step: float) -> Array:
        """Deflections (h, 3) [m] after a step [s]."""
        points, n, v = zip(self._jacobians, deflections, forces, strict=True), self._normal, self._v
        return np.array([self.friction.deflected(n, J @ v, z, f, step) for J, z, f in points])

    def rates(self, deflections: Array, forces: Array) -> Array:
        """Rates (h, 3) [m/s] of the deflections."""
        points, n, v = zip(self._jacobians, deflections, forces, strict=True), self._normal, self._v
        coefficient, slip_speed, stiffness = self.friction.parameters
        leaning = [(J @ v, lean(z, f, coefficient, stiffness)) for J, z, f in points]
        return np.array([deflection_rate(n, speed, leaned, slip_speed) for speed, leaned in leaning])
