"""Initial guess of a contact phase: the collision of a point mass, in place of the robot, with the target.

Contact law and target are those of the problem, with their switches and events. SciPy integrates them.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, linprog

from impactopt.arrays import Array
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, Nail, Target
from impactopt.contact.targets.base import SEPARATION, TOUCH, TURN, contact_phases
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.problem.checks import MOST_TOUCHES
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import VelocityLimit

MAX_CONTACT_TIME = 0.2  # [s] the integration of a contact ends here
# [s] first phase of a nail that moves at first touch: no phase may be empty
MIN_PRESS_TIME = 1e-6
# A search multiplies the approach speed by powers of this factor, so many times up and as many down. Boards
# and nails may need a faster mass; stiff contacts a slower one, as mass and nail part before the nail stops.
SPEED_FACTOR, SPEED_STEPS = 1.3, 12
# Steps in place of one where events have an order of their own: few speeds have the wanted one.
STEPS_FOR_ORDERS = 6
MIN_APPROACH_SPEED = 0.5  # [m/s] relative to a target that moves away
MAX_SPEED_INCREASE = 10.0  # [m/s] over the given speed, in the search for a target's speed after contact
MIN_STRIKER_SPEED = 0.1  # [m/s] a striker that is slower, in either direction, counts as this fast
STIFFNESS_DECADES = range(1, 5)  # powers of 10, up and down, of stiffnesses tried where bodies part too early
# Substitute for a long contact with a free mass: durations [s] of compression and restitution, speed that the
# mass gains [m/s], fraction of its speed that the robot keeps.
PUSH_DURATIONS, PUSH_SPEED, PUSH_SPEED_KEPT = np.array([0.015, 0.02]), 0.8, 0.6
MAX_IMPACT_TIME = 0.02  # [s] longer contacts with a free mass are replaced by the push


@dataclass(frozen=True)
class GuessedContact:
    """A point mass's contact with the target, at k collocation points.

    durations : of the contact phases [s].
    speed (k,) : of the mass, over its speed at contact.
    moved (k,) : integral of ``speed`` since the beginning of the phase [s].
    force (k,) : on the target [N].
    impulse (k,) : to the target since contact [N s].
    state (k, n_states) : of the target.
    travel (k,) : of the target's surface since the beginning of the phase [m].
    """

    durations: Array
    speed: Array
    moved: Array
    force: Array
    impulse: Array
    state: Array
    travel: Array


def effective_mass(
    c: StanceCoordinates, strikers: Sequence[str], normal: Array, y: Array, legs: Array, rates: Array
) -> tuple[float, float]:
    """Effective mass [kg] of a robot on fixed soles at its striker, and the striker's speed [m/s], along the
    normal.

    With two strikers: the mean of the masses at each one, as both change speed alike, and the mean speed.
    """
    q, v = c.join(y, legs), c.complete_motion(y, rates, np.zeros(c.ny), legs)[1]
    bodies = [
        ConstrainedDynamics.at(c.model, q, c.frames, c.robot.striker(name).model_frame) for name in strikers
    ]
    J_hand, J_c = np.array([normal @ body.hand for body in bodies]), bodies[0].held
    speed, m = float((J_hand @ v).mean()), len(J_c)
    both = np.vstack([J_c, J_hand])
    delassus = both @ np.linalg.solve(bodies[0].inertia, both.T)
    # J_hand P J_hand' (strikers, strikers), with P = H^-1 - H^-1 J_c' (J_c H^-1 J_c')^-1 J_c H^-1 as in
    # docs/notation.md. Least squares, because J_c H^-1 J_c' is singular at a straight knee.
    soles, coupling = delassus[:m, :m], delassus[:m, m:]
    inverse_mass = delassus[m:, m:] - delassus[m:, :m] @ np.linalg.lstsq(soles, coupling, rcond=1e-12)[0]
    # Impulses at the strikers that change all their speeds by one; with one striker 1 / (J P J').
    mass = float(np.linalg.solve(inverse_mass, np.ones(len(J_hand))).mean())
    return mass, speed if abs(speed) > MIN_STRIKER_SPEED else MIN_STRIKER_SPEED


def mass_at_contact(problem: ImpactProblem) -> float:
    """Effective mass [kg] of the robot at its striker, where inverse kinematics reaches the target."""
    c = problem.coordinates
    y, legs = c.split(problem.contact_posture)
    return effective_mass(c, problem.strikers, problem.normal, y, legs, np.zeros(c.ny))[0]


def coasted(
    c: StanceCoordinates, elapsed: Array, y: Array, rates: Array, legs: Array
) -> Iterator[tuple[Array, tuple[Array, Array]]]:
    """Legs of a robot that coasts at constant rates ydot, at ``elapsed`` times [s] since y.

    Yields joint angles, and rates with accelerations; shape (nl,) each.
    """
    for time in elapsed:
        # out of the legs' reach: the last angles, for the solver to correct
        with contextlib.suppress(InputError):
            legs = c.solve_legs(y + rates * time, legs)
        _, v, a = c.complete_motion(y + rates * time, rates, np.zeros(c.ny), legs)
        yield legs, (v[c.base + c.dependent], a[c.base + c.dependent])


def fastest_at_contact(problem: ImpactProblem) -> float:
    """Largest speed [m/s] of the striker along the normal within the joints' velocity limits.

    The posture is the one with which inverse kinematics reaches the target. A linear program; inf if it is
    unbounded.
    """
    c, limit = problem.coordinates, problem.term(VelocityLimit).most(problem.robot)
    y, legs = c.split(problem.contact_posture)
    model, data, at_rest = c.model, c.model.createData(), np.zeros(c.ny)
    # rates of all joints (nv, ny), and the striker's speed (ny,), for rates ydot of 1
    motions = np.column_stack([c.complete_motion(y, e, at_rest, legs)[1] for e in np.eye(c.ny)])
    pin.computeJointJacobians(model, data, c.join(y, legs))
    frame = model.getFrameId(f"striker:{problem.striker}")
    jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
    jacobian = np.reshape(jacobian, (6, model.nv))[:3]  # pin drops an axis where nv is 1
    speed, joints = problem.normal @ jacobian @ motions, motions[c.base :]
    bounds = np.concatenate([limit, limit])
    found = linprog(-speed, A_ub=np.vstack([joints, -joints]), b_ub=bounds, bounds=(None, None))
    return float(-found.fun) if found.status == 0 else np.inf


@dataclass(frozen=True)
class Parting:
    """A point mass and a target that separate before the last of the target's events; None: not known.

    event : name of that event.
    time : of the separation [s].
    order : of the events, if they happen at a speed the robot can have (`contact_order`).
    needed : speed at which one touch does [m/s].
    stiffness : of the contact with which one touch does at the robot's speed, the nearest by factors of 10.
    """

    event: str
    time: float
    order: tuple[str, ...] | None
    needed: float | None
    stiffness: float | None


def contact_order(
    law: ContactLaw,
    target: Target,
    mass: float,
    fastest: float,
    touches: int | None = None,
    most: float = np.inf,
) -> tuple[str, ...] | None:
    """Order in which a point mass [kg] brings about all events of a target, as ends of contact phases.

    fastest : largest speed of the mass [m/s].  touches : number of touches; None: any.  most : force [N] that
        is not exceeded, if there is such an order.

    () if the target's own phases have the events at some speed; else the order that the widest range of
    speeds has; None if there is none.
    """
    speeds = (fastest * SPEED_FACTOR ** (1 - k) for k in range(2 * SPEED_STEPS))
    own = touches in (None, 1)
    if own and any(_phases(_integrated(law, target, mass, v), target) is not None for v in speeds):
        return ()
    found = Counter[tuple[str, ...]]()
    gentle = Counter[tuple[str, ...]]()
    for _, order, peak in _orders(law, target, mass, fastest, touches or MOST_TOUCHES):
        if touches in (None, order.count(TOUCH) + 1):
            found[order] += 1
            gentle[order] += peak <= most
    counted = gentle if any(gentle.values()) else found
    return max(counted, key=counted.__getitem__, default=None)


def gentlest(law: ContactLaw, target: Target, mass: float, fastest: float) -> tuple[float, float] | None:
    """Speed [m/s] of a point mass [kg] that brings about all events of a target with the least peak force,
    and that force [N]; None if no speed does.
    """
    found = [(peak, speed) for speed, _, peak in _orders(law, target, mass, fastest, MOST_TOUCHES)]
    return min(found)[::-1] if found else None


def _orders(
    law: ContactLaw, target: Target, mass: float, fastest: float, touches: int
) -> Iterator[tuple[float, tuple[str, ...], float]]:
    """Speeds [m/s], down from the largest, at which a point mass brings about all events of a target that is
    met again in at most so many touches; with the order of events and the peak force [N].
    """
    for k in range(2 * SPEED_STEPS * STEPS_FOR_ORDERS if target.met_again else 0):
        speed = fastest * SPEED_FACTOR ** (-k / STEPS_FOR_ORDERS)
        history = _integrated(law, target, mass, speed, touches)
        if _too_slow(history, target):
            break
        if history.complete:
            yield speed, history.order, float(history.values[-1].max())


def parting(law: ContactLaw, target: Target, mass: float, fastest: float) -> Parting | None:
    """Detects that a point mass [kg] and a target separate before the events of the contact phases.

    fastest : largest speed of the mass [m/s].

    None if there is a speed at which one touch has all events, or nothing is known.
    """

    def complete(law: ContactLaw, speed: float) -> bool:
        return _phases(_integrated(law, target, mass, speed), target) is not None

    if not np.isfinite(fastest):
        return None
    order = contact_order(law, target, mass, fastest)
    if order == ():
        return None
    time = _integrated(law, target, mass, fastest).time
    if time[-1] >= MAX_CONTACT_TIME:
        return None
    faster = (fastest * SPEED_FACTOR**k for k in range(2, 2 * SPEED_STEPS))
    parameters = law.parameters
    factors = [10.0**n for k in STIFFNESS_DECADES for n in (-k, k)] if "stiffness" in parameters else []
    others = (parameters["stiffness"] * factor for factor in factors)
    return Parting(
        event=target.guards[-1],
        time=float(time[-1]),
        order=order,
        needed=next((v for v in faster if complete(law, v)), None),
        stiffness=next(
            (k for k in others if complete(type(law)(**{**parameters, "stiffness": k}), fastest)), None
        ),
    )


def guessed_contact(
    law: ContactLaw,
    target: Target,
    mass: float,
    speed: float,
    phase: NDArray[np.intp],
    place: Array,
    order: tuple[str, ...] = (),
) -> GuessedContact:
    """Contact of a point mass [kg] with the target, sampled at collocation points.

    speed : of the mass at contact [m/s]. It is changed as little as a target with events needs for all of
        them to happen in their order, and raised where the target moves away faster.
    order : ends of the phases, if they are not the target's own.
    phase (k,), place (k,) : of each collocation point, its contact phase and place in it, in [0, 1].
    """
    found, ends = _nearest(law, target, mass, speed, order)
    time, values = found.time, found.values
    if ends is None:  # no speed has the events: arbitrary phases, for the solver to correct
        ends = np.array([0.0, 0.4, 0.5, 1.0] if target.guards else [0.0, 0.5, 1.0])
        ends = time[-1] * (np.linspace(0.0, 1.0, len(order) + 1) if order else ends)
    times = ends[phase] + place * np.diff(ends)[phase]

    def in_phase(quantity: Array) -> Array:
        return np.interp(times, time, quantity) - np.interp(ends[phase], time, quantity)

    # rows as of `_History`
    x, v, travel, force = values[0], values[1], values[2], values[-1]
    states = [np.interp(times, time, state) for state in values[3:-1]]
    # Not for a mass that comes towards the robot: under such a push it would pass through the hand.
    comes = float(target.speed_before()) < 0
    if isinstance(target, FreeMass) and ends[-1] > MAX_IMPACT_TIME and not comes:
        return _push(target, phase, place)
    return GuessedContact(
        durations=np.diff(ends),
        speed=np.interp(times, time, v) / v[0],
        moved=in_phase(x) / v[0],
        force=np.interp(times, time, force),
        # momentum that the mass has lost, which no quadrature of the force has to approximate
        impulse=mass * (v[0] - np.interp(times, time, v)),
        state=np.reshape(states, (target.n_states, len(times))).T,
        travel=in_phase(travel),
    )


def _nearest(
    law: ContactLaw, target: Target, mass: float, speed: float, order: tuple[str, ...]
) -> tuple[_History, Array | None]:
    """Contact of a point mass [kg] with all events in their order, at the speed [m/s] nearest to the given
    one; and the instants of the phases, None if no speed has them.
    """
    speed = max(speed, float(target.speed_before()) + MIN_APPROACH_SPEED)
    finer, touches = (STEPS_FOR_ORDERS, order.count(TOUCH) + 1) if order else (1, 0)
    found, too_slow = _integrated(law, target, mass, speed, touches), -np.inf
    for k in range(2 * SPEED_STEPS * finer if target.guards else 1):
        # nearest speeds first, faster and slower in turn
        at = speed * SPEED_FACTOR ** ((k + 1) // 2 / finer * (1 if k % 2 else -1))
        if at <= too_slow:
            continue
        found = _integrated(law, target, mass, at, touches) if k else found
        ends = _phases(found, target) if found.order == order else None
        if ends is not None:
            return found, ends
        if order and _too_slow(found, target):
            too_slow = max(too_slow, at)
    return found, None


def _too_slow(found: _History, target: Target) -> bool:
    """True if not all of a target's events have happened, nor do at lower speeds."""
    # a nail that starts at first touch is met the more often, before it stops, the faster the mass is
    return not target.at_once and not set(target.guards) <= set(found.order)


