"""Initial guesses of programs: by inverse kinematics, from a strike, or mapped from another solution."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from scipy.optimize import lsq_linear

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates, independent_rates
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import CubicSpline, basis, quintic, rate_weights
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import strongest_posture
from impactopt.problem.terms import TargetSpeed
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import effective_mass, speed_that_leaves, speed_with_order
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.contact_refinement import map_stages, same_places
from impactopt.transcription.frozen_collision import bounds_reference
from impactopt.transcription.layout import ConstraintOrigin, Group
from impactopt.transcription.mesh import with_middles
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.plan import drifting_reference
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription

# ends of names of variables whose meaning depends on the collision model: they are guessed anew for another
MODEL_VARIABLES = ("coasting legs", "coasting leg rates", "coasting leg accelerations")
MAX_DURATION = 2.0  # [s] of a phase: in a slower swing the robot hardly moves at contact
# Share of the least leg extension that a guess keeps: the solver corrects smaller violations in as few
# iterations as without. And descents of the base [m] that are tried for it.
_GUESSED_EXTENSION, _DESCENTS = 0.5, np.arange(0.0, 0.2, 0.005)


def strike_rates(
    c: StanceCoordinates,
    strikers: Sequence[str],
    y: Array,
    legs: Array,
    velocity: Array,
    *,
    base: float = 0.3,
    limit: Array | None = None,
) -> Array:
    """Least rates ydot (ny,) that give all striking points ``velocity`` (3,) [m/s].

    base : scale of the base's rates against the joints'; 0: the base does not move.
    limit (ny,) : largest rates [rad/s], within which the velocity is as near as possible; None: no limits.
    """
    model, data = c.model, c.model.createData()
    frames = [model.getFrameId(f"striker:{name}") for name in strikers]

    def point(at: Array) -> Array:
        pin.framesForwardKinematics(model, data, c.join(at, legs))
        return np.concatenate([data.oMf[frame].translation for frame in frames])

    # central differences: their error, h^2, and rounding, 1e-16 / h, are both below 1e-9
    h = 1e-6
    jac = np.stack([(point(y + h * e) - point(y - h * e)) / (2 * h) for e in np.eye(c.ny)], axis=1)
    # least |rates / weight|, by the substitution rates = weight * r. Measured: with `base` of 0.05 to
    # 1 punch has the same optimum.
    weight = np.ones(c.ny)
    weight[: c.base] = base
    wanted = np.tile(velocity, len(frames))
    rates = np.asarray(weight * np.linalg.lstsq(jac * weight, wanted, rcond=None)[0])
    if limit is None or (np.abs(rates) <= limit).all():
        return rates
    return np.asarray(lsq_linear(jac, wanted, bounds=(-limit, limit)).x)


@dataclass(frozen=True)
class ReachedState:
    """State at contact: coordinates y and rates ydot (ny,), legs (nl,)."""

    y: Array
    rates: Array
    legs: Array


def reached(
    t: ContactProgram,
    *,
    posture: Array | None = None,
    speed: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
) -> ReachedState:
    """State at contact by inverse kinematics.

    posture (nq,) : at contact; None: `strongest_posture`.

    speed : of the striking points [m/s]; less if joints are not that fast. If the target's speed after the
        impact is bounded, or the contact's events have an order of their own, the nearest speed with which a
        point mass meets the bounds, or has the order.
    noise, seed : standard deviation [rad] and seed of a perturbation of the joints, for several guesses; the
        seed is also that of the postures to choose from.
    """
    p, c = t.problem, t.coordinates
    rng = np.random.default_rng(seed)
    if posture is None and seed not in t.postures:
        t.postures[seed] = strongest_posture(p, seed)
    y, legs = c.split(t.postures[seed] if posture is None else posture)
    y[c.base :] += noise * rng.standard_normal(c.ny - c.base)
    limits = t.builder.limits
    y = np.clip(y, limits.y_lower, limits.y_upper)
    if down := _descent(c, y, _GUESSED_EXTENSION * limits.extension.minimum) if c.soles else 0.0:
        y[2] -= down
        legs = c.solve_legs(y, c.start_legs)  # those of the posture may bend the other way
    bounds = p.extra(TargetSpeed)
    if p.order or bounds is not None:
        mass = effective_mass(c, p.strikers, p.normal, y, legs, np.zeros(c.ny))[0]
        if p.order:
            speed = speed_with_order(p.law, p.target, mass, speed, p.order)
        elif bounds is not None:
            speed = speed_that_leaves(p.law, p.target, mass, speed, bounds.least, bounds.most)
    base = 0.0 if c.drifts else 0.3  # momentum determines the rates of a floating base
    limit = 0.8 * limits.rate_limit[c.independent]
    most = np.concatenate([np.full(c.base, np.inf), limit]) if p.order else None
    rates = strike_rates(c, p.strikers, y, legs, speed * p.normal, base=base, limit=most)
    # one factor for all rates, so that the striking point still moves along the normal
    return ReachedState(y, rates * _within(rates[c.base :], limit), legs)


def _within(rates: Array, limit: Array) -> float:
    """Factor, at most 1, that brings rates inside their limits."""
    return min(1.0, float((limit / np.maximum(np.abs(rates), 1e-9)).min()))


def first_iterate(
    t: Transcription,
    *,
    posture: Array | None = None,
    speed: float = 1.0,
    noise: float = 0.0,
    seed: int = 0,
) -> Array:
    """Initial guess (n,) of a motion: quintic splines to the state of :func:`reached`, and back."""
    hit = reached(t, posture=posture, speed=speed, noise=noise, seed=seed)
    zero, (swing_T, follow_T) = np.zeros(len(t.y0)), _durations(t)
    start, end = _ends(t.problem, t.coordinates, t.problem.blow)
    swing = quintic(start, zero, hit.y, hit.rates, swing_T, t.swing.breaks)
    # Half of the rates is left after contact, as after an inelastic impact of two equal masses. Measured:
    # with 0.2 to 0.9 arm_planar and punch have the same optimum.
    back = quintic(hit.y, 0.5 * hit.rates, end, zero, follow_T, t.follow.breaks)
    curve = CubicSpline.fit(swing, t.swing.breaks, zero, hit.rates, swing_T)
    after = CubicSpline.fit(back, t.follow.breaks, 0.5 * hit.rates, zero, follow_T)
    if t.coordinates.drifts:
        # A drifting base takes the striker elsewhere than inverse kinematics has it; what comes after begins
        # there.
        curve = _drifting(t.problem, curve)
        hit = replace(hit, y=curve.sample(swing_T)[0][0], rates=curve.sample(swing_T)[1][0])
        after = _drifting(t.problem, after, hit)
    elif t.coordinates.soles:
        curve, after = (_with_bent_legs(t, spline) for spline in (curve, after))
    x = _motion(t, curve, after)
    t.hit.guess(x, hit.y, hit.rates, hit.legs)
    _draw_gains(t, x, noise, seed)
    return _finished(t, x)


def _with_bent_legs(t: Transcription, curve: CubicSpline) -> CubicSpline:
    """Spline with the base lowered where a leg of the given one is nearly straight or out of reach.

    The ends stay. Near a straight knee the legs' rates grow without bound: a guess of G1 asked for 33 times
    its hip's torque, from which the solver took 885 iterations in place of 154.
    """
    values, rates, _ = curve.sample(curve.breaks * curve.duration)
    least = _GUESSED_EXTENSION * t.builder.limits.extension.minimum
    down = np.array([0.0, *(_descent(t.coordinates, y, least) for y in values[1:-1]), 0.0])
    if not down.any():
        return curve
    values[:, 2] -= down
    return CubicSpline.fit(values, curve.breaks, rates[0], rates[-1], curve.duration)


def _descent(c: StanceCoordinates, y: Array, least: float) -> float:
    """Descent of the base [m] with which the legs of coordinates y (ny,) have this leg extension."""
    for down in _DESCENTS:
        lower = y.copy()
        lower[2] -= down
        with contextlib.suppress(InputError):  # out of the legs' reach
            if c.leg_extension(c.solve_legs(lower, c.start_legs))[: len(c.soles)].min() >= least:
                return float(down)
    return 0.0  # it is not the height that is wrong: for the solver to correct


def _drifting(problem: ImpactProblem, curve: CubicSpline, since: ReachedState | None = None) -> CubicSpline:
    """Spline with the joints' motion of another one, and the base's motion that conserves momentum.

    since : state in which it begins; None: that of the spline.
    """
    breaks, c = curve.breaks, problem.coordinates
    # the base is integrated with one Runge-Kutta step between two of these times
    fine = with_middles(with_middles(breaks))
    time = fine * curve.duration

    def sample(at: Array) -> tuple[Array, ...]:
        values = curve.sample(at)
        if since is not None and not at[0]:
            values[0][0, :6], values[1][0, :6] = since.y[:6], since.rates[:6]
        return values

    found = drifting_reference(problem, sample, time, backward=False)
    y = np.array([c.split(q)[0] for q in found.q])
    rates = [independent_rates(c, y[k], found.v[k]) for k in (0, -1)]
    return CubicSpline.fit(y[np.isin(fine, breaks)], breaks, rates[0], rates[1], curve.duration)


def strike_iterate(t: StrikeTranscription, *, speed: float = 1.0, noise: float = 0.0, seed: int = 0) -> Array:
    """Initial guess (n,) of a strike, from the state at contact of :func:`reached`."""
    hit = reached(t, speed=speed, noise=noise, seed=seed)
    x = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper)
    with contextlib.suppress(InputError):  # out of the legs' reach, for the solver to correct
        hit = replace(hit, legs=t.coordinates.solve_legs(hit.y, hit.legs))
    t.y.write(x, hit.y)
    t.legs.write(x, hit.legs)
    t.w.write(x, static_wrenches(t.coordinates, hit.y, hit.legs))
    t.hit.guess(x, hit.y, hit.rates, hit.legs)
    _draw_gains(t, x, noise, seed)
    return _finished(t, x)


def _draw_gains(t: ContactProgram, x: Array, noise: float, seed: int) -> None:
    """Draw gain factors between their bounds, if there is noise; without, they are 1."""
    gains = t.hit.contact.gains
    if noise and gains.size:
        k = gains.index(0)
        # uniform in the logarithms, which the variables are
        x[k] = np.random.default_rng(seed).uniform(t.layout.lower[k], t.layout.upper[k])


def iterate_from_strike(t: Transcription, strike: StrikeTranscription, x: Array) -> Array:
    """Initial guess (n,) of a motion from solver variables x of a strike: to its state at contact, and back.

    A coordinate whose swing would exceed its rate limit gets a lower rate at contact.
    """
    y, u = strike.y.read(x)[0], strike.u0.read(x)[0]
    after, rates = (e.evaluate(x) for e in strike.expected.state_after[:2])
    swing_T, follow_T = _durations(t)
    start, end = _ends(t.problem, t.coordinates, t.problem.blow)
    out = _motion(
        t,
        _least_accelerations(t, t.swing.breaks, swing_T, start, y, end_rates=u),
        _least_accelerations(t, t.follow.breaks, follow_T, after, end, rates=rates),
    )
    # the variables of the contact have the same names in both programs
    for name, group in strike.layout.groups.items():
        own = t.layout.groups.get(name)
        if own is not None and own.count == group.count:
            own.write(out, group.read(x))
    return _finished(t, out)


def warm_start(t: ContactProgram, old: ContactProgram, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
    """Solution of an old program, mapped to one that differs: warm start of the solver.

    The new program may have more nodes or collocation elements, another collision model, or first instants of
    contact. Variables at nodes are interpolated, and those of the contact sampled from its polynomials. The
    contact with a duration is guessed anew from an impact without one or a contact with other phases, and
    conversely. Multipliers are those of the same constraints and variables, else zero.

    x, y, z : solver variables (n,), multipliers of constraints (m,) and of bounds (n,) of the old program.

    Returns the same three of the new program.
    """
    stages = same_places(t.hit.stages, old.hit.stages)
    nodes = {}  # old and new nodes, by the first word of the variables' names
    if isinstance(t, Transcription) and isinstance(old, Transcription):
        nodes = {"swing": (old.swing_nodes, t.swing_nodes)}
        nodes |= dict.fromkeys(("follow", "abort"), (old.follow_nodes, t.follow_nodes))
        for sequence, old_sequence in zip((t.before, *t.after), (old.before, *old.after), strict=True):
            nodes |= {
                phase.kind: (old_sequence.stands[k].nodes, phase.nodes)
                for k, phase in sequence.stands.items()
            }
    new, bounds = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper), np.zeros(t.layout.n)
    for name, group in t.layout.groups.items():
        known = old.layout.groups.get(name)
        if known is None or not group.size:
            continue
        if known.labels != group.labels:  # one vector with an entry for each node, which its label names
            _map_by_label(group, known, (new, x), (bounds, z))
            continue
        pairs = [(k, k) for k in range(group.count)]  # vectors, new and old, whose multipliers are the same
        if name.endswith(MODEL_VARIABLES) and _model(t) != _model(old):
            continue
        # groups of a scenario begin with its name and a colon, and its name may begin with that of a phase
        if ": " not in name and name.split()[0] in nodes and known.count != group.count:
            before, now = nodes[name.split()[0]]
            # the old nodes are among the new ones; multipliers of added nodes are zero
            pairs = [(int(i), k) for k, i in enumerate(np.flatnonzero(np.isin(now, before)))]
            group.write(new, np.column_stack([np.interp(now, before, column) for column in known.read(x).T]))
        elif known.count == len(old.hit.stages) and known.count != group.count:
            pairs = stages  # `map_stages` writes the variables, below
        elif (known.count, known.size) != (group.count, group.size):
            continue  # of the events of another contact
        else:
            group.write(new, known.read(x))
        for i, k in pairs:
            bounds[group.index(i)] = z[known.index(k)]
    state = t.contact_state[0].evaluate(new), t.u0.read(new)[0], t.contact_legs.evaluate(new)
    for collision, old_collision in zip(t.hit.collisions, old.hit.collisions, strict=True):
        lasts, lasted = (isinstance(each, Collision) for each in (collision, old_collision))
        if not (lasts and lasted and len(collision.T) == len(old_collision.T)):
            if lasts or lasted:
                collision.guess(new, *state)
            continue
        if t.hit.elements != old.hit.elements:
            map_stages(collision, old_collision, new, x)
        if _model(t) != _model(old):
            collision.guess_model(new, *state)
        collision.write_positions(new)
    if len(t.hit.first) != len(old.hit.first):
        for first in t.hit.first:
            first.guess(new, *state)
    return _finished(t, new), _mapped_multipliers(t.program.origins, old.program.origins, y), bounds


def _map_by_label(group: Group, known: Group, *vectors: tuple[Array, Array]) -> None:
    """Copy the entries with the same label.  vectors : pairs of a new and an old vector (n,).

    Entries with a new label are lifted variables, which `_finished` computes.
    """
    places = {label: j for j, label in enumerate(known.labels)}
    entries = [k for k, label in enumerate(group.labels) if label in places]
    known_entries = [places[group.labels[k]] for k in entries]
    for k in range(min(group.count, known.count)):
        for new, old in vectors:
            new[group.index(k)[entries]] = old[known.index(k)[known_entries]]


def _model(t: ContactProgram) -> tuple[str, int, bool]:
    """Collision model, number of freezes, and if a frozen model has the reference's legs as contact ends."""
    p = t.problem
    return p.collision, p.freezes, p.frozen is not None and bounds_reference(p)


