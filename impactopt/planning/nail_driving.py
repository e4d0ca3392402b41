"""Series of blows on a nail, each planned for the depth that the one before has reached."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from impactopt.contact.targets import Nail
from impactopt.errors import InputError, check_array, check_whole
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Status

MIN_ADVANCE = 1e-4  # [m] a blow that drives the nail less is the last


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """One blow of a series: its plan, and the nail's depth [m] after it."""

    solution: Solution
    depth: float

    @property
    def driven(self) -> float:
        """Penetration that this blow has added [m]."""
        target = self.solution.problem.target
        assert isinstance(target, Nail)
        return self.depth - target.depth


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """A series of blows. reason : why it ended before the nail was in, "" if it is in."""

    blows: tuple[Blow, ...]
    reason: str

    @property
    def done(self) -> bool:
        """True if the nail is driven in."""
        return not self.reason

    def describe(self) -> dict[str, Any]:
        """JSON form of the series."""
        blows = [
            {
                "depth_m": blow.depth,
                "driven_m": blow.driven,
                "impulse_Ns": blow.solution.impulse,
                "peak_force_N": blow.solution.collision.peak_force,
                "hand_speed_m_s": blow.solution.plan.hand_speed,
                "iterations": blow.solution.result.iterations,
                "solve_seconds": blow.solution.solve_seconds,
            }
            for blow in self.blows
        ]
        return {"done": self.done, "reason": self.reason, "blows": blows}


def drive_nail(
    problem: ImpactProblem,
    *,
    depth: float,
    most: int = 20,
    report: Callable[[str], None] | None = None,
    **options: Any,
) -> Series:
    """Blows on the problem's nail until it is ``depth`` [m] deep in the wood.

    Each blow is planned for the nail's present depth: its head is at ``point`` plus the driven length along
    the normal, and the wood has the resistance of that depth. Each solve starts from the plan before and, if
    that fails, from a plain reach. Between the blows the robot returns to its start posture.

    most : largest number of blows.  report : called with a line of text for each blow.  options : of
        :func:`impactopt.solve`.

    Raises
    ------
    InputError : the target is not a `Nail`, or is deeper already.
    """
    nail = problem.target
    if not isinstance(nail, Nail):
        raise InputError(f"a series of blows drives a Nail; the problem's target is a {type(nail).__name__}")
    if not check_array("depth [m]", depth, ()) > nail.depth:
        raise InputError(
            f"the nail is {nail.depth:g} m deep already; give a depth beyond that, not {depth:g} m"
        )
    check_whole("most", most, least=1, most=10**6)
    blows: list[Blow] = []
    at, x = nail.depth, options.pop("start", "reach")
    from_plan = {name: value for name, value in options.items() if name != "starts"}  # a plan is one start
    while at < depth:
        if len(blows) == most:
            return Series(blows=tuple(blows), reason=f"the nail is not in yet at {1e3 * at:.1f} mm")
        here = dataclasses.replace(
            problem,
            # The head has moved with the nail, along the blow.
            point=problem.point + (at - nail.depth) * problem.normal,
            target=dataclasses.replace(nail, depth=at),
        )
        solution = solve(here, start=x, report=report, **(from_plan if blows else options))
        stopped = solution.status is Status.INTERRUPTED
        if not (isinstance(x, str) or solution.status.usable or stopped):
            solution = solve(here, start="reach", report=report, **options)
        if not solution.status.usable:
            why = f"blow {len(blows) + 1} has no plan: {solution.result.message}"
            return Series(blows=tuple(blows), reason=why)
        driven = float(solution.plan.collision.outcome["depth_m"])
        at += driven
        blows.append(Blow(solution=solution, depth=at))
        x = solution
        if report is not None:
            report(
                f"blow {len(blows)}: {1e3 * driven:.1f} mm with {solution.impulse:.2f} N s; "
                f"{1e3 * at:.1f} mm in all"
            )
        # Wood that hardens with depth may stop the nail before.
        if driven < MIN_ADVANCE and at < depth:
            return Series(blows=tuple(blows), reason=f"the nail moves no more at {1e3 * at:.1f} mm")
    return Series(blows=tuple(blows), reason="")
