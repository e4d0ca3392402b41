"""Re-planning for other parameters, by the KKT system of a plan and then by the solver; sensitivities."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.planning.between_nodes import BetweenNodes
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.clearance_constraints import Margins, same_bodies
from impactopt.planning.lazy_constraints import LazyTerms
from impactopt.planning.parameter_changes import Parameter, changed, moved_problem, parameter_of
from impactopt.planning.reconstruction import program_on, solution_of
from impactopt.planning.refinement import Guess, Outcome
from impactopt.planning.refinement import refine as refine_with
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.predictor import ActiveSystem, Change, Offset, Prediction, Predictor
from impactopt.solvers.program import Callback, SolverResult, Status, max_violation
from impactopt.transcription.transcription import Transcription, statement_of

__all__ = ["Bent", "Binding", "Sensitivity", "bent_of", "moved_solution", "sensitivity_of"]

_MORE, _ASIDE = 1.01, 1e-3  # of law and target; [m]
_PROXIMAL = 1e-2  # [N s] beside the objective's curvature, per square of a variable of order one


class Bent:
    """A solution's own program, and its KKT system, factored once."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        self.program = self._built(solution.problem)
        self._moving = self._follows()

    def program_for(
        self,
        problem: ImpactProblem,
        report: Callable[[str], None] | None = None,
        *,
        anew: bool = True,
    ) -> Transcription:
        """The solution's program with the numbers of another problem: the same variables and constraints.

        Where point, contact law and target alone are others it is good until the next one is asked for.
        anew : as of `ContactProgram.move_to`.

        Raises
        ------
        InputError : they are others.
        """
        if self._moving is not None and _alike(problem, self.solution.problem):
            self._moving.move_to(problem, anew=anew)
            return self._moving
        return self._built(problem, report)

    def _follows(self) -> Transcription | None:
        """A program that follows the problem; None if parts of it do not, such as a term of someone's own."""
        problem = self.solution.problem
        try:
            t = self._built(_beside(problem))
        except InputError:
            return None
        t.move_to(problem)
        return t if t.program.same_numbers(self.program.program) else None

    def _built(self, problem: ImpactProblem, report: Callable[[str], None] | None = None) -> Transcription:
        s = self.solution
        t = program_on(problem, s.nodes, s.elements, s.shares, report)
        if s.apart:
            if not same_bodies(problem, s.problem):
                raise InputError("the world has other bodies then: use solve(problem, start=solution)")
            t = t.with_apart(s.apart)
        if (t.program.n, t.program.m) != (len(s.result.x), len(s.result.multipliers)):
            raise InputError("the program has other constraints then: use solve(problem, start=solution)")
        return t

    @cached_property
    def predictor(self) -> Predictor:
        r = self.solution.result
        return Predictor(self.program.program, r.x, r.multipliers, r.bound_multipliers)

    @cached_property
    def system(self) -> ActiveSystem:
        r = self.solution.result
        return ActiveSystem(self.program.program, r.x, r.multipliers, r.bound_multipliers)

    @cached_property
    def steady(self) -> tuple[ActiveSystem, Offset]:
        """The same for steps that are not small, and leave alone what hardly matters; and what the solver has
        left, which is no part of what a change does.
        """
        r = self.solution.result
        common = r.x, r.multipliers, r.bound_multipliers
        system = ActiveSystem(self.program.program, *common, proximal=_PROXIMAL)
        return system, system.offset(self.program.program)


def _alike(problem: ImpactProblem, other: ImpactProblem) -> bool:
    """True if the programs of the two problems differ in bounds, constants and parameters only."""
    changing = {"point", "law", "target", "name"}
    pairs = [
        (getattr(problem, f.name), getattr(other, f.name)) for f in fields(problem) if f.name not in changing
    ]
    same = all(
        one is two or (np.array_equal(one, two) if isinstance(one, np.ndarray) else one == two)
        for one, two in pairs
    )
    kinds = type(problem.law) is type(other.law) and type(problem.target) is type(other.target)
    kinds = kinds and problem.target.speed_before() == other.target.speed_before()
    return same and kinds and (not problem.keeps_apart or same_bodies(problem, other))


