"""Bounds of a nonlinear program that come from parameters of its problem: their relaxation, and the
parameter values that a relaxed solution needs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.contact.fields import abouts
from impactopt.errors import InputError
from impactopt.planning.parameter_changes import changed, with_term
from impactopt.planning.refinement import program_for
from impactopt.problem.phases import Phase
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
from impactopt.solvers.program import constraint_violations
from impactopt.solvers.relaxed import Relaxation
from impactopt.transcription.layout import ConstraintOrigin
from impactopt.transcription.transcription import Transcription

Selector = Callable[[ConstraintOrigin], bool]
FEASIBLE = 1e-5  # largest violation of the (scaled) constraints that counts as none here
TYPICAL_DURATION = 1.0  # [s] of a swing or a follow-through
_NO_INDICES = np.zeros(0, dtype=np.intp)
# A reported value is beyond the least one by this part of the change: with the least one the feasible set is
# a single point, which no solver finds.
_RESERVE = 0.02
# [m] Shift of a clearance that costs as much in the relaxation as a shift of another bound by its own size.
_CLEARANCE_UNIT = 0.1
_MAX_PAIRS = 3  # of bodies that a cause names
_MAX_PROBES = 6  # evaluations of the program for the value of a term's parameter
# Terms whose constraints have names of their own. The others' names begin with the term's.
_TERM_OF: dict[str, type[Term]] = {
    "capture point": Balance,
    "vertical speed": Balance,
    "angular momentum": Balance,
    "normal force": ContactWrenchCone,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """Bound that alone makes a problem infeasible.

    kind : "time", "speed", or another kind of bound in a word.  text : the bound, with the value that would
    make the problem feasible.  problem : with that value; None if the bound may not take it.
    nearer : of a duration: the same cause with a value between the least one (0) and a typical one (1).
    """

    kind: str
    text: str
    problem: ImpactProblem | None
    nearer: Callable[[float], Cause] | None = None

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}"


class Pair(NamedTuple):
    """Pair of bodies with clearance constraints: their names, and the term of the constraints."""

    names: str
    term: type[KeepOut | SelfCollision]

    def select(self, constraint: ConstraintOrigin) -> bool:
        """True for a constraint of this pair."""
        return constraint.term == self.term.name and constraint.component == self.names


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Bounds of a program that come from one parameter of its problem.

    select : picks the constraints that it bounds.  variables : indices of those that it bounds.  unit : as of
    a `Relaxation`.  causes : by variables (n,) that meet all other bounds, the values that it would need.
    pair : of bodies whose clearance it is; None: it is no clearance.
    """

    name: str
    select: Selector | None
    variables: Index
    unit: float
    causes: Callable[[Array], Iterable[Cause]]
    is_time: bool = False
    pair: Pair | None = None

    def relaxation(self, t: Transcription) -> Relaxation:
        """Relaxation of this bound in any program with the same variables."""
        constraints = _NO_INDICES if self.select is None else _inequalities(t, self.select)
        return Relaxation(constraints, self.variables, self.unit)


def bounds_of(t: Transcription) -> list[Bound]:
    """All bounds of a program that come from parameters of its problem."""
    return [bound for group in (_durations, _clearances, _terms) for bound in group(t)]


