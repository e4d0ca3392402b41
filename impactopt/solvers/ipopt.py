"""IPOPT for numeric programs, by the library in CasADi's wheel, and the callbacks that it evaluates."""

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
from impactopt.solvers.program import (
    PATTERN_CHANGED,
    Callback,
    Matrix,
    NonlinearProgram,
    Point,
    SolverResult,
    Status,
    TimedProgram,
    Vector,
    check_program,
    is_stationary_violation,
)
from impactopt.solvers.run import Report


class Pattern:
    """Sparsity pattern of a matrix, and its values in CasADi's order."""

    def __init__(self, matrix: Matrix, *, upper: bool = False):
        """upper : the upper triangle only."""
        matrix = _canonical(matrix)
        # Copies, as a program may reuse its arrays.
        self._shape, self._indptr, self._indices = matrix.shape, matrix.indptr.copy(), matrix.indices.copy()
        self._upper: npt.NDArray[np.intp] | None = None
        if upper:
            columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
            self._upper = np.flatnonzero(matrix.indices <= columns)

    def casadi(self) -> Any:
        full = ca.Sparsity(*self._shape, self._indptr.tolist(), self._indices.tolist())
        return full if self._upper is None else ca.triu(full)

    def values(self, matrix: Matrix) -> Vector:
        # IPOPT gets the pattern once and then only values: an entry dropped where it is
        # zero would shift all after it.
        if not self._same(matrix):
            matrix = _canonical(matrix)  # unsorted or with duplicates
            if not self._same(matrix):
                raise InputError(PATTERN_CHANGED)
        values: Vector = matrix.data
        return values if self._upper is None else values[self._upper]

    def _same(self, matrix: Matrix) -> bool:
        return np.array_equal(matrix.indices, self._indices) and np.array_equal(matrix.indptr, self._indptr)


def _canonical(matrix: Matrix) -> Matrix:
    matrix = matrix.tocsc()
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    return matrix


class Functions:
    """Functions of a program, evaluated once a point, and requests to stop."""

    jacobian_pattern: Pattern
    hessian_pattern: Pattern

    def __init__(self, program: NonlinearProgram, report: Report, deadline: float):
        self.program, self.report, self.deadline = TimedProgram(program), report, deadline
        self.error: BaseException | None = None
        self.out_of_time = False
        self._point: Point | None = None

    def at(self, x: Vector) -> Point:
        """The point x, which `Report.best` considers."""
        # CasADi asks for f, g and their derivatives at one point in separate calls.
        if self._point is None or not np.array_equal(x, self._point.x):
            self._point = self.program.point(x.copy())
            self.report.best.consider(self._point.x, self._point.objective, self._point.g)
        return self._point

    def objective(self, x: Vector) -> Any:
        return self.at(x).objective

    def constraints(self, x: Vector) -> Any:
        return self.at(x).g

    def gradient(self, x: Vector) -> Any:
        return self.at(x).gradient

    def jacobian(self, x: Vector) -> Any:
        return self.jacobian_pattern.values(self.at(x).jacobian)

    def hessian(self, x: Vector, _p: None, sigma: Vector, multipliers: Vector) -> Any:
        # Copies, as x and the multipliers are views of CasADi's buffers.
        return self.hessian_pattern.values(
            self.program.hessian(x.copy(), float(sigma[0]), multipliers.copy())
        )

    def stopped(self) -> bool:
        self.out_of_time = self.out_of_time or time.perf_counter() > self.deadline
        return self.out_of_time or self.error is not None


class IterationCallback:
    """IPOPT's iteration callback: the report of an iteration, its point and multipliers."""

    def __init__(self, functions: Functions, point: Point):
        """point : initial guess."""
        self._functions, self.point = functions, point
        self.multipliers, self.bound_multipliers = np.zeros(len(point.g)), np.zeros(len(point.x))

    def __call__(self, x: Vector, _f: Vector, _g: Vector, lam_x: Vector, lam_g: Vector, _p: Vector) -> float:
        functions = self._functions
        # IPOPT needs the derivatives at this point next.
        self.point = functions.at(x)
        self.multipliers, self.bound_multipliers = lam_g.copy(), lam_x.copy()
        if functions.report.iteration(self.point, self.kkt(), ""):
            # Like Ctrl-C: a status, no exception of `solve_ipopt`.
            functions.error = KeyboardInterrupt()
        return 1.0 if functions.stopped() else 0.0

    def kkt(self) -> float:
        """Scaled stationarity of the last iterate; nan if its derivatives are not finite."""
        return self.point.kkt(self.multipliers, self.bound_multipliers)


class BufferFunction(ca.Callback):
    """CasADi function whose outputs, one Python function each, are written into CasADi's buffers.

    Exceptions cannot pass through CasADi. The first one is kept in `Functions.error`, and all later outputs
    are nan, on which IPOPT ends at once.
    """

    def __init__(self, name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], *functions: Any):
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self._functions = functions
        self._progress = functions[0] if isinstance(functions[0], IterationCallback) else None
        self._owner: Functions = self._progress._functions if self._progress else functions[0].__self__
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i][0]

    def get_sparsity_in(self, i: int) -> Any:
        return self._inputs[i][1]

    def get_sparsity_out(self, i: int) -> Any:
        return self._outputs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        owner = self._owner
        inputs = [None if a is None else np.frombuffer(a, dtype=np.float64) for a in arguments]
        for function, buffer in zip(self._functions, results, strict=True):
            # CasADi may ask for some outputs only, and a pattern may have no entries.
            if buffer is None or len(buffer) == 0:
                continue
            out = np.frombuffer(buffer, dtype=np.float64)
            # The callback's output is a flag; 1 requests a stop.
            stopping = 1.0 if self._progress is not None else np.nan
            if owner.stopped():
                out[:] = stopping
                continue
            try:
                out[:] = function(*inputs) if len(self._functions) == 1 else function(inputs[0])
            except (ArithmeticError, np.linalg.LinAlgError):
                out[:] = np.nan  # undefined at this point: IPOPT shortens its step
            # KeyboardInterrupt too; other errors are raised again at the end of `solve_ipopt`.
            except BaseException as error:
                owner.error = error
                out[:] = stopping
        return 0


