"""Diagnosis of a failed solve: a second solver's result, and the bound that makes a problem infeasible.

From the point of least violation, the bounds of each kind in turn are relaxed by as little as all others
require (`impactopt.solvers.relaxed`). A cause is a parameter of the problem, with a value at which a feasible
motion is known.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.planning.bounds import (
    FEASIBLE,
    TYPICAL_DURATION,
    Bound,
    Cause,
    bounds_of,
    changed_or_none,
    clearance_cause,
    motion_phases,
    phase_changes,
)
from impactopt.planning.budget import VIOLATED, Budget
from impactopt.planning.clearance_constraints import Margins, deepest_penetration
from impactopt.planning.lazy_constraints import slides_beyond, with_lazy_constraints
from impactopt.planning.parameter_changes import changed, with_parameter
from impactopt.planning.refinement import program_for, start_of
from impactopt.problem.checks import met_once
from impactopt.problem.feasibility import too_weak
from impactopt.problem.phases import LONGEST, SHORTEST, Phase
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Slide
from impactopt.robots.loads import shortfalls
from impactopt.robots.robot import Robot
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.program import NonlinearProgram, SolverResult, Status, max_violation
from impactopt.solvers.relaxed import RelaxedProgram
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import Parting, fastest_at_contact, parting
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.initial_guess import first_iterate, warm_start
from impactopt.transcription.plan import Plan, PlannedCollision
from impactopt.transcription.transcription import Transcription

# In the search durations may be so many times longer or shorter, or typical.
_DURATION_FACTOR = 4.0
_MAX_CONTACT_PHASE = 0.2  # [s] longest duration of a phase of contact in the search
# Iterations at most: with all bounds relaxed, with a single one, and of a program with a changed bound from
# its initial guess. Most need a third of it.
_ITERATIONS_ALL, _ITERATIONS_SINGLE, _ITERATIONS_CHANGED = 100, 60, 200
_MIN_ITERATIONS = 400  # that the whole search may take, after however short a solve
_MAX_SINGLE = 5  # bounds that are relaxed alone
# Stiffnesses over the problem's, from one half order of magnitude to two. Where there is a solution, most are
# found in half of the iterations.
_STIFFNESS_FACTORS = tuple(10.0 ** (sign * k / 2) for k in (1, 2, 3, 4) for sign in (1, -1))
_ITERATIONS_STIFFNESS = 50
_BARRIER, _PUSH = 1e-2, 1e-3  # solver options for an initial guess that is nearly feasible
_TOLERANCE = 1e-4  # values are reported with three digits
_MAX_VALUES = 4  # of one bound that are tried
_NOT_RELAXED = 1e-4  # smaller relaxations count as none


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Result of a search for the bounds that make a problem infeasible.

    causes : bounds each of which alone, if changed, makes the problem feasible.
    met : program of the problem with the constraints of all lazy terms, and feasible variables (n,); None if
        none are known.
    """

    causes: tuple[Cause, ...] = ()
    met: tuple[Transcription, Array] | None = None


def search(t: Transcription, result: SolverResult, budget: Budget) -> Search:
    """Searches for the cause of a program's infeasibility, in about as many iterations as its solve took.

    result : of the program, with the least violation that its solver found.
    """
    if budget.is_over():
        return Search()
    try:
        return _CauseSearch(t, result, budget).found()
    except InputError:  # the problem with wider durations is refused: no cause is known then
        return Search()