def speed_with_order(
    law: ContactLaw, target: Target, mass: float, speed: float, order: tuple[str, ...]
) -> float:
    """Approach speed [m/s] of a point mass [kg], nearest to the given one, with this order of events."""
    found, ends = _nearest(law, target, mass, speed, order)
    return speed if ends is None else float(found.values[1, 0])


def speed_that_leaves(
    law: ContactLaw, target: Target, mass: float, speed: float, least: float, most: float
) -> float:
    """Approach speed [m/s] of a point mass [kg], nearest to the given one, after which the target's speed is
    between ``least`` and ``most`` [m/s].
    """

    def target_speed(speed: float) -> float:
        values = _integrated(law, target, mass, speed).values
        return float(target.velocity(values[3:-1, -1], target.parameters))

    after = target_speed(speed)
    wanted = min(max(after, least), most)
    low = high = speed
    if after > most:
        low = float(target.speed_before()) + MIN_APPROACH_SPEED
    else:
        high = speed + MAX_SPEED_INCREASE
    if not target_speed(low) <= wanted <= target_speed(high):
        return speed
    return float(brentq(lambda v: target_speed(v) - wanted, low, high, xtol=1e-2)) if low < high else speed


def natural_durations(law: ContactLaw, target: Target, mass: float, order: tuple[str, ...] = ()) -> Array:
    """Duration [s] of each contact phase of a point mass [kg] that hits at 1 m/s."""
    phases = len(contact_phases(target, order))
    at = np.arange(phases, dtype=np.intp)
    return guessed_contact(law, target, mass, 1.0, at, np.ones(phases), order).durations


