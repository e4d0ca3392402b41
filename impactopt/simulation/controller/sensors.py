"""Sensor model: encoders, an inertial unit and the hand's force sensor, with their errors.

The inertial unit is Xsens' MTi-300 (data sheet of Movella, May 2023): roll and pitch within 0.2 degrees RMS,
gyroscope with 0.01 deg/s/sqrt(Hz) and a bias of 10 deg/h. Encoders behind the gears have 19 bits, and rates
are their differences over a sample; the hand's force has 2 N: both are assumptions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

__all__ = ["Measured", "Sensors"]

Array = NDArray[np.float64]
ENCODER = 2 * np.pi / 2**19 / np.sqrt(12)  # [rad] of a count, evenly spread
TILT = np.deg2rad(0.2)  # [rad] of roll and pitch: it stays in a replay
FLUTTER = np.deg2rad(0.02)  # [rad] of the orientation from sample to sample
GYRO_DENSITY = np.deg2rad(0.01)  # [rad/s/sqrt(Hz)]
HAND_FORCE = 2.0  # [N] of the wrist's sensor
GYRO_BIAS = np.deg2rad(10.0 / 3600)  # [rad/s]


@dataclass(frozen=True)
class Measured:
    """angles, rates (n,) of the joints; rotation (3, 3) of the base, and its angular velocity (3,) in its own
    axes [rad/s]; forces (h,) [N] against the normal, at each striking point.
    """

    angles: Array
    rates: Array
    rotation: Array
    gyro: Array
    forces: Array


class Sensors:
    """noise : factor of all errors.  rate [Hz] : of samples.  seed : of the errors."""

    def __init__(self, robot: Robot, *, noise: float, rate: float, seed: int) -> None:
        self.n, self.noise = robot.n, noise
        self._random = np.random.default_rng(seed)
        self._tilt = TILT * self._random.standard_normal(3) * [1.0, 1.0, 0.0]
        self._bias = GYRO_BIAS * self._random.standard_normal(3)
        # a difference of two counts; half the rate is the bandwidth
        self._rate, self._gyro = np.sqrt(2) * ENCODER * rate, GYRO_DENSITY * np.sqrt(rate / 2)

    def read(self, angles: Array, v: Array, rotation: Array, forces: Array) -> Measured:
        """Readings for joint angles (n,), velocity v (nv,), base rotation (3, 3) and forces (h,)."""
        s, n, drawn = self.noise, self.n, self._random.standard_normal(6 + 2 * self.n + len(forces))
        off = pin.exp3(s * (self._tilt + FLUTTER * drawn[:3]))
        gyro = v[3:6] if len(v) >= n + 6 else np.zeros(3)
        return Measured(
            angles=angles + s * ENCODER * drawn[3 : 3 + n],
            rates=v[-n:] + s * self._rate * drawn[3 + n : 3 + 2 * n],
            rotation=off @ rotation,
            gyro=gyro + s * (self._bias + self._gyro * drawn[3 + 2 * n : 6 + 2 * n]),
            forces=forces + s * HAND_FORCE * drawn[6 + 2 * n :],
        )
