"""Initial guesses: a reach to the target by inverse kinematics, or a strike's state at contact; and back."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from scipy.optimize import lsq_linear

from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates, independent_rates
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import CubicSpline, basis, quintic, rate_weights
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import TargetSpeed
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import effective_mass, speed_that_leaves
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.contact_refinement import map_contact, same_places
from impactopt.transcription.layout import Array, Group, Row
from impactopt.transcription.mesh import with_middles
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.plan import drifting_reference
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription

# ends of names of variables that models of the collision have each for itself
OF_MODEL = ("coasting legs", "coasting leg rates")
_SLOW = 2.0  # [s] of a swing: a guess that is slower has the robot nearly still at contact


def strike_rates(
    c: StanceCoordinates,
    strikers: Sequence[str],
    y: Array,
    legs: Array,
    velocity: Array,
    *,
    base: float = 0.3,
) -> Array:
    """Least rates ydot (ny,) that give the striking points ``velocity`` (3,) [m/s].

    ``base`` : ease of the base's rates.
    """
    model, data = c.model, c.model.createData()
    frames = [model.getFrameId(f"striker:{name}") for name in strikers]

    def point(at: Array) -> Array:
        pin.framesForwardKinematics(model, data, c.join(at, legs))
        return np.concatenate([data.oMf[frame].translation for frame in frames])

    h = 1e-6
    jac = np.stack([(point(y + h * e) - point(y - h * e)) / (2 * h) for e in np.eye(c.ny)], axis=1)
    # least |rates / weight|, by the substitution rates = weight r
    weight = np.ones(c.ny)
    weight[: c.base] = base
    return np.asarray(weight * np.linalg.lstsq(jac * weight, np.tile(velocity, len(frames)), rcond=None)[0])


@dataclass(frozen=True)
class Contact:
    """A state at contact: coordinates y and rates (ny,), legs (nl,)."""

    y: Array
    rates: Array
    legs: Array


def reached(t: ContactProgram, *, speed: float = 1.0, noise: float = 0.0, seed: int = 0) -> Contact:
    """The target reached by inverse kinematics, and met at ``speed`` [m/s] where joints are that fast; where
    the target's speed after the blow is bounded, at the nearest that a point mass may have.

    ``noise`` [rad] perturbs the posture, for several starts.
    """
    p, c = t.problem, t.coordinates
    rng = np.random.default_rng(seed)
    y, legs = c.split(p.contact_posture)
    y[c.base :] += noise * rng.standard_normal(c.ny - c.base)
    limits = t.builder.limits
    y = np.clip(y, limits.y_lower, limits.y_upper)
    bounds = p.extra(TargetSpeed)
    if bounds is not None:
        mass = effective_mass(c, p.strikers, p.normal, y, legs, np.zeros(c.ny))[0]
        speed = speed_that_leaves(p.law, p.target, mass, speed, bounds.least, bounds.most)
    ease = {"base": 0.0} if c.drifts else {}  # its momentum says how it moves
    rates = strike_rates(c, p.strikers, y, legs, speed * p.normal, **ease)
    return Contact(y, rates * _within(rates[c.base :], 0.8 * limits.rate_limit[c.independent]), legs)


def _within(rates: Array, limit: Array) -> float:
    """The factor, 1 at most, that brings rates inside their limits."""
    return min(1.0, float((limit / np.maximum(np.abs(rates), 1e-9)).min()))


def first_iterate(t: Transcription, *, speed: float = 1.0, noise: float = 0.0, seed: int = 0) -> Array:
    """Solver variables (n,) of a plain reach; speed, noise, seed: as of :func:`reached`."""
    hit = reached(t, speed=speed, noise=noise, seed=seed)
    zero, (swing_T, follow_T) = np.zeros(len(t.y0)), _durations(t)
    start, end = _ends(t.problem, t.coordinates, t.problem.blow)
    swing = quintic(start, zero, hit.y, hit.rates, swing_T, t.swing.breaks)
    # half of the rates is left after contact, as where two like masses meet
    back = quintic(hit.y, 0.5 * hit.rates, end, zero, follow_T, t.follow.breaks)
    curve = CubicSpline.fit(swing, t.swing.breaks, zero, hit.rates, swing_T)
    after = CubicSpline.fit(back, t.follow.breaks, 0.5 * hit.rates, zero, follow_T)
    if t.coordinates.drifts:
        curve = _drifting(t.problem, curve)
        hit = replace(hit, y=curve.sample(swing_T)[0][0], rates=curve.sample(swing_T)[1][0])
        after = _drifting(t.problem, after, hit)
    x = _motion(t, curve, after)
    t.hit.guess(x, hit.y, hit.rates, hit.legs)
    _draw_gains(t, x, noise, seed)
    return _finished(t, x)


def _drifting(problem: ImpactProblem, curve: CubicSpline, since: Contact | None = None) -> CubicSpline:
    """The spline with its joints' motion, and the base where that takes it if nothing holds it.

    since : the state in which it begins; None: that of the spline.
    """
    breaks, c = curve.breaks, problem.coordinates
    fine = with_middles(with_middles(breaks))
    time = fine * curve.duration

    def sample(at: Array) -> tuple[Array, ...]:
        rows = curve.sample(at)
        if since is not None and not at[0]:
            rows[0][0, :6], rows[1][0, :6] = since.y[:6], since.rates[:6]
        return rows

    found = drifting_reference(problem, sample, time, backward=False)
    y = np.array([c.split(q)[0] for q in found.q])
    rates = [independent_rates(c, y[k], found.v[k]) for k in (0, -1)]
    return CubicSpline.fit(y[np.isin(fine, breaks)], breaks, rates[0], rates[1], curve.duration)


def strike_iterate(t: StrikeTranscription, *, speed: float = 1.0, noise: float = 0.0, seed: int = 0) -> Array:
    """Solver variables (n,) of a strike, as of :func:`first_iterate`."""
    hit = reached(t, speed=speed, noise=noise, seed=seed)
    x = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper)
    with contextlib.suppress(InputError):  # out of the legs' reach: the solver has to fix it
        hit = replace(hit, legs=t.coordinates.solve_legs(hit.y, hit.legs))
    t.y.write(x, hit.y)
    t.legs.write(x, hit.legs)
    t.w.write(x, static_wrenches(t.coordinates, hit.y, hit.legs))
    t.hit.guess(x, hit.y, hit.rates, hit.legs)
    _draw_gains(t, x, noise, seed)
    return _finished(t, x)


def _draw_gains(t: ContactProgram, x: Array, noise: float, seed: int) -> None:
    """Gains that are chosen begin as they are given, and in noisy starts anywhere between their bounds."""
    gains = t.hit.contact.gains
    if noise and gains.size:
        k = gains.index(0)
        x[k] = np.random.default_rng(seed).uniform(t.layout.lower[k], t.layout.upper[k])


def iterate_from_strike(t: Transcription, strike: StrikeTranscription, x: Array) -> Array:
    """Solver variables (n,) of a motion from those of a strike: to its state at contact, and back.

    Where the swing there would break limits of rates it goes as fast as they allow.
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
    for name, group in strike.layout.groups.items():
        mine = t.layout.groups.get(name)
        if mine is not None and mine.count == group.count:
            mine.write(out, group.read(x))
    return _finished(t, out)


