"""Equations of motion of a collision, integrated with error control in steps that end on events.

The configuration is q = q_0 [+] u (Pinocchio's integrate). The motion is small, so that one chart covers the
collision: the state is a plain vector, with du/dt = J_log(u) v for the free-flyer. SciPy's DOP853 (order
eight) chooses the steps by its error estimates.

A step uses the forces of one phase, continued smoothly beyond the end of the phase. If the phase ends within
the step, the step is repeated up to the event. The derivatives of a target may jump where it switches, so
that no stage of a step may lie beyond a switch: steps lead up to the switch, and then a tiny one across it.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.10 (DOP853).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.integrate import DOP853
from scipy.optimize import brentq, minimize_scalar

from impactopt.arrays import Array
from impactopt.collision.interface import Collision
from impactopt.contact.friction import UNBENT
from impactopt.errors import InputError
from impactopt.simulation.pinocchio_robot import Body
from impactopt.simulation.reference.base import Forces, Phase

_OVERSHOOT = 1e-10  # fraction of a step beyond its event, so that the next step starts in the new phase
# fractions of a step at which events are looked for; an oscillation turns by less than a radian in a step
_EVENT_SAMPLES = (0.25, 0.5, 0.75, 1.0)
# some ten seconds of work: ten thousand oscillations, or a mode far faster than the collision
_MAX_EVALUATIONS = 300_000
_MIN_INSTANTS = 50  # of a history
# Fractions of the contact's time scale: length of the step across a switch, too short to matter; and how far
# ahead the phase is evaluated when hand and target have equal speeds.
_SWITCH_STEP, _TIE_STEP = 1e-12, 1e-6


class Instant(NamedTuple):
    """Recorded quantities of an instant. The wrenches are on the fixed frames, whose origins are `places`."""

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
    """State y at a time, with the quantities on which phase and rates depend; rate: of penetration [m/s]."""

    time: float
    y: Array
    hand_speed: float
    rate: float
    demand: Array


class _Step(NamedTuple):
    """A step: its begin and end [s], interpolation of the state (at), phase, and forces at its ends [N]."""

    begin: float
    end: float
    at: Any
    phase: Phase
    forces: tuple[float, float]


class Run(NamedTuple):
    """An integrated collision: its steps, the last state y, and whether the contact ended."""

    steps: Sequence[_Step]
    final: Array
    separated: bool

    @property
    def impulse(self) -> float:
        """Impulse [N s] on the target."""
        return float(self.final[-1])


class Scales(NamedTuple):
    """Scales of a contact, for tolerances and first steps.

    time [s], speed [m/s], impulse [N s], target: of each of its states, inverse_mass [1/kg]: of the relative
    motion of hand and target.
    """

    time: float
    speed: float
    impulse: float
    target: Array
    inverse_mass: float


def contact_scales(body: Body, forces: Forces, rate: float, horizon: float) -> Scales:
    """Scales of a contact that begins in the body's current state.

    rate [m/s] : of penetration.  horizon [s] : of the simulation.
    """
    at_rest = np.zeros(forces.target.n_states)
    torque = np.zeros(body.n)
    response = body.accelerate(torque, 0.0) - body.accelerate(torque, 1.0)
    inverse_mass, large = float((body.normal_jacobian @ response)[0]), 1e9  # [N] that moves any target

    def target_acceleration(force: float) -> float:
        rates = np.array(forces.target_rates(at_rest, force), dtype=float)
        return forces.target_speed(at_rest + 1e-9 * rates) / 1e-9

    # slope of the acceleration at forces that move any target
    inverse_mass += (target_acceleration(2 * large) - target_acceleration(large)) / large
    inverse_mass = max(inverse_mass, 1e-12)
    closing = max(abs(rate), 1e-6)
    # penetration at which the contact's work, force x depth, equals the kinetic energy, speed^2 /
    # inverse_mass up to a factor
    # from below any contact to how far the hand gets by the horizon
    depths = np.geomspace(1e-15, closing * horizon, 120)
    stopped = [forces.contact(x, closing, True) * inverse_mass * x > closing**2 for x in depths]
    time = float(depths[stopped.index(True) if True in stopped else -1]) / closing
    impulse = closing / inverse_mass
    # change of the target's states by the larger of their rates at rest and after this time
    first = np.array(forces.target_rates(at_rest, impulse / time), dtype=float)
    second = np.array(forces.target_rates(first * time, impulse / time), dtype=float)
    typical = np.array(forces.target.typical_state)
    target = np.maximum(np.abs(first), np.abs(second)) * time
    return Scales(time, closing, impulse, np.maximum(target, 1e-6 * typical), inverse_mass)


class _Switches(Exception):
    """Raised by an evaluation beyond a switch of the target, at a time [s]."""

    def __init__(self, time: float) -> None:
        super().__init__()
        self.time = time


def _last_step(solver: DOP853, at: Any, phase: Phase) -> _Step:
    """Last step of a solver; the force is the derivative of the impulse, the last state."""
    return _Step(solver.t_old, solver.t, at, phase, (float(solver.K[0, -1]), float(solver.f[-1])))


class Motion:
    """Motion from contact at q (nq,), v (nv,) on.

    The state is y = (u (nv), v (nv), penetration, target's state, deflection of bristles (3,), velocity of
    the target across the normal (3,) if friction moves it, impulse).
    """

    def __init__(self, body: Body, forces: Forces, q: Array, v: Array, horizon: float) -> None:
        self.body, self.forces, self._q, self._horizon = body, forces, q, horizon
        self._nv, self._n = body.nv, body.n
        self._floating, self._evaluations = body.nv > body.n, 0
        # signs of the target's switches that evaluations must not leave; None: they are not checked
        self._watched: Array | None = None
        self._bristles = 3 if body.sliding is not None and body.sliding.bristles else 0
        end = 2 * body.nv + 1 + forces.target.n_states
        self.target_part = slice(2 * body.nv + 1, end)  # of the state
        self._bristle_part = slice(end, end + self._bristles)
        self._moves = 3 if forces.mobility else 0
        last = end + self._bristles + self._moves
        self.tangential_part = slice(end + self._bristles, last)
        self._start = np.concatenate([np.zeros(body.nv), v, np.zeros(last - 2 * body.nv + 1)])
        begin = self._state(0.0, self._start)
        self._scales = contact_scales(body, forces, begin.rate, horizon)

    def run(self, tolerance: float) -> Run:
        """Integrates the collision with relative errors of each step below `tolerance`.

        Raises
        ------
        InputError : the motion diverges, or takes too many steps.
        """
        self._evaluations = 0
        steps: list[_Step] = []
        state, length = self._state(0.0, self._start), 1e-2 * self._scales.time
        while True:
            phase = self._phase(state)
            left = self._horizon - state.time
            if not phase.touching or left <= 1e-9 * self._horizon:
                return Run(steps, state.y, not phase.touching)
            state, length = self._integrate_phase(state, phase, tolerance, min(length, left), steps)

    def _integrate_phase(
        self, state: _State, phase: Phase, tolerance: float, first: float, steps: list[_Step]
    ) -> tuple[_State, float]:
        """Integrates up to the end of a phase, or to the horizon; appends to `steps`.

        first [s] : length of the first step.

        Returns
        -------
        The state at the end, and the length [s] of the last step by the error control.
        """
        solver = self._solver(state, phase, tolerance, first, self._horizon)
        while True:
            if solver.status == "finished":
                if solver.t_bound == self._horizon:
                    return self._state(solver.t, solver.y), first
                # it had a bound before a switch: go on from there
                again = min(first, self._horizon - solver.t)
                solver = self._solver(state, phase, tolerance, again, self._horizon)
            try:
                self._watched = phase.switches
                self._advance(solver)
            except _Switches as switch:
                # Approach the switch from before, and cross it by one tiny explicit Euler step.
                # at least some units in the last place of the time, or the step would not move it
                tiny = max(_SWITCH_STEP * self._scales.time, 8 * float(np.spacing(state.time)))
                if switch.time - state.time <= tiny:
                    self._watched = None
                    then = state.y + tiny * self._slope(state.time, state.y, phase)
                    across = state.time + tiny
                    steps.append(_Step(state.time, across, lambda _, y=then: y, phase, (0.0, 0.0)))
                    return self._state(across, then), first
                ahead = self._up_to_switch(state, phase, switch.time - state.time)
                until = state.time + max(ahead, tiny / 2)
                solver = self._solver(state, phase, tolerance, until - state.time, until)
                continue
            finally:
                self._watched = None
            at, length = solver.dense_output(), solver.t - state.time
            end = self._event(state, at, length, phase)
            if end is None:
                steps.append(_last_step(solver, at, phase))
                state = self._state(solver.t, solver.y)
                if solver.t_bound == self._horizon:
                    first = length
                # a switch that was exactly zero now has a sign: a new phase
                if (phase.switches == 0).any() and (self._switches(state, phase) != 0).any():
                    return state, first
                continue
            end = min(end + _OVERSHOOT * length, solver.t)
            # repeat the step up to the event: the end of a step is more exact than its interpolation
            again = self._solver(state, phase, tolerance, end - state.time, end)
            while again.status == "running":
                self._advance(again)
                steps.append(_last_step(again, again.dense_output(), phase))
            return self._state(again.t, again.y), length

    def _up_to_switch(self, state: _State, phase: Phase, beyond: float) -> float:
        """Time [s] from a state to shortly before the first switch, by linear extrapolation.

        beyond [s] : a time at which the switch has happened.
        """
        here = self._switches(state, phase)
        little = 1e-6 * beyond
        there = self._state(state.time + little, state.y + little * self._slope(state.time, state.y, phase))
        slope = (self._switches(there, phase) - here) / little
        falls = here * slope < 0
        if (here * (here + slope * little) < 0).any():
            return 0.5 * little
        nearest = float((-here[falls] / slope[falls]).min()) if falls.any() else beyond
        return min(0.98 * nearest, 0.5 * beyond)

    def _solver(self, state: _State, phase: Phase, tolerance: float, first: float, until: float) -> DOP853:
        """Solver from a state to a time [s], with a first step [s]; tolerances by the contact's scales."""
        scales, nv = self._scales, self._nv
        v = max(np.abs(self._start[nv : 2 * nv]).max(), scales.speed)
        sizes = np.concatenate(
            [
                np.full(nv, v * scales.time),
                np.full(nv, v),
                [scales.speed * scales.time],
                scales.target,
                np.full(self._bristles, scales.speed * scales.time),
                np.full(self._moves, v),
                [scales.impulse],
            ]
        )
        return DOP853(
            lambda t, y: self._slope(t, y, phase),
            state.time,
            state.y,
            until,
            rtol=tolerance,
            atol=0.1 * tolerance * sizes,  # for states that pass through zero
            first_step=min(first, until - state.time),
        )

    def _advance(self, solver: DOP853) -> None:
        """Makes one step.

        Raises
        ------
        InputError : it fails, or there were too many evaluations.
        """
        failed = solver.step()
        if failed or self._evaluations > _MAX_EVALUATIONS or not np.isfinite(solver.y).all():
            raise InputError(
                f"the contact is too fast to integrate within the tolerance (after {solver.t:.3g} s "
                f"the steps are {solver.t - (solver.t_old or 0.0):.2g} s; the contact's time scale is "
                f"{self._scales.time:.2g} s): give a softer law, a heavier target or less damping, or a "
                "higher tolerance"
            )

    def _event(self, before: _State, at: Any, length: float, phase: Phase) -> float | None:
        """Time [s] at which the phase ends within a step; None: it does not end."""

        def least_margin(fraction: float) -> float:
            time = before.time + fraction * length
            state = self._state(time, at(time)) if fraction else before
            return float(self.forces.margins(phase, *self._of(state)).min())

        low = 0.0
        for high in _EVENT_SAMPLES:
            if least_margin(high) < 0:
                if least_margin(low) <= 0:
                    return before.time + low * length
                return before.time + length * float(brentq(least_margin, low, high, xtol=1e-13, rtol=1e-13))
            low = high
        return None

    def _switches(self, state: _State, phase: Phase) -> Array:
        """Values of the target's switches."""
        _, _, penetration, rate = self._of(state)
        force = self.forces.contact(penetration, rate, phase.compressing) if phase.touching else 0.0
        return self.forces.switches(state.y[self.target_part], force)

    # ------------------------------------------------------------ one instant
    def _state(self, time: float, y: Array) -> _State:
        """State from a time and y; sets the body's state to it."""
        self._evaluations = self._evaluations + 1
        nv, n = self._nv, self._n
        u, v = y[:nv], y[nv : 2 * nv]
        self.body.update(pin.integrate(self.body.model, self._q, u), v)
        self.body.update_contact()
        speed = float(self.body.speeds()[0])
        rate = speed - self.forces.target_speed(y[self.target_part])
        return _State(time, y, speed, rate, self.forces.demand(time, u[-n:], v[-n:]))

    def _of(self, state: _State) -> tuple[Array, Array, float, float]:
        """Demand, joint velocity, penetration and its rate."""
        nv, y = self._nv, state.y
        return state.demand, y[2 * nv - self._n : 2 * nv], float(y[2 * nv]), state.rate

    def _phase(self, state: _State) -> Phase:
        """Phase of a state. If hand and target have equal speeds, that of the next instant."""
        phase = self._phase_at(state)
        if state.rate != 0:
            return phase
        ahead = _TIE_STEP * self._scales.time
        slope = self._rates(state, phase)[0]
        return self._phase_at(self._state(state.time + ahead, state.y + ahead * slope))

    def _phase_at(self, state: _State) -> Phase:
        return self.forces.phase(*self._of(state), state.y[self.target_part])

    def _slope(self, time: float, y: Array, phase: Phase) -> Array:
        """dy/dt with the forces of a phase.

        Raises
        ------
        _Switches : the target is beyond a switch that is watched.
        """
        state = self._state(time, y)
        watched = self._watched
        if watched is not None and watched.size and (self._switches(state, phase) * watched < 0).any():
            raise _Switches(time)
        return self._rates(state, phase)[0]

    def _rates(self, state: _State, phase: Phase) -> tuple[Array, Array, float]:
        """dy/dt, torque (n,) of the servo, and force [N]; `state` must be the one evaluated last."""
        nv, forces, y = self._nv, self.forces, state.y
        demand, velocity, penetration, rate = self._of(state)
        force = forces.contact(penetration, rate, phase.compressing) if phase.touching else 0.0
        torque = forces.torque(demand, phase)
        slope = np.empty_like(y)
        if self.body.sliding is not None and self._bristles + self._moves:
            deflection = y[self._bristle_part] if self._bristles else UNBENT
            bent = deflection[None], np.array([force])
            self.body.bend(*bent, y[self.tangential_part] if self._moves else np.zeros(3))
            if self._moves:
                slope[self.tangential_part] = forces.mobility * self.body.sliding.on_target(bent[1])
            if self._bristles:
                slope[self._bristle_part] = self.body.sliding.rates(*bent)[0]
        a = self.body.accelerate(torque - forces.friction(velocity, phase), force)
        slope[:nv] = y[nv : 2 * nv]
        if self._floating:  # du/dt = J_log(u) v; the other joints' coordinates are Euclidean
            slope[:6] = pin.Jlog6(pin.exp6(y[:6])) @ y[nv : nv + 6]
        slope[nv : 2 * nv] = a
        slope[2 * nv], slope[-1] = rate, force
        slope[self.target_part] = forces.target_rates(y[self.target_part], force)
        return slope, torque, force

    # ------------------------------------------------------------ histories
    def instants(self, run: Run, spacing: float) -> list[Instant]:
        """Instants of a run at most `spacing` [s] apart, at least fifty, and its end."""
        end, found, k = float(run.steps[-1].end) if run.steps else 0.0, [], 0
        count = max(int(np.ceil(end / spacing)), _MIN_INSTANTS) if run.steps else 0
        for time in np.linspace(0.0, end, count, endpoint=False):
            while run.steps[k].end <= time:
                k += 1
            step = run.steps[k]
            found.append(self._instant(self._state(time, step.at(time)), step.phase))
        state = self._state(end, run.final)
        return [*found, self._instant(state, self._phase(state))]

    def _instant(self, state: _State, phase: Phase) -> Instant:
        demand, velocity, penetration, rate = self._of(state)
        self._state(state.time, state.y)  # `_phase` may have left the body at a later state
        _, torque, force = self._rates(state, phase)
        target, wrench = state.hand_speed - rate, self.body.wrenches().ravel()
        return Instant(
            state.time,
            force,
            penetration,
            state.hand_speed,
            target,
            velocity,
            torque,
            demand,
            wrench,
            self.body.origins(),
        )

    def peak(self, run: Run) -> float:
        """Largest force [N] of a run: within the step with the largest force at an end, or its neighbours."""
        if not run.steps:
            return 0.0
        best = int(np.argmax([max(step.forces) for step in run.steps]))
        peak = max(run.steps[best].forces)
        for step in run.steps[max(best - 1, 0) : best + 2]:

            def negative_force(time: float, step: _Step = step) -> float:
                _, _, penetration, rate = self._of(self._state(time, step.at(time)))
                return -self.forces.contact(penetration, rate, step.phase.compressing)

            found = minimize_scalar(
                negative_force,
                bounds=(step.begin, step.end),
                method="bounded",
                options={"xatol": 1e-4 * (step.end - step.begin)},
            )
            peak = max(peak, -float(found.fun))
        return peak