def _push(target: FreeMass, phase: NDArray[np.intp], place: Array) -> GuessedContact:
    """Uniform force on a free mass, in place of a contact that is soft.

    Plans with many other constraints converge more reliably from here than from the soft contact.
    """
    total = float(PUSH_DURATIONS.sum())
    before = np.array([0.0, PUSH_DURATIONS[0]])[phase]
    elapsed = before + place * PUSH_DURATIONS[phase]
    fraction = elapsed / total
    ramp = (before / total + fraction) / 2 * place * PUSH_DURATIONS[phase]  # integral of the fraction
    force = np.full(len(phase), target.mass * PUSH_SPEED / total)
    return GuessedContact(
        durations=PUSH_DURATIONS,
        speed=1 - (1 - PUSH_SPEED_KEPT) * fraction,
        moved=place * PUSH_DURATIONS[phase] - (1 - PUSH_SPEED_KEPT) * ramp,
        force=force,
        impulse=force * elapsed,
        state=PUSH_SPEED * fraction[:, None],
        travel=PUSH_SPEED * ramp + target.initial_velocity * place * PUSH_DURATIONS[phase],
    )


class _History(NamedTuple):
    """Integrated contact of a point mass.

    time (k,) : [s].
    values (4 + n_states, k) : position [m] and speed [m/s] of the mass, travel [m] and state of the target,
        contact force [N].
    order, ends : ends of the contact's phases, and their instants [s]; () if they were not looked for.
    complete : all events have happened, and striker and target part for good.
    """

    time: Array
    values: Array
    order: tuple[str, ...] = ()
    ends: tuple[float, ...] = ()
    complete: bool = False


