"""Servo, motors, delays and gear loads of a replay."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.robots.actuators import numbers_of
from impactopt.robots.robot import Robot


class Servo:
    """Joint servo: feed-forward, stiffness and damping about a sampled reference, saturated.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n). A time that occurs twice marks a jump.
    kp, kd, limit : factors of the servo's kp, kd and torque limit.

    Joints without a motor (`Robot.passive`) have a spring and a damper, at rest at the reference's start, to
    which the factors do not apply.
    """

    def __init__(
        self, robot: Robot, reference: Any, *, kp: float = 1.0, kd: float = 1.0, limit: float = 1.0
    ) -> None:
        self.n = robot.n
        self.kp, self.kd, self.limit = kp * robot.kp, kd * robot.kd, limit * robot.torque_limit
        self.time: list[float] = np.asarray(reference.time).tolist()
        self.continuous = robot.angles.continuous
        angles = robot.joint_positions(reference.q)
        angles[:, self.continuous] = np.unwrap(angles[:, self.continuous], axis=0)
        rates, torques = np.array(reference.v[:, -robot.n :]), np.array(reference.torque)
        # springs do not follow the plan: they carry the tool at rest at first, and deflect from there
        passive = robot.passive
        angles[:, passive], rates[:, passive] = angles[0, passive], 0.0
        torques[:, passive] = torques[0, passive]
        self.limit[passive] = np.inf
        self.kp[passive], self.kd[passive] = robot.kp[passive], robot.kd[passive]
        self.reference = np.hstack([angles, rates, torques])

    def target(self, t: float) -> Array:
        """Reference angles, rates and feed-forward (3 n,) at a time [s]; at a jump, the values after it."""
        i = min(max(bisect_right(self.time, t) - 1, 0), len(self.time) - 2)
        # at a jump two times are equal; `bisect_right` takes the later one, so no interval has length 0
        f = min((t - self.time[i]) / (self.time[i + 1] - self.time[i]), 1.0)
        return np.asarray((1 - f) * self.reference[i] + f * self.reference[i + 1])

    def springs(self, angles: Array, rates: Array) -> Array:
        """Torque (n,) [N m] of the springs of joints without a motor; meaningless for the other joints."""
        n, rest = self.n, self.reference[0]
        return rest[2 * n :] + self.kp * (rest[:n] - angles) - self.kd * rates

    def torque(self, t: float, angles: Array, rates: Array) -> tuple[Array, Array]:
        """Torque demand (n,) [N m], and the demand after saturation."""
        target, n = self.target(t), self.n
        error = target[:n] - angles
        if self.continuous.size:  # the shorter way round
            error[self.continuous] = np.remainder(error[self.continuous] + np.pi, 2 * np.pi) - np.pi
        demand = target[2 * n :] + self.kp * error + self.kd * (target[n : 2 * n] - rates)
        return demand, np.minimum(np.maximum(demand, -self.limit), self.limit)


class GearWatch:
    """Torque of largest magnitude through each gear since the last recorded instant.

    The peak of an impact may be shorter than the time between two recorded instants.
    """

    def __init__(self, robot: Robot) -> None:
        self._armature = robot.armature
        self._high, self._low = np.zeros((2, robot.n))

    def update(self, torque: Array, acceleration: Array) -> None:
        """Records an instant: torque (n,) [N m] of the motors, acceleration (nv,) of the robot."""
        # the motor's share that accelerates its own rotor does not pass the gear
        load = torque - self._armature * acceleration[-len(self._armature) :]
        # both signs apart, as the largest magnitude may be of either
        np.maximum(self._high, load, out=self._high)
        np.minimum(self._low, load, out=self._low)

    def take(self) -> Array:
        """Largest torque (n,) [N m] so far; the record begins anew."""
        largest = np.where(self._high >= -self._low, self._high, self._low)
        self._high[:], self._low[:] = 0.0, 0.0
        return largest


@dataclass(frozen=True, kw_only=True)
class MotorCut:
    """Cut of a joint's demand by its motor's torque-speed line.

    duration [s], largest cut (most) [N m], first instant (since) [s].
    """

    joint: str
    duration: float
    most: float
    since: float

    def describe(self) -> dict[str, float | str]:
        """JSON form, as it stands in ``summary.json``."""
        return {
            "joint": self.joint,
            "ms": 1e3 * self.duration,
            "most_Nm": self.most,
            "since_s": self.since,
        }


class Motors:
    """Torque that motors produce for a demand; joints without motor data produce all of it.

    At speed w, full voltage gives the torque stall_torque (1 - w / no_load_speed), and full reverse voltage
    -stall_torque (1 + w / no_load_speed): a motor brakes harder than it drives. Friction shifts both lines
    against the motion. Between them the torque approaches the demand as a current through an inductance does,
    with the rate 2 pi bandwidth.
    """

    def __init__(self, robot: Robot) -> None:
        stall, idle, coulomb, viscous, bandwidth = (
            numbers_of(robot.actuators, name)
            for name in (
                "stall_torque",
                "no_load_speed",
                "coulomb_friction",
                "viscous_friction",
                "bandwidth",
            )
        )
        known = ~np.isnan(stall)
        self.lines = bool(known.any())
        self._stall = np.where(known, stall, np.inf)
        # friction counts only for motors with a line
        self._slope = np.where(known, stall / idle + viscous, 0.0)
        self._coulomb = np.where(known, coulomb, 0.0)
        self._rate = np.where(np.isnan(bandwidth), np.inf, 2 * np.pi * bandwidth)
        self._slow = bool(np.isfinite(self._rate).any())

    def cut(self, torque: Array, rates: Array) -> Array:
        """Torque (n,) [N m], clipped to the motors' lines at joint rates (n,)."""
        if not self.lines:
            return torque
        # back-EMF and viscous friction, linear in the rate, and dry friction
        lost = self._slope * rates + self._coulomb * np.sign(rates)
        # not np.clip, which takes three times as long
        return np.minimum(np.maximum(torque, -self._stall - lost), self._stall - lost)

    def now(self, torque: Array, wanted: Array) -> Array:
        """Present torque (n,) [N m]: `wanted` of motors without inductance, `torque` of the others."""
        return np.where(np.isfinite(self._rate), torque, wanted) if self._slow else wanted

    def after(self, torque: Array, wanted: Array, time: float) -> Array:
        """Torque (n,) [N m] a time [s] later, for a constant wanted torque (n,)."""
        if not self._slow:
            return wanted
        return wanted + np.exp(-self._rate * time) * (torque - wanted)  # first-order lag

    def mean(self, torque: Array, wanted: Array, time: float) -> Array:
        """Mean torque (n,) [N m] during a time [s], for a constant wanted torque (n,)."""
        if not self._slow:
            return wanted
        # infinite of a motor without inductance: the factor of the difference is 1 / inf = 0
        decay = self._rate * time
        # the exponential in `after`, integrated and divided by the time
        return wanted - np.expm1(-decay) / decay * (torque - wanted)


