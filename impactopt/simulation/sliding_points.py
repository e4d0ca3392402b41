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
        self.friction, self.bristles = friction, friction.stiffness > 0
        self._normal, self._jacobians, self._velocities = np.zeros(3), [np.zeros((3, 0))], [np.zeros(3)]

    def update(self, normal: Array, jacobians: Sequence[Array], v: Array) -> None:
        """Sets the normal (3,), the points' Jacobians (3, nv) and v (nv,)."""
        self._normal, self._jacobians, self._velocities = normal, list(jacobians), [J @ v for J in jacobians]

    def force_map(self, deflections: Array, forces: Array) -> Array:
        """Generalized forces (h, nv) of a unit of normal force at each point, with its friction."""
        points = zip(self._jacobians, self._velocities, deflections, forces, strict=True)
        return np.array([self.friction.way(self._normal, v, z, f) @ J for J, v, z, f in points])

    def deflected(self, deflections: Array, forces: Array, step: float) -> Array:
        """Deflections (h, 3) [m] after a step [s]."""
        points = zip(self._velocities, deflections, forces, strict=True)
        return np.array([self.friction.deflected(self._normal, v, z, f, step) for v, z, f in points])

    def rates(self, deflections: Array, forces: Array) -> Array:
        """Rates (h, 3) [m/s] of the deflections."""
        coefficient, slip_speed, stiffness = self.friction.parameters
        points = zip(self._velocities, deflections, forces, strict=True)
        return np.array(
            [
                deflection_rate(self._normal, v, lean(z, f, coefficient, stiffness), slip_speed)
                for v, z, f in points
            ]
        )
