"""Contact law, target dynamics and friction of striking points, evaluated numerically for replay engines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from impactopt.arrays import Array
from impactopt.contact.friction import ContactFriction, deflection_rate, lean
from impactopt.errors import InputError
from impactopt.simulation.result import FACE, Scene

MAX_SWITCHES = 20  # of a target within one step
BISECTIONS = 30  # of a step, to locate a switch, or a begin or end of contact
# Tolerances of the contact within a step. The absolute one is in m, N s and units of the target's state.
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-6, 1e-10
NEAR_STEPS = 2.0  # steps before a touch from which on the contact is integrated within them
MAX_POINTS = 20_000  # of the integration within one step; a contact that needs more is refused


@dataclass(frozen=True)
class Push:
    """Contact forces and target motion within one step of an engine in which a contact is near.

    forces (h,) [N] : of each striker, mean over the step
    first_half (h,) [N] : mean over the first half of the step
    peaks (h,) [N] : at the instant at which their sum is largest
    state, travel [m] : of the target, at the end
    depths (h,) [m] : of each striker in the target, at the end
    times (k,) [s] : instants in the step, from its start to its end; two at each begin and end of contact
    total (k,) [N] : sum of the forces then
    given (k,) [N s] : impulse of all strikers since the start of the step
    """

    forces: Array
    first_half: Array
    peaks: Array
    state: Array
    travel: float
    depths: Array
    times: Array
    total: Array
    given: Array


class TargetContact:
    """Contact law and target of a scene, evaluated numerically.

    A target's state (n_states,) is zero before contact. It gives the target's speed only; engines integrate
    the travel.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.law, self.target = scene, scene.law, scene.target
        points = [scene.point, *([] if scene.second is None else [scene.second[1]])]
        # tuples of floats: with three components, arrays would take several times as long
        self._points, self._normal = [tuple(p.tolist()) for p in points], tuple(scene.normal.tolist())
        self._face = scene.face**2
        self.untouched: Array = np.zeros(self.target.n_states)
        # read once, because every step uses them
        self._law_parameters, self._target_parameters = self.law.parameters, self.target.parameters

    def speed(self, state: Array) -> float:
        """Speed [m/s] of the hit surface along the normal."""
        return float(self.target.velocity(state, self._target_parameters))

    def travel_at_start(self, reference: Any) -> float:
        """Travel [m] at the start of a motion, < 0 for a target that moves before contact.

        It is zero at the planned contact.
        """
        before = self.speed(self.untouched)
        return -before * float(reference.contact_start) if before else 0.0

    def depths(self, places: Array, travel: float) -> Array:
        """Depths (h,) [m] of striking points at places (h, 3) [m] in a target with this travel [m].

        Points beside the target's surface have minus infinity.
        """
        depths, (nx, ny, nz) = [], self._normal
        for (x, y, z), (px, py, pz) in zip(places.tolist(), self._points, strict=True):
            dx, dy, dz = x - px, y - py, z - pz
            along = nx * dx + ny * dy + nz * dz
            across = (dx - along * nx) ** 2 + (dy - along * ny) ** 2 + (dz - along * nz) ** 2
            depths.append(-np.inf if across > self._face else along - travel)
        return np.array(depths)

    def forces(self, depths: Array, speeds: Array, state: Array) -> Array:
        """Contact forces (h,) [N] at depths (h,) [m] and speeds along the normal (h,) [m/s]."""
        rates = speeds - self.speed(state)
        pairs = zip(depths, rates, strict=True)
        force, parameters = self.law.force, self._law_parameters
        return np.array(
            [float(force(depth, rate, parameters)) if depth > 0 else 0.0 for depth, rate in pairs]
        )

    def near(self, depths: Array, speeds: Array, state: Array, step: float) -> bool:
        """True if any of the strikers may touch the target within a step [s]."""
        speed, pairs = self.speed(state), zip(depths.tolist(), speeds.tolist(), strict=True)
        # with a margin of 1 m/s on the closing speed
        return any(depth + NEAR_STEPS * step * (abs(rate - speed) + 1.0) > 0 for depth, rate in pairs)

    def pushed(
        self,
        depths: Array,
        speeds: Array,
        accelerations: Array,
        inverse_mass: Array,
        state: Array,
        travel: float,
        step: float,
    ) -> Push:
        """Contact over one step [s] of the engine, integrated with an adaptive step of its own.

        A light target behind a stiff contact may oscillate a thousand times within a step of the engine,
        which the engine could not resolve. Within the step the robot is reduced to its striking points: their
        speeds (h,) [m/s] change by `accelerations` (h,) [m/s2] without the contact, and by -`inverse_mass`
        (h, h) [1/kg] times the contact impulses.

        Raises
        ------
        InputError : the integration fails.
        """
        h = len(speeds)
        first = np.maximum(depths, -FACE)  # beside the target's surface, where depths are -inf: far away

        # y: depths (h,), impulses (h,), travel of the target in this step, state of the target
        def forces(t: float, y: Array) -> tuple[Array, Array, float]:
            """Forces (h,), speeds of the striking points (h,), and speed of the target."""
            hands = speeds + accelerations * t - inverse_mass @ y[h : 2 * h]
            return self.forces(y[:h], hands, y[2 * h + 1 :]), hands, self.speed(y[2 * h + 1 :])

        def rates(t: float, y: Array) -> list[float]:
            force, hands, target = forces(t, y)
            state_rates = self.target.derivative(y[2 * h + 1 :], float(force.sum()), self._target_parameters)
            return [*(hands - target), *force, target, *state_rates]

        begin = np.concatenate([first, np.zeros(h + 1), state])
        found = solve_ivp(
            rates,
            (0.0, step),
            begin,
            method="RK45",  # Newton's method, of implicit ones, does not converge across a target's switches
            rtol=RELATIVE_TOLERANCE,
            atol=ABSOLUTE_TOLERANCE,
            # A touch that begins within the step would else be stepped over, as there is no force before it.
            max_step=0.5 * step,
            first_step=0.5 * step,  # SciPy's own begins far too small
            dense_output=True,
        )
        if not found.success or found.t.size > MAX_POINTS or not np.isfinite(found.y).all():
            raise InputError(
                f"the contact cannot be followed within a step of {step:g} s: soften it, or give the target "
                "more mass"
            )
        end, impulses = found.y[:, -1], found.y[h : 2 * h]

        # The interpolant is for instants between the integration's own.
        known = dict(zip(found.t.tolist(), found.y.T, strict=True))

        @cache
        def found_forces(t: float) -> Array:
            if t not in known:
                known[t] = found.sol(t)
            return forces(t, known[t])[0]

        times = _with_both_sides(found.t, lambda t: bool(found_forces(t).any()))
        values = np.array([found_forces(t) for t in times])
        total = values.sum(axis=1)
        return Push(
            forces=impulses[:, -1] / step,
            first_half=np.array([np.interp(step / 2, found.t, impulse) for impulse in impulses]) / (step / 2),
            peaks=values[int(np.argmax(total))],
            state=np.array(end[2 * h + 1 :]),
            travel=travel + float(end[2 * h]),
            depths=np.where(np.isfinite(depths), end[:h], -np.inf),
            times=times,
            total=total,
            given=np.array([known[t][h : 2 * h].sum() for t in times]),
        )

    def untouched_step(self, state: Array, travel: float, step: float) -> tuple[Array, float]:
        """State and travel [m] after a step [s] without a force, the travel by the trapezoidal rule."""
        after = self.moved(state, 0.0, step)
        return after, travel + step / 2 * (self.speed(state) + self.speed(after))

    def rates(self, state: Array, force: float) -> Array:
        """Time derivative (n_states,) of the target's state."""
        derivative = self.target.derivative(state, force, self._target_parameters)
        return np.array([float(rate) for rate in derivative])

    def side(self, state: Array, force: float) -> tuple[bool, ...]:
        """Signs of the target's switches, True if positive."""
        switches = self.target.switches(state, force, self._target_parameters)
        return tuple(float(switch) > 0 for switch in switches)

    def moved(self, state: Array, force: float, length: float) -> Array:
        """State after a time [s] under a constant force, by the classical Runge-Kutta method of order four.

        It is one step without a switch of the target, or several that end just beyond a switch.

        Unlike Euler's method, it does not let the oscillation of an unbroken board grow.
        """
        if not any(self.target.derivative(state, force, self._target_parameters)):
            return state  # at rest, as before the impact

        def step(s: Array, h: float) -> tuple[Array, bool]:
            """State after a step h [s], and True if no state evaluated in it is beyond a switch."""
            a = self.rates(s, force)
            b = self.rates(second := s + h / 2 * a, force)
            c = self.rates(third := s + h / 2 * b, force)
            d = self.rates(fourth := s + h * c, force)
            after, before = s + h / 6 * (a + 2 * b + 2 * c + d), self.side(s, force)
            return after, all(self.side(x, force) == before for x in (second, third, fourth, after))

        done = 0.0
        for _ in range(MAX_SWITCHES):
            low, high = 0.0, length - done
            after, smooth = step(state, high)
            if smooth:
                return after
            # `step` tells no more than whether a switch is passed, so its length is bisected
            for _ in range(BISECTIONS):  # `low` is before the switch, `high` beyond it
                middle = (low + high) / 2
                low, high = (middle, high) if step(state, middle)[1] else (low, middle)
            state, done = step(state, high)[0], done + high
        return step(state, length - done)[0]