def carried_over(t: ContactProgram, old: ContactProgram, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
    """Variables, multipliers of constraints and of bounds of a program with more nodes than an old one, or
    elements, or of another model of the collision that lasts, or with a first instant of contact.

    What is at nodes is between those of the old nodes, and the contact is that of its polynomials;
    multipliers are those of the same constraints and variables.
    """
    stages = same_places(t.hit.stages, old.hit.stages)
    places = {}
    if isinstance(t, Transcription) and isinstance(old, Transcription):
        places = {"swing": (old.swing_nodes, t.swing_nodes)}
        places |= dict.fromkeys(("follow", "abort"), (old.follow_nodes, t.follow_nodes))
        for mine, its in zip((t.before, *t.after), (old.before, *old.after), strict=True):
            places |= {one.kind: (its.stands[k].nodes, one.nodes) for k, one in mine.stands.items()}
    new, bounds = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper), np.zeros(t.layout.n)
    for name, group in t.layout.groups.items():
        known = old.layout.groups.get(name)
        if known is None or not group.size:
            continue
        if known.labels != group.labels:  # of one vector with a part for each node, which its label names
            _carry_by_label(group, known, (new, x), (bounds, z))
            continue
        pairs = [(k, k) for k in range(group.count)]
        if name.endswith(OF_MODEL) and _model(t) != _model(old):
            continue
        if name.split()[0] in places and known.count != group.count:
            before, now = places[name.split()[0]]
            pairs = [(int(i), k) for k, i in enumerate(np.flatnonzero(np.isin(now, before)))]
            group.write(new, np.column_stack([np.interp(now, before, column) for column in known.read(x).T]))
        elif known.count == len(old.hit.stages) and known.count != group.count:
            pairs = stages
        else:
            group.write(new, known.read(x))
        for i, k in pairs:
            bounds[group.index(i)] = z[known.index(k)]
    for mine, its in zip(t.hit.collisions, old.hit.collisions, strict=True):
        if not isinstance(mine, Collision) or not isinstance(its, Collision):
            continue
        if _model(t) != _model(old):
            state = t.contact_state[0].evaluate(new), t.u0.read(new)[0], t.contact_legs.evaluate(new)
            mine.guess_model(new, *state)
        elif t.hit.elements != old.hit.elements:
            map_contact(mine, its, new, x)
    if len(t.hit.first) != len(old.hit.first):
        state = t.contact_state[0].evaluate(new), t.u0.read(new)[0], t.contact_legs.evaluate(new)
        for first in t.hit.first:
            first.guess(new, *state)
    return _finished(t, new), _of_same_rows(t.program.origins, old.program.origins, y), bounds