def _integrated(law: ContactLaw, target: Target, mass: float, speed: float, touches: int = 0) -> _History:
    """Contact of a point mass [kg] with a target.

    touches : 0: up to the first separation. Else up to the last of the target's events and the separation
        after it, or after this number of touches.

    Cached, as searches for an order of events, for durations and for guesses try the same speeds.
    """
    try:
        return _history(law, target, mass, speed, touches)
    except TypeError:  # a user's law or target without a hash
        return _history.__wrapped__(law, target, mass, speed, touches)


@lru_cache(maxsize=1024)  # an order of events takes up to 500
def _history(law: ContactLaw, target: Target, mass: float, speed: float, touches: int) -> _History:
    """See `_integrated`."""
    of_law, of_target = law.parameters, target.parameters

    # y = position and speed of the mass, travel and state of the target
    def surface_speed(y: Array) -> float:
        return float(target.velocity(y[3:], of_target))

    def force(y: Array) -> float:
        return float(law.force(float(y[0] - y[2]), rate(0.0, y), of_law))

    def derivative(_: float, y: Array) -> list[float]:
        f = force(y)
        return [y[1], -f / mass, surface_speed(y), *map(float, target.derivative(y[3:], f, of_target))]

    def rate(_: float, y: Array) -> float:
        return float(y[1] - surface_speed(y))

    def separation(_: float, y: Array) -> float:
        # The law's `separation` is its restitution; while bodies approach, at first touch too, it says
        # nothing.
        return 1.0 if rate(0.0, y) > 0 else float(law.separation(float(y[0] - y[2]), rate(0.0, y), of_law))

    def touch(_: float, y: Array) -> float:
        return float(y[0] - y[2])

    def passed(t: float, y: Array) -> float:
        return float(target.guard(y[3:], force(y), t, guards, of_target))

    start = np.array([0.0, speed, 0.0, *np.zeros(target.n_states)])
    # An explicit method, because the switches of a nail make implicit ones stall.
    # Steps are bounded, as results are interpolated linearly and the deepest point is the deepest of the
    # steps.
    options = {"method": "RK23", "rtol": 1e-4, "atol": 1e-8, "max_step": MAX_CONTACT_TIME / 400}
    times, values, order, ends = list[Array](), list[Array](), list[str](), list[float]()
    turns, apart, complete, guards, way = touches > 0 and law.switches, False, False, 0, -1.0
    while not complete and order.count(TOUCH) < max(touches, 1):
        possible = {TOUCH: _terminal(touch, 1.0)} if apart else {SEPARATION: _terminal(separation, -1.0)}
        if turns and not apart:
            possible[TURN] = _terminal(rate, way)
        if touches and guards < len(target.guards):
            possible[target.guards[guards]] = _terminal(passed, 1.0)
        found = solve_ivp(
            derivative,
            (ends[-1] if ends else 0.0, MAX_CONTACT_TIME),
            start,
            events=[*possible.values()],
            **options,
        )
        times.append(found.t)
        values.append(found.y)
        if found.status != 1:  # no event until the end of the time
            break
        # the state goes on; only the event that is looked for changes
        start = found.y[:, -1]
        end = next(name for name, at in zip(possible, found.t_events, strict=True) if at.size)
        order.append(end)
        ends.append(float(found.t[-1]))
        guards += end in target.guards
        if end in (SEPARATION, TOUCH):
            apart = end == SEPARATION
        if end not in target.guards:  # compression and restitution alternate
            way = 1.0 if end == TURN and way < 0 else -1.0
        over = apart and guards == len(target.guards)
        complete = not touches or (over and (end == SEPARATION or rate(0.0, start) <= 0))
    y = np.hstack(values)
    history = _History(np.concatenate(times), np.vstack([y, [force(each) for each in y.T]]))
    for array in (history.time, history.values):  # shared
        array.flags.writeable = False
    return history._replace(order=tuple(order), ends=tuple(ends), complete=complete) if touches else history