IPOPT_DEFAULTS: Mapping[str, Any] = {
    # no file: an ipopt.opt in the working directory could load libraries and write files
    "option_file_name": "",
    "print_level": 0,
    "sb": "yes",
    "linear_solver": "mumps",
    "max_iter": 500,
    "tol": 1e-6,
    "constr_viol_tol": 1e-6,
    # Constraints are scaled when they are transcribed; IPOPT's own scaling would loosen the large ones only.
    "nlp_scaling_method": "none",
    # Initial guesses are rough but near a solution; a larger barrier pushes them away (twice the iterations).
    "mu_strategy": "monotone",
    "mu_init": 3e-2,
    "acceptable_tol": 1e-4,
    "acceptable_constr_viol_tol": 1e-5,
    "acceptable_iter": 8,
}
"""Default options of `solve_ipopt`, by IPOPT's names."""

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
) -> SolverResult:
    """Solve a nonlinear program with IPOPT (Waechter and Biegler 2006).

    Parameters
    ----------
    program : the program.
    x0 : initial guess (n,).
    options : IPOPT's options by their own names, over `IPOPT_DEFAULTS`;
        `hessian_approximation="limited-memory"` makes the program's Hessian unnecessary.
    callback : progress, once an iteration; True or KeyboardInterrupt stops with the best iterate.
    time_limit : wall time [s].

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
        # IPOPT takes positive limits only.
        settings["max_wall_time"] = max(float(time_limit), 1e-3)
    tolerance = float(check_array("constr_viol_tol", settings["constr_viol_tol"], ()))
    report = Report(program, tolerance, callback)
    # Besides IPOPT's own limit, which it tests between iterations: a single evaluation may take long.
    deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
    functions = Functions(program, report, deadline)
    progress = IterationCallback(functions, functions.at(np.clip(x0, program.x_lower, program.x_upper)))
    solver, _alive = _build(functions, progress, x0, settings)
    initial = {
        "x0": x0,
        "lbx": program.x_lower,
        "ubx": program.x_upper,
        "lbg": program.g_lower,
        "ubg": program.g_upper,
    }
    try:
        answer = solver(**initial)
        outcome = str(solver.stats()["return_status"])
    except KeyboardInterrupt:  # caught by CasADi itself, between two of our functions
        answer, outcome = None, "User_Requested_Stop"
    if functions.error is not None and not isinstance(functions.error, KeyboardInterrupt):
        raise functions.error
    # We end it by a requested stop or by nan, so its own status does not give the cause.
    if functions.out_of_time:
        status = Status.TIME_LIMIT
    elif functions.error is not None:
        status = Status.INTERRUPTED
    else:
        status = _STATUS.get(outcome, Status.FAILED)
    point, y, z = progress.point, progress.multipliers, progress.bound_multipliers
    if answer is not None and functions.error is None and not functions.out_of_time:
        x, y, z = (np.array(answer[key]).ravel() for key in ("x", "lam_g", "lam_x"))
        point = functions.program.point(x)
    if status is Status.FAILED and _is_infeasible(functions, tolerance):
        status = Status.INFEASIBLE
    stuck = f" IPOPT: {outcome.replace('_', ' ')}."
    return report.result(status, functions.program, point, y, z, stuck=stuck)


def _is_infeasible(functions: Functions, tolerance: float) -> bool:
    """True if the best iterate's violation is stationary: IPOPT's restoration phase often fails there."""
    if (x := functions.report.best.x) is None:
        return False
    point, program = functions.program.point(x), functions.program
    return (
        point.max_violation > tolerance
        and point.differentiable
        and is_stationary_violation(program, x, point.g, point.jacobian)
    )


def _build(
    functions: Functions, progress: IterationCallback, x0: Vector, settings: Mapping[str, Any]
) -> tuple[Any, list[Any]]:
    """CasADi's nlpsol object, and the callbacks, which have to live as long as it does."""
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
    # f and g are callbacks, so nlpsol has to be given all derivatives; it can differentiate nothing.
    x = ca.MX.sym("x", n)
    # no_nlp_grad: nlpsol would differentiate the callbacks for it. Trial points with nan are no reason for
    # warnings.
    own = {"print_time": False, "no_nlp_grad": True, "show_eval_warnings": False, "ipopt": dict(settings)}
    try:
        solver = ca.nlpsol("ipopt", "ipopt", {"x": x, "f": f(x), "g": g(x)}, {**given, **own})
    except (RuntimeError, NotImplementedError, TypeError, OverflowError) as error:
        raise InputError(f"IPOPT does not take these options: {dict(settings)}\n{error}") from error
    return solver, alive


@functools.cache
def _one_blas_thread() -> None:
    """Limit the OpenBLAS in CasADi's wheel to one thread.

    For MUMPS's small fronts a second one gains nothing, and it spins while it waits: half of the processor
    time was the system's.
    """
    for library in Path(ca.__file__).parent.glob("libcasadi-tp-openblas.so*"):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
