"""SciPy's SLSQP and trust-constr on a numeric program, with exact derivatives. Peers to measure against."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
import scipy.optimize as so
import scipy.sparse as sp

from benchmarks.peer_result import evaluated_result
from impactopt.solvers.program import (
    BestIterate,
    NonlinearProgram,
    SolverResult,
    Status,
    TimedProgram,
    Vector,
)

MAX_ITERATIONS = 500
TOLERANCE = 1e-8


class _OutOfTime(Exception):
    pass


class _Watched:
    """The program's functions until the deadline, and the best point they have seen."""

    def __init__(self, program: NonlinearProgram, time_limit: float):
        self.timed = TimedProgram(program)
        self.best = BestIterate(program, 1e-6)
        self._deadline = time.perf_counter() + time_limit
        self._x, self._f, self._g = np.full(program.n, np.nan), np.nan, np.zeros(program.m)

    def _at(self, x: Vector) -> None:
        if np.array_equal(x, self._x):
            return
        if time.perf_counter() > self._deadline:
            raise _OutOfTime
        point = self.timed.point(x.copy())
        self._x, self._f, self._g = point.x, point.objective, point.g
        self.best.consider(point.x, point.objective, point.g)

    def objective(self, x: Vector) -> float:
        self._at(x)
        return self._f

    def constraints(self, x: Vector) -> Vector:
        self._at(x)
        return self._g


def solve_slsqp(program: NonlinearProgram, x0: Vector, time_limit: float) -> SolverResult:
    """Solve by SLSQP (Kraft 1988): dense, a quasi-Newton Hessian, a least-squares QP."""
    watched = _Watched(program, time_limit)
    lower, upper = program.g_lower, program.g_upper
    equal = np.flatnonzero(lower == upper)
    above = np.flatnonzero((lower != upper) & np.isfinite(upper))
    below = np.flatnonzero((lower != upper) & np.isfinite(lower))
    rows, signs = np.concatenate([above, below]), np.repeat([-1.0, 1.0], [above.size, below.size])
    bound = np.concatenate([upper[above], lower[below]])

    def jacobian(x: Vector) -> Any:
        return watched.timed.jacobian(x).tocsr()

    constraints = []
    if equal.size:
        constraints.append(
            {
                "type": "eq",
                "fun": lambda x: watched.constraints(x)[equal] - lower[equal],
                "jac": lambda x: jacobian(x)[equal].toarray(),
            }
        )
    if rows.size:
        constraints.append(
            {
                "type": "ineq",
                "fun": lambda x: signs * (watched.constraints(x)[rows] - bound),
                "jac": lambda x: signs[:, None] * jacobian(x)[rows].toarray(),
            }
        )
    return _solved(
        program,
        watched,
        x0,
        {0: Status.SOLVED, 9: Status.ITERATION_LIMIT, 4: Status.INFEASIBLE},
        method="SLSQP",
        constraints=constraints,
        options={"maxiter": MAX_ITERATIONS, "ftol": TOLERANCE},
    )


def solve_trust_constr(program: NonlinearProgram, x0: Vector, time_limit: float) -> SolverResult:
    """Solve by trust-constr (Byrd, Hribar, Nocedal 1999): an interior-point method with sparse matrices."""
    watched = _Watched(program, time_limit)
    timed = watched.timed
    zero = np.zeros(program.m)
    rows = so.NonlinearConstraint(
        watched.constraints,
        program.g_lower,
        program.g_upper,
        jac=lambda x: sp.csr_matrix(timed.jacobian(x)),
        hess=lambda x, y: sp.csr_matrix(timed.hessian(x, 0.0, y)),
    )
    return _solved(
        program,
        watched,
        x0,
        {1: Status.SOLVED, 2: Status.SOLVED, 0: Status.ITERATION_LIMIT},
        method="trust-constr",
        hess=lambda x: sp.csr_matrix(timed.hessian(x, 1.0, zero)),
        constraints=[rows] if program.m else [],
        options={"maxiter": MAX_ITERATIONS, "gtol": 1e-9, "xtol": 1e-9, "barrier_tol": TOLERANCE},
    )


def _solved(
    program: NonlinearProgram, watched: _Watched, x0: Vector, statuses: dict[int, Status], **options: Any
) -> SolverResult:
    began = time.perf_counter()
    status, message, iterations = Status.TIME_LIMIT, "out of time", 0

    def count(*_state: Any) -> None:
        nonlocal iterations
        iterations += 1

    x = np.clip(x0, program.x_lower, program.x_upper)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about delta_grad, and steps out of the bounds
            found = so.minimize(
                watched.objective,
                x,
                jac=watched.timed.gradient,
                bounds=so.Bounds(program.x_lower, program.x_upper),
                callback=count,
                **options,
            )
        x, status, message = found.x, statuses.get(int(found.status), Status.FAILED), str(found.message)
    except _OutOfTime:
        pass
    seconds = time.perf_counter() - began
    if not status.usable and watched.best.x is not None:
        x = watched.best.x
    y, z = np.zeros(program.m), np.zeros(program.n)
    if status.usable:
        y, z = least_multipliers(program, x, program.constraints(x), program.gradient(x), program.jacobian(x))
    return evaluated_result(
        program,
        x,
        y,
        z,
        status=status,
        iterations=iterations,
        seconds=seconds,
        seconds_functions=watched.timed.seconds,
        seconds_qp=np.nan,
        message=message,
    )


def least_multipliers(
    program: NonlinearProgram, x: Vector, g: Vector, gradient: Vector, jacobian: Any, near: float = 1e-4
) -> tuple[Vector, Vector]:
    """Multipliers (y, z) of the right sign that explain the gradient best, of the rows and bounds that hold.

    SciPy gives multipliers of one method only; to all that it finds the same is done. ``near``: distance to
    a bound at which it holds.
    """
    value = np.concatenate([g, x])
    high = np.concatenate([program.g_upper, program.x_upper]) - value <= near
    low = value - np.concatenate([program.g_lower, program.x_lower]) <= near
    held = np.flatnonzero(high | low)
    y = np.zeros(value.size)
    if held.size:
        columns = sp.hstack([jacobian.T, sp.diags_array(np.ones(program.n))], format="csc")[:, held]
        box = np.where(low[held], -np.inf, 0.0), np.where(high[held], np.inf, 0.0)
        small = columns.shape[0] * columns.shape[1] <= 10**6
        found = so.lsq_linear(
            columns.toarray() if small else columns, -gradient, bounds=box, tol=1e-12, max_iter=200
        )
        y[held] = found.x
    return y[: program.m], y[program.m :]
