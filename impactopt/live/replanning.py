"""Re-planning for requests of a live page: from the first plan, or by a solve from the latest one."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from impactopt.errors import InputError
from impactopt.live.requests import PlanRequest
from impactopt.planning.parameter_changes import moved_problem
from impactopt.planning.replanning import REPLANNING_TOLERANCES, moved_solution
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.report.tracks import Track, planned_track
from impactopt.solvers.program import IterationRecord, Status

TIME_LIMIT = 40.0  # [s] of an answer
REPLANNING_SHARE = 0.25  # of that for re-planning, which succeeds in a second or so, or not at all
MAX_VIOLATIONS = 5  # that are reported


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """Answer to a request.

    solution, track, margins : the plan, its motion, and its `Plan.margins`; None and {} without a plan.
    seconds : of the computation.  why : reason that there is no plan, with the worst constraints; else "".
    """

    solution: Solution | None = None
    track: Track | None = None
    margins: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    seconds: float = 0.0
    why: str = ""


class Replanning:
    """Planner for requests, from a first plan.

    A request is re-planned from the first plan (`moved_solution`), so that the same sliders give the same
    plan, whatever came before. If that fails, it is solved from the latest plan, which may be nearer; or from
    a plain reach, if that is the plan from which re-planning has failed.
    """

    def __init__(self, first: Solution) -> None:
        self.first = self.latest = first
        # builds what re-planning needs now, and not when the first slider moves
        with contextlib.suppress(InputError):
            moved_solution(first, point=first.problem.point)

    def __call__(self, request: PlanRequest, stale: Callable[[], bool]) -> Answer:
        began = time.perf_counter()
        try:
            solution = self._plan(request.changes(self.first.problem), stale)
            if not solution.status.usable:
                return Answer(seconds=time.perf_counter() - began, why=failure_reason(solution))
            reference = solution.plan.coarse_reference
            track = planned_track(solution, reference)
        except InputError as error:
            return Answer(seconds=time.perf_counter() - began, why=str(error))
        if not stale():
            self.latest = solution
        margins = solution.plan.margins(solution.collision, reference)
        seconds = time.perf_counter() - began
        return Answer(solution=solution, track=track, margins=margins, seconds=seconds)

    def _plan(self, changes: dict[str, Any], stale: Callable[[], bool]) -> Solution:
        if not changes:
            return self.first

        def stop(_: IterationRecord) -> bool:
            return stale()

        brief, moved = REPLANNING_SHARE * TIME_LIMIT, None
        # the program has other constraints; or the problem is wrong, and the solve below raises again
        with contextlib.suppress(InputError):
            moved = moved_solution(self.first, **changes, callback=stop, time_limit=brief)
        if moved is not None and (moved.status.usable or stale()):
            return moved
        problem = moved_problem(self.first.problem, **changes)
        # so far from a plan a warm start takes longer than none
        start = "reach" if moved is not None and self.latest is self.first else self.latest
        rest = TIME_LIMIT - brief
        return solve(problem, start=start, options=REPLANNING_TOLERANCES, callback=stop, time_limit=rest)


def failure_reason(solution: Solution) -> str:
    """Reason why a solution is not usable, and its worst constraints."""
    violations = [f"- {violation}" for violation in solution.violations[:MAX_VIOLATIONS]]
    in_time = solution.status is not Status.TIME_LIMIT
    reason = solution.result.message if in_time else "no plan was found in time"
    return "\n".join([reason, *violations])
