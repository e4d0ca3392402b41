"""Uno (Vanaret and Leyffer 2026) on a numeric program, by its presets "filtersqp" and "ipopt".

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

_OPTIONS: dict[str, Any] = {
    "logger": "SILENT",
    "QP_solver": "BQPD",  # the other one, HiGHS, is for convex QPs
    "linear_solver": "MUMPS",
    "max_iterations": IPOPT_DEFAULTS["max_iter"],
    "primal_tolerance": IPOPT_DEFAULTS["constr_viol_tol"],
    "dual_tolerance": IPOPT_DEFAULTS["tol"],
    "tight_unscaled_primal_infeasibility_tolerance": IPOPT_DEFAULTS["constr_viol_tol"],
    "acceptable_tolerance": IPOPT_DEFAULTS["acceptable_tol"],
    "acceptable_unscaled_primal_infeasibility_tolerance": IPOPT_DEFAULTS["acceptable_constr_viol_tol"],
    "acceptable_iteration_threshold": IPOPT_DEFAULTS["acceptable_iter"],
    "residual_norm": "INF",
    "use_function_scaling": False,  # as for IPOPT: our rows are scaled
    "barrier_initial_parameter": IPOPT_DEFAULTS["mu_init"],
}
_STATUS = {
    "FEASIBLE_KKT_POINT": Status.SOLVED,
    # whether these are good enough is for the judge of the bench
    "FEASIBLE_FJ_POINT": Status.ACCEPTABLE,
    "FEASIBLE_SMALL_STEP": Status.ACCEPTABLE,
    "INFEASIBLE_STATIONARY_POINT": Status.INFEASIBLE,
    "ITERATION_LIMIT": Status.ITERATION_LIMIT,
    "TIME_LIMIT": Status.TIME_LIMIT,
}


def solve_uno(program: NonlinearProgram, x0: Vector, time_limit: float, *, preset: str) -> SolverResult:
    """Solve by Uno, with exact derivatives.

    preset : "filtersqp", a trust-region filter SQP whose QPs BQPD solves with their indefinite Hessian; or
    "ipopt", a line-search interior-point method with MUMPS.  time_limit [s] : looked at in the functions.

    Raises
    ------
    InputError : `unopy` is not installed.
    """
    try:
        import unopy
    except ImportError as error:
        raise missing_package("Uno", "unopy", "peers") from error
    tolerance = _OPTIONS["primal_tolerance"]
    functions = peer_functions(program, x0, tolerance=tolerance, time_limit=time_limit)
    solver = unopy.UnoSolver()
    solver.set_preset(preset)
    for name, value in _OPTIONS.items():
        solver.set_option(name, value)
    solver.set_termination_callback(lambda *_iterate: functions.stopped())
    found = solver.optimize(_model(unopy, functions, x0))
    ended, point = found.optimization_status.name, found.solution_status.name
    return peer_result(
        functions,
        _STATUS.get(point if ended == "SUCCESS" else ended, Status.FAILED),
        np.array(found.primal_solution),
        np.array(found.constraint_dual_solution),
        np.array(found.lower_bound_dual_solution) + np.array(found.upper_bound_dual_solution),
        message=f"{ended}, {point}",
        iterations=int(found.number_iterations),
    )


def _model(unopy: Any, functions: Functions, x0: Vector) -> Any:
    program = functions.program
    n, m = program.n, program.m
    functions.jacobian_pattern = Pattern(program.jacobian(x0))
    functions.hessian_pattern = Pattern(program.hessian(x0, 1.0, np.zeros(m)), upper=True)

    def hessian(x: Vector, sigma: float, multipliers: Vector) -> Any:
        return functions.hessian(x, None, np.array([sigma]), multipliers)

    model = unopy.Model(
        unopy.PROBLEM_NONLINEAR, n, program.x_lower, program.x_upper, unopy.ZERO_BASED_INDEXING
    )
    model.set_objective(
        unopy.MINIMIZE, _guarded(functions, functions.objective), _written(functions, functions.gradient)
    )
    if m:
        rows, columns = functions.jacobian_pattern.casadi().get_triplet()
        model.set_constraints(
            m,
            _written(functions, functions.constraints),
            program.g_lower,
            program.g_upper,
            len(rows),
            rows,
            columns,
            _written(functions, functions.jacobian),
        )
    rows, columns = functions.hessian_pattern.casadi().get_triplet()
    model.set_lagrangian_hessian(len(rows), unopy.UPPER_TRIANGLE, rows, columns, _written(functions, hessian))
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_POSITIVE)
    model.set_initial_primal_iterate(x0)
    return model


def _guarded(functions: Functions, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function until time is up; whatever is raised in there means to Uno that it is not defined there.

    What is no matter of arithmetic is kept in `functions.error`.
    """

    def call(*arguments: Any) -> Any:
        if functions.stopped():
            raise ArithmeticError("stopped")
        try:
            value = function(*arguments)
            if not np.isfinite(value).all():
                raise ArithmeticError("not finite")
            return value
        except (ArithmeticError, np.linalg.LinAlgError):
            raise
        except BaseException as error:
            functions.error = error
            raise

    return call


def _written(functions: Functions, function: Callable[..., Any]) -> Callable[..., None]:
    """As `_guarded`, with its values written into the last argument."""
    guarded = _guarded(functions, function)

    def call(*arguments: Any) -> None:
        *given, out = arguments
        out[:] = guarded(*given)

    return call
