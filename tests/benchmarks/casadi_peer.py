"""CasADi's `sqpmethod` on a numeric program: a line-search SQP with the same exact derivatives as ours.

A peer to measure against; plans are not solved by it.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from benchmarks.peer_result import peer_functions, peer_result
from impactopt.solvers.ipopt import BufferFunction, Functions, IterationCallback, Pattern
from impactopt.solvers.program import NonlinearProgram, SolverResult, Status, Vector

MAX_ITERATIONS = 500
_STATUS = {
    "Solve_Succeeded": Status.SOLVED,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
}
_SILENT = {"print_header": False, "print_iteration": False, "print_status": False, "print_time": False}
_QP_OPTIONS: dict[str, dict[str, Any]] = {
    "osqp": {
        "osqp": {"verbose": False, "eps_abs": 1e-7, "eps_rel": 1e-7, "polish": True},
        "error_on_fail": False,
    },
    "qpoases": {"printLevel": "none"},
    "piqp": {},
}


def solve_sqpmethod(
    program: NonlinearProgram, x0: Vector, time_limit: float, *, qp: str = "qpoases"
) -> SolverResult:
    """Solve by CasADi's `sqpmethod`, its Hessian shifted until it is convex, elastic where rows contradict.

    qp : CasADi's name of the QP solver.  time_limit [s] : looked at once an iteration and in the functions.
    """
    functions = peer_functions(program, x0, tolerance=1e-6, time_limit=time_limit)
    progress = IterationCallback(functions, functions.at(x0))
    solver, _alive = _build(functions, progress, x0, qp)
    bounds = {
        "lbx": program.x_lower, "ubx": program.x_upper, "lbg": program.g_lower, "ubg": program.g_upper
    }  # fmt: skip
    seconds_qp = np.nan
    x, y, z = x0, np.zeros(program.m), np.zeros(program.n)
    try:
        answer = solver(x0=x0, **bounds)
        stats = solver.stats()
        outcome, seconds_qp = str(stats["return_status"]), float(stats.get("t_wall_QP", np.nan))
        x, y, z = (np.array(answer[key]).ravel() for key in ("x", "lam_g", "lam_x"))
    except RuntimeError as error:  # its QP solver gave up
        outcome = str(error).strip().splitlines()[-1]
    how: dict[str, Any] = {"message": outcome, "iterations": max(functions.report.iterations - 1, 0)}
    return peer_result(functions, _STATUS.get(outcome, Status.FAILED), x, y, z, seconds_qp=seconds_qp, **how)


def _build(functions: Functions, progress: IterationCallback, x0: Vector, qp: str) -> tuple[Any, list[Any]]:
    """The nlpsol object, and what has to stay alive as long as it does."""
    program = functions.program
    n, m = program.n, program.m
    column, none = ca.Sparsity.dense, ca.Sparsity.dense(0, 1)
    functions.jacobian_pattern = Pattern(program.jacobian(x0))
    functions.hessian_pattern = Pattern(program.hessian(x0, 1.0, np.zeros(m)))
    point = {"x": column(n, 1), "p": none}
    f = BufferFunction("f", {"x": column(n, 1)}, {"f": column(1, 1)}, functions.objective)
    g = BufferFunction("g", {"x": column(n, 1)}, {"g": column(m, 1)}, functions.constraints)
    derivatives = BufferFunction(
        "nlp_jac_fg",
        point,
        {
            "f": column(1, 1),
            "grad_f_x": column(n, 1),
            "g": column(m, 1),
            "jac_g_x": functions.jacobian_pattern.casadi(),
        },
        functions.objective,
        functions.gradient,
        functions.constraints,
        functions.jacobian,
    )
    hessian = BufferFunction(
        "nlp_hess_l",
        {**point, "lam_f": column(1, 1), "lam_g": column(m, 1)},
        {"hess_gamma_x_x": functions.hessian_pattern.casadi()},
        functions.hessian,
    )
    outputs = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": 0}
    watch = BufferFunction(
        "progress", {k: column(v, 1) for k, v in outputs.items()}, {"stop": column(1, 1)}, progress
    )
    x = ca.MX.sym("x", n)
    options = {
        **_SILENT,
        "qpsol": qp,
        "qpsol_options": {"error_on_fail": False, **_QP_OPTIONS[qp]},
        "jac_fg": derivatives,
        "hess_lag": hessian,
        "iteration_callback": watch,
        "convexify_strategy": "regularize",
        "elastic_mode": True,
        "max_iter": MAX_ITERATIONS,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "no_nlp_grad": True,
    }
    solver = ca.nlpsol("sqpmethod", "sqpmethod", {"x": x, "f": f(x), "g": g(x)}, options)
    return solver, [f, g, derivatives, hessian, watch]
