"""The collision's equations of motion, and their integration with error control, in steps that end on events.

The configuration is q = q_0 [+] u (Pinocchio's integrate): one chart of it covers the collision, whose motion
is small, so the state is a plain vector, with du/dt = J_log(u) v for the free-flyer. SciPy's DOP853 (order
eight) chooses the steps by the error that it estimates of each component of the state. A step goes by the
forces of one phase, which go on smoothly beyond its end: where a phase ends within a step, the step is taken
anew up to there. A target may jump where it switches, so that no stage may see it: steps lead up to there,
and a hair's breadth across.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.10 (DOP853).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import DOP853
from scipy.optimize import brentq, minimize_scalar

from impactopt.collision.interface import Collision
from impactopt.errors import InputError
from impactopt.simulation.pinocchio_robot import Body
from impactopt.simulation.reference.base import Forces, Phase

__all__ = ["Instant", "Motion", "Run", "Scales", "collision_from", "contact_scales"]

Array = NDArray[np.float64]
# of a step: how far it goes on beyond its event, so that the next one starts in the new phase
_BEYOND = 1e-10
# places of a step at which it is looked for the end of the phase: it turns by less than a radian
_PLACES = (0.25, 0.5, 0.75, 1.0)
# some ten seconds of work: of ten thousand swings, or a mode far faster than all that happens
_MOST_LOOKS = 300_000
_LEAST_INSTANTS = 50
# of the contact's time scale: a time too short to matter, in which a target may jump; how far ahead a tie
# is decided
_HAIR, _AHEAD = 1e-12, 1e-6


class Instant(NamedTuple):
    """Recorded quantities of an instant. The wrenches are on the constrained frames, at their `places`."""

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


class _Piece(NamedTuple):
    """A step: its begin and end [s], the state in between, its phase, and the forces at its ends [N]."""

    begin: float
    end: float
    at: Any
    phase: Phase
    forces: tuple[float, float]


class Run(NamedTuple):
    """A collision as it was integrated: its steps, the last state, and whether the contact ended."""

    pieces: Sequence[_Piece]
    final: Array
    separated: bool

    @property
    def impulse(self) -> float:
        return float(self.final[-1])


class Scales(NamedTuple):
    """Scales of a contact: [s], [m/s], [N s], of the target's state; and 1 / mass of hand and target together
    [1/kg].
    """

    time: float
    speed: float
    impulse: float
    target: Array
    mobility: float


def contact_scales(body: Body, forces: Forces, rate: float, horizon: float) -> Scales:
    """Scales of a contact that begins with that rate of penetration [m/s], where the body is looked at."""
    at_rest = np.zeros(forces.target.n_states)
    torque = np.zeros(body.n)
    pushed = body.accelerate(torque, 0.0) - body.accelerate(torque, 1.0)
    mobility, large = float((body.normal_jacobian @ pushed)[0]), 1e9  # [N] that any target gives way to

    def speed_by(force: float) -> float:
        rates = np.array(forces.target_rates(at_rest, force), dtype=float)
        return forces.target_speed(at_rest + 1e-9 * rates) / 1e-9

    mobility = max(mobility + (speed_by(2 * large) - speed_by(large)) / large, 1e-12)
    closing = max(abs(rate), 1e-6)
    # where the force has done what stops the two: force x mobility x way = speed^2
    ways = np.geomspace(1e-15, closing * horizon, 120)
    done = [forces.contact(x, closing, True) * mobility * x > closing**2 for x in ways]
    time = float(ways[done.index(True) if True in done else -1]) / closing
    impulse = closing / mobility
    first = np.array(forces.target_rates(at_rest, impulse / time), dtype=float)
    second = np.array(forces.target_rates(first * time, impulse / time), dtype=float)
    typical = np.array(forces.target.typical or np.ones(at_rest.size))
    target = np.maximum(np.abs(first), np.abs(second)) * time
    return Scales(time, closing, impulse, np.maximum(target, 1e-6 * typical), mobility)


class _Switches(Exception):
    """One of the target's switches has another sign than its phase has, at a time [s]."""

    def __init__(self, time: float) -> None:
        super().__init__()
        self.time = time


def _piece(solver: DOP853, at: Any, phase: Phase) -> _Piece:
    """The step that a solver has made last; the force is what the impulse changes by."""
    return _Piece(solver.t_old, solver.t, at, phase, (float(solver.K[0, -1]), float(solver.f[-1])))


