"""Search for the cause of infeasibility after a few iterations, not after solvers have given up."""

from __future__ import annotations

from dataclasses import replace

from impactopt import ImpactProblem
from impactopt.planning.budget import Budget
from impactopt.planning.clearance_constraints import Margins, Watch
from impactopt.planning.diagnosis import Search, search
from impactopt.solvers.program import SolverResult
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription, block_functions

ITERATIONS = 20  # the search needs a point with violations, not the least ones


def searched(problem: ImpactProblem, *, near: bool = False) -> tuple[Transcription, SolverResult, Search]:
    """Program of a problem, the result of a short solve of it, and the causes found from there.

    near : with clearance constraints for the bodies that are near each other in the initial guess.
    """
    t = Transcription(problem, block_functions(problem))
    if near:
        t = t.with_clearance(Watch(t, Margins(problem), first_iterate(t)).constraints())
    few = Budget(solver="ipm", options={"max_iterations": ITERATIONS}, time_limit=None, callback=None)
    result = few.run(t.program, first_iterate(t))
    return t, result, search(t, result, replace(few, options=None))
