"""The numbers of a problem that bound its program: how they give way, and what they say where they have."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import abouts, snake_case
from impactopt.errors import InputError
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import program_for
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import (
    DEFAULT_TERMS,
    ON_DEMAND_TERMS,
    TERMS,
    Balance,
    ContactWrenchCone,
    GearLoad,
    KeepOut,
    PositionLimit,
    SelfCollision,
    Term,
    TorqueLimit,
    VelocityLimit,
)
from impactopt.solvers.program import row_violations
from impactopt.solvers.relaxed import Relaxation
from impactopt.transcription.layout import Row
from impactopt.transcription.transcription import Transcription

__all__ = ["MET", "USUAL", "Bound", "Cause", "bounds_of", "changed_or_none"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Chosen = Callable[[Row], bool]
MET = 1e-5  # violation of constraints that counts as none here
USUAL = 1.0  # [s] of a motion
_NO = np.zeros(0, dtype=np.intp)
_TIMES = {"swing": "swing", "follow": "follow-through", "contact": "each phase of contact"}
_ROOM = 0.02  # by how much more a value is reported than what it takes: there the feasible set is one point
_FAR = 0.1  # [m] between bodies that count as much as a bound's own size
_PROBES = 6  # of a term's number, at most
_OF_TERM: dict[str, type[Term]] = {
    "capture point": Balance,
    "vertical speed": Balance,
    "angular momentum": Balance,
    "normal force": ContactWrenchCone,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """A bound that stands alone between a problem and a plan.

    first : its kind in a word: "time", "speed".  text : with the value that would do.
    problem : with that value; None where no value does that the bound may take.
    nearer : of a time: the same with a value that is so far (0 to 1) on the way to a usual one.
    """

    first: str
    text: str
    problem: ImpactProblem | None
    nearer: Callable[[float], Cause] | None = None

    def __str__(self) -> str:
        return f"{self.first}: {self.text}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Bounds of a program that come from one number of its problem.

    chosen : which constraints; variables : and whose bounds.  unit : as of a `Relaxation`.
    told : for variables (n,) that meet all else, the causes that they show.
    """

    name: str
    chosen: Chosen | None
    variables: Index
    unit: float
    told: Callable[[Array], Iterable[Cause]]
    is_time: bool = False

    def relaxation(self, t: Transcription) -> Relaxation:
        """Relaxation of this bound in any program with the same variables."""
        rows = _NO if self.chosen is None else _rows(t, self.chosen)
        return Relaxation(rows, self.variables, self.unit)


def bounds_of(t: Transcription) -> list[Bound]:
    """All bounds of a program that are numbers of its problem."""
    return [bound for of in (_durations, _of_bodies, _of_terms) for bound in of(t)]


def _durations(t: Transcription) -> Iterator[Bound]:
    """Bounds on the durations of swing, follow-through and the phases of contact."""
    p = t.problem
    found: dict[str, list[int]] = {}
    for name, group in t.layout.groups.items():
        if name.endswith(" duration"):
            kind = {"swing": "swing", "follow": "follow", "abort": "follow"}.get(name.split()[0], "contact")
            found.setdefault(kind, []).append(group.offset)
    scale = {kind: 0.01 if kind == "contact" else 0.1 for kind in found}
    for kind, numbers in found.items():
        field = "contact_duration" if kind == "contact" else kind
        at = np.array(numbers, dtype=np.intp)

        def told(x: Array, at: Index = at, kind: str = kind, field: str = field) -> Iterator[Cause]:
            own = getattr(p, field)
            low, high = own if kind == "contact" else own.duration
            times = x[at] * scale[kind]
            longer = times.max() > high
            value = float(times.max() if longer else times.min())
            if not longer and value >= low:
                return
            common = {"name": kind, "low": low, "high": high, "longer": longer}

            def cause(more: float, least: float = value, common: dict[str, Any] = common) -> Cause:
                return _time(p, least * (USUAL / least) ** more, **common)

            yield replace(cause(0.0), nearer=None if kind == "contact" else cause)

        yield Bound(
            name=kind,
            chosen=None,
            variables=at,
            unit=float(t.program.x_upper[at].max()),
            told=told,
            is_time=True,
        )


