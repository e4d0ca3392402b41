"""Servo, motors and gears of a replay."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.robots.actuators import numbers_of
from impactopt.robots.robot import Robot

__all__ = ["CutWatch", "Delay", "GearWatch", "MotorCut", "Motors", "Servo"]

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
        joints = robot.joint_models
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


@dataclass(frozen=True, kw_only=True)
class MotorCut:
    """Torque cut from a joint's demand by its motor's line: duration [s], largest cut [N m], first instant
    [s].
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

    A motor under its full voltage has the torque stall_torque (1 - w / no_load_speed), and braked by it
    -stall_torque (1 + w / no_load_speed): at speed, it can brake harder than it can drive. Friction takes its
    part of both. The torque goes to what is asked for, inside that, as a current does through an inductance:
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
        # friction is part of the line where there is one
        self._slope = np.where(known, stall / idle + viscous, 0.0)
        self._coulomb = np.where(known, coulomb, 0.0)
        self._rate = np.where(np.isnan(bandwidth), np.inf, 2 * np.pi * bandwidth)
        self._slow = bool(np.isfinite(self._rate).any())

    def cut(self, torque: Array, rates: Array) -> Array:
        """(n,) [N m] what the motors' lines leave of a torque (n,) at joint rates (n,)."""
        if not self.lines:
            return torque
        lost = self._slope * rates + self._coulomb * np.sign(rates)
        return np.clip(torque, -self._stall - lost, self._stall - lost)

    def now(self, torque: Array, wanted: Array) -> Array:
        """(n,) [N m] the torque of motors whose torque is `torque` where it cannot change at once."""
        return np.where(np.isfinite(self._rate), torque, wanted) if self._slow else wanted

    def after(self, torque: Array, wanted: Array, time: float) -> Array:
        """(n,) [N m] the torque (n,) a time [s] later, if one (n,) is wanted all the while."""
        if not self._slow:
            return wanted
        return wanted + np.exp(-self._rate * time) * (torque - wanted)

    def mean(self, torque: Array, wanted: Array, time: float) -> Array:
        """(n,) [N m] of `after`, its mean in that time."""
        if not self._slow:
            return wanted
        turns = self._rate * time
        return wanted - np.expm1(-turns) / turns * (torque - wanted)


class Delay:
    """Delay by joint, from reading the joints to setting their torque."""

    def __init__(self, robot: Robot) -> None:
        delay = numbers_of(robot.actuators, "delay")
        self._delay = np.where(np.isnan(delay), 0.0, delay)
        self._longest = float(self._delay.max())
        self._kept: deque[tuple[float, Array]] = deque()

    def keep(self, t: float, values: Array) -> None:
        """Values (..., n) that are asked for at a time [s], after those kept before."""
        if not self._longest:
            return
        while len(self._kept) > 1 and self._kept[1][0] <= t - self._longest:
            self._kept.popleft()
        self._kept.append((t, values))

    def at(self, t: float, now: Array) -> Array:
        """Demand that reaches the motors at a time [s] at which the present demand is `now` (..., n).

        Linear between the instants that are kept; before the first, the same was asked for.
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
            share = min(max((then - times[k - 1]) / span, 0.0), 1.0) if span > 0 else 1.0
            out[..., late] = ((1 - share) * values[k - 1] + share * values[k])[..., late]
        return out


class CutWatch:
    """Records the joints, and the durations, in which motor lines have cut the demand."""

    def __init__(self, robot: Robot) -> None:
        self._names, n = robot.joint_names, robot.n
        self._limit = robot.torque_limit
        self._time, self._most, self._since = np.zeros(n), np.zeros(n), np.full(n, np.inf)

    def look(self, t: float, wanted: Array, cut: Array, step: float) -> None:
        """Torque (n,) [N m] before and after the line, for a step [s] from a time [s]."""
        lost = np.abs(wanted - cut)
        some = lost > 1e-9 * self._limit
        self._time += step * some
        self._most = np.maximum(self._most, lost)
        self._since = np.where(some, np.minimum(self._since, t), self._since)

    def told(self) -> tuple[MotorCut, ...]:
        """The joints that were cut, the longest first."""
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
