"""What one solve is, whatever its steps."""

from __future__ import annotations

from abc import ABC, abstractmethod

from impactopt.program import Callback, NonlinearProgram, Status, Vector
from impactopt.sqp.options import SQPOptions
from impactopt.sqp.point import TimedProgram
from impactopt.sqp.report import Report


class Run(ABC):
    """One solve: the program and the point that it has come to, with its multipliers.

    Attributes
    ----------
    point : the last iterate. y (m,), z (n,) : multipliers of its rows and bounds.
    """

    def __init__(
        self,
        program: NonlinearProgram,
        options: SQPOptions,
        callback: Callback | None,
        x: Vector,
        y: Vector,
        z: Vector,
    ):
        self.report = Report(program, options.violation_tolerance, callback)
        self.program, self.options = TimedProgram(program), options
        self.point = self.program.unknown(x)
        self.y, self.z = y, z

    @abstractmethod
    def iterate(self) -> Status:
        """From the start until a status is reached."""

    def _out_of_time(self) -> bool:
        return self.options.time_limit is not None and self.report.elapsed() > self.options.time_limit