def _with_both_sides(times: Array, touches: Callable[[float], bool]) -> Array:
    """Instants (k,) [s], with two more at each begin and end of contact: just before and just after it.

    touches : tells whether there is a force at a time [s].
    """
    on, more = [touches(t) for t in times], []
    for k in range(len(times) - 1):
        if on[k] != on[k + 1]:
            low, high = times[k], times[k + 1]
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                low, high = (middle, high) if touches(middle) == on[k] else (low, middle)
            more += [low, high]
    return np.union1d(times, more)


class SlidingPoints:
    """Striking points with friction on the target, in the state that `update` sets.

    Deflections (h, 3) [m] of the h points' bristles and normal forces (h,) [N] are given to each method;
    friction without `bristles` does not depend on them.

    surface (3,) : velocity [m/s] of the target across the normal, if friction moves it
    """

    def __init__(self, friction: ContactFriction) -> None:
        self.friction, self.bristles = friction, friction.bristles
        self._normal, self._v = np.zeros(3), np.zeros(0)
        self._jacobians: Sequence[Array] | Array = ()
        self.surface, self._ways = np.zeros(3), np.zeros((0, 3))

    def update(self, normal: Array, jacobians: Sequence[Array] | Array, v: Array) -> None:
        """Sets the normal (3,), the points' Jacobians (3, nv) and v (nv,)."""
        self._normal, self._jacobians, self._v = normal, jacobians, v

    def force_map(self, deflections: Array, forces: Array) -> Array:
        """Generalized forces (h, nv) of a unit of normal force at each point, with its friction."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        self._ways = np.array([self.friction.way(self._normal, v, z, f) for v, z, f in points])
        return np.array([way @ J for way, J in zip(self._ways, self._jacobians, strict=True)])

    def on_target(self, forces: Array) -> Array:
        """Friction (3,) [N] on the target of normal forces (h,) [N], as of the last `force_map`."""
        return np.asarray(forces @ (self._ways - self._normal))

    def _speeds(self) -> list[Array]:
        """Velocities (3,) [m/s] of the points, across the normal against the target."""
        return [J @ self._v - self.surface for J in self._jacobians]

    def deflected(self, deflections: Array, forces: Array, step: float) -> Array:
        """Deflections (h, 3) [m] after a step [s]."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        return np.array([self.friction.deflected(self._normal, v, z, f, step) for v, z, f in points])

    def rates(self, deflections: Array, forces: Array) -> Array:
        """Rates (h, 3) [m/s] of the deflections."""
        points = zip(self._speeds(), deflections, forces, strict=True)
        coefficient, slip_speed, stiffness = self.friction.parameters
        leaning = [(v, lean(z, f, coefficient, stiffness)) for v, z, f in points]
        return np.array([deflection_rate(self._normal, v, leaned, slip_speed) for v, leaned in leaning])
