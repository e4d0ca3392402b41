"""The robot's servo as it follows a reference: what both engines apply to the joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

Array = NDArray[np.float64]


class Servo:
    """Feed-forward, stiffness and damping about a sampled reference, saturated.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n). An instant that stands twice is a jump.
    kp, kd, limit : factors of the robot's kp, kd and torque limit.

    Joints that nothing drives (`Robot.passive`) have a spring and a damper at rest at the reference's start.
    """

    def __init__(
        self, robot: Robot, reference: Any, *, kp: float = 1.0, kd: float = 1.0, limit: float = 1.0
    ) -> None:
        self.n = robot.n
        self.kp, self.kd, self.limit = kp * robot.kp, kd * robot.kd, limit * robot.torque_limit
        self.time = np.asarray(reference.time)
        joints = list(robot.model.joints)[-robot.n :]
        self.place = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        # a continuous joint's angle is kept as (cosine, sine)
        self.continuous = np.flatnonzero([joint.nq == 2 for joint in joints])
        angles = np.array([self.angles(q) for q in reference.q])
        angles[:, self.continuous] = np.unwrap(angles[:, self.continuous], axis=0)
        rates, torques = np.array(reference.v[:, -robot.n :]), np.array(reference.torque)
        # a spring does not know of a plan: it bears the tool at rest at first, and gives way from there
        own = robot.passive
        angles[:, own], rates[:, own], torques[:, own] = angles[0, own], 0.0, torques[0, own]
        self.limit[own] = np.inf
        self.reference = np.hstack([angles, rates, torques])

    def angles(self, q: Array) -> Array:
        """Joint angles (n,) of a configuration; those of continuous joints in [-pi, pi]."""
        out = q[self.place]
        for k in self.continuous:
            out[k] = np.arctan2(q[self.place[k] + 1], q[self.place[k]])
        return out

    def target(self, t: float) -> Array:
        """Reference angles, rates and feed-forward (3 n,) at a time; at a jump, what comes after it."""
        i = min(max(int(np.searchsorted(self.time, t, side="right")) - 1, 0), len(self.time) - 2)
        f = min((t - self.time[i]) / (self.time[i + 1] - self.time[i]), 1.0)
        return np.asarray((1 - f) * self.reference[i] + f * self.reference[i + 1])

    def springs(self, angles: Array, rates: Array) -> Array:
        """Torque (n,) [N m] of the joints that nothing drives, at any time; of the others it is none of
        theirs.
        """
        n, rest = self.n, self.reference[0]
        return rest[2 * n :] + self.kp * (rest[:n] - angles) - self.kd * rates

    def torque(self, t: float, angles: Array, rates: Array) -> tuple[Array, Array]:
        """Torque demand (n,) [N m] and what saturation leaves of it."""
        row, n = self.target(t), self.n
        error = row[:n] - angles
        if self.continuous.size:
            error[self.continuous] = np.remainder(error[self.continuous] + np.pi, 2 * np.pi) - np.pi
        demand = row[2 * n :] + self.kp * error + self.kd * (row[n : 2 * n] - rates)
        return demand, np.clip(demand, -self.limit, self.limit)