class Delay:
    """Delay of each joint, from reading the joints to setting their torque."""

    def __init__(self, robot: Robot) -> None:
        delay = numbers_of(robot.actuators, "delay")
        self._delay = np.where(np.isnan(delay), 0.0, delay)
        self._longest = float(self._delay.max())
        self._kept: deque[tuple[float, Array]] = deque()

    def keep(self, t: float, values: Array) -> None:
        """Stores the commanded values (..., n) of a time [s], later than all before."""
        if not self._longest:
            return
        # the oldest needed instant is the last one before the longest delay
        while len(self._kept) > 1 and self._kept[1][0] <= t - self._longest:
            self._kept.popleft()
        self._kept.append((t, values))

    def at(self, t: float, now: Array) -> Array:
        """Values (..., n) that reach the motors at a time [s], while those commanded are `now` (..., n).

        They are linear between the stored instants, and constant before the first.
        """
        if not self._longest:
            return now
        out = np.array(now)
        times = np.array([*(time for time, _ in self._kept), t])
        values = [*(value for _, value in self._kept), now]
        for delay in np.unique(self._delay[self._delay > 0]):
            then, late = t - delay, self._delay == delay
            k = min(max(int(np.searchsorted(times, then)), 1), len(times) - 1)
            span = times[k] - times[k - 1]
            f = min(max((then - times[k - 1]) / span, 0.0), 1.0) if span > 0 else 1.0
            out[..., late] = ((1 - f) * values[k - 1] + f * values[k])[..., late]
        return out


class CutWatch:
    """Record of the joints whose demand was cut by their motor's line, and for how long."""

    def __init__(self, robot: Robot) -> None:
        self._names, n = robot.joint_names, robot.n
        self._limit = robot.torque_limit
        self._time, self._most, self._since = np.zeros(n), np.zeros(n), np.full(n, np.inf)

    def update(self, t: float, wanted: Array, cut: Array, step: float) -> None:
        """Records a step [s] from a time [s], with torques (n,) [N m] before and after the line."""
        lost = np.abs(wanted - cut)
        is_cut = lost > 1e-9 * self._limit
        self._time += step * is_cut
        self._most = np.maximum(self._most, lost)
        self._since = np.where(is_cut, np.minimum(self._since, t), self._since)

    def cuts(self) -> tuple[MotorCut, ...]:
        """Cuts of all joints with any, the longest first."""
        order = [int(k) for k in np.argsort(-self._time, kind="stable") if self._time[k] > 0]
        return tuple(
            MotorCut(
                joint=self._names[k],
                duration=float(self._time[k]),
                most=float(self._most[k]),
                since=float(self._since[k]),
            )
            for k in order
        )