class _CauseSearch:
    """Relaxations of a program: it has wider bounds of the durations, `loose`, and `bounds` narrow them to
    those of the problem.
    """

    def __init__(self, t: Transcription, result: SolverResult, budget: Budget) -> None:
        self.given, self._budget = t.problem, budget
        # In iterations, not seconds, so that the result does not depend on the machine.
        self._iterations = max(_MIN_ITERATIONS, result.iterations)
        # With the constraints of all lazy terms, or a changed bound would be confirmed by a motion that
        # violates those.
        names = [term.section for term in t.problem.on_demand]
        p = with_lazy_constraints(t.problem, names)
        self.t = program_for(t, p)
        zero_multipliers = np.zeros(t.program.m), np.zeros(t.layout.n)
        # Multipliers of an infeasible program are no guess of any solution's.
        own = warm_start(self.t, t, result.x, *zero_multipliers)[0]
        shortest, longest = p.contact_duration
        phases, fixed = motion_phases(p), (TYPICAL_DURATION, TYPICAL_DURATION)
        # Wider than the problem allows, as a duration far from its bound may be the only cure.
        loose = changed(
            p,
            **phase_changes(p, {name: _loosened(phase) for name, phase in phases.items()}),
            contact_duration=(shortest, max(_MAX_CONTACT_PHASE, longest)),
        )
        self.loose = program_for(self.t, loose)
        lasting = {name: replace(phase, duration=fixed) for name, phase in phases.items()}
        typical = changed(loose, **phase_changes(loose, lasting))
        # initial guesses: the failed solve's last point, and the problem's own with typical durations
        self.guesses = own, first_iterate(program_for(self.t, typical))
        self.bounds = bounds_of(self.t)
        # program of the problem with a bound changed that makes it feasible, and its solution (n,)
        self._near: tuple[Transcription, Array] | None = None

    def found(self) -> Search:
        relaxed = self._all_relaxed()
        if relaxed is None:
            return Search(causes=tuple(self._stiffness()))
        x, sizes = relaxed
        # Nothing had to be relaxed: the failed solve was no proof.
        if sizes.max(initial=0.0) <= _NOT_RELAXED and self._is_feasible(x):
            return Search(met=(self.t, x))
        # those that were relaxed most first, then all durations
        order = np.argsort(-sizes, kind="stable").tolist()
        candidates = [self.bounds[k] for k in order if sizes[k] > _NOT_RELAXED]
        candidates += [bound for bound in self.bounds if bound.is_time and bound not in candidates]
        causes: list[Cause] = []
        for bound in candidates[:_MAX_SINGLE]:
            # From the point where all bounds are relaxed: it already meets what is not relaxed.
            alone = self._relaxed([bound], x, _ITERATIONS_SINGLE)
            if alone is not None:
                causes += filter(None, map(self._confirmed, bound.causes(alone[0])))
        if not any(cause.problem for cause in causes):
            causes += self._clearances(candidates, x)
        if not any(cause.problem for cause in causes):
            causes += self._stiffness()
        # Stable: those that would do come first, in the order found.
        causes.sort(key=lambda cause: cause.problem is None)
        # A motion within a changed bound may lead to one within the given ones: then nothing had to change.
        if self._near is not None:
            result = self._run(self.t.program, start_of(self.t, *self._near), _ITERATIONS_SINGLE)
            if result is not None and not _penetrates(self.t, result.x):
                return Search(causes=tuple(causes), met=(self.t, result.x))
        return Search(causes=tuple(causes))

    def _all_relaxed(self) -> tuple[Array, Array] | None:
        """A point that is feasible with all bounds relaxed at once, if an initial guess leads to one (see
        `_relaxed`).
        """
        for guess in self.guesses:
            found = self._relaxed(self.bounds, guess, _ITERATIONS_ALL)
            if found is not None:
                return found
        return None

    def _confirmed(self, cause: Cause) -> Cause | None:
        """A cause whose value makes the problem solvable from its initial guess; None if no value does.

        If the least duration does not, values nearer to a typical one are tried. A cause whose bound may not
        take the value is returned as it is.
        """
        for attempt in range(_MAX_VALUES):
            if cause.problem is None or (attempt and cause.nearer is None):
                break
            one = cause if not attempt or cause.nearer is None else cause.nearer(attempt / _MAX_VALUES)
            if one.problem is None:
                break
            # A confirmation does not take from the search.
            self._iterations += _ITERATIONS_CHANGED
            solution = self._solution(one.problem, _ITERATIONS_CHANGED)
            if solution is not None and not _penetrates(*solution):
                self._near = self._near or solution
                return replace(one, nearer=None)
        return replace(cause, nearer=None) if cause.problem is None else None

    def _clearances(self, candidates: Sequence[Bound], guess: Array) -> Iterator[Cause]:
        """Clearances that only together make the problem feasible, from variables (n,) with all relaxed."""
        bounds = [bound for bound in candidates if bound.pair is not None]
        found = self._relaxed(bounds, guess, _ITERATIONS_SINGLE) if len(bounds) > 1 else None
        if found is not None:
            pairs = [bound.pair for bound in bounds if bound.pair is not None]
            yield from filter(None, [self._confirmed(clearance_cause(self.t, found[0], pairs))])

    def _stiffness(self) -> Iterator[Cause]:
        """The first contact stiffness with a solution, among multiples of the problem's: no bound of the
        program contains it.
        """
        p = self.t.problem
        known = p.law.parameters.get("stiffness")
        self._iterations = _ITERATIONS_STIFFNESS * len(_STIFFNESS_FACTORS)
        for factor in () if known is None else _STIFFNESS_FACTORS:
            # Two digits are what the message gives, so it is what is tried.
            value = float(f"{known * factor:.2g}")
            law = with_parameter(p.law, "stiffness", value)
            new = changed_or_none(p, law=law)
            if new is None:
                continue
            if self._budget.is_over():
                return
            solution = self._solution(new, _ITERATIONS_STIFFNESS)
            if solution is not None:
                if _penetrates(*solution):
                    return  # so would the motions of other stiffnesses
                yield Cause(
                    kind="a soft contact" if factor > 1 else "a stiff contact",
                    text=f"stiffness of the contact: {value:.2g} N/m instead of {known:.2g} N/m "
                    "([contact] stiffness_N_m)",
                    problem=changed(self.given, law=law),
                )
                return

    def _solution(self, problem: ImpactProblem, most: int) -> tuple[Transcription, Array] | None:
        """Program and solution (n,) of a problem from its initial guess; None if there is none."""
        # without the clearances of a term that is turned off to show that it is the cause
        terms = problem.self_collision, problem.keep_out
        known = {k: v for k, v in self.t.clearance_constraints.items() if terms[k.other < 0].enabled}
        t = program_for(self.t, problem, constraints=known)
        result = self._run(t.program, first_iterate(t), most)
        return None if result is None else (t, result.x)

    def _run(self, program: NonlinearProgram, start: Array, most: int, **more: Any) -> SolverResult | None:
        """Result of the solver in ``most`` iterations, out of those left; None if it is not a solution."""
        most, left = min(most, self._iterations), self._budget.left
        if not most or left == 0:
            return None
        options = IPMOptions(
            max_iterations=most,
            time_limit=left,
            violation_tolerance=_TOLERANCE,
            kkt_tolerance=_TOLERANCE,
            complementarity_tolerance=_TOLERANCE,
            **more,
        )
        result = solve_ipm(program, start, options=options, callback=lambda _: self._budget.stop.asked)
        self._iterations -= min(result.iterations, self._iterations)
        return result if result.status.usable else None

    def _is_feasible(self, x: Array) -> bool:
        program = self.t.program
        return max_violation(program, x, program.constraints(x)) <= FEASIBLE

    def _relaxed(self, bounds: Sequence[Bound], guess: Array, most: int) -> tuple[Array, Array] | None:
        """Variables (n,) and least relaxations (len(bounds),) that are feasible; None if none are found."""
        # The relaxation is relative to the problem's own bounds, while durations stay within the loose ones.
        program, own = self.loose.program, self.t.program
        wide = program.x_lower.copy(), program.x_upper.copy()
        program.x_lower, program.x_upper = own.x_lower, own.x_upper
        try:
            relaxed = RelaxedProgram(program, [bound.relaxation(self.loose) for bound in bounds], guess)
        finally:
            program.x_lower, program.x_upper = wide
        durations = np.array([j for bound in bounds if bound.is_time for j in bound.variables], dtype=np.intp)
        # Relaxed bounds of variables become constraints (`RelaxedProgram`); the loose ones stay bounds.
        relaxed.x_lower[durations] = np.maximum(relaxed.x_lower[durations], wide[0][durations])
        relaxed.x_upper[durations] = np.minimum(relaxed.x_upper[durations], wide[1][durations])
        result = self._run(relaxed, relaxed.start(guess, _BARRIER), most, barrier=_BARRIER, push=_PUSH)
        if result is None:
            return None
        return result.x[: program.n], relaxed.sizes(result.x)


