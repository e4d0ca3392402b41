"""Three-dimensional animation of a motion, as a page of its own or in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

from impactopt.errors import InputError
from impactopt.files.output import record_of
from impactopt.files.record import Record
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.report.page import Page, html_page
from impactopt.report.stage import stage_of

BODY = '<main><div id="trouble"></div><div id="animation"></div></main>'
HEIGHT = 660  # pixels, in a notebook


@dataclass(frozen=True)
class Animation(Page):
    """Page with the moving robot, contact force, ZMP, support polygon and centre of mass.

    A notebook shows it as the value of a cell.  html : the whole page, which needs no network.
    """

    def _repr_html_(self) -> str:
        """HTML frame that separates the page's styles and scripts from those of the notebook."""
        return (
            f'<iframe srcdoc="{escape(self.html)}" title="animation" width="100%" height="{HEIGHT}" '
            'style="border: 0"></iframe>'
        )


def animation_of(record: Record, problem: ImpactProblem) -> Animation:
    """Animation of a record's motions: the planned one, and the simulated ones.

    Raises
    ------
    InputError : the record has no motion.
    """
    if not record.completed:
        raise InputError("this result has no motion to show: the solve ended before there was one")
    header, arrays = stage_of(record, problem)
    name = str(record.summary.get("problem", {}).get("name", "")) or "motion"
    return Animation(html_page(title=name, kind="alone", body=BODY, header=header, arrays=arrays))


def animate(solution: Solution, *, simulation: Any | None = None, replay: Any | None = None) -> Animation:
    """Animation of the planned motion and, if given, of its simulations on fixed and on free soles.

    simulation, replay : of :meth:`impactopt.Solution.validate`, by "pinocchio" and by "mujoco".

    Raises
    ------
    InputError : the solve ended before there was a motion; a simulation of another type.
    """
    record = record_of(solution, simulation=simulation, replay=replay)
    return animation_of(record, solution.problem)
