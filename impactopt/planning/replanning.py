"""Plans bent for other parameters of their problem: first by the KKT system of the plan, then by the
solver.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.planning.between_nodes import BetweenNodes
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.clearance_constraints import Margins
from impactopt.planning.lazy_constraints import LazyTerms
from impactopt.planning.parameter_changes import moved_problem
from impactopt.planning.parametric_program import Bent, bent_of
from impactopt.planning.reconstruction import solution_of
from impactopt.planning.refinement import Guess, Outcome
from impactopt.planning.refinement import refine as refine_with
from impactopt.planning.solution import Solution
from impactopt.solvers.options import with_todays_name
from impactopt.solvers.predictor import Change, Prediction
from impactopt.solvers.program import Callback, SolverResult, Status, max_violation
from impactopt.transcription.program_summary import statement_of
from impactopt.transcription.transcription import Transcription

__all__ = ["moved_solution"]

_FIRST_ORDER = 1e-3  # of constraints: a first-order plan that is off by more is none
_ENOUGH, _CORRECTIONS = 1e-4, 4  # of constraints: no more steps; and so many at most beside the first
_BARRIER = 1e-7  # where the solver goes on from a first-order plan: it is as near
# First barriers, and most iterations, from the plan itself. With the smaller one the solver keeps to bounds
# that hold no more, and takes a third longer. In one of 50 shifts either of them fails.
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
    _ = bent.predictor  # what all that is moved shares
    began = time.perf_counter()
    t = bent.program_for(problem, anew=polish)
    built = time.perf_counter()
    solver, options = with_todays_name("ipm", options)
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback).started()
    first = _first_order(solution, t, bent)
    if not polish:
        return _solution(solution, Outcome.of(t, first), (built - began, time.perf_counter() - built))
    margins = Margins(problem) if problem.keeps_apart else None
    origin = Guess(program=t, start=solution.result)
    # new constraints are farther off than what a tolerance for small moves makes up for
    given = {name: value for name, value in (options or {}).items() if not name.endswith("_tolerance")}
    exact = replace(budget, options=given)

    def refined(outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        return BetweenNodes(budget, margins, mesh=refine).refined(outcome)

    def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
        return refined(Outcome.of(guess.program, exact.run(guess.program.program, guess.start), guess))

    first = _polished(budget, t, first, solution.result)
    outcome = refined(Outcome.of(t, first, origin))
    outcome = refine_with(outcome, [LazyTerms(finer=False)], solve, budget)
    return _solution(solution, outcome, (built - began, time.perf_counter() - built))


def _polished(budget: Budget, t: Transcription, first: SolverResult, old: SolverResult) -> SolverResult:
    """Solution of the changed program, started from the first-order step if that nearly satisfies the
    constraints. Otherwise, or if the solver fails from there, it starts from the old solution, which is the
    better guess then.
    """
    result = budget.near_by().run(t.program, first, _BARRIER) if first.status.usable else None
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
