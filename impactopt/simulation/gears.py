"""Gear loads of a replay, evaluated in every step of an engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

Array = NDArray[np.float64]


class GearWatch:
    """Keeps the torque of largest magnitude through each gear since the last recorded instant.

    A blow's peak may last for less than the time between two of these.
    """

    def __init__(self, robot: Robot) -> None:
        self._armature = robot.armature
        self._high, self._low = np.zeros((2, robot.n))

    def look(self, torque: Array, acceleration: Array) -> None:
        """Torque (n,) [N m] of the servos, acceleration (nv,) of the robot."""
        load = torque - self._armature * acceleration[-len(self._armature) :]
        np.maximum(self._high, load, out=self._high)
        np.minimum(self._low, load, out=self._low)

    def taken(self) -> Array:
        """(n,) [N m]; from now on it begins anew."""
        found = np.where(self._high >= -self._low, self._high, self._low)
        self._high[:], self._low[:] = 0.0, 0.0
        return found
