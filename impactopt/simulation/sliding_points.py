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

    surface (3,) : velocity [m/s] of the target across the normal, if friction moves it
    """

    def __init__(self, friction: ContactFriction) -> None:
        self.friction, self.bristles = friction, friction.bristles
        self._normal, self._v = np.zeros(3), np.zeros(0)
        self._jacobians: Sequence[Array] | Array = ()
        self.surface, self._ways = np.zeros(3), np.zeros((0, 3))

    def update(self, normal: Array, jacobians: Sequence[Array] | Array, v: Array) -> None:
        """Sets the normal (3,), the points' Jacobians (3, nv) and v (nv,)."""
        self._normal, self._jacobians, self._v = normal, jacobians, v

    def force_map(self, deflections: Array, forces: Array) -> Array:
        """Generalized forces (h, nv) of a unit of normal force at each point, with its friction."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        self._ways = np.array([self.friction.way(self._normal, v, z, f) for v, z, f in points])
        return np.array([way @ J for way, J in zip(self._ways, self._jacobians, strict=True)])

    def on_target(self, forces: Array) -> Array:
        """Friction (3,) [N] on the target of normal forces (h,) [N], as of the last `force_map`."""
        return np.asarray(forces @ (self._ways - self._normal))

    def _speeds(self) -> list[Array]:
        """Velocities (3,) [m/s] of the points, across the normal against the target."""
        return [J @ self._v - self.surface for J in self._jacobians]

    def deflected(self, deflections: Array, forces: Array, step: float) -> Array:
        """Deflections (h, 3) [m] after a step [s]."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        return np.array([self.friction.deflected(self._normal, v, z, f, step) for v, z, f in points])

    def rates(self, deflections: Array, forces: Array) -> Array:
        """Rates (h, 3) [m/s] of the deflections."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        coefficient, slip_speed, stiffness = self.friction.parameters
        leaning = [(v, lean(z, f, coefficient, stiffness)) for v, z, f in points]
        return np.array([deflection_rate(self._normal, v, leaned, slip_speed) for v, leaned in leaning])
