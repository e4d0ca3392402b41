"""Report of a run of our solvers: its history while it runs, its result at the end."""

from __future__ import annotations

import time

import numpy as np

from impactopt.solvers.point import Point, TimedProgram
from impactopt.solvers.program import (
    BestIterate,
    Callback,
    IterationRecord,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    explain,
    stationarity,
)


class Report:
    """Keeps time, the history and the best iterate, and tells the caller.

    Attributes
    ----------
    seconds_qp : spent in QPs; the run adds to it.
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
        """Seconds since the start."""
        return time.perf_counter() - self._began

    def iteration(self, point: Point, kkt: float, note: str) -> bool:
        """Record an iteration and tell the caller; True if the caller wants to stop."""
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
        return self._callback is not None and self._callback(record) is True

    def result(
        self, status: Status, program: TimedProgram, point: Point, y: Vector, z: Vector
    ) -> SolverResult:
        """The result with that status: at the point if it is a solution, else at the best iterate."""
        if not status.usable and self.best.x is not None:
            point = program.point(self.best.x)
        message = explain(self._program, status, point.x, point.g, tolerance=self._tolerance)
        if status is Status.FAILED:
            message += _why(point)
        return SolverResult(
            x=point.x,
            multipliers=y,
            bound_multipliers=z,
            objective=point.objective,
            status=status,
            iterations=max(len(self._history) - 1, 0),
            seconds=self.elapsed(),
            seconds_functions=program.seconds,
            seconds_qp=self.seconds_qp,
            max_violation=point.max_violation,
            kkt=stationarity(point.gradient, point.jacobian, y, z) if point.differentiable else np.nan,
            message=message,
            history=tuple(self._history),
        )


def _why(point: Point) -> str:
    if not point.finite:
        return " The program's functions are not finite there; start elsewhere."
    if not point.differentiable:
        return " The program's derivatives are not finite there; start elsewhere."
    return " No step makes progress: wrong derivatives, bad scaling, or a QP solver that fails."