def _durations(t: Transcription) -> Iterator[Bound]:
    """Bounds on the durations of swing, follow-through, other stance phases and the phases of contact."""
    p = t.problem
    found: dict[str, list[int]] = {}
    for name, group in t.layout.groups.items():
        if name.endswith(" duration"):
            # Names are those of the transcription's groups; an abort motion has the follow-through's bounds.
            # Those of a scenario begin with its name and a colon, and are the durations of its contact.
            kind = name.split()[0].removesuffix("-abort").replace("abort", "follow")
            of_motion = kind in ("swing", "follow") or kind.startswith("stance")
            kind = kind if of_motion and ": " not in name else "contact"
            found.setdefault(kind, []).append(group.offset)
    # [s] units of the duration variables, as of the transcription
    scale = {kind: 0.01 if kind == "contact" else 0.1 for kind in found}
    for kind, numbers in found.items():
        at = np.array(numbers, dtype=np.intp)

        # Defaults bind the loop's variables as they are now; a closure would see the last ones.
        def causes(x: Array, at: Index = at, kind: str = kind) -> Iterator[Cause]:
            low, high = p.contact_duration if kind == "contact" else motion_phases(p)[kind].duration
            times = x[at] * scale[kind]
            # Several phases share a bound: the one farthest outside decides.
            longer = times.max() > high
            value = float(times.max() if longer else times.min())
            if not longer and value >= low:
                return
            common = {"name": kind, "low": low, "high": high, "longer": longer}

            # geometric interpolation from the least value (0) to the typical duration (1)
            def cause(fraction: float, least: float = value, common: dict[str, Any] = common) -> Cause:
                return _duration_cause(p, least * (TYPICAL_DURATION / least) ** fraction, **common)

            yield replace(cause(0.0), nearer=None if kind == "contact" else cause)

        yield Bound(
            name=kind,
            select=None,
            variables=at,
            # Relative to the bound itself, so that durations of contact and of swings cost alike.
            unit=float(t.program.x_upper[at].max()),
            causes=causes,
            is_time=True,
        )


def motion_phases(p: ImpactProblem) -> dict[str, Phase]:
    """Durations and splines by name: "swing", "follow", and "stance0" and so on of other stance phases."""
    stances = {f"stance{k}": stance.phase for k, stance in enumerate(p.stances) if stance.phase is not None}
    return {"swing": p.swing, "follow": p.follow, **stances}


def phase_changes(p: ImpactProblem, phases: Mapping[str, Phase]) -> dict[str, object]:
    """Fields of a problem that give it these phases, with names as in `motion_phases`."""
    changes: dict[str, object] = {
        name: phase for name, phase in phases.items() if name in ("swing", "follow")
    }
    stances = tuple(
        replace(stance, phase=phases.get(f"stance{k}", stance.phase)) for k, stance in enumerate(p.stances)
    )
    return changes | ({"stances": stances} if stances != p.stances else {})


def _duration_cause(
    p: ImpactProblem, value: float, *, name: str, low: float, high: float, longer: bool
) -> Cause:
    """Cause that a duration [s] has to be outside of its bounds, low and high."""
    bound = high if longer else low
    value = _outward(value, bound)
    # A fixed duration stays fixed.
    both = (value, value) if low == high else (low, value) if longer else (value, high)
    changes: dict[str, object]
    if name == "contact":
        phase, key, changes = "each phase of contact", "[collision]", {"contact_duration": both}
    else:
        phase, key = {"swing": "swing", "follow": "follow-through"}.get(name, name), f"[{name}]"
        changes = phase_changes(p, {name: replace(motion_phases(p)[name], duration=both)})
    if name.startswith("stance"):
        number = int(name.removeprefix("stance")) + 1
        phase, key = f"stance phase {number}", f"[[stances]] number {number},"
    text = f"{phase}: {value:.3g} s instead of {bound:.3g} s ({key} duration_s)"
    return Cause(kind="time", text=text, problem=changed_or_none(p, **changes))


def _clearances(t: Transcription) -> Iterator[Bound]:
    """Clearance of each pair of bodies that has constraints."""
    kinds = {kind.name: kind for kind in (KeepOut, SelfCollision)}
    for term, names in dict.fromkeys((r.term, r.component) for r in t.program.origins if r.term in kinds):
        pair = Pair(names, kinds[term])

        def causes(x: Array, pair: Pair = pair) -> Iterator[Cause]:
            yield clearance_cause(t, x, [pair])

        yield Bound(
            name=f"{term}, {names}",
            select=pair.select,
            variables=_NO_INDICES,
            unit=_CLEARANCE_UNIT,
            causes=causes,
            pair=pair,
        )


def clearance_cause(t: Transcription, x: Array, pairs: Sequence[Pair]) -> Cause:
    """Cause that bodies come too near to each other, at variables (n,) that meet all other bounds.

    The text names the pairs that miss most of their clearance.
    """
    missing = [(_violation(t, x, pair.select), pair) for pair in pairs]
    missing.sort(key=lambda one: -one[0])
    near = [(by, pair) for by, pair in missing if by > FEASIBLE] or missing[:1]
    terms = {pair.term for _, pair in near}
    on_ground = all("ground" in pair.names.split(" and ")[1:] for _, pair in near)
    problem: ImpactProblem | None = t.problem
    # Pairs have no parameter of their own: the problem that shows the cause is the one without the terms.
    for term in terms:
        problem = problem and changed_or_none(problem, terms=with_term(problem, term(enabled=False)))
    return Cause(
        kind="the floor" if on_ground else " and ".join(sorted(term.name for term in terms)),
        text=", and ".join(
            f"{pair.names}: {1e3 * by:.2g} mm nearer than allowed" for by, pair in near[:_MAX_PAIRS]
        ),
        problem=problem,
    )


