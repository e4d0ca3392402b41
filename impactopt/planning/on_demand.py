"""Terms that hold by default and get constraints once a plan without them breaks them: gear loads, how
far a blow slides.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import snake_case
from impactopt.errors import InputError
from impactopt.planning.changes import changed
from impactopt.planning.gears import gears_beyond
from impactopt.planning.multistart import carried, one_after_the_other, rank_of, with_effort_of
from impactopt.planning.sliding import slides_beyond
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ON_DEMAND_TERMS, GearLoad, Slide, Term
from impactopt.robots.actuator_loads import DriveLoads
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.initial_guess import carried_over
from impactopt.transcription.plan import Plan, PlannedCollision
from impactopt.transcription.planned_loads import plan_loads, strike_loads
from impactopt.transcription.planned_strike import PlannedStrike
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

__all__ = ["kept_on_demand", "program_for", "rows_on_demand", "with_rows"]

Array = NDArray[np.float64]
Program = TypeVar("Program", Transcription, StrikeTranscription)
_KINDS: dict[str, type[Term]] = {snake_case(type(term).__name__): type(term) for term in ON_DEMAND_TERMS}


def rows_on_demand(problem: ImpactProblem) -> tuple[str, ...]:
    """Names, as in files, of the lazy terms whose constraints a problem's programs have from the start."""
    own = {type(term) for term in problem.active_terms}
    return tuple(name for name, kind in _KINDS.items() if kind in own)


def with_rows(problem: ImpactProblem, names: Iterable[str]) -> ImpactProblem:
    """The same with the constraints of these lazy terms from the start; itself if it has them, or has
    switched them off.
    """
    kinds = [_KINDS[name] for name in names if name in _KINDS and problem.extra(_KINDS[name]) is None]
    if not kinds:
        return problem
    return changed(problem, terms=(*problem.terms, *(problem.term(kind) for kind in kinds)))


def kept_on_demand(
    t: Program,
    result: SolverResult,
    first: tuple[Program, Array | SolverResult],
    solve: Callable[[Program, Array | SolverResult], tuple[Program, SolverResult]],
    finer: Callable[[Program, Array], tuple[PlannedCollision, ...]],
    report: Callable[[str], None] | None = None,
) -> tuple[Program, SolverResult]:
    """A program's result if it keeps to the lazy terms; else that of the program with the constraints that it
    lacks: from there, and where that fails from the start. It has the effort of all.

    first : the program that it came from, and its start.  solve : a program from a start; it keeps bodies
    apart, from the clearance constraints that the program has.  finer : the collisions, if known at more
    instants than the program's.
    """
    for _ in _KINDS:  # constraints of one may break another
        broken = _broken(t, result, finer) if result.status.usable else {}
        if not broken:
            break
        said = "; ".join(broken.values())
        if report is not None:
            report(f"{said}: on with constraints of {', '.join(_KINDS[name].name for name in broken)}")
        bounded = with_rows(t.problem, broken)
        warm = program_for(t, bounded, report)
        found, new = solve(warm, carried(warm, t, result))
        if not new.status.usable and new.status is not Status.INTERRUPTED:
            origin, start = first
            x0 = start.x if isinstance(start, SolverResult) else start
            cold = program_for(origin.with_apart({}), bounded, report)
            none = np.zeros(origin.program.m), np.zeros(origin.layout.n)
            again, last = solve(cold, carried_over(cold, origin, x0, *none)[0])
            both = one_after_the_other(new, last)
            # where neither is a solution, the one that is less off its constraints says more
            kept = last.status is not Status.INTERRUPTED and rank_of(new) < rank_of(last)
            found, new = (found, with_effort_of(new, both)) if kept else (again, both)
        if not new.status.usable and new.status is not Status.INTERRUPTED:
            without = ", ".join(f"[terms.{name}]" for name in broken)
            new = replace(new, message=f"{new.message} Without {without} there is a plan, but {said}.")
        t, result = found, one_after_the_other(result, new)
    return t, result


def _broken(
    t: Program, result: SolverResult, finer: Callable[[Program, Array], tuple[PlannedCollision, ...]]
) -> dict[str, str]:
    """Violations of lazy terms that have no constraints yet: message by name of the term."""
    problem, has, out = t.problem, rows_on_demand(t.problem), dict[str, str]()
    planned: Plan | PlannedStrike = t.decode(result.x)
    for name, kind in _KINDS.items():
        term = problem.term(kind)
        if name in has or term not in problem.on_demand:
            continue
        words = ""
        if isinstance(term, GearLoad):
            words = gears_beyond(problem, _loads(t, planned, finer(t, result.x)))
        elif isinstance(term, Slide) and isinstance(planned, Plan):
            words = slides_beyond(term, planned)
        if words:
            out[name] = words
    return out


def _loads(
    t: Program, planned: Plan | PlannedStrike, finer: tuple[PlannedCollision, ...]
) -> list[DriveLoads]:
    """Gear and motor loads of all motions and all collisions."""
    hits = finer or [planned.collision, *(scenario.collision for scenario in planned.scenarios)]
    if isinstance(planned, PlannedStrike):
        still = np.zeros(t.robot.nv)
        return [strike_loads(t.robot, still, still, hit) for hit in hits]
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        return plan_loads(t.robot, planned, hits)
    return []


def program_for(t: Program, problem: ImpactProblem, report: Callable[[str], None] | None) -> Program:
    """The program of another problem on the same mesh, with the same clearance constraints."""
    elements, c = t.hit.elements if t.hit.guarded else (), problem.coordinates
    functions = block_functions(problem, c, report, elements)
    new: Program
    if isinstance(t, StrikeTranscription):
        new = type(t)(problem, c, functions, elements, t.hit.shares)
    else:
        new = Transcription(problem, c, functions, t.nodes, elements, t.hit.shares)
    return new.with_apart(t.apart_rows) if t.apart_rows else new