def _carry_by_label(group: Group, known: Group, *vectors: tuple[Array, Array]) -> None:
    """Copy what has the same label; ``vectors``: new and old ones. What is new is lifted, so it is found
    afterwards.
    """
    before = {label: j for j, label in enumerate(known.labels)}
    there = [k for k, label in enumerate(group.labels) if label in before]
    here = [before[group.labels[k]] for k in there]
    for k in range(min(group.count, known.count)):
        for new, old in vectors:
            new[group.index(k)[there]] = old[known.index(k)[here]]


def _model(t: ContactProgram) -> tuple[str, int]:
    return t.problem.collision, t.problem.freezes


def _of_same_rows(rows: Sequence[Row], known: Sequence[Row], numbers: Array) -> Array:
    """The numbers of known constraints for these: those of the same name, as often as there are any; else 0.

    Most constraints in front are the very same: programs differ by what comes after them.
    """
    differ = (k for k, (one, other) in enumerate(zip(rows, known, strict=False)) if one is not other)
    same = next(differ, min(len(rows), len(known)))
    of_names = dict(zip(_keys(known[same:]), numbers[same:].tolist(), strict=True))
    return np.concatenate([numbers[:same], [of_names.get(key, 0.0) for key in _keys(rows[same:])]])


def _keys(rows: Sequence[Row]) -> Iterator[tuple[tuple[str, str, str], int]]:
    """Name of each constraint, and the number of earlier ones of that name."""
    seen: dict[tuple[str, str, str], int] = {}
    for row in rows:
        name = row.term, row.place.name, row.component
        before = seen.get(name, 0)
        seen[name] = before + 1
        yield name, before


