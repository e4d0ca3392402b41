"""Initial guess of a contact: a point mass in place of the robot meets the target.

The law and the target are the true ones, switches and all, integrated by SciPy.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, linprog

from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, Nail, Target
from impactopt.contact.targets.base import contact_phases
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.operational_space import Held
from impactopt.problem.checks import MOST_TOUCHES
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import VelocityLimit
from impactopt.transcription.layout import Array

LONGEST = 0.2  # [s] a contact that has not ended by then is cut off
AT_ONCE = 1e-6  # [s] a nail that starts with the first touch is pressed for as long
# the blow is made harder until a board breaks, or a nail moves; and softer, where contact is so stiff that
# a harder one has hammer and nail part before the nail stands
FASTER, TRIES = 1.3, 12
FINER = 6  # times as many speeds are tried where the blow has several touches: few have as many as are asked
CLOSING = 0.5  # [m/s] at which what moves away is met, at least
FASTEST = 10.0  # [m/s] beyond a start's speed none is looked for
SLOW = 0.1  # [m/s] that a striker has at least, either way
DECADES = range(1, 5)  # of stiffness that are tried where bodies part too early
# a push: durations [s] of compression and restitution, the mass's speed [m/s] at the end, what is left of the
# robot's; and the shortest blow [s] that it stands for
PUSH, PUSHED, LEFT, SOFT = np.array([0.015, 0.02]), 0.8, 0.6, 0.02


@dataclass(frozen=True)
class Blow:
    """A contact at k collocation points. ``durations`` [s] of its phases; the others at the points:

    speed (k,) of the point mass over that at contact, moved (k,) [s]: its integral in the phase so far;
    force (k,) [N]; impulse (k,) [N s]; state (k, n), travel (k,) [m] of the target in the phase.
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
    """Mass [kg] of a robot on fixed soles at its striker, along the normal, and the striker's speed [m/s].

    Of several strikers: of each, with the others as fast; and their mean speed. One that goes back is met by
    what comes; one that hardly moves counts as slow.
    """
    q, v = c.join(y, legs), c.complete_motion(y, rates, np.zeros(c.ny), legs)[1]
    bodies = [Held.at(c.model, q, c.frames, c.robot.striker(name).model_frame) for name in strikers]
    rows, held = np.array([normal @ body.hand for body in bodies]), bodies[0].held
    speed, m = float((rows @ v).mean()), len(held)
    both = np.vstack([held, rows])
    inner = both @ np.linalg.solve(bodies[0].inertia, both.T)
    # j P j' with the P of docs/notation.md: the inverse mass of the strikers on fixed soles, whose Delassus
    # matrix is singular at a straight knee: least squares
    yields = inner[m:, m:] - inner[m:, :m] @ np.linalg.lstsq(inner[:m, :m], inner[:m, m:], rcond=1e-12)[0]
    mass = float(np.linalg.solve(yields, np.ones(len(rows))).mean())
    return mass, speed if abs(speed) > SLOW else SLOW


def mass_at_contact(problem: ImpactProblem) -> float:
    """Effective mass [kg] of the robot at its striker, where inverse kinematics reaches the target."""
    c = problem.coordinates
    y, legs = c.split(problem.contact_posture)
    return effective_mass(c, problem.strikers, problem.normal, y, legs, np.zeros(c.ny))[0]


def coasted(
    c: StanceCoordinates, elapsed: Array, y: Array, rates: Array, legs: Array
) -> Iterator[tuple[Array, tuple[Array, Array]]]:
    """Legs of a robot that coasts, at times [s] since y: angles, and rates and accelerations; (nl,) each."""
    for at in elapsed:
        with contextlib.suppress(InputError):  # out of the legs' reach: the solver has to fix it
            legs = c.solve_legs(y + rates * at, legs)
        _, v, a = c.complete_motion(y + rates * at, rates, np.zeros(c.ny), legs)
        yield legs, (v[c.base + c.dependent], a[c.base + c.dependent])


