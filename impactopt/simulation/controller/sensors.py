"""Sensors of the whole-body controller, and its estimate of the state from them.

The inertial unit is Xsens' MTi-300 (data sheet of Movella, May 2023): roll and pitch within 0.2 degrees RMS,
gyroscope with 0.01 deg/s/sqrt(Hz) and a bias of 10 deg/h. Two properties are assumed: encoders behind the
gears have 19 bits, and rates are their differences over a sample; the hand's force sensor has a noise of 2 N.

The base's orientation is that of the inertial unit. Its position and velocity follow from leg kinematics,
with soles at rest where they began to stand: the mean over the soles, weighted by load.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.robots.robot import Robot

# standard deviations, at noise = 1
ENCODER = 2 * np.pi / 2**19 / np.sqrt(12)  # [rad] quantization: uniform over one count
TILT = np.deg2rad(0.2)  # [rad] of roll and pitch, constant during a replay
ORIENTATION_NOISE = np.deg2rad(0.02)  # [rad] from sample to sample
GYRO_DENSITY = np.deg2rad(0.01)  # [rad/s/sqrt(Hz)]
GYRO_BIAS = np.deg2rad(10.0 / 3600)  # [rad/s], constant during a replay
HAND_FORCE = 2.0  # [N] of the wrist's sensor
CONTACT_DEVIATIONS = 10.0  # standard deviations of a force reading that counts as contact


@dataclass(frozen=True)
class Measured:
    """Sensor readings at one instant.

    angles, rates (n,) : of the joints [rad, rad/s]
    rotation (3, 3) : of the base
    gyro (3,) [rad/s] : angular velocity of the base, in its own axes
    forces (h,) [N] : against the normal, at each striking point
    """

    angles: Array
    rates: Array
    rotation: Array
    gyro: Array
    forces: Array


class Sensors:
    """Sensors of a robot, with random errors.

    noise : factor of all errors.  rate [Hz] : of samples.  seed : of the errors.

    contact_force : [N] of a reading that counts as contact; noise never reaches it.
    """

    def __init__(self, robot: Robot, *, noise: float, rate: float, seed: int) -> None:
        self.n, self.noise, self.contact_force = robot.n, noise, CONTACT_DEVIATIONS * noise * HAND_FORCE
        self._random = np.random.default_rng(seed)
        # the accuracy in the data sheet is that of roll and pitch; yaw has no constant error here
        self._tilt = TILT * self._random.standard_normal(3) * [1.0, 1.0, 0.0]
        self._bias = GYRO_BIAS * self._random.standard_normal(3)
        # a rate is a difference of two readings; white noise has the bandwidth rate / 2
        self._rate_noise, self._gyro_noise = np.sqrt(2) * ENCODER * rate, GYRO_DENSITY * np.sqrt(rate / 2)

    def read(self, angles: Array, v: Array, rotation: Array, forces: Array) -> Measured:
        """Readings for joint angles (n,), velocity v (nv,), base rotation (3, 3) and forces (h,)."""
        s, n, drawn = self.noise, self.n, self._random.standard_normal(6 + 2 * self.n + len(forces))
        # on the left: about the world's axes
        error = pin.exp3(s * (self._tilt + ORIENTATION_NOISE * drawn[:3]))
        gyro = v[3:6] if len(v) >= n + 6 else np.zeros(3)
        return Measured(
            angles=angles + s * ENCODER * drawn[3 : 3 + n],
            rates=v[-n:] + s * self._rate_noise * drawn[3 + n : 3 + 2 * n],
            rotation=error @ rotation,
            gyro=gyro + s * (self._bias + self._gyro_noise * drawn[3 + 2 * n : 6 + 2 * n]),
            forces=forces + s * HAND_FORCE * drawn[6 + 2 * n :],
        )


class StateEstimate:
    """Estimate of a robot's state from its sensors, for soles at rest.

    soles : frames of the model that stand.  q0 (nq,) : configuration at the beginning of their stance.
    """

    def __init__(self, robot: Robot, soles: tuple[str, ...], q0: Array) -> None:
        self.model, self.floating, self._angles = robot.model, robot.floating, robot.angles
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        self.data: Any = robot.model.createData()
        self._placements = dict[int, Any]()  # of the standing soles, by frame number
        self.stand(soles, q0)

    def stand(self, soles: tuple[str, ...], q: Array) -> None:
        """Sets the soles that stand from now on.

        Those that stood before keep their placement; the others stand where q (nq,) has them.
        """
        pin.framesForwardKinematics(self.model, self.data, q)
        frames = [self.model.getFrameId(name) for name in soles]
        self._placements = {i: self._placements.get(i, self.data.oMf[i].copy()) for i in frames}

    def of(self, measured: Measured, loads: Array, points: Array) -> tuple[Array, Array]:
        """q (nq,), v (nv,) from readings.

        loads (soles,) : weights of the soles.
        points (soles, 3) [m] : point of each sole that is at rest, in the sole's frame.
        """
        model, data = self.model, self.data
        q, v = self._angles.put(np.zeros(self._nq), measured.angles), np.zeros(self._nv)
        v[-self._n :] = measured.rates
        if not self.floating:
            return q, v
        q[3:7] = pin.Quaternion(measured.rotation).coeffs()
        v[3:6] = measured.gyro
        pin.forwardKinematics(model, data, q, v)
        weights = loads / loads.sum()
        # so far the base is at the origin, with no linear velocity: move it so that each sole's point is in
        # its place, at rest
        position, velocity = np.zeros(3), np.zeros(3)
        for (i, standing), point, weight in zip(self._placements.items(), points, weights, strict=True):
            now = pin.updateFramePlacement(model, data, i)
            position += weight * (standing.act(point) - now.act(point))
            moves = pin.getFrameVelocity(model, data, i, pin.LOCAL)
            # velocity of the sole's point: v + omega x point, in the sole's axes
            velocity -= weight * (now.rotation @ (moves.linear - pin.skew(point) @ moves.angular))
        q[:3], v[:3] = position, measured.rotation.T @ velocity
        return q, v
