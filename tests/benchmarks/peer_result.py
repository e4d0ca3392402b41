"""Result of a peer that solved a program by the functions of our IPOPT adapter."""

from __future__ import annotations

import time

import numpy as np

from impactopt.solvers.ipopt import Functions
from impactopt.solvers.program import SolverResult, Status, Vector, max_violation, stationarity


def peer_result(
    functions: Functions,
    status: Status,
    x: Vector,
    multipliers: Vector,
    bound_multipliers: Vector,
    *,
    message: str,
    since: float,
    iterations: int,
    seconds_qp: float = np.nan,
) -> SolverResult:
    """Result at the peer's last point if that is usable, else at the best point; evaluated here.

    since : clock at the beginning.  An exception of the functions is raised again here.
    """
    if functions.error is not None:
        raise functions.error
    status = Status.TIME_LIMIT if functions.out_of_time else status
    if not status.usable and functions.best.x is not None:
        x = functions.best.x
    program, seconds = functions.program, time.perf_counter() - since
    g, gradient, jacobian = program.constraints(x), program.gradient(x), program.jacobian(x)
    return SolverResult(
        x=x,
        multipliers=multipliers,
        bound_multipliers=bound_multipliers,
        objective=float(program.objective(x)),
        status=status,
        iterations=iterations,
        seconds=seconds,
        seconds_functions=functions.seconds,
        seconds_qp=seconds_qp,
        max_violation=max_violation(program, x, g),
        kkt=stationarity(gradient, jacobian, multipliers, bound_multipliers),
        message="out of time" if functions.out_of_time else message,
    )
