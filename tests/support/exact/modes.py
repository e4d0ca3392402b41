"""The frozen collision as linear equations with constant coefficients, one set for each phase.

With z = (state of `JointSpaceModel`, 1) a phase has dz/dt = M z, and lasts as long as certain linear forms
of z keep within bounds: the rate of penetration, the force in restitution, each joint's demand where it may
saturate and its velocity where friction has a transition band, and the target's switch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collision.model import JointSpaceModel
from support.exact.linear_contact import force_coefficients, target_modes

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Phase:
    """What a phase is told by: compression or restitution; of each joint the sign of the torque limit that
    it is at, and of the velocity beyond friction's transition band, or 0; the target's mode."""

    compressing: bool
    saturated: Array
    sliding: Array
    mode: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Watch:
    """Linear forms (w, N) of z with their bounds (w), and what each is of: (name, number of the joint)."""

    rows: Array
    lower: Array
    upper: Array
    of: list[tuple[str, int]]


class Modes:
    """Equations and bounds of the phases.

    Parameters
    ----------
    model : the collision in joint space; not one with several freezes, and without the peak.
    data : its data by name, as arrays.

    Raises
    ------
    InputError : law or target that are not linear between events.
    """

    def __init__(self, model: JointSpaceModel, data: dict[str, Array]) -> None:
        self.model, self.data, n = model, data, model.n
        self.laws = force_coefficients(model.law, _numbers(model.law_numbers(data)))
        self.modes = target_modes(model.target, _numbers(model.target_numbers(data)))
        self.size = model.n_states + 1
        unit = np.eye(self.size)
        self.part = {name: unit[place] for name, place in model.layout.items()}
        self.one, time, impulse = unit[-1], self.part["time"][0], self.part["impulse"][0]
        drift = {name: data[name] if name in data else np.zeros(1) for name in ("d", "e")}
        # joint velocities less those at contact, and the hand's speed: integrals of eqs. (9), (15), (16)
        self.u = np.zeros((n, self.size))
        self.hand = data["hand_speed"] * self.one - data["m"] * impulse + drift["e"] * time
        if n:
            A, s = _symmetric(data["A"], n), data["s"]
            self.u = A @ self.part["torque"] - np.outer(s, impulse) + np.outer(drift["d"], time)
            self.hand = self.hand + s @ self.part["torque"]
        # the servo's demand (eqs. 10, 11)
        self.demand = -_times(data["kd"], self.u) if n else self.u
        if n and model.effects.stiffness:
            self.demand = self.demand + _times(data["kp"], self.part["deviation"])
        if n and model.effects.feedforward:
            self.demand = self.demand + np.outer(data["feedforward"], self.one)
        self.joint_velocity = self.u
        if model.effects.friction:
            self.joint_velocity = self.u + np.outer(data["joint_velocity"], self.one)

    # ------------------------------------------------------------ forms
    def rate(self, phase: Phase) -> Array:
        """Of penetration [m/s] (N)."""
        return self.hand - self._target(self.modes[phase.mode].velocity, phase, np.zeros(self.size))

    def force(self, phase: Phase, *, compressing: bool | None = None) -> Array:
        """[N] (N) of the phase's branch, or of the one asked for."""
        f_0, k, d = self.laws[phase.compressing if compressing is None else compressing]
        return f_0 * self.one + k * self.part["penetration"][0] + d * self.rate(phase)

    def _target(self, row: Array, phase: Phase, force: Array) -> Array:
        """A form of the target's state, force and one as a form of z."""
        k = self.model.target.n_states
        return row[..., :k] @ self.part["target"] + row[..., k : k + 1] * force + row[..., k + 1 :] * self.one

    def matrix(self, phase: Phase) -> Array:
        """M (N, N)."""
        model, force = self.model, self.force(phase)
        tau = np.where(phase.saturated[:, None] == 0, self.demand, 0.0)
        if model.effects.saturation:
            tau = tau + np.outer(phase.saturated * self.data["torque_limit"], self.one)
        if model.effects.friction:
            viscous, coulomb = self.data["viscous"], self.data["coulomb"]
            slope = viscous + np.where(phase.sliding == 0, coulomb / model.transition, 0.0)
            tau = tau - slope[:, None] * self.joint_velocity
            tau = tau - np.outer(phase.sliding * coulomb, self.one)
        rates = {
            "time": self.one,
            "penetration": self.rate(phase),
            "impulse": force,
            "target": self._target(self.modes[phase.mode].derivative, phase, force),
            "torque": tau,
            "deviation": -self.u,
            "torque2": self.part["torque"],
            "impulse2": self.part["impulse"],
        }
        M = np.zeros((self.size, self.size))
        for name, place in model.layout.items():
            M[place] = rates[name]
        return M

    # ------------------------------------------------------------ phases
    def start(self) -> tuple[Array, Phase]:
        """(z, phase) at contact."""
        z = np.append(self.model.start(), 1.0)
        none = np.zeros(self.model.n)
        first = Phase(compressing=True, saturated=none, sliding=none)
        saturated = self._side(self.demand @ z, self._limit())
        sliding = self._side(self.joint_velocity @ z, self._band())
        first = replace(first, saturated=saturated, sliding=sliding)
        rate = self.rate(first)
        # what neither approaches nor parts is decided by the next derivative
        compressing = rate @ z > 0 or (rate @ z == 0 and rate @ self.matrix(first) @ z > 0)
        return z, replace(first, compressing=bool(compressing))

    def fastest(self) -> float:
        """[1/s] the largest rate of any mode, with no joint saturated and friction in its band."""
        none, rates = np.zeros(self.model.n), [1e-12]
        for compressing in (False, True):
            for mode in range(len(self.modes)):
                phase = Phase(compressing=compressing, saturated=none, sliding=none, mode=mode)
                rates.append(float(np.abs(np.linalg.eigvals(self.matrix(phase))).max()))
        return max(rates)

    def watch(self, phase: Phase) -> Watch:
        """What ends the phase as soon as it leaves its bounds."""
        up, down = (0.0, np.inf), (-np.inf, 0.0)
        rows, bounds, of = [self.rate(phase)], [up if phase.compressing else down], [("rate", 0)]
        if not phase.compressing:
            rows, bounds, of = [*rows, self.force(phase)], [*bounds, up], [*of, ("force", 0)]
        mode = self.modes[phase.mode]
        if mode.watched is not None:
            rows.append(self._target(mode.watched, phase, self.force(phase)))
            bounds, of = [*bounds, mode.bounds], [*of, ("target", 0)]
        for name, forms, sides, level in (
            ("saturated", self.demand, phase.saturated, self._limit()),
            ("sliding", self.joint_velocity, phase.sliding, self._band()),
        ):
            for i in np.flatnonzero(np.isfinite(level)):
                rows.append(forms[i])
                side, edge = sides[i], level[i]
                bounds.append(
                    (-edge, edge) if side == 0 else (edge, np.inf) if side > 0 else (-np.inf, -edge)
                )
                of.append((name, int(i)))
        lower, upper = np.array(bounds).T
        return Watch(rows=np.array(rows), lower=lower, upper=upper, of=of)

    def after(self, phase: Phase, what: tuple[str, int], *, above: bool) -> Phase | None:
        """The phase that follows when a form has left its bounds, above or below; None: separation."""
        name, i = what
        if name == "force":
            return None
        if name == "rate":
            return replace(phase, compressing=not phase.compressing)
        if name == "target":
            return replace(phase, mode=self.modes[phase.mode].following)
        sides: Array = getattr(phase, name).copy()
        sides[i] = (1.0 if above else -1.0) if sides[i] == 0 else 0.0
        changed: dict[str, Any] = {name: sides}
        return replace(phase, **changed)

    def entering(self, phase: Phase, z: Array) -> Array:
        """z at the phase's begin: a target that has stopped has no speed left, not even by rounding."""
        if not self.modes[phase.mode].stopped:
            return z
        z = z.copy()
        z[self.model.layout["target"].start] = 0.0
        return z

    def _limit(self) -> Array:
        n, on = self.model.n, self.model.effects.saturation
        return self.data["torque_limit"] if on else np.full(n, np.inf)

    def _band(self) -> Array:
        return np.full(self.model.n, self.model.transition if self.model.effects.friction else np.inf)

    @staticmethod
    def _side(value: Array, level: Array) -> Array:
        return np.where(np.abs(value) > level, np.sign(value), 0.0)


def _numbers(found: Mapping[str, Array]) -> dict[str, float]:
    return {name: float(np.asarray(value).item()) for name, value in found.items()}


def _symmetric(lower: Array, n: int) -> Array:
    """From its lower triangle, by columns."""
    A = np.zeros((n, n))
    A[np.triu_indices(n)] = lower
    return A + np.triu(A, 1).T


def _times(gain: Array, forms: Array) -> Array:
    """Gain times forms, the gain a matrix or one number a joint."""
    return gain[:, None] * forms if gain.ndim == 1 else gain @ forms
