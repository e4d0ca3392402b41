"""Implicit integration of a collision in NumPy, for machines without a C compiler.

The method, its events and its error control are those of native/implicit.h; it is a hundred times slower. The
time loop is a CasADi callback, so that the freezes before it and the outputs after it are the same graph as
with explicit steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from impactopt.collision.implicit import (
    CONTROL,
    STAGES,
    Contact,
    StateMaps,
    Step,
    first_negative,
    largest,
    tables,
)
from impactopt.collision.model import JointSpaceModel

Array = NDArray[np.float64]

_TERMS = STAGES + 1
_TABLES = tables()
_POWERS, _AT_ONE = np.asarray(_TABLES["POWERS"]), np.asarray(_TABLES["AT_ONE"])
_HULL = np.asarray(_TABLES["HULL"])[:, :_TERMS]
_LEFT_OUT = float(np.asarray(_TABLES["LEFT_OUT"]))

# CasADi holds no reference to a callback: a function that calls a deleted one would crash the process
_ALIVE: list[ca.Callback] = []


class ImplicitLoop(ca.Callback):
    """ca.Function (y, *data) -> (final state; states (n_states, columns)).

    The final state is that at separation, or at the end of the freeze.

    tolerance : see `SymbolicModel`.  most_steps : largest number of steps.  spacing [s] : of the states; the
    last one is repeated.
    """

    def __init__(
        self, model: JointSpaceModel, *, tolerance: float, most_steps: int, spacing: float, columns: int
    ) -> None:
        ca.Callback.__init__(self)
        self.model, self.tolerance, self.most_steps = model, tolerance, most_steps
        self.spacing, self.columns = spacing, columns
        self.contact = Contact(model.law, model.target)
        self.construct("implicit_loop", {})
        _ALIVE.append(self)

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
    """Quantities at one state.

    u (n) [rad/s] : change of the joint velocities.  demand (n) [N m] : servo torque before saturation.
    free (n) : joints that are not saturated.  net (n) [N m] : torque less friction.  rate [m/s] : of
        penetration.
    """

    u: Array
    demand: Array
    free: NDArray[np.bool_]
    net: Array
    rate: float
    compressing: bool
    contact: bool


class _Run:
    """Integration of one collision, or of one freeze of it."""

    def __init__(self, loop: ImplicitLoop, data: Mapping[str, Array]) -> None:
        self.loop, self.model, self.is_nonlinear = loop, loop.model, loop.contact.is_nonlinear
        model, n = self.model, self.model.n
        self.parts, self.data = model.layout, data

        def vector(name: str, default: float = 0.0) -> Array:
            return data[name].ravel() if name in data else np.full(n, default)

        Q = np.zeros((n + 1, n + 1))
        if n:
            A = np.zeros((n, n))
            # by columns of the lower triangle is by rows of the upper one
            A[np.triu_indices(n)] = data["A"].ravel()  # its lower triangle by columns
            Q[:n, :n] = A + np.triu(A, 1).T
            Q[:n, n] = Q[n, :n] = data["s"].ravel()
        Q[n, n] = data["m"].item()
        self.inverse_mass = float(Q[n, n])
        self.hand_speed = data["hand_speed"].item()
        self.until = data["until"].item() if model.refrozen else model.horizon
        self.kd, self.kp = _matrix(data.get("kd"), n), _matrix(data.get("kp"), n)
        self.limit = vector("torque_limit", np.inf)
        self.viscous, self.coulomb = vector("viscous"), vector("coulomb")
        self.velocity, self.before = vector("joint_velocity"), vector("velocity_before")
        self.feedforward = vector("feedforward")
        self.saturates, self.slides = model.effects.saturation and n > 0, model.effects.friction and n > 0
        law = {name: data[f"contact_{name}"].item() for name in model.law.parameters}
        target = {name: data[f"target_{name}"].item() for name in model.target.parameters}
        self.law = loop.contact.of(law, target)
        self.maps = self._state_maps(Q, np.append(vector("d"), data["e"].item() if "e" in data else 0.0))

    def _state_maps(self, Q: Array, drift: Array) -> StateMaps:
        """Linear maps of the state, from Q = [A, s; s', m] and drifts of joints and hand (n + 1)."""
        unit, parts = np.eye(self.model.n_states), self.parts
        # [u; w] = Q [integral of torque; -impulse] + drift x time: the state's parts are such integrals
        speeds = Q @ np.vstack([unit[parts["torque"]], -unit[parts["impulse"]]])
        speeds = speeds + np.outer(drift, unit[parts["time"]][0])
        demand = -self.kd @ speeds[:-1]
        if "deviation" in parts:
            demand = demand + self.kp @ unit[parts["deviation"]]
        return StateMaps(
            speeds=speeds,
            demand=demand,
            penetration=unit[parts["penetration"]][0],
            impulse=unit[parts["impulse"]][0],
            target=unit[parts["target"]],
        )

    # ------------------------------------------------------------ instants
    def number(self, y: Array, name: str) -> float:
        return float(y[self.parts[name]][0])

    def instant(self, y: Array) -> _Instant:
        speeds, depth = self.maps.speeds @ y, self.number(y, "penetration")
        rate = float(speeds[-1]) + self.hand_speed - self.law.velocity(y[self.parts["target"]])
        u = speeds[:-1] + self.before
        demand = self.maps.demand @ y - self.kd @ self.before + self.feedforward
        torque = np.clip(demand, -self.limit, self.limit)
        net = torque
        if self.slides:
            joint_rate = self.velocity + u
            sign = np.clip(joint_rate / self.model.transition, -1.0, 1.0)
            net = torque - (self.viscous * joint_rate + self.coulomb * sign)
        compressing = rate > 0.0 or (rate == 0.0 and self._closing(y, depth, net))
        contact = compressing or self.law.separation(depth, rate) > 0.0
        return _Instant(u, demand, torque == demand, net, rate, compressing, contact)

    def _closing(self, y: Array, depth: float, net: Array) -> bool:
        """True if hand and target, now at the same speed, accelerate towards each other."""
        slope, parts, z = np.zeros(y.size), self.parts, y[self.parts["target"]]
        slope[parts["torque"]], slope[parts["time"]] = net, 1.0
        force = slope[parts["impulse"]] = max(self.law.force(depth, 0.0, False)[0], 0.0)
        gained = self.law.velocity(z + 1e-9 * self.law.rates(z, force)) - self.law.velocity(z)
        return bool(self.maps.speeds[-1] @ slope > gained / 1e-9)

    def mobility(self, y: Array, now: _Instant) -> tuple[float, float, float, float]:
        """Inverse mass of hand and target together [1/kg]; contact force and its derivatives."""
        z = y[self.parts["target"]]
        found = self.law.force(self.number(y, "penetration"), now.rate, now.compressing)
        _, G, velocity_by_z = self.law.slopes(z, found[0])
        return (self.inverse_mass + float(velocity_by_z @ G), *found)

    # ------------------------------------------------------------ one step
    def step(self, y: Array, now: _Instant, h: float) -> Step:
        parts, maps = self.parts, self.maps
        # a saturated joint's torque is constant
        slope = now.free[:, None] * maps.demand
        if self.slides:
            band = np.abs(self.velocity + now.u) <= self.model.transition
            damping = self.viscous + band * self.coulomb / self.model.transition
            slope = slope - damping[:, None] * maps.speeds[:-1]
        J, rates = np.zeros((y.size, y.size)), np.zeros(y.size)
        J[parts["torque"]], rates[parts["torque"]] = slope, now.net
        if "deviation" in parts:
            J[parts["deviation"]], rates[parts["deviation"]] = -maps.speeds[:-1], -now.u
        rates[parts["time"]], rates[parts["penetration"]] = 1.0, now.rate
        force = self.law.force(self.number(y, "penetration"), now.rate, now.compressing)[0]
        rates[parts["impulse"]] = force
        rates[parts["target"]] = self.law.rates(y[parts["target"]], force)
        return Step(y, rates, J, maps, self.law, (now.rate, now.compressing), h)

    def terms_of(self, now: _Instant, s: Step) -> tuple[Array, Array]:
        """Terms (9, n) of the joint velocities and of the servo torques before saturation."""
        speeds, demand = s.terms @ self.maps.speeds[:-1].T, s.terms @ self.maps.demand.T
        # with the constants that the maps leave out
        speeds[0], demand[0] = now.u, now.demand
        return speeds, demand

    def error_of(self, now: _Instant, s: Step, scale: float, mobility: float) -> float:
        """Estimated error of a step over the permitted one; NaN if Newton's method has not converged.

        The estimate is the first neglected term, as large as the last one. The speed takes the last two, as
        one alone is next to zero at some phases of an oscillation (with a nail, that left an error of 3e-6).

        scale [m/s] : largest rate of penetration so far.  mobility [1/kg] : of hand and target together.
        """
        if not s.converged:
            return float("nan")
        impulse = s.terms[:, self.parts["impulse"]].ravel()
        least = scale / mobility if self.is_nonlinear else 1e-300
        error = np.abs(s.rate[STAGES - 1 :]).max() / max(scale, abs(s.rate[1]))
        error = max(error, abs(impulse[STAGES]) / max(impulse[0], abs(impulse[1]), least))
        error = max(error, self._error_of_switches(s, scale))
        error *= _LEFT_OUT / self.loop.tolerance
        if self.saturates:
            most = float(np.max(np.abs(self.terms_of(now, s)[1][STAGES]) / self.limit))
            error = max(error, most * _LEFT_OUT / CONTROL.error_of_limit)
        return float(error)

    def _error_of_switches(self, s: Step, scale: float) -> float:
        """Last term of the target's switches, relative to the quantities that they are made of.

        The hand's speed and the impulse hardly depend on a board that vibrates slowly, but this vibration
        decides when it breaks.
        """
        z, force = s.terms[0, self.parts["target"]], s.force[0]
        values, by_z, by_force = self.law.switches(z, force)
        if not values.size:
            return 0.0
        terms = self.switch_terms(s)
        by_speed = np.abs(by_z @ self.law.slopes(z, force)[2]) * scale
        place = np.maximum(np.abs(terms[0]), np.abs(by_z * z).max(axis=1, initial=0.0))
        size = np.max(
            [CONTROL.error_of_switch * place, np.abs(by_force * force), by_speed, np.abs(terms[1])], axis=0
        )
        return float(np.max(np.abs(terms[STAGES]) / np.where(size > 0.0, size, np.inf)))

    def switch_terms(self, s: Step) -> Array:
        """Terms (9, k) of the target's switching functions in the step."""
        z = s.terms[:, self.parts["target"]]
        values, by_z, by_force = self.law.switches(z[0], s.force[0])
        if self.loop.contact.target_is_nonlinear:
            at, forces = s.at_nodes(z), s.at_nodes(s.force)
            return s.through_nodes(values, lambda i: self.law.switches(at[i], float(forces[i]))[0])
        terms: Array = z @ by_z.T + np.outer(s.force, by_force)
        terms[0] = values
        return terms

    def first_step(self, y: Array, now: _Instant, left: float) -> float:
        """Length [s] of the first step, at most the time that is left."""
        mobility, force, k, d = self.mobility(y, now)
        if not self.loop.contact.law_is_nonlinear:
            rate = max(d * mobility, sqrt(max(k * mobility, 0.0)))
            return CONTROL.first_step_phase / rate if rate * left > CONTROL.first_step_phase else left
        h, depth = left, self.number(y, "penetration")
        permitted = CONTROL.first_speed_change_flat if k == 0.0 and d == 0.0 else CONTROL.first_speed_change
        for _ in range(60):
            then = self.law.force(depth + abs(now.rate) * h, now.rate, now.compressing)[0]
            if abs(then - force) * mobility * h <= permitted * abs(now.rate):
                break
            h /= 2
        return h

    def state_at(self, y: Array, s: Step, theta: float) -> Array:
        """State at a fraction of the step, with peak force and second integrals as at its start."""
        p = _AT_ONE if theta == 1.0 else _powers(theta)
        moved: Array = p @ s.terms
        for name in ("peak", "torque2", "impulse2"):
            if name in self.parts:
                moved[self.parts[name]] = y[self.parts[name]]
        return moved

    def move(self, y: Array, s: Step, theta: float) -> Array:
        """State at the end of the step, which is a fraction theta of it."""
        moved, parts = self.state_at(y, s, theta), self.parts
        if "torque2" in parts:
            p = s.h * _integrals(theta)
            moved[parts["torque2"]] += p @ s.terms[:, parts["torque"]]
            moved[parts["impulse2"]] += p @ s.terms[:, parts["impulse"]]
        if "peak" in parts:
            moved[parts["peak"]] = largest(s.force @ _HULL, theta, self.number(y, "peak"))
        return moved

    # ------------------------------------------------------------ events
    def event(self, y: Array, now: _Instant, s: Step, end: float) -> float | None:
        """Fraction of the step at which the phase changes first; None if it does not before `end`.

        Events are the end of compression, separation, a joint that enters or leaves saturation or the
        transition band of its friction, and the switches of the target.
        """
        events = [None if now.compressing else self._separation(s)]
        # Bernstein coefficients of polynomials that become negative at an event
        falling = [(1.0 if now.compressing else -1.0) * (s.rate @ _HULL)]
        speeds, demand = self.terms_of(now, s)
        if self.saturates:
            falling += _levels(demand, np.zeros(self.model.n), self.limit)
        if self.slides:
            falling += _levels(speeds, self.velocity, np.full(self.model.n, self.model.transition))
        for b in self.switch_terms(s).T @ _HULL:
            if b[0] != 0.0:
                falling.append(-b if b[0] < 0.0 else b)
            elif b.any():  # a tie: the target's mode is that of zero, which may not be the next one
                events.append(0.0)
        events += [first_negative(b) for b in falling]
        return min((theta for theta in events if theta is not None and theta < end), default=None)

    def _separation(self, s: Step) -> float | None:
        """Fraction of the step at which contact ends, or None."""
        if not self.loop.contact.law_is_nonlinear:
            return first_negative(s.force @ _HULL)
        depth, depths = s.terms @ self.maps.penetration, s.at_nodes(s.terms @ self.maps.penetration)
        rates = s.at_nodes(s.rate)

        def separation(theta: float) -> float:
            p = _powers(theta)
            return self.law.separation(float(p @ depth), float(p @ s.rate))

        start = separation(0.0)
        terms = s.through_nodes(start, lambda i: self.law.separation(float(depths[i]), float(rates[i])))
        estimate = first_negative(terms @ _HULL)
        # the polynomial approximates a nonlinear law, which has the last word
        if estimate is None or not start > 0.0:
            return estimate
        beyond = next((t for t in np.linspace(estimate, 1.0, 21) if separation(t) <= 0.0), None)
        if beyond is None:
            return estimate
        return float(brentq(separation, 0.0, beyond, xtol=1e-16, rtol=1e-14))

    # ------------------------------------------------------------ integration
    def states(self, y: Array) -> Array:
        """States from y on (columns + 1, n_states); the last is that at separation or at the freeze's end."""
        columns, spacing, kept = self.loop.columns, self.loop.spacing, [y]
        scale = h = first = 0.0
        repeated = 0
        for _ in range(self.loop.most_steps):
            now = self.instant(y)
            time = self.number(y, "time")
            if not now.contact or not time < self.until:
                break
            left = self.until - time
            scale = max(scale, abs(now.rate))
            h = self.first_step(y, now, left) if h == 0.0 else h
            if self.loop.contact.law_is_nonlinear and not now.compressing:
                to_separation = self.number(y, "penetration") / -now.rate if now.rate else np.inf
                h = min(h, CONTROL.separation_fraction * to_separation) if to_separation > 2.0 * first else h
            mobility = self.mobility(y, now)[0]
            for _ in range(CONTROL.max_tries):
                s = self.step(y, now, h)
                error = self.error_of(now, s, scale, mobility)
                if error <= 1.0 or (s.converged and np.isnan(error)):
                    break
                # the neglected term is of order nine in h
                h *= max(0.2, 0.9 * error ** (-1.0 / _TERMS)) if s.converged else CONTROL.retry_factor
            if not np.isfinite(error):
                y = np.full_like(y, np.nan)
                break
            first = first or h
            end = min(1.0, left / h)
            at = self.event(y, now, s, end)
            # immediate events in a row are one whose end rounding hides: overshoot eight times farther each
            # time
            repeated = repeated + 1 if at is not None and at < CONTROL.immediate_event and repeated < 8 else 0
            theta = end
            if at is not None:
                theta = min(
                    end, at + CONTROL.event_overshoot * max(at, CONTROL.immediate_event * (1 << 3 * repeated))
                )
            while len(kept) < columns - 1 and (part := (len(kept) * spacing - time) / h) < theta:
                kept.append(self.state_at(y, s, part))
            y = self.move(y, s, theta)
            if theta == end and end < 1.0:
                # exactly, as the loop ends at this time, and rounding would add a step
                y[self.parts["time"]] = self.until
            lengthen_below = CONTROL.lengthen_below_nonlinear if self.is_nonlinear else CONTROL.lengthen_below
            if at is None and error < lengthen_below and left > 2.0 * h:
                h *= min((CONTROL.aimed_error / error) ** (1.0 / _TERMS) if error > 0.0 else 4.0, 4.0)
        if np.isnan(self.instant(y).rate):
            y = np.full_like(y, np.nan)
        return np.array([*kept[: max(columns - 1, 0)], *[y] * max(columns - len(kept), 1), y])


def _matrix(gain: Array | None, n: int) -> Array:
    """Gain matrix (n, n), diagonal if the gains are one number a joint."""
    if gain is None:
        return np.zeros((n, n))
    return gain if n and gain.shape == (n, n) and n > 1 else np.diag(gain.ravel()[:n])


def _levels(w: Array, offset: Array, level: Array) -> list[Array]:
    """Bernstein coefficients of polynomials that become negative where |w' p + offset| crosses a level.

    w (9, n) : terms.  offset, level (n).  Joints whose coefficients exclude a crossing are left out.
    """
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
    """Polynomials p_j(theta) (9)."""
    p: Array = _POWERS @ theta ** np.arange(_TERMS)
    return p


def _integrals(theta: float) -> Array:
    """Integrals of the p_j from 0 to theta (9)."""
    orders = np.arange(1, _TERMS + 1)
    p: Array = _POWERS @ (theta**orders / orders)
    return p