def _terms(t: Transcription) -> Iterator[Bound]:
    """Parameters of all terms, lazy ones included, that have constraints or bounded variables.

    Clearances have bounds of their own, and limits of position are not relaxed.
    """
    p = t.problem
    terms = [p.term(type(term)) for term in (*DEFAULT_TERMS, *ON_DEMAND_TERMS)]
    terms += [term for term in p.active_terms if not any(type(term) is type(other) for other in terms)]
    swing = float(t.swing.T.read(t.program.x_upper)[0, 0])
    for term in terms:
        if isinstance(term, (KeepOut, SelfCollision, PositionLimit)):
            continue

        def select(constraint: ConstraintOrigin, term: Term = term) -> bool:
            return _TERM_OF.get(constraint.term) is type(term) or constraint.term.startswith(term.name)

        if isinstance(term, GearLoad):
            yield from _gear_loads(t, term)
            continue
        variables = _torques(t) if isinstance(term, TorqueLimit) else _NO_INDICES
        if not _inequalities(t, select).size and not variables.size:
            continue
        # velocity constraints are multiplied by the duration, so that they are linear in the variables
        unit = swing if isinstance(term, VelocityLimit) else 1.0

        def causes(x: Array, term: Term = term, select: Selector = select) -> Iterator[Cause]:
            yield from _term_causes(t, x, term, select)

        yield Bound(name=term.name, select=select, variables=variables, unit=unit, causes=causes)


def _gear_loads(t: Transcription, term: GearLoad) -> Iterator[Bound]:
    """Gear load limit of each joint that has constraints."""
    most, names = np.asarray(term.most(t.robot), dtype=float), t.robot.joint_names
    for k, joint in enumerate(names):

        def select(constraint: ConstraintOrigin, joint: str = joint) -> bool:
            return constraint.term == term.name and constraint.component == joint

        if not _inequalities(t, select).size:
            continue

        def causes(x: Array, k: int = k, joint: str = joint, select: Selector = select) -> Iterator[Cause]:
            value = _outward(float(most[k]) + _violation(t, x, select), float(most[k]))
            limits = {n: float(m) for n, m in zip(names, most, strict=True) if np.isfinite(m)}
            bounded = replace(term, limit=limits | {joint: value})
            text = f"gear of {joint}: {value:.3g} instead of {most[k]:.3g} times its torque limit"
            at = changed_or_none(t.problem, terms=with_term(t.problem, bounded))
            yield Cause(kind="gears", text=f"{text} ([terms.gear_load] limit)", problem=at)

        yield Bound(
            name=f"gear of {joint}",
            select=select,
            variables=_NO_INDICES,
            unit=float(most[k]),
            causes=causes,
        )