def _beside(problem: ImpactProblem) -> ImpactProblem:
    """A problem with a point, law and target that are a little others."""
    law, target = (
        type(part)(**{name: _MORE * value for name, value in part.parameters.items()})
        for part in (problem.law, problem.target)
    )
    with contextlib.suppress(InputError):  # an arm in a plane reaches no point beside it
        return changed(problem, law=law, target=target, point=problem.point + _ASIDE)
    return changed(problem, law=law, target=target, point=problem.point + _ASIDE * problem.normal)


_known: WeakKeyDictionary[Solution, Bent] = WeakKeyDictionary()


def bent_of(solution: Solution) -> Bent:
    if not solution.status.usable:
        raise InputError(
            f"this plan is no solution ({solution.status.value}): it has no sensitivities; solve it first"
        )
    if solution not in _known:
        _known[solution] = Bent(solution)
    return _known[solution]


Array = NDArray[np.float64]
# of a parameter's size: half of a difference. The least durations of a contact's phases come from a point
# mass's blow, whose integration leaves 1e-6 of them: a smaller step would see that
_STEP = 1e-2
_SMALL = 1e-6  # a shadow price that is nothing


@dataclass(frozen=True, kw_only=True)
class Binding:
    """A constraint that a plan is at, and its shadow price: what the objective gains by its bound, per unit.

    row : as messages name it.  price : [objective's unit / unit]; ``unit`` of what the bound is moved by.
    """

    row: str
    price: float
    unit: str

    def __str__(self) -> str:
        return f"{self.row}: {self.price:.3g} per {self.unit}"


@dataclass(frozen=True, kw_only=True, repr=False)
class Sensitivity:
    """First-order sensitivity of a plan to a parameter of its problem.

    parameter, value : its name and value.  impulse : d impulse / d parameter [N s / unit].
    objective : d (weighted sum of the objectives, less the prices on motion) / d parameter.
    binding : constraints and bounds that the plan is at, dearest first.
    """

    parameter: str
    value: float
    impulse: float
    objective: float
    binding: tuple[Binding, ...]

    def __repr__(self) -> str:
        return f"<Sensitivity to {self.parameter}: {self.impulse:.4g} N s per unit>"


def sensitivity_of(solution: Solution, parameter: str) -> Sensitivity:
    """Sensitivity of impulse and objective to a parameter, and the active constraints:
    `Solution.sensitivity`.

    Derivatives of the program by the parameter are central differences at the solution; the solution's own
    follow from the KKT system.
    """
    bent = bent_of(solution)
    number, x = parameter_of(solution.problem, parameter), solution.result.x
    whole, half = (_slope(bent, number, _STEP * number.typical / k) for k in (1, 2))
    offset, impulse, objective = (_extrapolated(*pair) for pair in zip(whole, half, strict=True))
    n, m = len(x), len(solution.result.multipliers)
    # implicit function theorem: the KKT matrix times dz/dp is minus the slope of the KKT residual at fixed z
    change = bent.system.step(Offset(dual=offset[:n], rows=offset[n : n + m], variables=offset[n + m :]))
    # impulse and objective may depend on the number at the same motion too
    program = bent.program
    slope = float(impulse) + _along(program.impulse, x, change.x)
    cost_slope = float(objective) + float(program.program.gradient(x) @ change.x)
    return Sensitivity(
        parameter=parameter,
        value=number.value,
        impulse=slope,
        objective=-cost_slope,
        binding=_binding(bent),
    )