def _penetrates(t: Transcription, x: Array) -> bool:
    """True if bodies penetrate at the nodes of a solution (n,).

    Its program has clearance constraints only for those that were near in the failed solve.
    """
    return t.problem.keeps_apart and bool(deepest_penetration(t, x, Margins(t.problem))[1])


def _loosened(phase: Phase) -> Phase:
    shortest, longest = phase.duration
    # A typical duration has to be inside, as one guess has it.
    shortest = min(shortest / _DURATION_FACTOR, TYPICAL_DURATION)
    longest = max(longest * _DURATION_FACTOR, TYPICAL_DURATION)
    return replace(phase, duration=(max(shortest, SHORTEST), min(longest, LONGEST)))


MAX_NAMED = 3  # margins in a message


def ipopt_retry(budget: Budget, program: NonlinearProgram, start: Array, old: SolverResult) -> SolverResult:
    """Result of IPOPT from the same initial guess, if our solver has failed without a diagnosis and IPOPT's
    result is better; else the old result.

    IPOPT has another restoration phase, so it rarely fails on the same programs. A limit that the caller has
    set is a diagnosis.
    """
    limited = "max_iterations" in (budget.options or {})
    undiagnosed = old.status is Status.FAILED or (old.status is Status.ITERATION_LIMIT and not limited)
    if budget.solver == "ipopt" or not undiagnosed or budget.is_over():
        return old
    violation = max_violation(program, old.x, program.constraints(old.x))
    if old.status is Status.FAILED and violation <= VIOLATED < old.max_violation:
        return old  # its constraints are met: it was refused for a penetration or its replay
    budget.say("our solver ends without a diagnosis: IPOPT tries once, from the same initial guess")
    # Options are those of our solver.
    new = replace(budget, solver="ipopt", options=None).run(program, start)
    if new.status is Status.INTERRUPTED or _rank(new) < _rank(old):
        return new
    return old


