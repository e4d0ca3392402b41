"""Base class of one solve by a solver of our own, its report, and the interface of a watch."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from impactopt.errors import check_array
from impactopt.solvers.options import SolverOptions
from impactopt.solvers.program import (
    BestIterate,
    Callback,
    Determined,
    IterationRecord,
    NonlinearProgram,
    Point,
    SolverResult,
    Status,
    TimedProgram,
    Vector,
    check_program,
    explain,
)


class Report:
    """Time, history and best iterate of a solve; calls the progress callback.

    Attributes
    ----------
    seconds_qp : spent in QPs or Newton systems; the run adds to it.
    best : the best iterate.
    """

    def __init__(self, program: NonlinearProgram, tolerance: float, callback: Callback | None):
        self.seconds_qp = 0.0
        self._program, self._tolerance, self._callback = program, tolerance, callback
        self._began = time.perf_counter()
        self._history: list[IterationRecord] = []
        self.best = BestIterate(program, tolerance)
        self._last: Point | None = None

    @property
    def iterations(self) -> int:
        """Number of points recorded."""
        return len(self._history)

    def elapsed(self) -> float:
        """Seconds since the solve began."""
        return time.perf_counter() - self._began

    def iteration(self, point: Point, kkt: float, note: str) -> bool:
        """Record an iteration and call the callback; True if that requests a stop."""
        # Before the callback, which may end the solve by an exception.
        self.best.consider(point.x, point.objective, point.g)
        step = 0.0 if self._last is None else float(np.max(np.abs(point.x - self._last.x), initial=0.0))
        self._last = point
        record = IterationRecord(
            iteration=len(self._history),
            objective=point.objective,
            max_violation=point.max_violation,
            kkt=kkt,
            step=step,
            seconds=self.elapsed(),
            note=note,
        )
        self._history.append(record)
        # `is True`, as a callback that prints or appends may return anything.
        return self._callback is not None and self._callback(record) is True

    def result(
        self,
        status: Status,
        program: TimedProgram,
        point: Point,
        y: Vector,
        z: Vector,
        *,
        stuck: str = " No step makes progress: wrong derivatives, bad scaling, or a QP solver that fails.",
    ) -> SolverResult:
        """Result with a status: at the point if it is a solution, else at the best iterate.

        stuck : reason of a failure at a point that has derivatives.
        """
        # y and z stay those of the last iterate, as none are stored with the best:
        # kkt is then of this mixture.
        if not status.usable and self.best.x is not None:
            point = program.point(self.best.x)
        message = explain(self._program, status, point.x, point.g, tolerance=self._tolerance)
        if status is Status.FAILED:
            message += _failure_reason(point) or stuck
        return SolverResult(
            x=point.x,
            multipliers=y,
            bound_multipliers=z,
            objective=point.objective,
            status=status,
            # The first record is the initial guess.
            iterations=max(len(self._history) - 1, 0),
            seconds=self.elapsed(),
            seconds_functions=program.seconds,
            seconds_qp=self.seconds_qp,
            max_violation=point.max_violation,
            kkt=point.kkt(y, z),
            message=message,
            history=tuple(self._history),
        )


def _failure_reason(point: Point) -> str:
    if not point.finite:
        return " The program's functions are not finite there; give another initial guess."
    if not point.differentiable:
        return " The program's derivatives are not finite there; give another initial guess."
    return ""


_Options = TypeVar("_Options", bound=SolverOptions)


@cache
def threads() -> ThreadpoolController:
    """Controller of BLAS's threads, to limit them to one.

    Small matrices need no second thread: it only waits, and occupies a processor while it does. The
    controller is cached, as finding the loaded libraries takes as long as a QP.
    """
    return ThreadpoolController()


@dataclass(frozen=True, eq=False)
class BarrierState:
    """State of an interior-point solve that was ended early, from which another one continues.

    barrier : parameter mu.
    constraints (m,) : slacks of the constraints, or their values if they have none; NaN for a new constraint.
    variables (n,) : likewise of the variables' bounds.
    """

    barrier: float
    constraints: Vector
    variables: Vector


class Watch(Protocol):
    """Monitor of the iterates for lazy constraints, which a program needs once iterates come near them.

    It may end a solve, so that these constraints are added, and limit steps until then.
    """

    def lacks(self, x: Vector) -> bool:
        """True if the program lacks constraints that an iterate (n,) needs: the solve ends."""

    def leave(self, state: BarrierState) -> None:
        """Receive the state in which the solve ended for that."""

    def limit(self, x: Vector, step: Vector, most: float) -> float:
        """Largest permitted length, ``most`` at most, of a step (n,) from an iterate (n,)."""


class Run(ABC, Generic[_Options]):
    """One solve: the program, the present point, and its multipliers.

    x0 : initial guess (n,); moved into the variables' bounds.
    y, z : initial guess of the multipliers of constraints (m,) and of bounds (n,); None: zero.

    Attributes
    ----------
    point : the last iterate. y (m,), z (n,) : multipliers of its constraints and bounds.

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds.
    """

    def __init__(
        self,
        program: NonlinearProgram,
        x0: npt.ArrayLike,
        options: _Options,
        callback: Callback | None,
        y: npt.ArrayLike | None,
        z: npt.ArrayLike | None,
    ):
        x0 = np.clip(check_program(program, x0), program.x_lower, program.x_upper)
        self.y = np.zeros(program.m) if y is None else check_array("multipliers", y, (program.m,))
        self.z = np.zeros(program.n) if z is None else check_array("bound_multipliers", z, (program.n,))
        self.report = Report(program, options.violation_tolerance, callback)
        self.program, self.options = TimedProgram(program), options
        self.determined: Sequence[Determined] = getattr(program, "determined", ())
        # Nothing is evaluated before `solve`, in which interruption is a status.
        self.point = self.program.unknown(x0)

    def solve(self) -> SolverResult:
        """Result of the solve; infeasible programs, interruption (Ctrl-C) and limits are statuses."""
        # The limit is per solve and not global: other code of the process keeps its threads.
        with threads().limit(limits=1, user_api="blas"):
            try:
                status = self.iterate()
            except KeyboardInterrupt:
                status = Status.INTERRUPTED
        return self.report.result(status, self.program, self.point, self.y, self.z)

    @abstractmethod
    def iterate(self) -> Status:
        """Iterate from the initial guess; the status that ends it."""

    def _out_of_time(self) -> bool:
        return self.options.time_limit is not None and self.report.elapsed() > self.options.time_limit
