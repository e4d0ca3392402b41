"""Base class of one solve, whatever its steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

from impactopt.solvers.options import SQPOptions
from impactopt.solvers.point import TimedProgram
from impactopt.solvers.program import Callback, NonlinearProgram, Status, Vector
from impactopt.solvers.report import Report


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """Task of a run: from x (n,), with a guess of the multipliers, y (m,) of rows, z (n,) of bounds.

    watch, path : as of `solve_sqp`.
    """

    program: NonlinearProgram
    options: SQPOptions
    callback: Callback | None
    x: Vector
    y: Vector
    z: Vector
    watch: Watch | None = None
    path: Path | None = None


class Run(ABC):
    """One solve: the program and the point that it has come to, with its multipliers.

    Attributes
    ----------
    point : the last iterate. y (m,), z (n,) : multipliers of its rows and bounds.
    """

    def __init__(self, task: Task):
        self.report = Report(task.program, task.options.violation_tolerance, task.callback)
        self.program, self.options = TimedProgram(task.program), task.options
        self.point = self.program.unknown(task.x)
        self.y, self.z = task.y, task.z

    @abstractmethod
    def iterate(self) -> Status:
        """Run from the initial guess until a status is reached."""

    def _out_of_time(self) -> bool:
        return self.options.time_limit is not None and self.report.elapsed() > self.options.time_limit
