"""A numeric program as CasADi functions: evaluated once a point, written straight into CasADi's buffers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.errors import InputError
from impactopt.solvers.program import (
    BestIterate,
    Callback,
    IterationRecord,
    Matrix,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    max_violation,
    stationarity,
)


class Pattern:
    """The sparsity pattern of a matrix evaluated again and again, and its values in CasADi's order."""

    def __init__(self, matrix: Matrix, *, upper: bool = False):
        matrix = _canonical(matrix)
        self._shape, self._indptr, self._indices = matrix.shape, matrix.indptr.copy(), matrix.indices.copy()
        self._kept: npt.NDArray[np.intp] | None = None
        if upper:
            columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
            self._kept = np.flatnonzero(matrix.indices <= columns)

    def casadi(self) -> Any:
        full = ca.Sparsity(*self._shape, self._indptr.tolist(), self._indices.tolist())
        return full if self._kept is None else ca.triu(full)

    def values(self, matrix: Matrix) -> Vector:
        if not self._same(matrix):
            matrix = _canonical(matrix)  # unsorted or with duplicates: the slow way
            if not self._same(matrix):
                raise InputError(
                    "a derivative of the program changed its sparsity pattern; keep structural zeros explicit"
                )
        values: Vector = matrix.data
        return values if self._kept is None else values[self._kept]

    def _same(self, matrix: Matrix) -> bool:
        return np.array_equal(matrix.indices, self._indices) and np.array_equal(matrix.indptr, self._indptr)


def _canonical(matrix: Matrix) -> Matrix:
    matrix = matrix.tocsc()
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    return matrix


class Functions:
    """The program's functions, timed and evaluated once a point; when to stop; the best point seen."""

    jacobian_pattern: Pattern
    hessian_pattern: Pattern

    def __init__(self, program: NonlinearProgram, tolerance: float, deadline: float):
        self.program, self.tolerance, self.deadline = program, tolerance, deadline
        self.best = BestIterate(program, tolerance)
        self.error: BaseException | None = None
        self.out_of_time = False
        self.seconds = 0.0
        self._x: Vector = np.full(program.n, np.nan)
        self._known: dict[str, Any] = {}

    def start(self, x0: Vector) -> None:
        """Consider the start, so that there is an iterate to give back whatever comes."""
        x0 = np.clip(x0, self.program.x_lower, self.program.x_upper)
        self.best.consider(x0, float(self.program.objective(x0)), self.program.constraints(x0))
        if self.best.x is None:
            self.best.x = x0

    def release(self) -> None:
        """Forget the last point and its matrices."""
        self._known = {}

    def ended(
        self,
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
        """Result of a solver that was given these functions, re-evaluated here: its last point, or the best
        point seen if that is no solution.

        since : the clock when it began.  Raises what was raised in the functions.
        """
        if self.error is not None:
            raise self.error
        status = Status.TIME_LIMIT if self.out_of_time else status
        if not status.usable and self.best.x is not None:
            x = self.best.x
        program, seconds = self.program, time.perf_counter() - since
        g, gradient, jacobian = program.constraints(x), program.gradient(x), program.jacobian(x)
        return SolverResult(
            x=x,
            multipliers=multipliers,
            bound_multipliers=bound_multipliers,
            objective=float(program.objective(x)),
            status=status,
            iterations=iterations,
            seconds=seconds,
            seconds_functions=self.seconds,
            seconds_qp=seconds_qp,
            max_violation=max_violation(program, x, g),
            kkt=stationarity(gradient, jacobian, multipliers, bound_multipliers),
            message="out of time" if self.out_of_time else message,
        )

    def objective(self, x: Vector) -> Any:
        value = self._at(x, "objective", self.program.objective)
        self._consider()
        return value

    def constraints(self, x: Vector) -> Any:
        value = self._at(x, "constraints", self.program.constraints)
        self._consider()
        return value

    def gradient(self, x: Vector) -> Any:
        return self._at(x, "gradient", self.program.gradient)

    def jacobian(self, x: Vector) -> Any:
        return self.jacobian_pattern.values(self._at(x, "jacobian", self.program.jacobian))

    def hessian(self, x: Vector, _p: None, sigma: Vector, multipliers: Vector) -> Any:
        matrix = self._timed(lambda: self.program.hessian(x.copy(), float(sigma[0]), multipliers.copy()))
        return self.hessian_pattern.values(matrix)

    def kkt(self, x: Vector, multipliers: Vector, bound_multipliers: Vector) -> float:
        """Scaled stationarity where the derivatives at x are at hand, else nan."""
        known = self._known if np.array_equal(x, self._x) else {}
        if "gradient" not in known or ("jacobian" not in known and self.program.m):
            return np.nan
        jacobian = known.get("jacobian", sp.csc_array((0, self.program.n)))
        return stationarity(known["gradient"], jacobian, multipliers, bound_multipliers)

    def stopped(self) -> bool:
        self.out_of_time = self.out_of_time or time.perf_counter() > self.deadline
        return self.out_of_time or self.error is not None

    def _at(self, x: Vector, name: str, function: Callable[[Vector], Any]) -> Any:
        if not np.array_equal(x, self._x):
            self._x, self._known = x.copy(), {}
        if name not in self._known:
            self._known[name] = self._timed(lambda: function(self._x))
        return self._known[name]

    def _timed(self, evaluate: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        try:
            return evaluate()
        finally:
            self.seconds += time.perf_counter() - begin

    def _consider(self) -> None:
        if "objective" in self._known and "constraints" in self._known:
            self.best.consider(self._x, float(self._known["objective"]), self._known["constraints"])


class IterationCallback:
    """IPOPT's iteration callback: keeps the history and tells the caller."""

    def __init__(self, functions: Functions, callback: Callback | None, start: float):
        self._functions, self._callback, self._start = functions, callback, start
        program = functions.program
        self.history: list[IterationRecord] = []
        self.x = np.full(program.n, np.nan)
        self.multipliers, self.bound_multipliers = np.zeros(program.m), np.zeros(program.n)

    def __call__(self, x: Vector, f: Vector, g: Vector, lam_x: Vector, lam_g: Vector, _lam_p: None) -> float:
        functions = self._functions
        step = float(np.max(np.abs(x - self.x), initial=0.0)) if self.history else 0.0
        self.x, self.multipliers, self.bound_multipliers = x.copy(), lam_g.copy(), lam_x.copy()
        record = IterationRecord(
            iteration=len(self.history),
            objective=float(f[0]),
            max_violation=max_violation(functions.program, x, g),
            kkt=functions.kkt(x, lam_g, lam_x),
            step=step,
            seconds=time.perf_counter() - self._start,
        )
        self.history.append(record)
        if self._callback is not None and self._callback(record) is True:
            functions.error = KeyboardInterrupt()
        return 1.0 if functions.stopped() else 0.0


class BufferFunction(ca.Callback):
    """A CasADi function whose outputs, one Python function each, are written straight into CasADi's buffers.

    What is raised in there cannot pass through CasADi: it is kept in `functions.error`, and from then on
    every output is nan until IPOPT gives up, which is at once.
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
            if buffer is None or len(buffer) == 0:
                continue
            out = np.frombuffer(buffer, dtype=np.float64)
            stopping = 1.0 if self._progress is not None else np.nan
            if owner.stopped():
                out[:] = stopping
                continue
            try:
                out[:] = function(*inputs) if len(self._functions) == 1 else function(inputs[0])
            except (ArithmeticError, np.linalg.LinAlgError):
                out[:] = np.nan  # not defined here: IPOPT shortens its step
            except BaseException as error:
                owner.error = error
                out[:] = stopping
        return 0
