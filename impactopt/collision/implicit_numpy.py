"""The implicit steps of native/implicit.h in NumPy, for machines without a C compiler: the same method,
events and error control, a hundred times slower. The loop is a CasADi callback, so that all before and after
it, the freezes and the outputs, is the graph that the other methods have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.bernstein import first_negative, largest
from impactopt.collision.implicit import STAGES, gamma, linear_contact, tables
from impactopt.collision.model import JointSpaceModel

__all__ = ["implicit_loop"]

Array = NDArray[np.float64]

# as in native/implicit.h, which says what they are
_JUST_BEYOND, _AT_ONCE, _FIRST_STEP, _WORTH_LONGER, _AIMED_AT = 1e-9, 1e-5, 0.5, 2e-3, 0.2
_OF_LIMIT, _MOST_TRIES, _TERMS = 1e-2, 200, STAGES + 1

_TABLES = tables()
_POWERS, _AT_ONE = np.asarray(_TABLES["POWERS"]), np.asarray(_TABLES["AT_ONE"])
_HULL = np.asarray(_TABLES["HULL"])[:, :_TERMS]
_LEFT_OUT = float(np.asarray(_TABLES["LEFT_OUT"]))
_GAMMA = gamma()

# CasADi does not own callbacks: one that is gone while a function calls it would crash the process
_ALIVE: list[ca.Callback] = []


def implicit_loop(
    model: JointSpaceModel, *, tolerance: float, most_steps: int, spacing: float, columns: int
) -> Any:
    """ca.Function (y, *data) -> (state at separation, or at the freeze's end; states (n_states, columns)).

    tolerance : as of `SymbolicModel`.  most_steps : after which it ends.  spacing [s] : of the states, of
    which the last is repeated.
    """
    loop = _Loop(model, tolerance, most_steps, spacing, columns)
    _ALIVE.append(loop)
    return loop


class _Loop(ca.Callback):
    def __init__(
        self, model: JointSpaceModel, tolerance: float, most_steps: int, spacing: float, columns: int
    ) -> None:
        ca.Callback.__init__(self)
        self.model, self.tolerance, self.most_steps = model, tolerance, most_steps
        self.spacing, self.columns = spacing, columns
        self.contact = linear_contact(model.law, model.target)
        self.construct("implicit_loop", {})

    def get_n_in(self) -> int:
        return 1 + len(self.model.data)

    def get_n_out(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> Any:
        shape = [*self.model.data.values()][i - 1] if i else (self.model.n_states, 1)
        return ca.Sparsity.dense(*shape)

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(self.model.n_states, self.columns if i else 1)

    def eval(self, given: list[Any]) -> list[Any]:
        y, *values = [np.array(x, dtype=float) for x in given]
        data = dict(zip(self.model.data, values, strict=True))
        with np.errstate(all="ignore"):
            try:
                states = _Run(self, data).states(y.ravel())
            except np.linalg.LinAlgError:
                states = np.full((max(self.columns, 1), self.model.n_states), np.nan)
        return [ca.DM(states[-1]), ca.DM(states[: self.columns].T)]


@dataclass
class _Instant:
    """What follows from a state."""

    u: Array
    demand: Array
    free: NDArray[np.bool_]
    net: Array
    rate: float
    compressing: bool
    contact: bool


@dataclass
class _Contact:
    """Law and target in the piece where the step begins."""

    f_0: float
    k: float
    d: float
    rates: Array
    at: Array
    inverse: Array
    moved: Array
    mobility: float


@dataclass
class _Series:
    """w_j of a step, and what depends on it; the first of each is the value at the begin.

    states (9, n_states) of the model, without second integrals and peak; speeds, demand (9, n).
    """

    states: Array
    speeds: Array
    demand: Array
    rate: Array
    force: Array


class _Run:
    """One collision, or one freeze of it."""

    def __init__(self, loop: _Loop, data: Mapping[str, Array]) -> None:
        self.loop, self.model = loop, loop.model
        model, n = self.model, self.model.n
        self.parts, self.data = model.layout, data

        def vector(name: str, default: float = 0.0) -> Array:
            return data[name].ravel() if name in data else np.full(n, default)

        self.Q = np.zeros((n + 1, n + 1))
        if n:
            A = np.zeros((n, n))
            A[np.triu_indices(n)] = data["A"].ravel()  # its lower triangle by columns
            self.Q[:n, :n] = A + np.triu(A, 1).T
            self.Q[:n, n] = self.Q[n, :n] = data["s"].ravel()
        self.Q[n, n] = data["m"].item()
        self.drift = np.append(vector("d"), data["e"].item() if "e" in data else 0.0)
        self.hand_speed = data["hand_speed"].item()
        self.until = data["until"].item() if model.refrozen else model.horizon
        self.kd, self.kp = vector("kd"), vector("kp")
        self.limit = vector("torque_limit", np.inf)
        self.viscous, self.coulomb = vector("viscous"), vector("coulomb")
        self.velocity, self.before = vector("joint_velocity"), vector("velocity_before")
        self.feedforward = vector("feedforward")
        self.saturates, self.slides = model.terms.saturation and n > 0, model.terms.friction and n > 0
        self.law = {name: data[f"contact_{name}"].item() for name in model.law.parameters}
        self.target = {name: data[f"target_{name}"].item() for name in model.target.parameters}
        self.slopes = np.array(loop.contact[0](ca.DM(list(self.law.values()))))
        self.of_target = ca.DM(list(self.target.values()))
        self.kept: tuple[float, Array, Array] | None = None  # step, D and X of the last factorization

    # ------------------------------------------------------------ instants
    def part(self, y: Array, name: str) -> Array:
        place = self.parts.get(name)
        return np.zeros(self.model.n) if place is None else y[place]

    def number(self, y: Array, name: str) -> float:
        return float(y[self.parts[name]][0])

    def look(self, y: Array) -> _Instant:
        T = np.append(self.part(y, "torque"), -self.number(y, "impulse"))
        speeds = self.Q @ T + self.drift * self.number(y, "time")
        z = y[self.parts["target"]]
        rate = speeds[-1] + self.hand_speed - float(self.model.target.velocity([*z], self.target))
        u = speeds[:-1] + self.before
        demand = self.kp * self.part(y, "deviation") - self.kd * u + self.feedforward
        torque = np.clip(demand, -self.limit, self.limit)
        net = torque
        if self.slides:
            joint_rate = self.velocity + u
            sign = np.clip(joint_rate / self.model.transition, -1.0, 1.0)
            net = torque - (self.viscous * joint_rate + self.coulomb * sign)
        left = float(self.model.law.branch(self.number(y, "penetration"), rate, False, self.law))
        return _Instant(
            u=u,
            demand=demand,
            free=torque == demand,
            net=net,
            rate=rate,
            compressing=rate > 0.0,
            contact=rate > 0.0 or left > 0.0,
        )

    def contact_here(self, y: Array, now: _Instant, g: float, mobility: float) -> _Contact:
        f_0, k, d = (float(x) for x in self.slopes[:, int(now.compressing)])
        z, nz = y[self.parts["target"]], self.model.target.n_states
        if not nz:
            none = np.zeros(0)
            return _Contact(f_0, k, d, none, none, np.zeros((0, 0)), none, mobility)
        force = f_0 + k * self.number(y, "penetration") + d * now.rate
        Z, G, at = (np.array(x) for x in self.loop.contact[1](z, force, self.of_target))
        rates = np.array([float(x) for x in self.model.target.derivative([*z], force, self.target)])
        inverse: Array = np.asarray(np.linalg.inv(np.eye(nz) - g * Z), dtype=float)
        moved = inverse @ G.ravel()
        return _Contact(f_0, k, d, rates, at.ravel(), inverse, moved, mobility + float(at.ravel() @ moved))

    # ------------------------------------------------------------ one step
    def series(self, y: Array, now: _Instant, h: float) -> tuple[_Series, _Contact]:
        model, parts, n, g = self.model, self.parts, self.model.n, _GAMMA * h
        kp = self.kp * now.free
        D = (self.kd + g * self.kp) * now.free
        if self.slides:
            band = np.abs(self.velocity + now.u) <= model.transition
            D = D + self.viscous + band * self.coulomb / model.transition
        if self.kept is None or self.kept[0] != h or not np.array_equal(self.kept[1], D):
            damped = np.eye(n + 1)
            damped[:, :n] += g * self.Q[:, :n] * D
            self.kept = (h, D, np.asarray(np.linalg.solve(damped, self.Q), dtype=float))
        X = self.kept[2]
        c = self.contact_here(y, now, g, float(X[n, n]))
        slope = c.k * g + c.d
        has_springs = "deviation" in parts
        springs = parts["deviation"] if has_springs else slice(0, 0)
        joints, hand, target = parts["torque"], parts["impulse"], parts["target"]
        s = _Series(
            np.zeros((_TERMS, model.n_states)),
            np.zeros((_TERMS, n)),
            np.zeros((_TERMS, n)),
            np.zeros(_TERMS),
            np.zeros(_TERMS),
        )
        s.states[0], s.speeds[0], s.demand[0], s.rate[0] = y, now.u, now.demand, now.rate
        s.force[0] = c.f_0 + c.k * self.number(y, "penetration") + c.d * now.rate
        b = np.zeros(model.n_states)  # the right-hand side
        b[joints], b[hand], b[parts["penetration"]], b[target] = now.net, s.force[0], now.rate, c.rates
        if has_springs:
            b[springs] = -now.u
        b, time = h * b, h
        b[parts["time"]] = h
        for j in range(STAGES):
            # S b: speeds, force, rate and target of it
            drift = self.drift * time
            rho = np.append(b[joints] - g * D * drift[:n], -b[hand])
            if has_springs:
                rho[:n] += g * kp * b[springs]
            speeds = drift + X @ rho
            held = c.inverse @ b[target]
            rate = speeds[n] - float(c.at @ held)
            penetration = float(b[parts["penetration"]][0])
            force = (c.k * penetration + slope * rate) / (1.0 + slope * g * c.mobility)
            rate -= g * c.mobility * force
            speeds = speeds - X[:, n] * (g * force)
            z = held + g * c.moved * force
            w = s.states[j + 1]
            v = speeds[:n]
            net = -D * v
            if has_springs:
                net = net + kp * b[springs]
            if j == 0:
                w[joints] = b[joints] + g * net
                w[hand] = b[hand] + g * force
                w[parts["penetration"]] = penetration + g * rate
                w[target], w[parts["time"]] = z, h
                if has_springs:
                    w[springs] = b[springs] - g * v
                s.speeds[1], s.rate[1], s.force[1] = v, rate, force
            else:
                w[joints], w[hand], w[parts["penetration"]] = h * net, h * force, h * rate
                w[target] = (z - s.states[j][target]) / _GAMMA
                if has_springs:
                    w[springs] = -h * v
                s.speeds[j + 1] = (v - s.speeds[j]) / _GAMMA
                s.rate[j + 1] = (rate - s.rate[j]) / _GAMMA
                s.force[j + 1] = (force - s.force[j]) / _GAMMA
            s.demand[j + 1] = -self.kd * s.speeds[j + 1]
            if has_springs:
                s.demand[j + 1] += self.kp * w[springs]
            b, time = w, h if j == 0 else 0.0
        # time is linear, which the powers p_j of h J are not; `state_at` knows
        return s, c

    def error_of(self, s: _Series, scale: float) -> float:
        """What a further term would add, of what is allowed."""
        impulse = s.states[:, self.parts["impulse"]].ravel()
        error = abs(s.rate[STAGES]) / max(scale, abs(s.rate[1]))
        error = max(error, abs(impulse[STAGES]) / max(impulse[0], abs(impulse[1]), 1e-300))
        error *= _LEFT_OUT / self.loop.tolerance
        if self.saturates:
            most = float(np.max(np.abs(s.demand[STAGES]) / self.limit))
            error = max(error, most * _LEFT_OUT / _OF_LIMIT)
        return float(error)

    def state_at(self, y: Array, s: _Series, h: float, theta: float) -> Array:
        """The state at a part of the step, but for what only its end has."""
        p = _AT_ONE if theta == 1.0 else _powers(theta)
        moved: Array = p @ s.states
        moved[self.parts["time"]] = self.number(y, "time") + h * theta
        for name in ("peak", "torque2", "impulse2"):
            if name in self.parts:
                moved[self.parts[name]] = y[self.parts[name]]
        return moved

    def move(self, y: Array, s: _Series, h: float, theta: float) -> Array:
        moved, parts = self.state_at(y, s, h, theta), self.parts
        if "torque2" in parts:
            p = h * _integrals(theta)
            moved[parts["torque2"]] += p @ s.states[:, parts["torque"]]
            moved[parts["impulse2"]] += p @ s.states[:, parts["impulse"]]
        if "peak" in parts:
            moved[parts["peak"]] = largest(s.force @ _HULL, theta, self.number(y, "peak"))
        return moved

    # ------------------------------------------------------------ events
    def event(self, y: Array, now: _Instant, s: _Series, end: float) -> float | None:
        """The part of the step after which the phase is another one; None: not before `end`."""
        falling = [(1.0 if now.compressing else -1.0) * (s.rate @ _HULL)]
        if not now.compressing:
            falling.append(s.force @ _HULL)
        if self.saturates:
            falling += _levels(s.demand, np.zeros(self.model.n), self.limit)
        if self.slides:
            falling += _levels(s.speeds, self.velocity, np.full(self.model.n, self.model.transition))
        if self.model.target.n_states:
            z = y[self.parts["target"]]
            values, by_z, by_force = (
                np.array(x) for x in self.loop.contact[2](z, s.force[0], self.of_target)
            )
            terms = s.states[:, self.parts["target"]] @ by_z.T + np.outer(s.force, by_force.ravel())
            terms[0] = values.ravel()
            for b in terms.T @ _HULL if terms.size else ():
                side = b[0] if b[0] != 0.0 else b[1]
                falling.append(-b if side < 0.0 else b)
        places = [place for b in falling if (place := first_negative(b)) is not None and place < end]
        return min(places, default=None)

    # ------------------------------------------------------------ from y to separation, or the freeze's end
    def states(self, y: Array) -> Array:
        """(columns + 1, n_states), the last at the end."""
        columns, spacing, kept = self.loop.columns, self.loop.spacing, [y]
        scale = h = 0.0
        repeated = 0
        for _ in range(self.loop.most_steps):
            now = self.look(y)
            time = self.number(y, "time")
            if not now.contact or not time < self.until:
                break
            left = self.until - time
            scale = max(scale, abs(now.rate))
            if h == 0.0:
                c = self.contact_here(y, now, 0.0, float(self.Q[-1, -1]))
                rate = max(c.d * c.mobility, sqrt(max(c.k * c.mobility, 0.0)))
                h = _FIRST_STEP / rate if rate * left > _FIRST_STEP else left
            for _ in range(_MOST_TRIES):
                s, _contact = self.series(y, now, h)
                error = self.error_of(s, scale)
                if not error > 1.0:
                    break
                h *= max(0.2, 0.9 * error ** (-1.0 / _TERMS))
            if not np.isfinite(error):
                y = np.full_like(y, np.nan)
                break
            end = min(1.0, left / h)
            at = self.event(y, now, s, end)
            repeated = repeated + 1 if at is not None and at < _AT_ONCE and repeated < 8 else 0
            theta = end
            if at is not None:
                theta = min(end, at + _JUST_BEYOND * max(at, _AT_ONCE * (1 << 3 * repeated)))
            while len(kept) < columns - 1 and (part := (len(kept) * spacing - time) / h) < theta:
                kept.append(self.state_at(y, s, h, part))
            y = self.move(y, s, h, theta)
            if theta == end and end < 1.0:
                y[self.parts["time"]] = self.until
            if at is None and error < _WORTH_LONGER and left > 2.0 * h:
                h *= min((_AIMED_AT / error) ** (1.0 / _TERMS) if error > 0.0 else 4.0, 4.0)
        if np.isnan(self.look(y).rate):
            y = np.full_like(y, np.nan)
        return np.array([*kept[: max(columns - 1, 0)], *[y] * max(columns - len(kept), 1), y])


def _levels(w: Array, offset: Array, level: Array) -> list[Array]:
    """What falls below zero where |a joint's series| crosses its level, of those that may."""
    b = w.T @ _HULL + offset[:, None]
    within = np.abs(b[:, 0]) <= level
    out = []
    for i in np.flatnonzero(np.where(within, (np.abs(b) > level[:, None]).any(axis=1), True)):
        if within[i]:
            out += [level[i] + b[i], level[i] - b[i]]
        else:
            out.append(np.sign(b[i, 0]) * b[i] - level[i])
    return out


def _powers(theta: float) -> Array:
    p: Array = _POWERS @ theta ** np.arange(_TERMS)
    return p


def _integrals(theta: float) -> Array:
    orders = np.arange(1, _TERMS + 1)
    p: Array = _POWERS @ (theta**orders / orders)
    return p