def _rank(result: SolverResult) -> tuple[bool, bool, float]:
    """Sorting key: solutions first, then diagnosed results, then by the violation."""
    # A program that is known to be infeasible is worth more than one that failed with less violation.
    return not result.status.usable, result.status is not Status.INFEASIBLE, result.max_violation


def ended_with_violations(t: ContactProgram, result: SolverResult) -> bool:
    """True if a solver has ended by itself with violated constraints."""
    if result.status not in (Status.FAILED, Status.INFEASIBLE, Status.ITERATION_LIMIT):
        return False
    return max_violation(t.program, result.x, t.program.constraints(result.x)) > VIOLATED


def with_reason(
    t: ContactProgram, result: SolverResult, causes: Sequence[Cause] = (), *, known: Sequence[str] = ()
) -> SolverResult:
    """A failed result, with the reason that the problem is infeasible in its message and status: reasons
    ``known`` beforehand, a bound that would have to change, or an estimate by colliding point masses.

    Results that end otherwise, and those without a reason, are returned as they are.
    """
    if not ended_with_violations(t, result):
        return result
    would_do = [cause for cause in causes if cause.problem is not None]
    weak = too_weak(t.problem)
    # By falling certainty: what cannot be, a bound whose change was tried, an estimate by point masses.
    if known:
        why = f"Infeasible: {'; '.join(known)}."
    elif would_do:
        first, *others = would_do
        why = f"Infeasible: {first.kind}. {first.text} would do, with all else as it is"
        why += "".join(f"; or {other.text}" for other in others) + "."
        # the point masses explain the contact only, which need not be what makes the problem infeasible
        masses = (_too_stiff(t) or _too_soft(t)) if "contact" in first.kind else ""
        why += "".join(f" Besides, {text}." for text in (weak, masses) if text)
    else:
        not_allowed = [f"{cause.kind}: {cause.text}, which is not allowed" for cause in causes]
        found = weak or _too_stiff(t) or _too_soft(t) or "".join(not_allowed[:1])
        if not found:
            return result
        why = f"Infeasible: {found}."
    # the solver's first sentence says how it ended, which the reason replaces
    rest = result.message.partition(". ")[2] or result.message
    return replace(result, status=Status.INFEASIBLE, message=f"{why} {rest}")