def _mapped_multipliers(
    constraints: Sequence[ConstraintOrigin], known: Sequence[ConstraintOrigin], multipliers: Array
) -> Array:
    """Multipliers of constraints by name, from those of known constraints; 0 for names that are new."""
    # most programs share their first constraints, and differ in those that come after them
    differ = (k for k, (one, other) in enumerate(zip(constraints, known, strict=False)) if one is not other)
    same = next(differ, min(len(constraints), len(known)))
    of_names = dict(zip(_keys(known[same:]), multipliers[same:].tolist(), strict=True))
    return np.concatenate([multipliers[:same], [of_names.get(k, 0.0) for k in _keys(constraints[same:])]])


def _keys(constraints: Sequence[ConstraintOrigin]) -> Iterator[tuple[tuple[str, str, str], int]]:
    """Name of each constraint, and the number of earlier ones with that name."""
    seen: dict[tuple[str, str, str], int] = {}
    for constraint in constraints:
        name = constraint.term, constraint.place.name, constraint.component
        before = seen.get(name, 0)
        seen[name] = before + 1
        yield name, before


def _finished(t: ContactProgram, x: Array) -> Array:
    """Variables x with lifted ones computed, inside their bounds."""
    return np.clip(t.with_lifted(x), t.layout.lower, t.layout.upper)


