"""Sensors of the whole-body controller, and its estimate of the state from them.

The inertial unit is Xsens' MTi-300 (data sheet of Movella, May 2023): roll and pitch within 0.2 degrees RMS,
gyroscope with 0.01 deg/s/sqrt(Hz) and a bias of 10 deg/h. Encoders behind the gears have 19 bits, and rates
are their differences over a sample; the hand's force has 2 N: both are assumptions.

The base's orientation is the inertial unit's. Its place is where the legs put it if the soles are where they
stood as they began to, and its velocity if they rest there: the mean over the soles, by their loads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

__all__ = ["Measured", "Sensors", "StateEstimate"]

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


class StateEstimate:
    """soles : frames of the model that stand.  q0 (nq,) : configuration in which they began to."""

    def __init__(self, robot: Robot, soles: tuple[str, ...], q0: Array) -> None:
        self.model, self.floating = robot.model, robot.floating
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        self.data: Any = robot.model.createData()
        joints = robot.joint_models
        self._place = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        self._continuous = np.flatnonzero([joint.nq == 2 for joint in joints])
        self._stood = dict[int, Any]()
        self.stand(soles, q0)

    def stand(self, soles: tuple[str, ...], q: Array) -> None:
        """Soles that stand from now on: those that did before where they did, others where q (nq,) has
        them.
        """
        pin.framesForwardKinematics(self.model, self.data, q)
        frames = [self.model.getFrameId(name) for name in soles]
        self._stood = {i: self._stood.get(i, self.data.oMf[i].copy()) for i in frames}

    def of(self, measured: Measured, loads: Array, points: Array) -> tuple[Array, Array]:
        """q (nq,), v (nv,).  loads (soles,) : weights;  points (soles, 3) [m] : of each sole, in its frame,
        that rests.
        """
        model, data = self.model, self.data
        q, v = np.zeros(self._nq), np.zeros(self._nv)
        q[self._place] = measured.angles
        for k in self._continuous:
            at = self._place[k]
            q[at], q[at + 1] = np.cos(measured.angles[k]), np.sin(measured.angles[k])
        v[-self._n :] = measured.rates
        if not self.floating:
            return q, v
        q[3:7] = pin.Quaternion(measured.rotation).coeffs()
        v[3:6] = measured.gyro
        pin.forwardKinematics(model, data, q, v)
        share = loads / loads.sum()
        place, speed = np.zeros(3), np.zeros(3)
        for (i, stood), point, part in zip(self._stood.items(), points, share, strict=True):
            at = pin.updateFramePlacement(model, data, i)
            place += part * (stood.act(point) - at.act(point))
            moves = pin.getFrameVelocity(model, data, i, pin.LOCAL)
            speed -= part * (at.rotation @ (moves.linear - pin.skew(point) @ moves.angular))
        q[:3], v[:3] = place, measured.rotation.T @ speed
        return q, v
