"""Reconstruction of a solution's program, and of a `Solution` from a refinement's outcome."""

from __future__ import annotations

from collections.abc import Callable

from impactopt.planning.causes import Cause
from impactopt.planning.gain_selection import ChosenGains
from impactopt.planning.refinement import Outcome
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription.contact_refinement import ContactError
from impactopt.transcription.mesh import Elements, MoreNodes, Shares
from impactopt.transcription.transcription import Transcription, block_functions

__all__ = ["program_of", "program_on", "solution_of"]


def program_on(
    problem: ImpactProblem,
    nodes: MoreNodes,
    elements: Elements,
    shares: Shares,
    report: Callable[[str], None] | None = None,
) -> Transcription:
    """Program of a problem on a given mesh, without clearance constraints."""
    functions = block_functions(problem, problem.coordinates, report, elements)
    return Transcription(problem, problem.coordinates, functions, nodes, elements, shares)


def program_of(solution: Solution) -> Transcription:
    """Program of a solution, without clearance constraints."""
    return program_on(solution.problem, solution.nodes, solution.elements, solution.shares)


def solution_of(
    outcome: Outcome[Transcription],
    *,
    solver: str,
    seconds: tuple[float, float],
    statement: str,
    gains: tuple[ChosenGains, ...] = (),
    causes: tuple[Cause, ...] = (),
    window: str = "",
    contact_error: ContactError | None = None,
) -> Solution:
    """The `Solution` of a refinement's outcome.

    seconds [s] : to build the program, and to solve it.
    """
    t, at = outcome.program, outcome.at
    return Solution(
        problem=t.problem,
        result=outcome.result,
        solver=solver,
        build_seconds=seconds[0],
        solve_seconds=seconds[1],
        violations=outcome.violations,
        objectives=t.achieved(at.x),
        attempts=outcome.attempts,
        statement=statement,
        gains=gains,
        causes=causes,
        window=window,
        contact_error=contact_error,
        plan=at.planned,
        nodes=t.nodes,
        elements=t.hit.elements if t.hit.guarded else (),
        shares=t.hit.shares,
        apart=t.clearance_constraints,
        contact=at.contact if outcome.usable else None,
    )