class Motion:
    """A collision from contact at q (nq), v (nv) on.

    Its state is y = (u (nv), v (nv), penetration, target's state, impulse).
    """

    def __init__(self, body: Body, forces: Forces, q: Array, v: Array, horizon: float) -> None:
        self.body, self.forces, self._q, self._horizon = body, forces, q, horizon
        self._nv, self._n = body.nv, body.n
        self._floating, self._looks = body.nv > body.n, 0
        self._watched: Array | None = None
        self._start = np.concatenate([np.zeros(body.nv), v, np.zeros(2 + forces.target.n_states)])
        begin = self._look(0.0, self._start)
        self._scales = contact_scales(body, forces, begin.rate, horizon)

    def run(self, tolerance: float) -> Run:
        """The collision with errors of each step that are below `tolerance`, relative.

        Raises
        ------
        InputError : the motion diverges, or takes too many steps.
        """
        self._looks = 0
        pieces: list[_Piece] = []
        state, step = self._look(0.0, self._start), 1e-2 * self._scales.time
        while True:
            phase = self._phase(state)
            left = self._horizon - state.time
            if not phase.touching or left <= 1e-9 * self._horizon:
                return Run(pieces, state.y, not phase.touching)
            state, step = self._go(state, phase, tolerance, min(step, left), pieces)

    def _go(
        self, state: _State, phase: Phase, tolerance: float, first: float, pieces: list[_Piece]
    ) -> tuple[_State, float]:
        """(state where the phase ends, or at the horizon; the step that led there [s])."""
        solver = self._solver(state, phase, tolerance, first, self._horizon)
        while True:
            if solver.status == "finished":
                if solver.t_bound == self._horizon:
                    return self._look(solver.t, solver.y), first
                again = min(first, self._horizon - solver.t)
                solver = self._solver(state, phase, tolerance, again, self._horizon)
            try:
                self._watched = phase.switches
                self._advance(solver)
            except _Switches as switch:
                # nearer each time, and the last bit in one go: a target may jump there
                hair = max(_HAIR * self._scales.time, 8 * float(np.spacing(state.time)))
                if switch.time - state.time <= hair:
                    self._watched = None
                    then = state.y + hair * self._slope(state.time, state.y, phase)
                    across = state.time + hair
                    pieces.append(_Piece(state.time, across, lambda _, y=then: y, phase, (0.0, 0.0)))
                    return self._look(across, then), first
                ahead = self._up_to_switch(state, phase, switch.time - state.time)
                until = state.time + max(ahead, hair / 2)
                solver = self._solver(state, phase, tolerance, until - state.time, until)
                continue
            finally:
                self._watched = None
            at, length = solver.dense_output(), solver.t - state.time
            end = self._end(state, at, length, phase)
            if end is None:
                pieces.append(_piece(solver, at, phase))
                state = self._look(solver.t, solver.y)
                if solver.t_bound == self._horizon:
                    first = length
                if (phase.switches == 0).any() and (self._switches(state, phase) != 0).any():
                    return state, first
                continue
            end = min(end + _BEYOND * length, solver.t)
            # anew, as a step is more exact than what it says of its inside
            again = self._solver(state, phase, tolerance, end - state.time, end)
            while again.status == "running":
                self._advance(again)
                pieces.append(_piece(again, again.dense_output(), phase))
            return self._look(again.t, again.y), length

    def _up_to_switch(self, state: _State, phase: Phase, beyond: float) -> float:
        """[s] from a state to shortly before the first switch, which is not as far as `beyond`."""
        here = self._switches(state, phase)
        little = 1e-6 * beyond
        there = self._look(state.time + little, state.y + little * self._slope(state.time, state.y, phase))
        slope = (self._switches(there, phase) - here) / little
        falls = here * slope < 0
        if (here * (here + slope * little) < 0).any():
            return 0.5 * little
        nearest = float((-here[falls] / slope[falls]).min()) if falls.any() else beyond
        return min(0.98 * nearest, 0.5 * beyond)

    def _solver(self, state: _State, phase: Phase, tolerance: float, first: float, until: float) -> DOP853:
        scales, nv = self._scales, self._nv
        v = max(np.abs(self._start[nv : 2 * nv]).max(), scales.speed)
        sizes = np.concatenate(
            [
                np.full(nv, v * scales.time),
                np.full(nv, v),
                [scales.speed * scales.time],
                scales.target,
                [scales.impulse],
            ]
        )
        return DOP853(
            lambda t, y: self._slope(t, y, phase),
            state.time,
            state.y,
            until,
            rtol=tolerance,
            atol=0.1 * tolerance * sizes,
            first_step=min(first, until - state.time),
        )

    def _advance(self, solver: DOP853) -> None:
        failed = solver.step()
        if failed or self._looks > _MOST_LOOKS or not np.isfinite(solver.y).all():
            raise InputError(
                f"the contact is too fast to follow with errors below the tolerance (at {solver.t:.3g} s of "
                f"it, in steps of {solver.t - (solver.t_old or 0.0):.2g} s; it begins with a time scale of "
                f"{self._scales.time:.2g} s): give a softer law, a heavier target or less damping, or a "
                "higher tolerance"
            )

    def _end(self, before: _State, at: Any, length: float, phase: Phase) -> float | None:
        """[s] where the phase ends within a step; None: it does not."""

        def least(share: float) -> float:
            time = before.time + share * length
            state = self._look(time, at(time)) if share else before
            return float(self.forces.margins(phase, *self._of(state)).min())

        low = 0.0
        for place in _PLACES:
            if least(place) < 0:
                if least(low) <= 0:
                    return before.time + low * length
                return before.time + length * float(brentq(least, low, place, xtol=1e-13, rtol=1e-13))
            low = place
        return None

    def _switches(self, state: _State, phase: Phase) -> Array:
        _, _, penetration, rate = self._of(state)
        force = self.forces.contact(penetration, rate, phase.compressing) if phase.touching else 0.0
        return self.forces.switches(state.y[2 * self._nv + 1 : -1], force)

    # ------------------------------------------------------------ one instant
    def _look(self, time: float, y: Array) -> _State:
        self._looks = self._looks + 1
        nv, n = self._nv, self._n
        u, v = y[:nv], y[nv : 2 * nv]
        speed = self.body.update(pin.integrate(self.body.model, self._q, u), v)
        rate = speed - self.forces.target_speed(y[2 * nv + 1 : -1])
        return _State(time, y, speed, rate, self.forces.demand(time, u[-n:], v[-n:]))

    def _of(self, state: _State) -> tuple[Array, Array, float, float]:
        """Demand, joint velocity, penetration and its rate."""
        nv, y = self._nv, state.y
        return state.demand, y[2 * nv - self._n : 2 * nv], float(y[2 * nv]), state.rate

    def _phase(self, state: _State) -> Phase:
        """The phase of a state. Where hand and target neither approach nor part, the next instant decides."""
        phase = self._phase_at(state)
        if state.rate != 0:
            return phase
        ahead = _AHEAD * self._scales.time
        slope = self._rates(state, phase)[0]
        return self._phase_at(self._look(state.time + ahead, state.y + ahead * slope))

    def _phase_at(self, state: _State) -> Phase:
        return self.forces.phase(*self._of(state), state.y[2 * self._nv + 1 : -1])

    def _slope(self, time: float, y: Array, phase: Phase) -> Array:
        state = self._look(time, y)
        watched = self._watched
        if watched is not None and watched.size and (self._switches(state, phase) * watched < 0).any():
            raise _Switches(time)
        return self._rates(state, phase)[0]

    def _rates(self, state: _State, phase: Phase) -> tuple[Array, Array, float]:
        """(dy/dt, the servo's torque, the force) with the body where `_look` has left it."""
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
        slope[2 * nv], slope[-1] = rate, force
        slope[2 * nv + 1 : -1] = forces.target_rates(y[2 * nv + 1 : -1], force)
        return slope, torque, force

    # ------------------------------------------------------------ histories
    def instants(self, run: Run, spacing: float) -> list[Instant]:
        """Instants of a run, at multiples of `spacing` [s] or of a fiftieth of its duration, and its end."""
        end, found, k = self._until(run), [], 0
        count = max(int(np.ceil(end / spacing)), _LEAST_INSTANTS) if run.pieces else 0
        for time in np.linspace(0.0, end, count, endpoint=False):
            while run.pieces[k].end <= time:
                k += 1
            piece = run.pieces[k]
            found.append(self._instant(self._look(time, piece.at(time)), piece.phase))
        state = self._look(end, run.final)
        return [*found, self._instant(state, self._phase(state))]

    def _until(self, run: Run) -> float:
        return float(run.pieces[-1].end) if run.pieces else 0.0

    def _instant(self, state: _State, phase: Phase) -> Instant:
        demand, velocity, penetration, rate = self._of(state)
        self._look(state.time, state.y)
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
        """The largest force [N] of a run: within the step with the largest at an end, or beside it."""
        if not run.pieces:
            return 0.0
        best = int(np.argmax([max(piece.forces) for piece in run.pieces]))
        peak = max(run.pieces[best].forces)
        for piece in run.pieces[max(best - 1, 0) : best + 2]:

            def less(time: float, piece: _Piece = piece) -> float:
                _, _, penetration, rate = self._of(self._look(time, piece.at(time)))
                return -self.forces.contact(penetration, rate, piece.phase.compressing)

            near = {"xatol": 1e-4 * (piece.end - piece.begin)}
            found = minimize_scalar(less, bounds=(piece.begin, piece.end), method="bounded", options=near)
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
) -> Collision:
    """The result of a collision with that end, and that largest force [N].

    soles : how many of the constrained frames, the first, are soles.
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
    kind, numbers = forces.target, forces.target_numbers
    at_rest = np.zeros(kind.n_states)
    return Collision(
        impulse=impulse,
        peak_force=peak,
        duration=instants[-1].time,
        energy=float(kind.energy(target, numbers) - kind.energy(at_rest, numbers)),
        separated=separated,
        velocity=velocity,
        configuration=configuration,
        target_result=dict(zip(kind.results, map(float, kind.result(target, numbers)), strict=True)),
        sole_wrench=sole_wrench,
        hand_wrench=wrench[:, soles:] if wrench.shape[1] > soles else None,
        ground_wrench=ground,
        zmp=zmp,
        freeze_error=0.0,
        **columns,
    )