_Event = Callable[[float, Array], float]


def _terminal(event: _Event, direction: float) -> _Event:
    """Event that ends an integration where it changes its sign in this direction."""

    def terminal(t: float, y: Array) -> float:
        return event(t, y)

    terminal.terminal, terminal.direction = True, direction  # type: ignore[attr-defined]
    return terminal


def _phases(found: _History, target: Target) -> Array | None:
    """Start and ends (phases + 1,) of the contact phases [s]; None unless all events happen, in order."""
    if found.order:
        return np.array([0.0, *found.ends]) if found.complete else None
    time, values = found.time, found.values
    deepest = int(np.argmax(values[0] - values[2]))
    ends = [0.0, time[deepest], time[-1]]  # compression and restitution
    if isinstance(target, Nail):  # pressed, driven, released
        moves = np.flatnonzero(values[3] > 0)
        if not moves.size:
            return None
        ends = [0.0, max(time[moves[0] - 1], MIN_PRESS_TIME), time[moves[-1]], time[-1]]
    elif target.guards:
        first = _first_event(found, target)
        # an event after the turn is not the one that splits compression
        if first is None or first >= deepest:
            return None
        # phases: up to the event, from there to the turn, restitution
        ends.insert(1, time[first])
    return np.array(ends) if min(np.diff(ends)) > 0 else None


def _first_event(found: _History, target: Target) -> int | None:
    """Index of the first instant after a target's first event; None if it does not happen."""
    time, values = found.time, found.values
    guards = (float(target.guard(values[3:-1, k], values[-1, k], time[k], 0)) for k in range(len(time)))
    return next((k for k, guard in enumerate(guards) if guard >= 0), None)