def fastest_at_contact(problem: ImpactProblem) -> float:
    """Greatest speed [m/s] of the striker along the normal that the joints' limits allow, where inverse
    kinematics reaches the target.
    """
    c, limit = problem.coordinates, problem.term(VelocityLimit).most(problem.robot)
    y, legs = c.split(problem.contact_posture)
    model, data, still = c.model, c.model.createData(), np.zeros(c.ny)
    # rates of all joints (nv, ny), and the striker's speed (ny,), for rates ydot of 1
    motions = np.column_stack([c.complete_motion(y, e, still, legs)[1] for e in np.eye(c.ny)])
    pin.computeJointJacobians(model, data, c.join(y, legs))
    frame = model.getFrameId(f"striker:{problem.striker}")
    jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
    jacobian = np.reshape(jacobian, (6, model.nv))[:3]  # pin drops an axis where nv is 1
    row, joints = problem.normal @ jacobian @ motions, motions[c.base :]
    bounds = np.concatenate([limit, limit])
    found = linprog(-row, A_ub=np.vstack([joints, -joints]), b_ub=bounds, bounds=(None, None))
    return float(-found.fun) if found.status == 0 else np.inf


@dataclass(frozen=True)
class Parting:
    """Point masses that part before the last of a target's events, ``event``: when [s].

    touches : how often they have to meet for it, at a speed that they may have.
    needed : speed [m/s] at which they do not; stiffness: the nearest, by factors of 10, with which they do
        not at the speed that they have. None where none is known.
    """

    event: str
    time: float
    touches: int | None
    needed: float | None
    stiffness: float | None


def touches_needed(law: ContactLaw, target: Target, mass: float, fastest: float) -> int | None:
    """Touches in which a point mass [kg] brings about all events of a target, at a speed up to the fastest;
    None where as many as a plan may have do not.
    """
    speeds = (fastest * FASTER ** (1 - k) for k in range(2 * TRIES))
    if any(_phases(_histories(law, target, mass, v), target) is not None for v in speeds):
        return 1
    if not target.met_again:
        return None
    least: int | None = None
    for k in range(2 * TRIES * FINER):
        found = _histories(law, target, mass, fastest * FASTER ** (1 - k / FINER), least or MOST_TOUCHES)
        if _phases(found, target) is not None:
            least = min(found.touches, least or MOST_TOUCHES)
        if least in (1, 2) or _first_event(found, target) is None:  # slower, there is none either
            break
    return least


def can_meet(law: ContactLaw, target: Target, mass: float, fastest: float, touches: int) -> bool:
    """True if a point mass [kg] brings about all events of a target in so many touches, at some speed up to
    the fastest.
    """
    for k in range(2 * TRIES * FINER):
        found = _histories(law, target, mass, fastest * FASTER ** (-k / FINER), touches)
        if found.touches == touches and _phases(found, target) is not None:
            return True
        if _first_event(found, target) is None:  # slower, there is none either
            return False
    return False


def parting(law: ContactLaw, target: Target, mass: float, fastest: float) -> Parting | None:
    """Detects that a point mass [kg] and a target part before the phases' events, at all speeds up to the
    fastest.

    None: at one of them, they do not.
    """

    def whole(law: ContactLaw, speed: float) -> bool:
        return _phases(_histories(law, target, mass, speed), target) is not None

    if not np.isfinite(fastest):
        return None
    touches = touches_needed(law, target, mass, fastest)
    if touches == 1:
        return None
    time = _histories(law, target, mass, fastest).time
    if time[-1] >= LONGEST:
        return None
    faster = (fastest * FASTER**k for k in range(2, 2 * TRIES))
    numbers = law.parameters
    factors = [10.0**n for k in DECADES for n in (-k, k)] if "stiffness" in numbers else []
    other = (numbers["stiffness"] * factor for factor in factors)
    return Parting(
        event=target.guards[-1],
        time=float(time[-1]),
        touches=touches,
        needed=next((v for v in faster if whole(law, v)), None),
        stiffness=next((k for k in other if whole(type(law)(**{**numbers, "stiffness": k}), fastest)), None),
    )


