"""IPOPT on a numeric program, through the IPOPT that CasADi's wheel carries.

See `ipopt_functions` for how the program's functions reach it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from impactopt.errors import InputError, check_array
from impactopt.solvers.ipopt_functions import BufferFunction, Functions, IterationCallback, Pattern
from impactopt.solvers.program import (
    Callback,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    check_program,
    explain,
    is_stationary_violation,
    max_violation,
    stationarity,
)

IPOPT_DEFAULTS: Mapping[str, Any] = {
    # none is read: an ipopt.opt in the working directory could load libraries and write files
    "option_file_name": "",
    "print_level": 0,
    "sb": "yes",
    "linear_solver": "mumps",
    "max_iter": 500,
    "tol": 1e-6,
    "constr_viol_tol": 1e-6,
    # Constraints are scaled when they are transcribed; IPOPT's own scaling would loosen the large ones only.
    "nlp_scaling_method": "none",
    # Starts are rough but not far off: a large first barrier would only push them away
    # (half the iterations).
    "mu_strategy": "monotone",
    "mu_init": 3e-2,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "acceptable_iter": 8,
}
"""What `solve_ipopt` gives IPOPT unless told otherwise."""

_STATUS = {
    "Solve_Succeeded": Status.SOLVED,
    "Feasible_Point_Found": Status.SOLVED,
    "Solved_To_Acceptable_Level": Status.ACCEPTABLE,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    "User_Requested_Stop": Status.INTERRUPTED,
}


def solve_ipopt(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: Mapping[str, Any] | None = None,
    callback: Callback | None = None,
    time_limit: float | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
) -> SolverResult:
    """Solve a nonlinear program with IPOPT (Waechter and Biegler 2006).

    Parameters
    ----------
    program : the program.
    x0 : start (n,).
    options : IPOPT's options by their own names, over `IPOPT_DEFAULTS`;
        `hessian_approximation="limited-memory"` makes the program's Hessian unnecessary.
    callback : progress, once an iteration; True or KeyboardInterrupt stops with the best iterate.
    time_limit : wall time [s].
    multipliers, bound_multipliers : start of the multipliers (m,), (n,); set `warm_start_init_point="yes"`
        and a small `mu_init` for IPOPT to use them.

    Returns
    -------
    The result; infeasible programs, interruption (Ctrl-C) and limits are statuses, not exceptions.

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds, options that IPOPT does not know.
    """
    _one_blas_thread()
    x0 = check_program(program, x0)
    settings = {**IPOPT_DEFAULTS, **(options or {})}
    if time_limit is not None:
        settings["max_wall_time"] = max(float(time_limit), 1e-3)
    tolerance = float(check_array("constr_viol_tol", settings["constr_viol_tol"], ()))
    start = time.perf_counter()
    functions = Functions(
        program, tolerance, deadline=start + time_limit if time_limit is not None else np.inf
    )
    functions.start(x0)
    progress = IterationCallback(functions, callback, start)
    solver, _alive = _build(functions, progress, x0, settings)
    initial = {
        "x0": x0,
        "lbx": program.x_lower,
        "ubx": program.x_upper,
        "lbg": program.g_lower,
        "ubg": program.g_upper,
    }
    if multipliers is not None:
        initial["lam_g0"] = check_array("multipliers", multipliers, (program.m,))
    if bound_multipliers is not None:
        initial["lam_x0"] = check_array("bound_multipliers", bound_multipliers, (program.n,))
    try:
        answer = solver(**initial)
        outcome = str(solver.stats()["return_status"])
    except KeyboardInterrupt:  # caught by CasADi itself, between two of our functions
        answer, outcome = None, "User_Requested_Stop"
    if functions.error is not None and not isinstance(functions.error, KeyboardInterrupt):
        raise functions.error
    return _result(functions, progress, answer, outcome, start)


def _result(
    functions: Functions,
    progress: IterationCallback,
    answer: Mapping[str, Any] | None,
    outcome: str,
    start: float,
) -> SolverResult:
    program, best = functions.program, functions.best
    status = _STATUS.get(outcome, Status.FAILED)
    if functions.out_of_time:
        status = Status.TIME_LIMIT
    elif functions.error is not None:
        status = Status.INTERRUPTED
    x, y, z = progress.x, progress.multipliers, progress.bound_multipliers
    if answer is not None and functions.error is None and not functions.out_of_time:
        x, y, z = (np.array(answer[key]).ravel() for key in ("x", "lam_g", "lam_x"))
    functions.release()
    if not status.usable and best.x is not None:
        x = best.x
    g, gradient, jacobian = program.constraints(x), program.gradient(x), program.jacobian(x)
    violation = max_violation(program, x, g)
    if (
        status is Status.FAILED
        and violation > functions.tolerance
        and is_stationary_violation(program, x, g, jacobian)
    ):
        status = Status.INFEASIBLE  # the restoration phase often ends so
    message = explain(program, status, x, g, tolerance=functions.tolerance)
    if status is Status.FAILED:
        message += f" IPOPT: {outcome.replace('_', ' ')}."
        if not np.isfinite(violation):
            message += " The program's functions are not finite there."
    return SolverResult(
        x=x,
        multipliers=y,
        bound_multipliers=z,
        objective=float(program.objective(x)),
        status=status,
        iterations=max(len(progress.history) - 1, 0),
        seconds=time.perf_counter() - start,
        seconds_functions=functions.seconds,
        seconds_qp=0.0,
        max_violation=violation,
        kkt=stationarity(gradient, jacobian, y, z),
        message=message,
        history=tuple(progress.history),
    )


def _build(
    functions: Functions, progress: IterationCallback, x0: Vector, settings: Mapping[str, Any]
) -> tuple[Any, list[Any]]:
    """The nlpsol object, and what has to stay alive as long as it does."""
    program = functions.program
    n, m = program.n, program.m
    column, none = ca.Sparsity.dense, ca.Sparsity.dense(0, 1)
    functions.jacobian_pattern = Pattern(program.jacobian(x0))
    f = BufferFunction("f", {"x": column(n, 1)}, {"f": column(1, 1)}, functions.objective)
    g = BufferFunction("g", {"x": column(n, 1)}, {"g": column(m, 1)}, functions.constraints)
    inputs = {"x": column(n, 1), "p": none}
    gradient = BufferFunction(
        "nlp_grad_f",
        inputs,
        {"f": column(1, 1), "grad_f_x": column(n, 1)},
        functions.objective,
        functions.gradient,
    )
    jacobian = BufferFunction(
        "nlp_jac_g",
        inputs,
        {"g": column(m, 1), "jac_g_x": functions.jacobian_pattern.casadi()},
        functions.constraints,
        functions.jacobian,
    )
    outputs = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": 0}
    watch = BufferFunction(
        "progress", {k: column(v, 1) for k, v in outputs.items()}, {"stop": column(1, 1)}, progress
    )
    alive = [f, g, gradient, jacobian, watch]
    given = {"grad_f": gradient, "jac_g": jacobian, "iteration_callback": watch}
    if settings.get("hessian_approximation") != "limited-memory":
        functions.hessian_pattern = Pattern(program.hessian(x0, 1.0, np.zeros(m)), upper=True)
        inputs = {**inputs, "lam_f": column(1, 1), "lam_g": column(m, 1)}
        given["hess_lag"] = BufferFunction(
            "nlp_hess_l",
            inputs,
            {"triu_hess_gamma_x_x": functions.hessian_pattern.casadi()},
            functions.hessian,
        )
        alive.append(given["hess_lag"])
    x = ca.MX.sym("x", n)
    own = {"print_time": False, "no_nlp_grad": True, "show_eval_warnings": False, "ipopt": dict(settings)}
    try:
        solver = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": f(x), "g": g(x)}, {**given, **own})
    except (RuntimeError, NotImplementedError, TypeError, OverflowError) as error:
        raise InputError(f"IPOPT does not take these options: {dict(settings)}\n{error}") from error
    return solver, alive


@functools.cache
def _one_blas_thread() -> None:
    """Keep the OpenBLAS that CasADi's wheel carries to one thread.

    On MUMPS's small fronts a second one gains nothing, and while it waits it spins: half of the processor
    time was the system's.
    """
    for library in Path(ca.__file__).parent.glob("libcasadi-tp-openblas.so*"):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
