"""Re-planning for changed parameters, by a plan's KKT system and then by the solver; parametric
sensitivities.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, wraps
from typing import Any, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from impactopt.arrays import Array
from impactopt.errors import InputError, check_choice, check_kind
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.clearance_constraints import Margins, same_bodies
from impactopt.planning.lazy_constraints import LazyTerms
from impactopt.planning.oracles import BetweenNodes
from impactopt.planning.parameter_changes import MOVABLE, Parameter, changed, moved_problem, parameter_of
from impactopt.planning.refinement import Guess, Outcome
from impactopt.planning.refinement import refine as refine_with
from impactopt.planning.solution import Solution, program_on, solution_of
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.violation import Measure
from impactopt.solvers.predictor import ActiveSystem, Change, Offset, Prediction, Predictor
from impactopt.solvers.program import Callback, SolverResult, Status, max_violation
from impactopt.transcription.contact_refinement import ContactError
from impactopt.transcription.contact_state import pulls_apart
from impactopt.transcription.transcription import Transcription, statement_of

# changes that show whether a program follows its problem: factor of the parameters of law and target, and
# shift of the point [m]
_TRIAL_FACTOR, _TRIAL_SHIFT = 1.01, 1e-3
# [N s] Curvature added to the objective's for every (scaled) variable, as large steps would otherwise move
# variables that hardly matter.
_PROXIMAL = 1e-2


class ParametricProgram:
    """Nonlinear program of a solution as a function of the problem's parameters, and the KKT system at the
    solution, factored once.
    """

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        self.program = self._built(solution.problem)
        self._movable = self._movable_program()

    def program_for(
        self,
        problem: ImpactProblem,
        report: Callable[[str], None] | None = None,
        *,
        anew: bool = True,
    ) -> Transcription:
        """The solution's program with the parameters of another problem: same variables and constraints.

        If only point, contact law and target differ, all calls return one program, moved to the problem: a
        result is valid until the next call.
        anew : as of `ContactProgram.move_to`.

        Raises
        ------
        InputError : the other problem's program has other variables or constraints.
        """
        # Moving sets numbers only; a new program takes the building of all its blocks.
        if self._movable is not None and _alike(problem, self.solution.problem):
            self._movable.move_to(problem, anew=anew)
            return self._movable
        return self._built(problem, report)

    def _movable_program(self) -> Transcription | None:
        """A program that `ContactProgram.move_to` moves to other problems; None if parts of it do not follow,
        such as a user's own term.

        It is built for a slightly different problem and moved back: all its numbers must be the solution's.
        """
        problem = self.solution.problem
        try:
            t = self._built(_slightly_changed(problem))
        except InputError:
            return None
        t.move_to(problem)
        # A part that does not follow would keep the other problem's numbers.
        return t if t.program.same_parameters(self.program.program) else None

    def _built(self, problem: ImpactProblem, report: Callable[[str], None] | None = None) -> Transcription:
        s = self.solution
        t = program_on(problem, s.nodes, s.elements, s.shares, report)
        if s.clearance_constraints:
            if not same_bodies(problem, s.problem):
                raise InputError("the world has other bodies then: use solve(problem, start=solution)")
            t = t.with_clearance(s.clearance_constraints)
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
        """KKT system with a proximal term, for steps that are not small; and the KKT residual that the solver
        left at the solution, which is not an effect of the changed parameters.
        """
        r = self.solution.result
        common = r.x, r.multipliers, r.bound_multipliers
        system = ActiveSystem(self.program.program, *common, proximal=_PROXIMAL)
        return system, system.offset(self.program.program)


def _alike(problem: ImpactProblem, other: ImpactProblem) -> bool:
    """True if the programs of the two problems differ in bounds, constants and parameters only."""
    movable = {"point", "law", "target", "name"}
    pairs = [
        (getattr(problem, f.name), getattr(other, f.name)) for f in fields(problem) if f.name not in movable
    ]
    same_fields = all(
        one is two or (np.array_equal(one, two) if np.ndarray in (type(one), type(two)) else one == two)
        for one, two in pairs
    )
    same_types = type(problem.law) is type(other.law) and type(problem.target) is type(other.target)
    same_types = same_types and problem.target.speed_before() == other.target.speed_before()
    # a damper adds first instants, and a bound that keeps the force from pulling
    same_damper = problem.first_instant == other.first_instant and (
        pulls_apart(problem.law) == pulls_apart(other.law)
    )
    same_bodies_apart = not problem.keeps_apart or same_bodies(problem, other)
    return same_fields and same_types and same_damper and same_bodies_apart


def _slightly_changed(problem: ImpactProblem) -> ImpactProblem:
    """A problem with a slightly different point, law and target."""
    law, target = (
        # A parameter of 0 stays 0: whether the program follows it is not tested.
        type(part)(**{name: _TRIAL_FACTOR * value for name, value in part.parameters.items()})
        for part in (problem.law, problem.target)
    )
    with contextlib.suppress(InputError):  # a planar arm cannot reach a point outside of its plane
        return changed(problem, law=law, target=target, point=problem.point + _TRIAL_SHIFT)
    return changed(problem, law=law, target=target, point=problem.point + _TRIAL_SHIFT * problem.normal)


_known: WeakKeyDictionary[Solution, ParametricProgram] = WeakKeyDictionary()
_locks: WeakKeyDictionary[Solution, Any] = WeakKeyDictionary()
P = ParamSpec("P")
R = TypeVar("R")


def _one_at_a_time(run: Callable[P, R]) -> Callable[P, R]:
    """The function, for one thread at a time of each solution: all calls for it move one program."""

    @wraps(run)
    def locked(*args: P.args, **options: P.kwargs) -> R:
        solution: Any = args[0] if args else options.get("solution")
        check_kind("solution", solution, Solution)
        with _locks.setdefault(solution, threading.RLock()):
            return run(*args, **options)

    return locked


def parametric_program(solution: Solution) -> ParametricProgram:
    if not solution.status.usable:
        raise InputError(
            f"this plan is not a solution ({solution.status.value}) and has no sensitivities: solve it first"
        )
    if solution not in _known:
        # of a copy: an entry that refers to its own key is never freed
        _known[solution] = ParametricProgram(replace(solution))
    return _known[solution]


# Half of a central difference, over the parameter's size. The least durations of a contact's phases come from
# the impact of a point mass, integrated with a relative error of 1e-6, which dominates with a smaller step.
_DIFFERENCE_STEP = 1e-2
# Shadow prices below this fraction of the objective, per unit of the bound, do not matter: the objective of a
# solution is off by `complementarity_tolerance` (1e-6) for each of some ten active constraints.
_MIN_PRICE = 1e-5


@dataclass(frozen=True, kw_only=True)
class Binding:
    """Active constraint of a plan, and its shadow price: gain of the objective per unit by which the bound is
    relaxed.

    row : name of the constraint, as in messages.  price : [objective's unit / unit].  unit : of the bound.
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
    binding : active constraints and bounds, by falling shadow price; not those whose multiplier is only the
        barrier's.
    """

    parameter: str
    value: float
    impulse: float
    objective: float
    binding: tuple[Binding, ...]

    def __repr__(self) -> str:
        return f"<Sensitivity to {self.parameter}: {self.impulse:.4g} N s per unit>"


@_one_at_a_time
def sensitivity_of(solution: Solution, parameter: str) -> Sensitivity:
    """Sensitivity of impulse and objective to a parameter, and the active constraints:
    `Solution.sensitivity`.

    Derivatives of the program by the parameter are central differences at the solution. Those of the solution
    follow from the KKT system.
    """
    family = parametric_program(solution)
    p, x = parameter_of(solution.problem, parameter), solution.result.x
    whole, half = (_slope(family, p, _DIFFERENCE_STEP * p.typical / k) for k in (1, 2))
    residual, impulse, objective = (_extrapolated(*pair) for pair in zip(whole, half, strict=True))
    n, m = len(x), len(solution.result.multipliers)
    # implicit function theorem: KKT matrix times dz/dp = -(derivative of the KKT residual by p at fixed z)
    change = family.system.step(
        Offset(dual=residual[:n], constraints=residual[n : n + m], variables=residual[n + m :])
    )
    # total derivatives: impulse and objective may also depend on the parameter itself, at the same x
    program = family.program
    impulse_slope = float(impulse) + _along(program.impulse, x, change.x)
    cost_slope = float(objective) + float(program.program.gradient(x) @ change.x)
    return Sensitivity(
        parameter=parameter,
        value=p.value,
        impulse=impulse_slope,
        objective=-cost_slope,  # the program minimizes
        binding=_binding(family),
    )


def _slope(family: ParametricProgram, parameter: Parameter, half: float) -> tuple[Array, Array, Array]:
    """Central differences by a parameter, at fixed variables and multipliers: of the KKT residual
    (n + m + n,), the impulse and the minimized objective.

    Raises
    ------
    InputError : the parameter is at a bound, such as a depth of 0.
    """
    x, sides = family.solution.result.x, []
    for value in (parameter.value + half, parameter.value - half):
        try:
            problem = parameter.at(value)
        except InputError as error:
            raise InputError(
                f"sensitivity: central differences need both sides of {parameter.name} = "
                f"{parameter.value:g}, and one is not allowed ({error}); solve with a value off this bound"
            ) from error
        t = family.program_for(problem)
        offset = family.system.offset(t.program)
        residual = np.concatenate([getattr(offset, name) for name in Offset.PARTS])
        sides.append((residual, np.array(t.impulse(x)), np.array(t.program.objective(x))))
    residual, impulse, objective = ((one - other) / (2 * half) for one, other in zip(*sides, strict=True))
    return residual, impulse, objective


def _extrapolated(whole: Array, half: Array) -> Array:
    """Richardson extrapolation of central differences with a step and its half."""
    # both errors have even powers of the step only, so the result is of fourth order
    return (4 * half - whole) / 3


def _along(function: Callable[[Array], float], x: Array, d: Array) -> float:
    """Derivative of a smooth function along d, by central differences."""
    size = float(np.abs(d).max(initial=0.0))
    if not size:
        return 0.0
    h = 1e-4 / size
    return (function(x + h * d) - function(x - h * d)) / (2 * h)


def _binding(family: ParametricProgram) -> tuple[Binding, ...]:
    """Active inequalities and bounds with a shadow price, by falling price."""
    t, system = family.program, family.system
    program, out = t.program, list[Binding]()
    least = _MIN_PRICE * max(abs(program.objective(system.x)), 1.0)

    def add(name: str, multiplier: float, measure: Measure | None, scale: float = 1.0) -> None:
        # the program's constraints and variables are scaled: ``factor`` leads back to the unit of the bound
        unit, factor = ("1", 1.0) if measure is None else (measure.unit, measure.factor)
        if measure is not None and measure.over is not None:
            factor /= max(float(measure.over.evaluate(system.x)[0]), measure.least)
        # A multiplier's sign is the side of its bound; relaxing outward never costs.
        if (price := float(abs(multiplier)) / (scale * factor)) > least:
            out.append(Binding(row=name, price=price, unit=unit))

    # At an interior point slack x multiplier is the barrier, for inactive constraints too: a multiplier that
    # is smaller than its slack is the barrier's. Both are scaled to order one.
    for i in np.flatnonzero((program.g_lower < program.g_upper) & (system.soft_constraints < 1.0)):
        origin = t.constraints.origins[int(i)]
        if system.constraints[i]:
            add(origin.describe(system.x, 0.0)[0], system.y[i], origin.measure)
    for j in np.flatnonzero((program.x_lower < program.x_upper) & (system.soft_bounds < 1.0)):
        group = t.layout.group_of(int(j))
        k = (int(j) - group.offset) % group.size
        measure = group.measures[k] if group.measures else None
        if system.bounds[j]:
            add(f"bound of {t.layout.name(int(j))}", system.z[j], measure, float(group.scale[k]))
    return tuple(sorted(out, key=lambda binding: -binding.price))


_MAX_VIOLATION = 1e-3  # of the (scaled) constraints: a first-order plan with more is not usable
# Newton steps with the solution's active set: no more of them below this violation, and at most so many
# beside the first.
_SMALL_VIOLATION, _MAX_CORRECTIONS = 1e-4, 4
# First barrier, and the option `push_warm`, from the old plan: for a change that violates a
# constraint by `_FAR` at most, and for a larger one. For `punch` moved by 5 mm they take 9 and 15 iterations;
# for shifts of centimetres with another target 55 and 25. If one fails, the other is tried. A first-order
# plan is a better initial guess for shifts of up to a millimetre only, and takes longer than it saves.
_NEAR_START, _FAR_START = (1e-5, 1.0), (3e-4, 40.0)
_FAR, _ITERATIONS_FIRST = 0.5, 150
# Wrenches that hardly matter, as those after a missed target, would take a fifth of the iterations to their
# last digits. 24 impulses of `punch` are within 0.1 % with these, 0.03 % in the median.
REPLANNING_TOLERANCES = {"kkt_tolerance": 1e-4, "complementarity_tolerance": 3e-5}


@_one_at_a_time
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
    """Plan for a problem with changed parameters: `Solution.moved`.

    options : default tolerances are `REPLANNING_TOLERANCES`.
    changes : as of `impactopt.planning.parameter_changes.moved_problem`.
    """
    for name in changes:
        check_choice("moved: a plan has no parameter", name, MOVABLE)
    problem = moved_problem(solution.problem, **changes)
    family = parametric_program(solution)
    if not polish:
        _ = family.predictor  # made once for all changes, so it is not part of the time of this one
    began = time.perf_counter()
    t = family.program_for(problem, anew=polish)
    built = time.perf_counter()
    if not polish:
        first = _first_order(solution, t, family)
        return _solution(solution, Outcome.of(t, first), (built - began, time.perf_counter() - built))
    settings = {**REPLANNING_TOLERANCES, **(options or {})}
    budget = Budget(solver="ipm", options=settings, time_limit=time_limit, callback=callback).started()
    margins = Margins(problem) if problem.keeps_apart else None
    origin = Guess(program=t, start=solution.result)
    # These tolerances are for small changes from the old plan. New constraints change it by more, and are
    # solved with the solver's own tolerances.
    others = {name: value for name, value in settings.items() if not name.endswith("_tolerance")}
    exact = replace(budget, options=others)

    def refined(outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        return BetweenNodes(budget, margins, mesh=refine).refined(outcome)

    def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
        return refined(Outcome.of(guess.program, exact.run(guess.program.program, guess.start), guess))

    outcome = refined(Outcome.of(t, _polished(budget, t, solution.result), origin))
    outcome = refine_with(outcome, [LazyTerms(finer=refine)], solve, budget)
    # on the finer mesh that the refinement has made; without it, making one would take half of the time
    error = outcome.at.contact_error if refine and outcome.usable else None
    return _solution(solution, outcome, (built - began, time.perf_counter() - built), error)


def _polished(budget: Budget, t: Transcription, old: SolverResult) -> SolverResult:
    """Solution of the changed program, with the old one as warm start."""
    far = max_violation(t.program, old.x, t.program.constraints(old.x)) > _FAR
    starts = (_FAR_START, _NEAR_START) if far else (_NEAR_START, _FAR_START)
    result: SolverResult | None = None
    for (barrier, push), most in zip(starts, (_ITERATIONS_FIRST, None), strict=True):
        if result and (result.status.usable or result.status is Status.INTERRUPTED or budget.is_over()):
            break
        pushed = replace(budget, options={"push_warm": push, **(budget.options or {})})
        new = pushed.run(t.program, old, barrier, most)
        result = one_after_the_other(result, new) if result else new
    assert result is not None
    return result


def _first_order(solution: Solution, t: Transcription, family: ParametricProgram) -> SolverResult:
    """First-order plan by QPs; if those are not solved, by steps with the active set of the solution."""
    began = time.perf_counter()
    found = family.predictor.predict(t.program)
    if found is None:
        return _by_active_set(solution, t, family)
    message = f"By {found.steps} first-order QPs: constraints are violated by {found.violation:.1g} at most."
    return _result(solution, t, found, message, began)


def _by_active_set(solution: Solution, t: Transcription, family: ParametricProgram) -> SolverResult:
    """Newton steps on the changed program's KKT conditions, with the matrix and active set of the solution,
    clipped to the bounds.

    The first step gives the first-order plan. More follow while constraints are violated and a step reduces
    the violation. The residual that the solver left at the solution is subtracted.
    """
    program, began = t.program, time.perf_counter()
    system, residual_before = family.steady
    at, best, worst = Change(x=system.x, y=system.y, z=system.z), None, np.inf
    for taken in range(1 + _MAX_CORRECTIONS):
        residual = system.offset(program, at)
        step = system.step(residual.less(residual_before))
        x = np.clip(at.x + step.x, program.x_lower, program.x_upper)
        at = Change(x=x, y=at.y + step.y, z=at.z + step.z)
        violation = max_violation(program, x, program.constraints(x))
        if not violation < worst:
            break
        best, worst, steps = at, violation, taken + 1
        if worst <= _SMALL_VIOLATION:
            break
    if best is None:
        raise InputError(
            "the constraints are not finite at the first-order plan: the change is too large for it; use "
            "moved with polish=True, or solve(problem, start=solution)"
        )
    # a multiplier of the wrong sign: its inequality or bound is no longer active
    inequality, free = program.g_lower < program.g_upper, program.x_lower < program.x_upper
    released_y, released_z = (
        inequality & (system.constraints * best.y < 0),
        free & (system.bounds * best.z < 0),
    )
    released = int(released_y.sum() + released_z.sum())
    message = f"By {steps} first-order steps: constraints are violated by {worst:.1g} at most"
    message += f"; {released} active constraints have multipliers of the wrong sign." if released else "."
    y, z = np.where(released_y, 0.0, best.y), np.where(released_z, 0.0, best.z)
    return _result(solution, t, Prediction(x=best.x, y=y, z=z, violation=worst, steps=steps), message, began)


def _result(
    solution: Solution, t: Transcription, found: Prediction, message: str, began: float
) -> SolverResult:
    seconds = time.perf_counter() - began
    return replace(
        solution.result,
        x=found.x,
        multipliers=found.y,
        bound_multipliers=found.z,
        objective=t.program.objective(found.x),
        status=Status.ACCEPTABLE if found.violation <= _MAX_VIOLATION else Status.ITERATION_LIMIT,
        iterations=found.steps,
        seconds=seconds,
        seconds_functions=0.0,
        seconds_qp=seconds,
        max_violation=found.violation,
        kkt=float("nan"),
        message=message,
        history=(),
    )


def _solution(
    old: Solution,
    outcome: Outcome[Transcription],
    seconds: tuple[float, float],
    contact_error: ContactError | None = None,
) -> Solution:
    t = outcome.program
    return solution_of(
        replace(outcome, attempts=(outcome.attempt("moved"),)),
        solver=old.solver,
        seconds=seconds,
        statement=statement_of(t) if len(t.constraints.origins) == t.program.m else old.statement,
        gains=old.gains,
        contact_error=contact_error,
    )