def _time(p: ImpactProblem, value: float, *, name: str, low: float, high: float, longer: bool) -> Cause:
    """A duration that would do beside its bounds."""
    bound = high if longer else low
    value = _outward(value, bound)
    both = (value, value) if low == high else (low, value) if longer else (value, high)
    text = f"{_TIMES[name]}: {value:.3g} s for {bound:.3g} s"
    if name == "contact":
        new = changed_or_none(p, contact_duration=both)
        return Cause(first="time", text=f"{text} ([collision] duration_s)", problem=new)
    new = changed_or_none(p, **{name: replace(getattr(p, name), duration=both)})
    return Cause(first="time", text=f"{text} ([{name}] duration_s)", problem=new)


def _of_bodies(t: Transcription) -> Iterator[Bound]:
    """Pairs of bodies."""
    kinds = KeepOut.name, SelfCollision.name
    for term, pair in dict.fromkeys((r.term, r.component) for r in t.program.origins if r.term in kinds):

        def chosen(row: Row, term: str = term, pair: str = pair) -> bool:
            return row.term == term and row.component == pair

        def told(x: Array, chosen: Chosen = chosen, term: str = term, pair: str = pair) -> Iterator[Cause]:
            off = 1e3 * _off(t, x, chosen)
            kind = KeepOut if term == KeepOut.name else SelfCollision
            free = kind(enabled=False)
            first = "the floor" if "ground" in pair.split(" and ")[1:] else term
            words = f"{pair}: {off:.2g} mm nearer than they may be"
            yield Cause(
                first=first, text=words, problem=changed_or_none(t.problem, terms=_with(t.problem, free))
            )

        yield Bound(name=f"{term}, {pair}", chosen=chosen, variables=_NO, unit=_FAR, told=told)


def _of_terms(t: Transcription) -> Iterator[Bound]:
    """Numbers of terms."""
    p = t.problem
    terms = [p.term(type(term)) for term in (*DEFAULT_TERMS, *ON_DEMAND_TERMS)]
    terms += [term for term in p.active_terms if not any(type(term) is type(other) for other in terms)]
    swing = float(t.swing.T.read(t.program.x_upper)[0, 0])
    for term in terms:
        if isinstance(term, (KeepOut, SelfCollision, PositionLimit)):
            continue

        def chosen(row: Row, term: Term = term) -> bool:
            return _OF_TERM.get(row.term) is type(term) or row.term.startswith(term.name)

        if isinstance(term, GearLoad):
            yield from _of_gears(t, term)
            continue
        variables = _torques(t) if isinstance(term, TorqueLimit) else _NO
        if not _rows(t, chosen).size and not variables.size:
            continue
        unit = swing if isinstance(term, VelocityLimit) else 1.0

        def told(x: Array, term: Term = term, chosen: Chosen = chosen) -> Iterator[Cause]:
            yield from _fields(t, x, term, chosen)

        yield Bound(name=term.name, chosen=chosen, variables=variables, unit=unit, told=told)


def _of_gears(t: Transcription, term: GearLoad) -> Iterator[Bound]:
    most, names = np.asarray(term.most(t.robot), dtype=float), t.robot.joint_names
    for k, joint in enumerate(names):

        def chosen(row: Row, joint: str = joint) -> bool:
            return row.term == term.name and row.component == joint

        if not _rows(t, chosen).size:
            continue

        def told(x: Array, k: int = k, joint: str = joint, chosen: Chosen = chosen) -> Iterator[Cause]:
            off = _off(t, x, chosen)
            value = _outward(float(most[k]) + off, float(most[k]))
            limits = {n: float(m) for n, m in zip(names, most, strict=True) if np.isfinite(m)}
            bounded = replace(term, limit=limits | {joint: value})
            words = f"gear of {joint}: {value:.3g} for {most[k]:.3g} of its torque limit"
            at = changed_or_none(t.problem, terms=_with(t.problem, bounded))
            yield Cause(first="gears", text=f"{words} ([terms.gear_load] limit)", problem=at)

        yield Bound(name=f"gear of {joint}", chosen=chosen, variables=_NO, unit=float(most[k]), told=told)