def _term_causes(t: Transcription, x: Array, term: Term, select: Selector) -> Iterator[Cause]:
    """Parameters of a term each of which alone, with another value, makes variables (n,) feasible."""
    kind = {TorqueLimit: "torque", VelocityLimit: "speed"}.get(type(term), term.name)
    section = f"[terms.{term.section}] " if type(term) in TERMS else f"{type(term).__name__}."
    about_field = {field.name: about for field, about in abouts(type(term))}
    constraints = _inequalities(t, select).tolist()
    violations = constraint_violations(t.program, t.program.constraints(x))
    worst = max(constraints, key=lambda i: violations[i], default=None)
    where = ""
    if worst is not None and violations[worst] > FEASIBLE:
        name, _ = t.program.describe_violation(worst, x, float(violations[worst]))
        where = f"; {name.partition(', ')[2]}"
    for field in fields(term):
        given, about = getattr(term, field.name), about_field.get(field.name)
        by_joint = about is not None and about.by_joint and isinstance(given, Mapping)
        old = 1.0 if by_joint else given  # a table by joint is searched for a factor of all its numbers
        # Only numbers are searched for a value; an infinite one bounds nothing.
        if isinstance(old, bool) or not isinstance(old, float) or not np.isfinite(old):
            continue

        def at(value: float, name: str = field.name, given: Any = given, by_joint: bool = by_joint) -> Term:
            new = {joint: value * one for joint, one in given.items()} if by_joint else value
            return replace(term, **{name: new})

        def violation_at(value: float, at: Callable[[float], Term] = at) -> float:
            p = changed(t.problem, terms=with_term(t.problem, at(value)))
            return _violation(
                program_for(t.with_clearance({}), p), x, select, torques=type(term) is TorqueLimit
            )

        needed = _feasible_value(violation_at, old)
        if needed is None:
            continue
        value = _outward(needed, old)
        unit = "" if about is None else about.unit
        instead = f"instead of {old:.3g}{' ' + unit if unit else ''}"
        text = f"{term.name}: {value:.3g} {'times the limit of each joint' if by_joint else instead}"
        new = changed_or_none(t.problem, terms=with_term(t.problem, at(value)))
        yield Cause(kind=kind, text=f"{text} ({section}{field.name}{where})", problem=new)


def _feasible_value(violation: Callable[[float], float], old: float) -> float | None:
    """Value of a parameter, next to the old one, at which nothing is violated, by the secant method.

    None if the violation does not depend on it, or the parameter may not have such values.
    """
    step = 0.05 * max(abs(old), 0.01)
    try:
        before = violation(old)
        value = old + step
        after = None
        with contextlib.suppress(InputError):
            after = violation(value)
        if after is None or after > before - 1e-9:  # upwards is no better: downwards
            value = old - step
            after = violation(value)
        if before <= FEASIBLE or after > before - 1e-9:
            return None
        points = [(old, before), (value, after)]
        for _ in range(_MAX_PROBES):
            (a, fa), (b, fb) = points[-2:]
            if fb <= FEASIBLE:
                return b
            if fb >= fa:
                return None
            new = b + 1.001 * fb * (b - a) / (fa - fb)  # slightly beyond the root, to end at no violation
            points.append((new, violation(new)))
    except InputError:
        return None
    return None


def _violation(t: Transcription, x: Array, select: Selector, *, torques: bool = False) -> float:
    """Largest violation of the selected inequalities, and of the bounds of ``torques``, at variables (n,)."""
    found = _inequalities(t, select)
    most = constraint_violations(t.program, t.program.constraints(x))[found].max(initial=0.0)
    # The torque limit bounds variables, not constraints.
    if torques:
        j = _torques(t)
        beyond = np.maximum(t.program.x_lower[j] - x[j], x[j] - t.program.x_upper[j])
        most = max(most, beyond.max(initial=0.0))
    return float(most)


def _inequalities(t: Transcription, select: Selector) -> Index:
    """Indices of the selected constraints that are inequalities."""
    # Equalities have no side to relax.
    found = np.array([i for i, origin in enumerate(t.program.origins) if select(origin)], dtype=np.intp)
    return found[t.program.g_lower[found] < t.program.g_upper[found]]


def _torques(t: Transcription) -> Index:
    """Indices of the variables that are torques, bounded by the torque limit."""
    found = [
        np.arange(group.offset, group.offset + group.count * group.size)
        for name, group in t.layout.groups.items()
        if name.startswith(("torque, ", "torque in collision, ")) or name == "feed-forward at contact"
    ]
    return np.concatenate([_NO_INDICES, *found])


def changed_or_none(problem: ImpactProblem, **new: object) -> ImpactProblem | None:
    """A problem with other parameters; None if it may not have them."""
    with contextlib.suppress(InputError):
        return changed(problem, **new)
    return None


def _outward(value: float, bound: float) -> float:
    """Value beyond a bound, moved farther from it by a reserve and rounded outward to three digits."""
    up = value > bound
    value += _RESERVE * (value - bound) + (1 if up else -1) * 1e-3 * abs(value)
    size = 10.0 ** (np.floor(np.log10(max(abs(value), 1e-12))) - 2)
    return float(f"{(np.ceil if up else np.floor)(value / size) * size:.3g}")