def _slope(bent: Bent, number: Parameter, half: float) -> tuple[Array, Array, Array]:
    """Central differences by a number at the solution: of KKT conditions, impulse and what is minimized."""
    x, sides = bent.solution.result.x, []
    for value in (number.value + half, number.value - half):
        t = bent.program_for(number.at(value))
        off = bent.system.offset(t.program)
        parts = np.concatenate([getattr(off, name) for name in Offset.PARTS])
        sides.append((parts, np.array(t.impulse(x)), np.array(t.program.objective(x))))
    parts, impulse, objective = ((one - other) / (2 * half) for one, other in zip(*sides, strict=True))
    return parts, impulse, objective


def _extrapolated(whole: Array, half: Array) -> Array:
    """Richardson extrapolation of central differences with a step and its half."""
    # both errors are even in the step: four times the half's less the whole's leaves those of fourth order
    return (4 * half - whole) / 3


def _along(function: Callable[[Array], float], x: Array, d: Array) -> float:
    """Derivative of a smooth function along d, by central differences."""
    size = float(np.abs(d).max(initial=0.0))
    if not size:
        return 0.0
    h = 1e-4 / size
    return (function(x + h * d) - function(x - h * d)) / (2 * h)


def _binding(bent: Bent) -> tuple[Binding, ...]:
    """Inequalities and bounds that hold with a price, dearest first."""
    t, system = bent.program, bent.system
    program, out = t.program, list[Binding]()
    unequal = program.g_lower < program.g_upper
    for i in np.flatnonzero(system.rows * unequal):
        price, origin = abs(float(system.y[i])), t.rows.origins[int(i)]
        measure = origin.measure
        unit, factor = ("1", 1.0) if measure is None else (measure.unit, measure.factor)
        if measure is not None and measure.over is not None:
            factor /= max(float(measure.over.evaluate(system.x)[0]), measure.least)
        if price > _SMALL:
            out.append(Binding(row=origin.told(system.x, 0.0)[0], price=price / factor, unit=unit))
    moves = program.x_lower < program.x_upper
    for j in np.flatnonzero(system.bounds * moves):
        price = abs(float(system.z[j]))
        if price > _SMALL:
            group = next(g for g in t.layout.groups.values() if g.offset <= j < g.offset + g.count * g.size)
            scale = float(group.scale[(int(j) - group.offset) % group.size])
            out.append(Binding(row=f"bound of {t.layout.name(int(j))}", price=price / scale, unit="SI unit"))
    return tuple(sorted(out, key=lambda binding: -binding.price))


_FIRST_ORDER = 1e-3  # of constraints: a first-order plan that is off by more is none
_ENOUGH, _CORRECTIONS = 1e-4, 4  # of constraints: no more steps; and so many at most beside the first
# First barriers of the solver, and most iterations. With the smaller one the solver keeps to bounds that hold
# no more, and takes a third longer. In one of 50 shifts either of them fails. A plan of first order is a
# better start for shifts of a millimetre alone, and takes longer than what it saves
_FROM_PLAN = ((1e-3, 150), (1e-5, None))