def _fields(t: Transcription, x: Array, term: Term, chosen: Chosen) -> Iterator[Cause]:
    """The numbers of a term any one of which would do, with their values."""
    first = {TorqueLimit: "torque", VelocityLimit: "speed"}.get(type(term), term.name)
    kind = type(term).__name__
    written = f"[terms.{snake_case(kind)}] " if type(term) in TERMS else f"{kind}."
    allowed = {field.name: about for field, about in abouts(type(term))}
    rows = _rows(t, chosen).tolist()
    off = row_violations(t.program, t.program.constraints(x))
    worst = max(rows, key=lambda i: off[i], default=None)
    where = ""
    if worst is not None and off[worst] > MET:
        row, _ = t.program.describe_violation(worst, x, float(off[worst]))
        where = f"; {row.partition(', ')[2]}"
    for field in fields(term):
        old = getattr(term, field.name)
        if isinstance(old, bool) or not isinstance(old, float) or not np.isfinite(old):
            continue

        def off_at(value: float, name: str = field.name) -> float:
            p = changed(t.problem, terms=_with(t.problem, replace(term, **{name: value})))
            return _off(program_for(t.with_apart({}), p), x, chosen, torques=type(term) is TorqueLimit)

        needed = _where_met(off_at, old)
        if needed is None:
            continue
        value = _outward(needed, old)
        unit = allowed[field.name].unit if field.name in allowed else ""
        words = f"{term.name}: {value:.3g} for {old:.3g}{' ' + unit if unit else ''}"
        new = None
        with contextlib.suppress(InputError):
            new = changed(t.problem, terms=_with(t.problem, replace(term, **{field.name: value})))
        yield Cause(first=first, text=f"{words} ({written}{field.name}{where})", problem=new)


def _where_met(off: Callable[[float], float], old: float) -> float | None:
    """The value of a number, next to the old one, at which nothing is off; None if it changes nothing, or may
    not have such values.
    """
    step = 0.05 * max(abs(old), 0.01)
    try:
        before = off(old)
        value = old + step
        after = None
        with contextlib.suppress(InputError):
            after = off(value)
        if after is None or after > before - 1e-9:
            value = old - step
            after = off(value)
        if before <= MET or after > before - 1e-9:
            return None
        points = [(old, before), (value, after)]
        for _ in range(_PROBES):
            (a, fa), (b, fb) = points[-2:]
            if fb <= MET:
                return b
            if fb >= fa:
                return None
            new = b + 1.001 * fb * (b - a) / (fa - fb)
            points.append((new, off(new)))
    except InputError:
        return None
    return None


def _off(t: Transcription, x: Array, chosen: Chosen, *, torques: bool = False) -> float:
    rows = _rows(t, chosen)
    off = row_violations(t.program, t.program.constraints(x))[rows].max(initial=0.0)
    if torques:
        j = _torques(t)
        beyond = np.maximum(t.program.x_lower[j] - x[j], x[j] - t.program.x_upper[j])
        off = max(off, beyond.max(initial=0.0))
    return float(off)


def _rows(t: Transcription, chosen: Chosen) -> Index:
    """Numbers of the constraints that are chosen, of those that are bounds."""
    found = np.array([i for i, row in enumerate(t.program.origins) if chosen(row)], dtype=np.intp)
    return found[t.program.g_lower[found] < t.program.g_upper[found]]


def _torques(t: Transcription) -> Index:
    """Variables that are torques with the limit as their bounds."""
    found = [
        np.arange(group.offset, group.offset + group.count * group.size)
        for name, group in t.layout.groups.items()
        if name.startswith(("torque, ", "torque in collision, ")) or name == "feed-forward at contact"
    ]
    return np.concatenate([_NO, *found])


def _with(problem: ImpactProblem, term: Term) -> tuple[Term, ...]:
    return (*(other for other in problem.terms if type(other) is not type(term)), term)


def changed_or_none(problem: ImpactProblem, **new: object) -> ImpactProblem | None:
    """A problem with other parameters; None if it may not have them."""
    with contextlib.suppress(InputError):
        return changed(problem, **new)
    return None


def _outward(value: float, bound: float) -> float:
    """Value with some room, in three digits, away from the bound."""
    up = value > bound
    value += _ROOM * (value - bound) + (1 if up else -1) * 1e-3 * abs(value)
    size = 10.0 ** (np.floor(np.log10(max(abs(value), 1e-12))) - 2)
    return float(f"{(np.ceil if up else np.floor)(value / size) * size:.3g}")
