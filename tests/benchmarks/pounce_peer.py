"""POUNCE, IPOPT's method written anew in Rust with its own sparse factorization, on a numeric program.

A peer to measure against, with the tolerances and limits that IPOPT has here; plans are not solved by it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.peer_result import peer_functions, peer_result
from impactopt.errors import missing_package
from impactopt.solvers.ipopt import IPOPT_DEFAULTS, Functions, Pattern
from impactopt.solvers.program import NonlinearProgram, SolverResult, Status, Vector

_OF_IPOPT = {name: value for name, value in IPOPT_DEFAULTS.items() if name != "linear_solver"}
_STATUS = {
    0: Status.SOLVED,
    1: Status.ACCEPTABLE,
    2: Status.INFEASIBLE,
    3: Status.ACCEPTABLE,  # a step too small: whether it is good enough is for the judge of the bench
    -1: Status.ITERATION_LIMIT,
    -4: Status.TIME_LIMIT,
    -5: Status.TIME_LIMIT,
}


def solve_pounce(program: NonlinearProgram, x0: Vector, time_limit: float) -> SolverResult:
    """Solve by POUNCE's interior-point method, with exact derivatives.

    time_limit [s] : looked at once an iteration and in the functions.

    Raises
    ------
    InputError : `pounce-solver` is not installed.
    """
    try:
        import pounce
    except ImportError as error:
        raise missing_package("POUNCE", "pounce-solver", "peers") from error
    tolerance = IPOPT_DEFAULTS["constr_viol_tol"]
    functions = peer_functions(program, x0, tolerance=tolerance, time_limit=time_limit)
    bounds = {"lb": program.x_lower, "ub": program.x_upper, "cl": program.g_lower, "cu": program.g_upper}
    problem = pounce.Problem(program.n, program.m, _Callbacks(functions, x0), **bounds)
    for name, value in _OF_IPOPT.items():
        problem.add_option(name, value)
    x, found = problem.solve(x0.copy())
    return peer_result(
        functions,
        _STATUS.get(int(found["status"]), Status.FAILED),
        np.asarray(x),
        np.asarray(found["mult_g"]),
        np.asarray(found["mult_x_U"]) - np.asarray(found["mult_x_L"]),
        message=str(found["status_msg"]),
        iterations=int(found["iter_count"]),
    )


class _Callbacks:
    """What POUNCE asks, by the names that it asks for (those of cyipopt).

    Where a function is not defined it is nan, and POUNCE shortens its step. What is no matter of arithmetic
    is kept in `functions.error` and ends the solve.
    """

    def __init__(self, functions: Functions, x0: Vector) -> None:
        program, self._functions = functions.program, functions
        functions.jacobian_pattern = Pattern(program.jacobian(x0))
        functions.hessian_pattern = Pattern(program.hessian(x0, 1.0, np.zeros(program.m)), upper=True)
        self._jacobian = tuple(map(np.array, functions.jacobian_pattern.casadi().get_triplet()))
        # of a symmetric matrix: the upper triangle by columns is the lower one by rows
        self._hessian = tuple(map(np.array, functions.hessian_pattern.casadi().get_triplet()))[::-1]

    def jacobianstructure(self) -> tuple[Any, ...]:
        return self._jacobian

    def hessianstructure(self) -> tuple[Any, ...]:
        return self._hessian

    def objective(self, x: Vector) -> float:
        return float(self._asked(1, self._functions.objective, x)[0])

    def gradient(self, x: Vector) -> Vector:
        return self._asked(len(x), self._functions.gradient, x)

    def constraints(self, x: Vector) -> Vector:
        return self._asked(self._functions.program.m, self._functions.constraints, x)

    def jacobian(self, x: Vector) -> Vector:
        return self._asked(len(self._jacobian[0]), self._functions.jacobian, x)

    def hessian(self, x: Vector, multipliers: Vector, factor: float) -> Vector:
        given = (x, None, np.array([factor]), multipliers)
        return self._asked(len(self._hessian[0]), self._functions.hessian, *given)

    def intermediate(self, *_state: Any) -> bool:
        return not self._functions.stopped()

    def _asked(self, size: int, function: Callable[..., Any], *given: Any) -> Vector:
        """(size,) values."""
        out = np.full(size, np.nan)
        if not self._functions.stopped():
            try:
                out[:] = function(*given)
            except (ArithmeticError, np.linalg.LinAlgError):
                pass
            except BaseException as error:
                self._functions.error = error
        return out
