"""What a replay's gears bear, looked at in every step of an engine."""

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
        self._armature, self._most = robot.armature, np.zeros(robot.n)

    def look(self, torque: Array, acceleration: Array) -> None:
        """Torque (n,) [N m] of the servos, acceleration (nv,) of the robot."""
        load = torque - self._armature * acceleration[-len(self._armature) :]
        self._most = np.where(np.abs(load) > np.abs(self._most), load, self._most)

    def taken(self) -> Array:
        """(n,) [N m]; from now on it begins anew."""
        found, self._most = self._most, np.zeros(len(self._armature))
        return found
