"""A result, or a robot's bodies, to look at in a browser: one page that needs no network."""

from __future__ import annotations

from typing import Any

from impactopt.files.output import record_of
from impactopt.planning.solution import Solution
from impactopt.report.animation import Animation, animation_of
from impactopt.report.bodies_page import bodies_page, bodies_page_of_problem
from impactopt.report.report import Report, report_of

__all__ = [
    "Animation",
    "Report",
    "animate",
    "animation_of",
    "bodies_page",
    "bodies_page_of_problem",
    "report_of",
    "report_page",
]


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