def with_limits_kept(
    result: SolverResult, plan: Plan, collision: PlannedCollision, robot: Robot
) -> SolverResult:
    """A solved result itself if its plan keeps at least half of each sole's margin between nodes, too, no
    joint is beyond the robot's limits, and the slide is within its own; else with the status acceptable, and
    a message that names them.

    collision : of the plan, on a finer mesh if there is one.
    """
    with contextlib.suppress(InputError):  # legs out of reach: completing the motion reports it
        if short := shortfalls(plan.sole_margins(collision, coarse=True)):
            message = (
                f"A sole keeps less than half of a margin between nodes: {'; '.join(short[:MAX_NAMED])}."
            )
        elif beyond := _joints_beyond(plan, robot):
            message = f"Between nodes {beyond}; give more `intervals`, or more time."
        elif far := _slide_beyond(plan):
            message = (
                f"Between collocation points {far}; give more elements in `compression` and `restitution` of "
                "[collision]."
            )
        else:
            return result
        return replace(result, status=Status.ACCEPTABLE, message=message)
    return result


def lost_in_contact(plan: Plan, collision: PlannedCollision) -> bool:
    """True if a plan loses limits of soles or of the slide between collocation points; collision: as of
    `with_limits_kept`.
    """
    return bool(shortfalls(plan.sole_margins(collision, coarse=True), "collision") or _slide_beyond(plan))


def _slide_beyond(plan: Plan) -> str:
    """Message with a slide beyond its limit between collocation points; "" if there is none."""
    return next((slides_beyond(t, plan) for t in plan.problem.on_demand if isinstance(t, Slide)), "")


def _joints_beyond(plan: Plan, robot: Robot) -> str:
    """Message with the joint that is farthest beyond the robot's limit of velocity or torque; "" if none."""
    worst, message = 1 + VIOLATED, ""
    for t in (plan.coarse_reference, *([plan.coarse_missed_reference] if plan.abort is not None else [])):
        for what, used in (
            ("velocity", t.v[:, -robot.n :] / robot.velocity_limit),
            ("torque", t.torque / robot.torque_limit),
        ):
            most = np.abs(used).max(axis=0)
            k = int(most.argmax())
            if most[k] > worst:
                worst, message = most[k], f"{robot.joint_names[k]} has {most[k]:.3g} times its {what} limit"
    return message


def _too_stiff(t: ContactProgram) -> str:
    """Message that the target's last event does not happen in one contact, even at the largest speed that the
    joints allow; "" if it may.
    """
    p = t.problem
    # With several touches planned, parting before the event is what is planned.
    if not isinstance(t.expected, Collision) or not p.target.guards or p.order:
        return ""
    limit = fastest_at_contact(p)
    found = parting(p.law, p.target, t.hit.mass, limit)
    return "" if found is None else _parting_message(found, limit, one_touch=bool(met_once(p)))


def _parting_message(found: Parting, limit: float, *, one_touch: bool) -> str:
    """limit [m/s] : largest speed.  one_touch : whether a plan can have one touch only."""
    message = (
        f"one contact is not enough: even at {limit:.2g} m/s, the most that the joints allow, point masses "
        f"as heavy as striker and target separate {1e3 * found.time:.2g} ms after they touch, before the "
        f"target's {found.event!r}"
    )
    if found.order is not None and not one_touch:
        message += f"; `[collision] touches = {list(found.order)}` plans them"
    if found.needed is not None:
        message += f"; {found.needed:.2g} m/s would be enough"
    if found.stiffness is not None:
        message += f"; a contact stiffness of {found.stiffness:.1g} would do"
    return message


def _too_soft(t: ContactProgram) -> str:
    """Message that an impact of point masses takes longer than the contact may last; "" if it does not."""
    longest = t.problem.contact_duration[1]
    if not isinstance(t.expected, Collision) or t.expected.natural <= longest:
        return ""
    return (
        f"this contact is soft: between point masses as heavy as striker and target one phase of it takes "
        f"{1e3 * t.expected.natural:.2g} ms, and `[collision] duration_s` allows {1e3 * longest:.2g} ms at "
        "most"
    )