def _finished(t: ContactProgram, x: Array) -> Array:
    return np.clip(t.with_lifted(x), t.layout.lower, t.layout.upper)


def _durations(t: Transcription) -> tuple[float, float]:
    """Durations of swing and follow-through [s]: the middle of their ranges, where that is not slow."""
    swing, follow = (
        max(phase.duration[0], min(float(np.mean(phase.duration)), _SLOW))
        for phase in (t.problem.swing, t.problem.follow)
    )
    return swing, follow


def _motion(t: Transcription, curve: CubicSpline, back: CubicSpline) -> Array:
    """A swing and a follow-through, with legs and sole wrenches as at rest."""
    x = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper)
    for phase, spline in ((t.swing, curve), *((follow, back) for follow in t.follows)):
        _write(t.builder, x, phase, spline)
    for course in (t.before, *t.after):
        for k, phase in course.stands.items():
            b, T = course.builders[k], float(np.mean(phase.phase.duration))
            (start, end), still = _ends(t.problem, b.coordinates, k), np.zeros(b.ny)
            way = quintic(start, still, end, still, T, phase.breaks)
            _write(b, x, phase, CubicSpline.fit(way, phase.breaks, still, still, T))
    if t.abort is not None and t.coordinates.legs:
        t.abort.coast_w.write(x, t.swing.w.read(x)[-1:])
    return x


def _ends(problem: ImpactProblem, c: StanceCoordinates, k: int) -> list[Array]:
    """Coordinates (ny,) at the ends of stance phase k."""
    return [c.split(problem.change_posture(j))[0] for j in (k - 1, k)]


def _write(b: Builder, x: Array, phase: MotionPhase, spline: CubicSpline) -> None:
    """A phase's spline, with legs and sole wrenches as at rest."""
    c, limits, legs = b.coordinates, b.limits, b.legs0
    phase.guess(x, spline)
    all_legs, all_w = [], []
    for y in spline.sample(phase.nodes * spline.duration)[0]:
        with contextlib.suppress(InputError):  # out of the legs' reach: the solver has to fix it
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
    """The spline of least accelerations inside the limits of positions, to ``end`` without acceleration.

    It starts and ends at rest, or with these rates. A coordinate that would break its limit of rates starts
    and ends slower.
    """
    factors, count = rate_weights(breaks), len(breaks) + 2
    nodes = with_middles(breaks)
    # weighted by the root of a node's part of the time, so that squares sum up to the integral
    accelerations = basis(breaks, nodes)[2] * np.sqrt(np.gradient(nodes))[:, None]
    c, limits = t.coordinates, t.builder.limits
    limit = np.concatenate([np.full(c.base, np.inf), limits.rate_limit[c.independent]])
    control = np.zeros((count, c.ny))
    for k in range(c.ny):
        fastest = np.inf
        for slower in (1.0, 0.8, 0.6, 0.4, 0.2):
            way = slower * duration
            u0, u1 = (0.0 if u is None else way * float(u[k]) for u in (rates, end_rates))
            points = np.zeros(count)
            points[0] = start[k]
            points[1] = points[0] + u0 / factors[0]
            held = [0, 1, count - 3, count - 2, count - 1]
            if rates is None:  # at rest without acceleration
                points[2] = points[1]
                held.append(2)
            points[-1] = end[k]
            # three points with the end's rate between them: no acceleration there
            points[-2] = points[-1] - u1 / factors[-1]
            points[-3] = points[-2] - u1 / factors[-2]
            free = np.setdiff1d(np.arange(count), held)
            bounds = limits.y_lower[k] - 1e-9, limits.y_upper[k] + 1e-9
            found = lsq_linear(accelerations[:, free], -accelerations @ points, bounds)
            points[free] = found.x
            fast = float(np.abs(factors * np.diff(points)).max()) / duration
            if fast < fastest:
                fastest, control[:, k] = fast, points
            if fast <= limit[k]:
                break
    return CubicSpline(control=control, breaks=breaks, duration=duration)