def blow(
    law: ContactLaw,
    target: Target,
    mass: float,
    speed: float,
    phase: NDArray[np.intp],
    place: Array,
    touches: int,
) -> Blow:
    """A point mass [kg] that meets the target at a speed [m/s], at points ``place`` in [0, 1] of phases.

    A target with events is met as fast, or as slowly, as it takes for all of them to happen in so many
    touches, and one that moves away no slower than it goes.
    """
    speed = max(speed, float(target.speed_before()) + CLOSING)
    finer = 1 if touches == 1 else FINER
    for k in range(2 * TRIES * finer if target.guards else 1):
        # nearest speeds first, slower and faster in turn
        at = speed * FASTER ** ((k + 1) // 2 / finer * (1 if k % 2 else -1))
        found = _histories(law, target, mass, at, touches)
        ends = _phases(found, target) if found.touches == touches else None
        if ends is not None:
            break
    time, rows, _ = found
    if ends is None:  # somewhere, where the solver has to fix it
        ends = np.array([0.0, 0.4, 0.5, 1.0] if target.guards else [0.0, 0.5, 1.0])
        ends = time[-1] * (ends if touches == 1 else np.linspace(0.0, 1.0, 2 * touches + 1))
    times = ends[phase] + place * np.diff(ends)[phase]

    def sample(values: Array) -> Array:
        return np.stack([np.interp(times, time, row) for row in values], axis=1)

    def since(values: Array) -> Array:
        return np.interp(times, time, values) - np.interp(ends[phase], time, values)

    x, v, travel, force = rows[0], rows[1], rows[2], rows[-1]
    state = sample(rows[3:-1]) if target.n_states else np.zeros((len(times), 0))
    comes = float(target.speed_before()) < 0  # through the hand, if it were pushed
    if isinstance(target, FreeMass) and ends[-1] > SOFT and not comes:
        return push(target, phase, place)
    return Blow(
        durations=np.diff(ends),
        speed=np.interp(times, time, v) / v[0],
        moved=since(x) / v[0],
        force=np.interp(times, time, force),
        impulse=mass * (v[0] - np.interp(times, time, v)),
        state=state,
        travel=since(travel),
    )


def speed_that_leaves(
    law: ContactLaw, target: Target, mass: float, speed: float, least: float, most: float
) -> float:
    """The speed [m/s] nearest to a given one with which a point mass [kg] leaves the target no slower than
    ``least``, and no faster than ``most`` [m/s].
    """

    def left(speed: float) -> float:
        rows = _histories(law, target, mass, speed).rows
        return float(target.velocity(rows[3:-1, -1], target.parameters))

    after = left(speed)
    wanted = min(max(after, least), most)
    low = high = speed
    if after > most:
        low = float(target.speed_before()) + CLOSING
    else:
        high = speed + FASTEST
    if not left(low) <= wanted <= left(high):
        return speed
    return float(brentq(lambda v: left(v) - wanted, low, high, xtol=1e-2)) if low < high else speed


def natural_durations(law: ContactLaw, target: Target, mass: float, touches: int) -> Array:
    """Duration [s] of each phase of a point mass [kg] that hits at 1 m/s.

    It is known from the last programs, which mostly are of the same blow.
    """
    try:
        return _natural_durations(law, target, mass, touches)
    except TypeError:  # a law or a target of one's own that has no hash
        return _natural_durations.__wrapped__(law, target, mass, touches)


@lru_cache(maxsize=64)
def _natural_durations(law: ContactLaw, target: Target, mass: float, touches: int) -> Array:
    phases = len(contact_phases(target, touches))
    at = np.arange(phases, dtype=np.intp)
    return blow(law, target, mass, 1.0, at, np.ones(phases), touches).durations


def push(target: FreeMass, phase: NDArray[np.intp], place: Array) -> Blow:
    """A uniform force on a free mass.

    Where a contact with one is soft, plans with much else to meet converge more surely from here than from
    its true blow.
    """
    total = float(PUSH.sum())
    before = np.array([0.0, PUSH[0]])[phase]
    elapsed = before + place * PUSH[phase]
    fraction = elapsed / total
    ramp = (before / total + fraction) / 2 * place * PUSH[phase]  # the fraction's integral in the phase
    force = np.full(len(phase), target.mass * PUSHED / total)
    return Blow(
        durations=PUSH,
        speed=1 - (1 - LEFT) * fraction,
        moved=place * PUSH[phase] - (1 - LEFT) * ramp,
        force=force,
        impulse=force * elapsed,
        state=PUSHED * fraction[:, None],
        travel=PUSHED * ramp + target.initial_velocity * place * PUSH[phase],
    )


class _History(NamedTuple):
    """Instants (k,) [s], and rows of the mass's position and speed, the target's travel and state, force.

    met : instants [s] at which they part and meet again, in turn, before they part for the last time.
    """

    time: Array
    rows: Array
    met: list[float]

    @property
    def touches(self) -> int:
        return len(self.met) // 2 + 1


def _histories(law: ContactLaw, target: Target, mass: float, speed: float, touches: int = 1) -> _History:
    """The blow of a point mass that meets a target until its first event has happened, so many times at
    most.
    """

    of_law, of_target = law.parameters, target.parameters

    def moves(y: Array) -> float:
        return float(target.velocity(y[3:], of_target))

    def force(y: Array) -> float:
        return float(law.force(float(y[0] - y[2]), float(y[1] - moves(y)), of_law))

    def flow(_: float, y: Array) -> list[float]:
        f = force(y)
        return [y[1], -f / mass, moves(y), *map(float, target.derivative(y[3:], f, of_target))]

    def apart(_: float, y: Array) -> float:
        rate = float(y[1] - moves(y))
        return 1.0 if rate > 0 else float(law.separation(float(y[0] - y[2]), rate, of_law))

    def meet(_: float, y: Array) -> float:
        return float(y[0] - y[2])

    apart.terminal, apart.direction = True, -1.0  # type: ignore[attr-defined]
    meet.terminal, meet.direction = True, 1.0  # type: ignore[attr-defined]
    start = np.array([0.0, speed, 0.0, *np.zeros(target.n_states)])
    # explicit: what switches, as a nail does, makes stiff solvers stall
    options = {"method": "RK23", "rtol": 1e-4, "atol": 1e-8, "max_step": LONGEST / 400}
    times, columns, met = list[Array](), list[Array](), list[float]()
    for k in range(2 * touches - 1):
        span = (met[-1] if met else 0.0, LONGEST)
        found = solve_ivp(flow, span, start, events=meet if k % 2 else apart, **options)
        times.append(found.t)
        columns.append(found.y)
        if found.status != 1:
            break
        start = found.y[:, -1]
        if k % 2 == 0 and (k == 2 * touches - 2 or target.guard(start[3:], 0.0, found.t[-1], 0) >= 0):
            break
        met.append(float(found.t[-1]))
    y = np.hstack(columns)
    return _History(np.concatenate(times), np.vstack([y, [force(each) for each in y.T]]), met)


def _phases(found: _History, target: Target) -> Array | None:
    """Start and ends of the phases [s]; None if the target's events have not happened in their order."""
    time, rows, met = found
    if met:
        first = _first_event(found, target)
        if len(met) % 2 or first is None or not met[-1] < time[first] < time[-1]:
            return None
        return np.array([0.0, *met, time[first], time[-1]])
    deepest = int(np.argmax(rows[0] - rows[2]))
    ends = [0.0, time[deepest], time[-1]]
    if isinstance(target, Nail):
        moves = np.flatnonzero(rows[3] > 0)
        if not moves.size:
            return None
        ends = [0.0, max(time[moves[0] - 1], AT_ONCE), time[moves[-1]], time[-1]]
    elif target.guards:
        first = _first_event(found, target)
        if first is None or first >= deepest:
            return None
        ends.insert(1, time[first])
    return np.array(ends) if min(np.diff(ends)) > 0 else None


def _first_event(found: _History, target: Target) -> int | None:
    """Index of the instant at which a target's first event has happened; None: it does not happen."""
    time, rows, _ = found
    return next(
        (k for k in range(len(time)) if float(target.guard(rows[3:-1, k], rows[-1, k], time[k], 0)) >= 0),
        None,
    )
