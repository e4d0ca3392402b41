"""Re-plans for a request: by a parametric step from the first plan, or by a solve from the last one."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.live.requests import PlanRequest
from impactopt.planning.parameter_changes import moved_problem
from impactopt.planning.replanning import moved_solution
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.report.tracks import Track, planned_track
from impactopt.solvers.program import IterationRecord, Status
from impactopt.transcription.plan import Plan, Trajectory

__all__ = ["Answer", "Replanning"]

PATIENCE = 20.0  # [s] that each of the two ways may take
_STEPS = 3e-3, 1e-2  # [s] least and most between instants of the motion that is drawn
_IN_CONTACT = 6  # instants, if the least step allows it
_WORST = 5  # constraints that are reported
# of the solver: impulses are within 0.15 %, in two thirds of the iterations. With a looser complementarity
# the barrier holds plans off their bounds: 1e-3 took a tenth of a nail stroke's impulse
_LOOSE = {"kkt_tolerance": 1e-3, "complementarity_tolerance": 1e-5}


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """Answer to a request.

    solution, track, margins : the plan, its motion, its `Plan.margins`; None where there is none.  seconds :
    it took.  why : there is none, with the worst constraints.
    """

    solution: Solution | None = None
    track: Track | None = None
    margins: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    seconds: float = 0.0
    why: str = ""


class Replanning:
    """Plans for requests, from a first plan.

    The first plan is bent (`moved_solution`): one setting of the sliders then gives one plan, whatever came
    before. Where that fails, the request is solved from the last plan that there was, which may be nearer.
    """

    def __init__(self, first: Solution, *, patience: float = PATIENCE) -> None:
        self.first = self.last = first
        self.patience = patience
        with contextlib.suppress(
            InputError
        ):  # what that needs is made now, and not when the first slider moves
            moved_solution(first, point=first.problem.point, options=_LOOSE)

    def __call__(self, request: PlanRequest, stale: Callable[[], bool]) -> Answer:
        began = time.perf_counter()
        try:
            solution = self._plan(request.changes(self.first.problem), stale)
            if not solution.status.usable:
                return Answer(seconds=time.perf_counter() - began, why=why_not(solution))
            reference = _reference(solution.plan)
            track = planned_track(solution, reference)
        except InputError as error:
            return Answer(seconds=time.perf_counter() - began, why=str(error))
        if not stale():
            self.last = solution
        margins = solution.plan.margins(solution.collision, reference)
        seconds = time.perf_counter() - began
        return Answer(solution=solution, track=track, margins=margins, seconds=seconds)

    def _plan(self, changes: dict[str, Any], stale: Callable[[], bool]) -> Solution:
        if not changes:
            return self.first

        def stop(_: IterationRecord) -> bool:
            return stale()

        common: dict[str, Any] = {"callback": stop, "time_limit": self.patience, "options": _LOOSE}
        try:
            bent = moved_solution(self.first, **changes, **common)
        except InputError:  # its program has other constraints, or there is no such problem
            bent = None
        if bent is not None and (bent.status.usable or stale()):
            return bent
        problem = moved_problem(self.first.problem, **changes)
        return solve(problem, start=self.last, **common)


def _reference(plan: Plan) -> Trajectory:
    """Reference of a plan, coarse enough for a picture: computing it costs as much as some iterations."""
    duration = plan.compression + plan.restitution
    return plan.trajectory(step=float(np.clip(duration / _IN_CONTACT, *_STEPS)), hold=0.2)


def why_not(solution: Solution) -> str:
    """Reason why a solution is no plan, and its worst constraints."""
    rows = [f"- {row}" for row in solution.violations[:_WORST]]
    time_limit = solution.status is Status.TIME_LIMIT
    told = "no plan was found in time" if time_limit else solution.result.message
    return "\n".join([told, *rows])
