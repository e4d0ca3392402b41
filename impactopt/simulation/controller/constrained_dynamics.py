"""Accelerations and wrenches as functions of the torques, of a robot on soles, with hands that hold on.

H a + h = S' tau + J' w and J a + dJ/dt v = 0 give a = A tau + a0 and w = B tau + b0. So a QP over
accelerations and wrenches under the equation of motion has as many unknowns as there are torques.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from impactopt.robots.robot import Robot

__all__ = ["HeldDynamics"]

Array = NDArray[np.float64]
_AXES = pin.LOCAL_WORLD_ALIGNED


class HeldDynamics:
    """A robot on soles, at a state; h points of it strike.

    A (nv, n), a0 (nv,) : accelerations.  B (6 a sole and a hand that holds on, n), b0 : wrenches of the
    ground on the frames at their origins, in world axes.  places : of these frames.
    hands (h, 3, nv) : Jacobians of the striking points.  hand_places (h, 3) [m] : where they are.
    hand_drift (h, 3) [m/s^2] : their accelerations where joints have none.
    back : the part of b0 that would bring soles back to where they stood.
    recoil (nv, h) : how velocities change by a unit impulse against the normal at each.
    """

    def __init__(
        self,
        robot: Robot,
        soles: tuple[str, ...],
        strikers: tuple[str, ...],
        normal: Array,
        q0: Array,
        *,
        holding: tuple[str, ...] = (),
    ) -> None:
        self.model, self.normal = robot.model, normal
        self.data: Any = robot.model.createData()
        self._soles = [self.model.getFrameId(name) for name in soles]
        self._held = [*self._soles, *(self.model.getFrameId(name) for name in holding)]
        self._strikers = [self.model.getFrameId(name) for name in strikers]
        nv, n, rows, h = robot.nv, robot.n, 6 * len(self._held), len(strikers)
        self._n, self._nv = n, nv
        # as LAPACK has them, by columns: torques, none, what brings soles back, unit forces at the hands
        self._left = np.zeros((nv + rows, nv + rows), order="F")
        self._right = np.zeros((nv + rows, n + 2 + h), order="F")
        self.hands = np.zeros((h, 3, nv))
        self.hand_places, self.hand_drift = np.zeros((2, h, 3))
        self._right[nv - n : nv, :n] = np.eye(n)
        self._upper = np.triu(np.ones((nv, nv)), 1) + 0.5 * np.eye(nv)  # of H, half its diagonal
        self._none = np.zeros(nv)
        pin.framesForwardKinematics(self.model, self.data, q0)
        self._stood = [self.data.oMf[i].copy() for i in self._soles]

    def look(self, q: Array, v: Array, forces: Array | float = 0.0, bandwidth: float = 0.0) -> None:
        """Go to q (nq), v (nv), with forces (h,) [N] on the striking points, against the normal."""
        model, data, nv, n = self.model, self.data, self._nv, self._n
        left, right = self._left, self._right
        pin.forwardKinematics(model, data, q, v, self._none)
        pin.computeJointJacobians(model, data)
        half = pin.crba(model, data, q) * self._upper
        np.add(half, half.T, out=left[:nv, :nv])
        right[:nv, n] = -pin.nonLinearEffects(model, data, q, v)
        self.places = []
        for k, i in enumerate(self._held):
            rows = slice(nv + 6 * k, nv + 6 * k + 6)
            self.places.append(pin.updateFramePlacement(model, data, i).copy())
            J = pin.getFrameJacobian(model, data, i, _AXES)
            left[rows, :nv], left[:nv, rows] = J, -J.T
            right[rows, n] = -pin.getFrameClassicalAcceleration(model, data, i, _AXES).vector
            if k >= len(self._soles):  # a grip holds by itself
                continue
            at, stood = self.places[-1], self._stood[k]
            turned = pin.log3(at.rotation @ stood.rotation.T)
            away = np.zeros(6)  # a sole that has slid stays where it is
            away[2], away[3:5] = at.translation[2] - stood.translation[2], turned[:2]
            right[rows, n + 1] = -(bandwidth**2) * away - 2 * bandwidth * (J @ v)
        for k, i in enumerate(self._strikers):
            self.hand_places[k] = pin.updateFramePlacement(model, data, i).translation
            self.hands[k] = np.reshape(pin.getFrameJacobian(model, data, i, _AXES), (6, nv))[:3]
            self.hand_drift[k] = pin.getFrameClassicalAcceleration(model, data, i, _AXES).linear
            right[:nv, n + 2 + k] = -self.normal @ self.hands[k]
        _, _, found, _ = dgesv(left, right)
        push = found[:, n + 2 :] @ np.broadcast_to(forces, len(self._strikers))
        self.A, self.a0 = found[:nv, :n], (found[:, n] + push + found[:, n + 1])[:nv]
        self.recoil = found[:nv, n + 2 :]
        self.B, self.b0 = found[nv:, :n], (found[:, n] + push + found[:, n + 1])[nv:]
        self.back = found[nv:, n + 1]

    def pulled(self, which: NDArray[np.bool_], torque: Array) -> None:
        """Joints (n,) have torques (n,) [N m] that are no choice: springs'."""
        pull = np.where(which, torque, 0.0)
        self.a0, self.b0 = self.a0 + self.A @ pull, self.b0 + self.B @ pull
        self.A, self.B = self.A * ~which, self.B * ~which
