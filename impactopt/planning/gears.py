"""The default bound of what gears bear: its rows are put in once a plan without them goes beyond it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.planning.multistart import carried, one_after_the_other
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import GearLoad
from impactopt.robots.loads import DriveLoads
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.mesh_refinement import GEAR
from impactopt.transcription.plan import Plan, PlannedCollision
from impactopt.transcription.planned_loads import plan_loads, strike_loads
from impactopt.transcription.planned_strike import PlannedStrike
from impactopt.transcription.start import carried_over
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

__all__ = ["gear_rows", "gears_beyond", "with_gear_rows", "within_gears"]

Array = NDArray[np.float64]
Program = TypeVar("Program", Transcription, StrikeTranscription)
_KNOWN = ("start_posture", "coordinates", "contact_posture", "world", "bodies")  # to both problems, once made


def gear_rows(problem: ImpactProblem) -> bool:
    """Whether programs of a problem have rows on gears from the start."""
    return any(isinstance(term, GearLoad) for term in problem.active_terms)


def with_gear_rows(problem: ImpactProblem) -> ImpactProblem:
    """The same with the default bound as a term of its own; itself if it has one, or has switched it off."""
    if problem.extra(GearLoad) is not None:
        return problem
    bounded = replace(problem, terms=(*problem.terms, problem.gear_load))
    bounded.__dict__.update({name: problem.__dict__[name] for name in _KNOWN if name in problem.__dict__})
    return bounded


def within_gears(
    t: Program,
    result: SolverResult,
    first: tuple[Program, Array | SolverResult],
    solve: Callable[[Program, Array | SolverResult], tuple[Program, SolverResult]],
    finer: Callable[[Program, Array], tuple[PlannedCollision, ...]],
    report: Callable[[str], None] | None = None,
) -> tuple[Program, SolverResult]:
    """A program's result if its gears bear no more than they may by default; else that of the program with
    rows on them: from there, and where that leads nowhere from the start. It has the effort of all.

    first : the program that it came from, and its start.  solve : a program from a start; it keeps bodies
    apart, from the rows between them that the program has.  finer : the collisions, if known at more
    instants than the program's.
    """
    problem = t.problem
    if not result.status.usable or gear_rows(problem) or not problem.gear_load.active:
        return t, result
    beyond = gears_beyond(problem, _loads(t, result.x, finer(t, result.x)))
    if not beyond:
        return t, result
    if report is not None:
        report(f"{beyond}: on with rows on gears")
    bounded = with_gear_rows(problem)
    warm = _program(t, bounded, report)
    found, new = solve(warm, carried(warm, t, result))
    if not new.status.usable and new.status is not Status.INTERRUPTED:
        origin, start = first
        x0 = start.x if isinstance(start, SolverResult) else start
        cold = _program(origin.with_apart({}), bounded, report)
        none = np.zeros(origin.program.m), np.zeros(origin.layout.n)
        again = solve(cold, carried_over(cold, origin, x0, *none)[0])
        found, new = again[0], one_after_the_other(new, again[1])
    if not new.status.usable and new.status is not Status.INTERRUPTED:
        free = f"Without a bound of its gears there is a plan, but {beyond} ([terms.gear_load])."
        new = replace(new, message=f"{new.message} {free}")
    return found, one_after_the_other(result, new)


def gears_beyond(problem: ImpactProblem, found: Iterable[DriveLoads], more: float = GEAR) -> str:
    """The gear that bears most beyond what a problem lets it, in words; "" if none does.

    more : by so much at least, of what it may bear. Rows would keep it within 3 % between the program's
    points.
    """
    most = problem.gear_load.most(problem.robot)
    worst, said = 1.0 + more, ""
    for loads in found:
        share = np.nan_to_num(loads.gear / most)
        k = int(share.argmax())
        if share[k] > worst:
            of_limit = f"{loads.gear[k]:.3g} times its torque limit, which may be {most[k]:.3g}"
            worst, said = share[k], f"gear of {loads.joints[k]}: {of_limit}"
    return said


def _loads(t: Program, x: Array, finer: tuple[PlannedCollision, ...]) -> list[DriveLoads]:
    """Of all motions and all collisions."""
    planned: Plan | PlannedStrike = t.decode(x)
    hits = finer or [planned.collision, *(scenario.collision for scenario in planned.scenarios)]
    if isinstance(planned, PlannedStrike):
        still = np.zeros(t.robot.nv)
        return [strike_loads(t.robot, still, still, hit) for hit in hits]
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        return plan_loads(t.robot, planned, hits)
    return []


def _program(t: Program, problem: ImpactProblem, report: Callable[[str], None] | None) -> Program:
    """The program of another problem on the same mesh, with the same rows between bodies."""
    elements = t.hit.elements if t.hit.guarded else ()
    functions = block_functions(problem, t.coordinates, report, elements)
    new: Program
    if isinstance(t, StrikeTranscription):
        new = type(t)(problem, t.coordinates, functions, elements, t.hit.shares)
    else:
        new = Transcription(problem, t.coordinates, functions, t.nodes, elements, t.hit.shares)
    return new.with_apart(t.apart_rows) if t.apart_rows else new
