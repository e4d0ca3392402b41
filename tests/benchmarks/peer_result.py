"""Results of peers, evaluated by the program's own functions."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from impactopt.solvers.ipopt import Functions
from impactopt.solvers.program import (
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    max_violation,
    stationarity,
)
from impactopt.solvers.run import Report


def peer_functions(
    program: NonlinearProgram, x0: Vector, *, tolerance: float, time_limit: float
) -> Functions:
    """Functions that a peer evaluates for at most time_limit [s]; the initial guess (n,) is their best point.

    tolerance : of violations.
    """
    functions = Functions(program, Report(program, tolerance, None), time.perf_counter() + time_limit)
    functions.at(np.clip(x0, program.x_lower, program.x_upper))
    return functions


def peer_result(
    functions: Functions,
    status: Status,
    x: Vector,
    multipliers: Vector,
    bound_multipliers: Vector,
    *,
    message: str,
    iterations: int,
    seconds_qp: float = np.nan,
) -> SolverResult:
    """Result at the peer's last point if that is usable, else at the best point; evaluated here.

    An exception of the functions is raised again here.
    """
    if functions.error is not None:
        raise functions.error
    status = Status.TIME_LIMIT if functions.out_of_time else status
    if not status.usable and functions.report.best.x is not None:
        x = functions.report.best.x
    seconds = functions.program.seconds
    return evaluated_result(
        functions.program,
        x,
        multipliers,
        bound_multipliers,
        status=status,
        iterations=iterations,
        seconds=functions.report.elapsed(),
        seconds_functions=seconds,
        seconds_qp=seconds_qp,
        message="out of time" if functions.out_of_time else message,
    )


def evaluated_result(
    program: NonlinearProgram, x: Vector, multipliers: Vector, bound_multipliers: Vector, **measured: Any
) -> SolverResult:
    """Result at a point (n,) with multipliers (m,), (n,), whose objective and residuals are evaluated here.

    measured : its other fields.
    """
    gradient, jacobian = program.gradient(x), program.jacobian(x)
    return SolverResult(
        x=x,
        multipliers=multipliers,
        bound_multipliers=bound_multipliers,
        objective=float(program.objective(x)),
        max_violation=max_violation(program, x, program.constraints(x)),
        kkt=stationarity(gradient, jacobian, multipliers, bound_multipliers),
        **measured,
    )