def collision_from(
    instants: Sequence[Instant],
    configuration: Array,
    velocity: Array,
    impulse: float,
    peak: float,
    target: Array,
    soles: int,
    forces: Forces,
    separated: bool,
    tangential: Array,
) -> Collision:
    """Result of a simulated collision.

    instants : of its histories.  configuration, velocity, target : final q (nq,), v (nv,) and target state.
    impulse [N s], peak [N] : of the contact force.  soles : number of soles, the first of the fixed frames.
    tangential : velocity (3,) [m/s] of the target across the normal, if friction moves it.
    """
    columns: dict[str, Any] = {
        name: np.array([getattr(i, name) for i in instants]) for name in Instant._fields
    }
    k = len(instants)
    wrench, places = columns.pop("wrench").reshape(k, -1, 6), columns.pop("places")
    sole_wrench = ground = zmp = None
    if soles:
        sole_wrench = wrench[:, :soles]
        force = sole_wrench[..., :3]
        moment = sole_wrench[..., 3:] + np.cross(places[:, :soles], force)
        ground = np.hstack([force.sum(axis=1), moment.sum(axis=1)])
        zmp = np.stack([-ground[:, 4], ground[:, 3]], axis=1) / ground[:, 2:3]
    kind, parameters = forces.target, forces.target_parameters
    at_rest = np.zeros(kind.n_states)
    energy = float(kind.energy(target, parameters) - kind.energy(at_rest, parameters))
    if forces.mobility:
        energy += float(tangential @ tangential) / (2 * forces.mobility)
    return Collision(
        impulse=impulse,
        peak_force=peak,
        duration=instants[-1].time,
        energy=energy,
        separated=separated,
        velocity=velocity,
        configuration=configuration,
        target_result=dict(zip(kind.results, map(float, kind.result(target, parameters)), strict=True)),
        sole_wrench=sole_wrench,
        hand_wrench=wrench[:, soles:] if wrench.shape[1] > soles else None,
        ground_wrench=ground,
        zmp=zmp,
        tangential_velocity=tangential if forces.mobility else None,
        freeze_error=0.0,
        **columns,
    )
