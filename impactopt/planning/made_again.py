"""Reconstructs a solution's program, and assembles a `Solution`'s data from a solver's result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from impactopt.planning.contact_replay import PlannedContact
from impactopt.planning.models import planned_contact
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import SolverResult
from impactopt.transcription.mesh import Elements, Shares
from impactopt.transcription.mesh_refinement import MoreNodes
from impactopt.transcription.transcription import Transcription, block_functions

__all__ = ["planned_by", "program_of", "program_on"]


def program_on(
    problem: ImpactProblem,
    nodes: MoreNodes,
    elements: Elements,
    shares: Shares,
    report: Callable[[str], None] | None = None,
) -> Transcription:
    """A problem's program on a mesh that is known, without clearance constraints."""
    functions = block_functions(problem, problem.coordinates, report, elements)
    return Transcription(problem, problem.coordinates, functions, nodes, elements, shares)


def program_of(solution: Solution) -> Transcription:
    """The program of a solution, without clearance constraints."""
    s = solution
    return program_on(s.problem, s.nodes, s.elements, s.shares)


def planned_by(
    t: Transcription, result: SolverResult, contact: PlannedContact | None = None
) -> dict[str, Any]:
    """Fields of the `Solution` that follow from a program and its result alone.

    contact : the planned one, if it is known.
    """
    plan = t.decode(result.x) if contact is None else contact.planned
    if result.status.usable and contact is None:
        contact = planned_contact(t, result.x, plan)
    return {
        "plan": plan,
        "nodes": t.nodes,
        "elements": t.hit.elements if t.hit.guarded else (),
        "shares": t.hit.shares,
        "apart": t.apart_rows,
        "contact": contact,
    }
