"""Motion and page of a solution that is at hand."""

from __future__ import annotations

from typing import Any

from impactopt.files.output import record_of
from impactopt.planning.solution import Solution
from impactopt.report.animation import Animation, animation_of
from impactopt.report.report import Report, report_of

__all__ = ["animate", "report_page"]


def animate(solution: Solution, *, simulation: Any | None = None, replay: Any | None = None) -> Animation:
    """The planned motion; and beside it, if given, its simulations on held and on free soles.

    simulation, replay : what :meth:`impactopt.Solution.validate` gave, by "pinocchio" and by "mujoco".

    Raises
    ------
    InputError : the solve ended before there was a motion.
    """
    record = record_of(solution, simulation=simulation, replay=replay)
    return animation_of(record, solution.problem)


def report_page(solution: Solution, *, simulation: Any | None = None, replay: Any | None = None) -> Report:
    """A page as of `impactopt show`; simulation, replay : as of :func:`animate`."""
    record = record_of(solution, simulation=simulation, replay=replay)
    return report_of(record, solution.problem)