def moved_solution(
    solution: Solution,
    *,
    polish: bool = True,
    refine: bool = False,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    callback: Callback | None = None,
    **changes: Any,
) -> Solution:
    """The plan for a problem with other parameters: `Solution.moved`.

    changes : as of `impactopt.planning.parameter_changes.moved_problem`.
    """
    problem = moved_problem(solution.problem, **changes)
    bent = bent_of(solution)
    if not polish:
        _ = bent.predictor  # what all that is moved shares
    began = time.perf_counter()
    t = bent.program_for(problem, anew=polish)
    built = time.perf_counter()
    if not polish:
        first = _first_order(solution, t, bent)
        return _solution(solution, Outcome.of(t, first), (built - began, time.perf_counter() - built))
    budget = Budget(solver="ipm", options=options, time_limit=time_limit, callback=callback).started()
    margins = Margins(problem) if problem.keeps_apart else None
    origin = Guess(program=t, start=solution.result)
    # new constraints are farther off than what a tolerance for small moves makes up for
    given = {name: value for name, value in (options or {}).items() if not name.endswith("_tolerance")}
    exact = replace(budget, options=given)

    def refined(outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        return BetweenNodes(budget, margins, mesh=refine).refined(outcome)

    def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
        return refined(Outcome.of(guess.program, exact.run(guess.program.program, guess.start), guess))

    outcome = refined(Outcome.of(t, _polished(budget, t, solution.result), origin))
    outcome = refine_with(outcome, [LazyTerms(finer=False)], solve, budget)
    return _solution(solution, outcome, (built - began, time.perf_counter() - built))


def _polished(budget: Budget, t: Transcription, old: SolverResult) -> SolverResult:
    """Solution of the changed program, started from the old one."""
    result: SolverResult | None = None
    for barrier, most in _FROM_PLAN:
        if result and (result.status.usable or result.status is Status.INTERRUPTED or budget.left == 0):
            break
        new = budget.run(t.program, old, barrier, most)
        result = one_after_the_other(result, new) if result else new
    assert result is not None
    return result


def _first_order(solution: Solution, t: Transcription, bent: Bent) -> SolverResult:
    """First-order plan by QPs; if those are not solved, by steps with the active set of the solution."""
    began = time.perf_counter()
    found = bent.predictor.predict(t.program)
    if found is None:
        return _by_active_set(solution, t, bent)
    words = f"By {found.steps} QPs of first order: constraints are off by {found.violation:.1g} at most."
    return _result(solution, t, found, words, began)


def _by_active_set(solution: Solution, t: Transcription, bent: Bent) -> SolverResult:
    """Newton steps on the changed program's KKT conditions with the solution's own matrix and active set,
    clipped to bounds: the first is the plan of first order, more of them while constraints are off and they
    help.

    What the solver had left at the solution is not made up for.
    """
    program, began = t.program, time.perf_counter()
    system, own = bent.steady
    at, best, worst = Change(x=system.x, y=system.y, z=system.z), None, np.inf
    for taken in range(1 + _CORRECTIONS):
        off = system.offset(program, at)
        step = system.step(off.less(own))
        x = np.clip(at.x + step.x, program.x_lower, program.x_upper)
        at = Change(x=x, y=at.y + step.y, z=at.z + step.z)
        found = max_violation(program, x, program.constraints(x))
        if not found < worst:
            break
        best, worst, steps = at, found, taken + 1
        if worst <= _ENOUGH:
            break
    assert best is not None
    unequal, moves = program.g_lower < program.g_upper, program.x_lower < program.x_upper
    gone_y, gone_z = unequal & (system.rows * best.y < 0), moves & (system.bounds * best.z < 0)
    turned = int(gone_y.sum() + gone_z.sum())
    words = f"By {steps} steps of first order: constraints are off by {worst:.1g} at most"
    words += f"; {turned} of those that held should not any more." if turned else "."
    y, z = np.where(gone_y, 0.0, best.y), np.where(gone_z, 0.0, best.z)
    return _result(solution, t, Prediction(x=best.x, y=y, z=z, violation=worst, steps=steps), words, began)


def _result(
    solution: Solution, t: Transcription, found: Prediction, words: str, began: float
) -> SolverResult:
    seconds = time.perf_counter() - began
    return replace(
        solution.result,
        x=found.x,
        multipliers=found.y,
        bound_multipliers=found.z,
        objective=t.program.objective(found.x),
        status=Status.ACCEPTABLE if found.violation <= _FIRST_ORDER else Status.ITERATION_LIMIT,
        iterations=found.steps,
        seconds=seconds,
        seconds_functions=0.0,
        seconds_qp=seconds,
        max_violation=found.violation,
        kkt=float("nan"),
        message=words,
        history=(),
    )


def _solution(old: Solution, outcome: Outcome[Transcription], seconds: tuple[float, float]) -> Solution:
    t = outcome.program
    return solution_of(
        replace(outcome, attempts=(outcome.attempt("moved"),)),
        solver=old.solver,
        seconds=seconds,
        statement=statement_of(t) if len(t.rows.origins) == t.program.m else old.statement,
        gains=old.gains,
    )
