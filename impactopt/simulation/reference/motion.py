"""The collision's equations of motion, and their integration by Runge-Kutta steps that end on events.

The configuration is q = q_0 [+] u (Pinocchio's integrate): one chart of it covers the collision, whose motion
is small, so a step is a classical one on a plain vector, with du/dt = J_log(u) v for the free-flyer. All is
smooth between events; the step that meets one is cut there, which keeps the method's fourth order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.simulation.pinocchio_robot import Body
from impactopt.simulation.reference.forces import Forces, Phase

__all__ = ["Instant", "Motion"]

Array = NDArray[np.float64]
# of a full step: how far a step goes on beyond its event, so that the next one starts in the new phase; the
# forces are continuous there, so its square is what this costs
_BEYOND = 1e-5


class Instant(NamedTuple):
    """What a record keeps of an instant. The wrenches are on the held frames, at their `places`."""

    time: float
    force: float
    penetration: float
    hand_speed: float
    target_speed: float
    joint_velocity: Array
    torque: Array
    demand: Array
    wrench: Array
    places: Array


class _State(NamedTuple):
    """A state with what its phase and its rates depend on."""

    time: float
    y: Array
    hand_speed: float
    rate: float
    demand: Array


class Motion:
    """A collision from contact at q (nq), v (nv) on.

    Its state is y = (u (nv), v (nv), penetration, impulse, target's state).
    """

    def __init__(self, body: Body, forces: Forces, q: Array, v: Array) -> None:
        self.body, self.forces, self._q = body, forces, q
        self._nv, self._n = body.nv, body.n
        self._floating = body.nv > body.n
        self._start = np.concatenate([np.zeros(body.nv), v, np.zeros(2 + forces.target.n_states)])

    def run(self, step: float, horizon: float, record: Callable[[Instant], None]) -> tuple[Array, bool]:
        """(last state, whether the contact ended before the horizon); `record` gets every step's instant.

        Raises
        ------
        InputError : the motion diverges.
        """
        state = self._look(0.0, self._start)
        while True:
            phase = self._phase(state)
            slope, instant = self._rates(state, phase, keep=True)
            record(instant)
            left = horizon - state.time
            if not phase.touching or left <= 1e-9 * horizon:
                return state.y, not phase.touching
            length = min(step, left)
            following = self._step(state, slope, phase, length)
            if not np.isfinite(following.y).all():
                raise InputError(
                    f"step [s]: {step:g} is unstable here (at {state.time:.3g} s of contact); "
                    "give a shorter one"
                )
            state = self._cut(state, slope, phase, length, following)

    def _cut(self, state: _State, slope: Array, phase: Phase, length: float, following: _State) -> _State:
        """The state at the end of a step, or just beyond the first event in it."""
        beyond = _BEYOND * length
        # a target may jump at its switches, so that no stage may see one: halves lead up to it, and a step
        # too short to matter across
        while length > beyond and self._switched(following, phase):
            length /= 2
            following = self._step(state, slope, phase, length)
        first, last = self._margins(state, phase), self._margins(following, phase)
        if last.min() >= 0:
            return following
        low, high = 0.0, length
        for k in range(60):
            if high - low <= 2 * beyond:
                break
            if k % 3 == 2:  # secants may creep
                middle = 0.5 * (low + high)
            else:
                crossed = last < 0
                a, b = np.maximum(first[crossed], 0.0), last[crossed]
                middle = min(low + (high - low) * float((a / (a - b)).min()) + beyond, high - beyond)
            trial = self._step(state, slope, phase, middle)
            margins = self._margins(trial, phase)
            if margins.min() < 0:
                high, last, following = middle, margins, trial
            else:
                low, first = middle, margins
        # a cut step leaves the body where the last trial was
        return self._look(following.time, following.y)

    def _step(self, state: _State, k1: Array, phase: Phase, h: float) -> _State:
        t, y = state.time, state.y
        k2 = self._slope(t + h / 2, y + h / 2 * k1, phase)
        k3 = self._slope(t + h / 2, y + h / 2 * k2, phase)
        k4 = self._slope(t + h, y + h * k3, phase)
        return self._look(t + h, y + h / 6 * (k1 + 2 * (k2 + k3) + k4))

    # ------------------------------------------------------------ one instant
    def _look(self, time: float, y: Array) -> _State:
        nv, n = self._nv, self._n
        u, v = y[:nv], y[nv : 2 * nv]
        speed = self.body.look(pin.integrate(self.body.model, self._q, u), v)
        rate = speed - self.forces.target_speed(y[2 * nv + 2 :])
        return _State(time, y, speed, rate, self.forces.demand(time, u[-n:], v[-n:]))

    def _of(self, state: _State) -> tuple[Array, Array, float, float]:
        """Demand, joint velocity, penetration and its rate."""
        nv, y = self._nv, state.y
        return state.demand, y[2 * nv - self._n : 2 * nv], float(y[2 * nv]), state.rate

    def _phase(self, state: _State) -> Phase:
        return self.forces.phase(*self._of(state), state.y[2 * self._nv + 2 :])

    def _margins(self, state: _State, phase: Phase) -> Array:
        return self.forces.margins(phase, *self._of(state))

    def _switched(self, state: _State, phase: Phase) -> bool:
        if not phase.switches.size:
            return False
        _, _, penetration, rate = self._of(state)
        force = self.forces.contact(penetration, rate, phase.compressing)
        switches = self.forces.switches(state.y[2 * self._nv + 2 :], force)
        return bool((switches * phase.switches < 0).any())

    def _slope(self, time: float, y: Array, phase: Phase) -> Array:
        return self._rates(self._look(time, y), phase)[0]

    def _rates(self, state: _State, phase: Phase, *, keep: bool = False) -> tuple[Array, Any]:
        """(dy/dt, the instant where it is to be kept) with the body where `_look` has left it."""
        nv, forces, y = self._nv, self.forces, state.y
        demand, velocity, penetration, rate = self._of(state)
        force = forces.contact(penetration, rate, phase.compressing) if phase.touching else 0.0
        torque = forces.torque(demand, phase)
        a = self.body.accelerate(torque - forces.friction(velocity, phase), force)
        slope = np.empty_like(y)
        slope[:nv] = y[nv : 2 * nv]
        if self._floating:
            slope[:6] = pin.Jlog6(pin.exp6(y[:6])) @ y[nv : nv + 6]
        slope[nv : 2 * nv] = a
        slope[2 * nv], slope[2 * nv + 1] = rate, force
        slope[2 * nv + 2 :] = forces.target_rates(y[2 * nv + 2 :], force)
        if not keep:
            return slope, None
        target = state.hand_speed - rate
        instant = Instant(
            state.time,
            force,
            penetration,
            state.hand_speed,
            target,
            velocity,
            torque,
            demand,
            self.body.wrenches().ravel(),
            self.body.places(),
        )
        return slope, instant
