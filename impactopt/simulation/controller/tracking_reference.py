"""Reference of the controller: the plan's motion, switched by the impact that the hand senses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.controller.recovery import Recovery
from impactopt.simulation.controller.setpoint import Aim

__all__ = ["Target"]

Array = NDArray[np.float64]
PATIENCE = 0.02  # [s] beyond twice the planned contact; then the motion after it begins in any case


class Target:
    """The reference of a plan, sampled, on the clock of what has happened.

    reference : time (k,), q, v, a, torque, contact_start, contact_end, as of
        :class:`impactopt.transcription.plan.Trajectory`.
    spread : the motion before the blow goes on until the hand is free again, and then that after it begins.
    recovery : what becomes of the follow-through; None: it stays as planned.
    """

    def __init__(
        self,
        robot: Robot,
        reference: Any,
        strikers: tuple[str, ...],
        *,
        spread: bool,
        recovery: Recovery | None = None,
    ) -> None:
        self.model, self.spread, self.recovery = robot.model, spread, recovery
        self._n, self._nv = robot.n, robot.nv
        self.time = np.asarray(reference.time)
        self.q, self.v = np.asarray(reference.q), np.asarray(reference.v)
        self.contact = float(reference.contact_start), float(reference.contact_end)
        data, frames = self.model.createData(), [self.model.getFrameId(name) for name in strikers]
        self.rows = np.array([self._row(data, reference, k, frames) for k in range(len(self.time))])
        self.felt = self.free = np.nan  # [s] when the hand began and ceased to feel a force
        jump = np.flatnonzero(np.diff(self.time) == 0)
        after = jump[self.time[jump] >= self.contact[1] - 1e-9]
        self.last = int(after[0]) if after.size else len(self.time) - 1  # of the motion before

    def _row(self, data: Any, r: Any, k: int, frames: list[int]) -> Array:
        model = self.model
        q, v, a = r.q[k], r.v[k], r.a[k]
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        mass = max(float(pin.computeTotalMass(model)), 1e-9)
        h, dh = data.hg, data.dhg
        hands = []
        for i in frames:
            hands.append(pin.updateFramePlacement(model, data, i).translation)
            hands.append(pin.getFrameVelocity(model, data, i, pin.LOCAL_WORLD_ALIGNED).linear)
            hands.append(pin.getFrameClassicalAcceleration(model, data, i, pin.LOCAL_WORLD_ALIGNED).linear)
        com = data.com[0]
        parts = (
            v,
            a,
            r.torque[k],
            com,
            h.linear / mass,
            dh.linear / mass,
            h.angular,
            dh.angular,
            *hands,
        )
        return np.concatenate(parts)

    def feel(self, t: float, touching: bool) -> None:
        """Updates the contact state from the hand's sensor at a time [s]."""
        if touching and self.before:
            self.felt = t
        elif not touching and self.struck:
            self.free = t

    @property
    def before(self) -> bool:
        """True if the hand has sensed no contact yet."""
        return math.isnan(self.felt)

    @property
    def bounced(self) -> bool:
        """True if the hand was in contact, and is free again."""
        return math.isfinite(self.free)

    @property
    def struck(self) -> bool:
        """True if the hand is in contact, for the first time."""
        return math.isfinite(self.felt) and math.isnan(self.free)

    def near_blow(self, t: float, window: float) -> bool:
        """True during the impact and within a window [s] of it."""
        if math.isfinite(self.felt):
            return math.isnan(self.free) or t < self.free + window
        return bool(self.contact[0] - window <= t <= self.contact[1] + window)

    @property
    def over(self) -> float:
        """[s] when the blow is over, at the latest; nan: the hand has felt nothing yet."""
        start, end = self.contact
        return self.free if math.isfinite(self.free) else self.felt + 2 * (end - start) + PATIENCE

    def recovers(self, t: float) -> bool:
        """True once the robot recovers from the impact."""
        return self.recovery is not None and bool(t >= self.over + self.recovery.start)

    def clock(self, t: float) -> tuple[float, int]:
        """Time [s] in the reference, and the last row that it may take."""
        end, final = self.contact[1], len(self.time) - 1
        if not self.spread:
            return t, final
        if math.isfinite(self.felt):
            return (t, self.last) if t < self.over else (end + t - self.over, final)
        return (t, self.last) if t < end + PATIENCE else (t, final)

    def at(self, t: float) -> Aim:
        """Reference at a time [s]."""
        if self.recovery is None or not self.recovers(t):
            return self._planned(*self.clock(t))
        begun = self.over + self.recovery.start
        gone, rate, gain = self.recovery.clock(t - begun)
        now, last = self.clock(begun)
        return self.recovery.of(self._planned(now + gone, last), rate, gain)

    def _planned(self, now: float, last: int) -> Aim:
        i = int(np.searchsorted(self.time[: last + 1], now, side="right")) - 1
        i = min(max(i, 0), last - 1)
        span = self.time[i + 1] - self.time[i]
        f = (now - self.time[i]) / span if span > 0 else 1.0
        beyond = max(now - self.time[last], 0.0) if last < len(self.time) - 1 else 0.0
        f = min(f, 1.0)
        row = (1 - f) * self.rows[i] + f * self.rows[i + 1]
        q = pin.interpolate(self.model, self.q[i], self.q[i + 1], f)
        n, nv = self._n, self._nv
        v, a, torque = row[:nv], row[nv : 2 * nv], row[2 * nv : 2 * nv + n]
        rest = row[2 * nv + n :]
        com, momentum, hands = rest[:9], rest[9:15], rest[15:].reshape(-1, 3, 3)
        if beyond:  # the motion before the blow coasts on
            q = pin.integrate(self.model, q, beyond * v)
            com = np.concatenate([com[:3] + beyond * com[3:6], com[3:]])
            hands = hands.copy()
            hands[:, 0] += beyond * hands[:, 1]
        return Aim(q, v, a, torque, com.reshape(3, 3), momentum.reshape(2, 3), hands)
