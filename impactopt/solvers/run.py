"""Base class of one solve by a solver of our own."""

from __future__ import annotations

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
from impactopt.solvers.point import TimedProgram
from impactopt.solvers.program import (
    Callback,
    Determined,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    check_program,
)
from impactopt.solvers.report import Report

_Options = TypeVar("_Options", bound=SolverOptions)


@cache
def threads() -> ThreadpoolController:
    """Controller of BLAS's threads, which small matrices do not need: a second one only waits, and takes the
    processor. Cached, as finding the loaded libraries takes as long as a QP.
    """
    return ThreadpoolController()


@dataclass(frozen=True, eq=False)
class Path:
    """State in which a solve was left: its barrier, and the slacks of rows (m,) and of variables' bounds
    (n,), what has none its own value. NaN: of a row that is new.
    """

    barrier: float
    rows: Vector
    bounds: Vector


class Watch(Protocol):
    """One who knows more of a program than it says: constraints that it will need, once iterates come near
    to what they forbid.
    """

    def lacks(self, x: Vector) -> bool:
        """True if an iterate (n,) asks for constraints that the program has not."""

    def leave(self, path: Path) -> None:
        """Take the state in which the solve is left for that."""

    def limit(self, x: Vector, step: Vector, most: float) -> float:
        """The part of a step (n,) from an iterate (n,), ``most`` at most, that may be taken."""


class Run(ABC, Generic[_Options]):
    """One solve: the program and the point that it has come to, with its multipliers.

    x0 : initial guess (n,); moved into the variables' bounds, where every iterate stays.
    y, z : guess of the multipliers of constraints (m,) and of bounds (n,); None: there is none.

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
        self.point = self.program.unknown(x0)

    def solve(self) -> SolverResult:
        """Result of the solve; infeasible programs, interruption (Ctrl-C) and limits are statuses."""
        with threads().limit(limits=1, user_api="blas"):
            try:
                status = self.iterate()
            except KeyboardInterrupt:
                status = Status.INTERRUPTED
        return self.report.result(status, self.program, self.point, self.y, self.z)

    @abstractmethod
    def iterate(self) -> Status:
        """Run from the initial guess until a status is reached."""

    def _out_of_time(self) -> bool:
        return self.options.time_limit is not None and self.report.elapsed() > self.options.time_limit