def _durations(t: Transcription) -> tuple[float, float]:
    """Durations of swing and follow-through [s]: the middle of their ranges, or `MAX_DURATION`."""
    swing, follow = (
        max(phase.duration[0], min(float(np.mean(phase.duration)), MAX_DURATION))
        for phase in (t.problem.swing, t.problem.follow)
    )
    return swing, follow


def _motion(t: Transcription, curve: CubicSpline, back: CubicSpline) -> Array:
    """Variables of a motion (n,) with these splines as swing and follow-through, and stance phases between
    their postures; legs and sole wrenches as at rest.
    """
    x = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper)
    for phase, spline in ((t.swing, curve), *((follow, back) for follow in t.follows)):
        _write(t.builder, x, phase, spline)
    for sequence in (t.before, *t.after):
        for k, phase in sequence.stands.items():
            b, T = sequence.builders[k], float(np.mean(phase.phase.duration))
            (start, end), at_rest = _ends(t.problem, b.coordinates, k), np.zeros(b.ny)
            values = quintic(start, at_rest, end, at_rest, T, phase.breaks)
            _write(b, x, phase, CubicSpline.fit(values, phase.breaks, at_rest, at_rest, T))
    if t.abort is not None and t.coordinates.legs:
        t.abort.coast_w.write(x, t.swing.w.read(x)[-1:])
    return x


