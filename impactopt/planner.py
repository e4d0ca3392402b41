"""One way from a problem to a solution, whichever solver carries it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.errors import InputError, did_you_mean
from impactopt.ipopt import solve_ipopt
from impactopt.nlp.start import first_iterate
from impactopt.nlp.transcription import Transcription, block_functions
from impactopt.problem import ImpactProblem
from impactopt.program import Callback, NonlinearProgram, SolverResult, worst_rows
from impactopt.solution import Solution
from impactopt.sqp import SQPOptions, solve_sqp

SOLVERS = ("ipopt", "sqp")
VIOLATED = 1e-4  # rows beyond this are named
NAMED = 20  # at most


def solve(
    problem: ImpactProblem,
    *,
    solver: str = "ipopt",
    start: ArrayLike | None = None,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Plan the motion that hits hardest within the problem's terms.

    solver : "ipopt" (exact Hessian, the dependable one) or "sqp" (ours, on OSQP).
    start (n,) : solver variables to start from, such as ``solution.result.x`` of a neighbouring problem;
        default: a plain reach.
    options : the solver's own.  time_limit [s] : of the solver.
    report : told in words what is being built; callback : called with every iteration's record; returning
        True, or Ctrl-C, stops with the best iterate.

    An infeasible problem is a status with named rows, not an exception.

    Raises
    ------
    InputError : unknown solver or option, a start of the wrong length.
    """
    if solver not in SOLVERS:
        raise InputError(
            f"unknown solver {solver!r}{did_you_mean(solver, SOLVERS)}: there are {', '.join(SOLVERS)}"
        )
    began = time.perf_counter()
    functions = block_functions(problem, problem.coordinates, report)
    transcription = Transcription(problem, problem.coordinates, functions)
    program = transcription.program
    x0 = first_iterate(transcription) if start is None else np.asarray(start, dtype=float)
    built = time.perf_counter()
    if report is not None:
        report(f"program of {program.n} variables and {program.m} rows; {solver} starts")
    result = _run(program, x0, solver, options, time_limit, callback)
    solved = time.perf_counter()
    found = program.constraints(result.x)
    return Solution(
        problem=problem,
        plan=transcription.decode(result.x),
        result=result,
        solver=solver,
        build_seconds=built - began,
        solve_seconds=solved - built,
        violations=tuple(worst_rows(program, result.x, found, tolerance=VIOLATED, count=NAMED)),
        objectives=transcription.achieved(result.x),
    )


def _run(
    program: NonlinearProgram,
    x0: Any,
    solver: str,
    options: Mapping[str, Any] | None,
    time_limit: float | None,
    callback: Callback | None,
) -> SolverResult:
    if solver == "ipopt":
        return solve_ipopt(program, x0, options=options, callback=callback, time_limit=time_limit)
    settings = dict(options or {})
    if time_limit is not None:
        settings["time_limit"] = time_limit
    return solve_sqp(program, x0, options=SQPOptions(**settings), callback=callback)
