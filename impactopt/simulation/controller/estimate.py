"""The state of the robot from what its sensors tell.

The base's orientation is the inertial unit's. Its place is where the legs put it if the soles are where they
stood in the beginning, and its velocity if they rest there: the mean over the soles, by their loads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.controller.sensors import Measured

__all__ = ["StateEstimate"]

Array = NDArray[np.float64]


class StateEstimate:
    """soles : frames of the model that stand.  q0 (nq,) : configuration in which they began to."""

    def __init__(self, robot: Robot, soles: tuple[str, ...], q0: Array) -> None:
        self.model, self.floating = robot.model, robot.floating
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        self.data: Any = robot.model.createData()
        joints = list(robot.model.joints)[-robot.n :]
        self._place = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        self._continuous = np.flatnonzero([joint.nq == 2 for joint in joints])
        self._soles = [self.model.getFrameId(name) for name in soles]
        pin.framesForwardKinematics(self.model, self.data, q0)
        self._stood = [self.data.oMf[i].copy() for i in self._soles]

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
        for i, stood, point, part in zip(self._soles, self._stood, points, share, strict=True):
            at = pin.updateFramePlacement(model, data, i)
            place += part * (stood.act(point) - at.act(point))
            moves = pin.getFrameVelocity(model, data, i, pin.LOCAL)
            speed -= part * (at.rotation @ (moves.linear - pin.skew(point) @ moves.angular))
        q[:3], v[:3] = place, measured.rotation.T @ speed
        return q, v