def _ends(problem: ImpactProblem, c: StanceCoordinates, k: int) -> list[Array]:
    """Coordinates (ny,) at the beginning and the end of stance phase k."""
    return [c.split(problem.change_posture(j))[0] for j in (k - 1, k)]


def _write(b: Builder, x: Array, phase: MotionPhase, spline: CubicSpline) -> None:
    """Write a phase's spline to x (n,), with legs and sole wrenches as at rest."""
    c, limits, legs = b.coordinates, b.limits, b.legs0
    phase.guess(x, spline)
    all_legs, all_w = [], []
    for y in spline.sample(phase.nodes * spline.duration)[0]:
        with contextlib.suppress(InputError):  # out of the legs' reach, for the solver to correct
            legs = c.solve_legs(y, legs)
        all_legs.append(np.clip(legs, limits.legs_lower, limits.legs_upper))
        all_w.append(static_wrenches(c, y, legs))
    if c.legs:
        phase.legs.write(x, np.array(all_legs))
        phase.w.write(x, np.array(all_w))


def _least_accelerations(
    t: Transcription,
    breaks: Array,
    duration: float,
    start: Array,
    end: Array,
    *,
    rates: Array | None = None,
    end_rates: Array | None = None,
) -> CubicSpline:
    """Spline of least squared accelerations inside position limits, from ``start`` to ``end`` (ny,).

    rates, end_rates : ydot at start and end; None: at rest. There is no acceleration at the end, nor at a
        start at rest. A coordinate that would exceed its rate limit starts and ends with lower rates.
    """
    factors, count = rate_weights(breaks), len(breaks) + 2
    nodes = with_middles(breaks)
    # weighted by the root of the time around a node, so that the sum of squares is an integral
    accelerations = basis(breaks, nodes)[2] * np.sqrt(np.gradient(nodes))[:, None]
    c, limits = t.coordinates, t.builder.limits
    limit = np.concatenate([np.full(c.base, np.inf), limits.rate_limit[c.independent]])
    control = np.zeros((count, c.ny))
    for k in range(c.ny):  # coordinates do not depend on each other: one small least squares problem each
        slowest = np.inf  # largest rate of the slowest spline so far
        for factor in (1.0, 0.8, 0.6, 0.4, 0.2):  # of the given rates
            u0, u1 = (0.0 if u is None else factor * duration * float(u[k]) for u in (rates, end_rates))
            # control points: the rate at an end is the difference of two, times a factor over the duration
            points = np.zeros(count)
            points[0] = start[k]
            points[1] = points[0] + u0 / factors[0]
            fixed = [0, 1, count - 3, count - 2, count - 1]
            if rates is None:  # at rest without acceleration
                points[2] = points[1]
                fixed.append(2)
            points[-1] = end[k]
            # the last three points have the end's rate between them: no acceleration there
            points[-2] = points[-1] - u1 / factors[-1]
            points[-3] = points[-2] - u1 / factors[-2]
            free = np.setdiff1d(np.arange(count), fixed)
            bounds = limits.y_lower[k] - 1e-9, limits.y_upper[k] + 1e-9
            found = lsq_linear(accelerations[:, free], -accelerations @ points, bounds)
            points[free] = found.x
            # control points of the rate, which bound it
            largest = float(np.abs(factors * np.diff(points)).max()) / duration
            if largest < slowest:
                slowest, control[:, k] = largest, points
            if largest <= limit[k]:
                break
    return CubicSpline(control=control, breaks=breaks, duration=duration)
