"""One way from a problem to a solution, whichever solver carries it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.planning.causes import Cause, search
from impactopt.planning.chosen_gains import roomy, settled
from impactopt.planning.keeping_apart import Margins, same_bodies
from impactopt.planning.made_again import planned_by, program_of
from impactopt.planning.models import carried_start, climbed
from impactopt.planning.motion_price import with_first_scale, within_price
from impactopt.planning.multistart import (
    EFFORT,
    VIOLATED,
    Budget,
    Starts,
    attempt_of,
    check_starts,
    drawn,
    one_after_the_other,
    solve_from,
    violations_of,
)
from impactopt.planning.on_demand import kept_on_demand, rows_on_demand, with_rows
from impactopt.planning.rounds import Refining
from impactopt.planning.side_by_side import best_side_by_side, check_workers
from impactopt.planning.solution import Solution
from impactopt.planning.stopping import stopping
from impactopt.planning.strike import clear_strike
from impactopt.planning.verdict import lacks_rows, with_reason, with_soles_kept
from impactopt.planning.window import window_caution
from impactopt.problem.feasibility import hopeless
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Callback, SolverResult, Status, max_violation
from impactopt.transcription.clearance import ApartRow, Held
from impactopt.transcription.initial_guess import first_iterate, iterate_from_strike, strike_iterate
from impactopt.transcription.mesh import Elements, Shares
from impactopt.transcription.mesh_refinement import NO_MORE, MoreNodes
from impactopt.transcription.plan import PlannedCollision
from impactopt.transcription.program_summary import statement_of
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]
STARTS = ("reach", "strike")
_MORE = 2  # starts, where all that were asked for end with penetrating bodies


def solve(
    problem: ImpactProblem,
    *,
    solver: str = "sqp",
    start: str | ArrayLike | Solution = "reach",
    starts: int = 1,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    workers: int = 1,
    refine: bool = True,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Plan the motion that maximizes the problem's objectives, by default the impulse, within its terms.

    solver : "sqp", our own, or "ipopt". Ours is a primal-dual interior-point method: it takes one Newton step
        on each quadratic model of the program. ``options={"qp_solver": "osqp"}`` makes it a true SQP, which
        solves its QPs to their end, for small programs (:class:`impactopt.solvers.sqp.SQPOptions`).
    start : "reach", a plain reach to the target; "strike", the state at contact of the hardest blow near such
        a reach, which is a program of its own (:func:`impactopt.optimize_strike`); solver variables (n,); or
        the solution of a neighbouring problem, such as the same with its target moved by a few centimetres.
    starts : number of starts. The first one is plain, the others have perturbed postures and other speeds,
        drawn by ``seed``. The best motion is kept; ``Solution.attempts`` has all. Where all end with bodies
        in each other, up to two more are tried.
    options : the solver's own.  time_limit [s] : of all starts together, without compiling functions.
    workers : processes that the starts are solved on, side by side. Then no callback is asked, and no more
        starts are tried than were asked for.
    refine : whether the mesh is refined. Nodes are added where a motion uses up more than half of a margin
        between two nodes, and it is solved again from the solution, at most three times (``Solution.nodes``).
        The contact gets finer elements while theirs make an error of more than half a per cent of the impulse
        (``Solution.elements``, ``Solution.contact_error``).
    report : called with a line of text while functions are built.  callback : called with every iteration's
        record; if it returns True, or on Ctrl-C, the solve stops with the best iterate.

    An infeasible problem is a status with named constraints, not an exception.

    Raises
    ------
    InputError : unknown solver, option or start, a start of the wrong length, several of a given start.
    """
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback)
    check_starts(starts, seed, given=not isinstance(start, str))
    check_workers(workers, callback)
    if isinstance(start, str) and start not in STARTS:
        near = did_you_mean(start, STARTS)
        raise InputError(
            f"unknown start {start!r}{near}: give 'reach', 'strike', solver variables (n,) or a Solution"
        )
    with stopping() as stop:
        budget = replace(budget, stop=stop)
        if problem.collision == "auto":
            common: dict[str, Any] = {"solver": solver, "options": options, "refine": refine}
            common |= {"workers": workers, "report": report, "callback": callback}

            def run(chosen: ImpactProblem, other: Solution | None, left: float | None) -> Solution:
                if other is not None:
                    return solve(chosen, start=other, time_limit=left, **common)
                return solve(chosen, start=start, starts=starts, seed=seed, time_limit=left, **common)

            return climbed(problem, run, time_limit=time_limit, report=report)
        if workers > 1 and starts > 1:
            block_functions(roomy(problem), problem.coordinates, report)  # compiled here, not by each
            run_one = partial(_planned, problem, start, 0, seed, refine)
            return best_side_by_side(run_one, budget, starts=starts, workers=workers, report=report)
        return _planned(problem, start, _MORE, seed, refine, budget, range(starts), report)


def _planned(
    problem: ImpactProblem,
    start: str | ArrayLike | Solution,
    more: int,
    seed: int,
    refine: bool,
    budget: Budget,
    which: range,
    report: Callable[[str], None] | None,
) -> Solution:
    """The best motion from these starts, and up to so many more; or from the given one."""
    given: str | Array | SolverResult
    nodes: MoreNodes = NO_MORE
    elements: Elements = ()
    shares: Shares = ()
    apart: Mapping[ApartRow, Held] = {}
    if isinstance(start, Solution):
        # a neighbour is likely to need the same constraints and prices
        problem = with_rows(problem, rows_on_demand(start.problem))
        if problem.style == start.problem.style:
            problem = replace(problem, price_scale=start.problem.price_scale)
        given, nodes, elements, shares = start.result, start.nodes, start.elements, start.shares
        if start.problem.keeps_apart and same_bodies(problem, start.problem):
            apart = start.apart
    else:
        given = start if isinstance(start, str) else check_array("start", start, (None,))
    began, problem = time.perf_counter(), roomy(problem)
    functions = block_functions(problem, problem.coordinates, report, elements)
    budget = budget.started()
    t = Transcription(problem, problem.coordinates, functions, nodes, elements, shares)
    if isinstance(start, Solution):
        given = carried_start(t, partial(program_of, start), start, apart)
    if isinstance(given, str):
        t = with_first_scale(t)
        problem = t.problem
    else:
        check_array("start", given.x if isinstance(given, SolverResult) else given, (t.program.n,))
    if isinstance(given, SolverResult) and _meets_rows(t, given):
        budget = budget.near_by()  # the start may be the optimum
    if report is not None:
        report(f"program of {t.program.n} variables and {t.program.m} constraints; {budget.solver} starts")
    margins = Margins(problem) if problem.keeps_apart else None
    refining = Refining(budget, margins, apart, report)
    # limbs that penetrate, or gears that break, say nothing of what a start is worth: each is led to
    # its end before they compare
    each = partial(_solved_from, refining, refine and margins is not None)
    of_start = _starts(t, given, which, more, seed, partial(clear_strike, budget, margins), refining)
    t, fields = solve_from(t, of_start, budget, began, each)
    if margins is None and refine and fields["result"].status.usable:
        t, fields = _on(refining, t, fields)
    known = hopeless(problem) if lacks_rows(t, fields["result"]) else []
    causes: tuple[Cause, ...] = ()
    if not known:
        t, fields, causes = _explained(t, fields, budget, each, report)
    t, fields = settled(t, fields, budget, report)
    explained = with_reason(t, fields["result"], causes, known=known)
    result = fields["result"] = refining.checked(t, explained)
    solution = Solution(
        contact_error=refining.error(t, result.x) if result.status.usable else None,
        statement=statement_of(t),
        window=window_caution(t, result) if result.status.usable else "",
        causes=tuple(cause for cause in causes if cause.problem is not None),
        **planned_by(t, result, refining.known_contact(t, result.x)),
        **fields,
    )
    return with_soles_kept(solution) if refine else solution


def _explained(
    t: Transcription,
    fields: dict[str, Any],
    budget: Budget,
    work: Callable[[Transcription, Array], tuple[Transcription, SolverResult]],
    report: Callable[[str], None] | None,
) -> tuple[Transcription, dict[str, Any], tuple[Cause, ...]]:
    """Diagnosis of a failed solve: the bounds that make it infeasible, or a solution from a feasible point
    that the diagnosis has found.

    A limit that the caller has set is an answer, and stays one.
    """
    old: SolverResult = fields["result"]
    limited = old.status is Status.ITERATION_LIMIT and "max_iterations" in (budget.options or {})
    if limited or not lacks_rows(t, old) or budget.left == 0:
        return t, fields, ()
    if report is not None:
        report("no motion meets all bounds: which one would have to move?")
    found = search(t, old, budget)
    if found.met is None or budget.left == 0:
        return t, fields, found.causes
    if report is not None:
        report("there is a motion that meets all bounds: on from there")
    new, result = work(*found.met)
    if not result.status.usable:
        return t, fields, ()
    attempts = [replace(a, kept=False) for a in fields["attempts"]]
    attempts.append(replace(attempt_of(new, "a motion within all bounds", result), kept=True))
    rows = new.program.constraints(result.x)
    fields = fields | {
        "problem": new.problem,
        "result": one_after_the_other(old, result),
        "solve_seconds": fields["solve_seconds"] + result.seconds,
        "violations": violations_of(new, result.x, rows),
        "objectives": new.achieved(result.x),
        "attempts": tuple(attempts),
    }
    return new, fields, ()


def _meets_rows(t: Transcription, start: SolverResult) -> bool:
    return max_violation(t.program, start.x, t.program.constraints(start.x)) <= VIOLATED


def _solved_from(
    refining: Refining, to_its_end: bool, t: Transcription, start: Array | SolverResult
) -> tuple[Transcription, SolverResult]:
    """Solves from one initial guess, adding the lazy constraints that it needs.  to_its_end : refines it,
    too.
    """
    work = refining.solve if to_its_end else refining.first
    found, result = _bounded(refining, *work(t, start), (t, start), to_its_end)

    def again(other: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        own = refining.anew(other)
        done = _bounded(
            own, *(own.solve if to_its_end else own.first)(other, start), (other, start), to_its_end
        )
        refining.learn(own)
        return done

    return within_price(found, result, again, refining.report)


def _bounded(
    refining: Refining,
    t: Transcription,
    result: SolverResult,
    first: tuple[Transcription, Array | SolverResult],
    to_its_end: bool,
) -> tuple[Transcription, SolverResult]:
    """Adds lazy constraints until none is violated (`kept_on_demand`)."""

    def solve(other: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        own = refining.anew(other)
        done = own.solve(other, start) if to_its_end else own.first(other, start)
        refining.learn(own)
        return done

    def finer(other: Transcription, x: Array) -> tuple[PlannedCollision, ...]:
        error = refining.error(other, x)
        return () if error is None or error.missed else error.finer

    return kept_on_demand(t, result, first, solve, finer, refining.report)


def _on(refining: Refining, t: Transcription, fields: dict[str, Any]) -> tuple[Transcription, dict[str, Any]]:
    """The best result's program with what it lacks, and the fields of its solution; a round is an attempt
    more.
    """
    began, old = time.perf_counter(), fields["result"]
    finer, result, rounds = refining.rounds(t, old, old.x)
    within, bounded = _bounded(refining, finer, result, (t, old.x), True)
    if within is not finer:
        alone = {key: getattr(bounded, key) - getattr(result, key) for key in EFFORT}
        rounds.append((within, "lazy constraints", replace(bounded, **alone)))
        finer, result = within, bounded
    if not rounds:
        return t, fields
    rows = finer.program.constraints(result.x)
    attempts = [replace(a, kept=False) for a in fields["attempts"]]
    attempts += [attempt_of(program, name, r) for program, name, r in rounds]
    attempts[-1] = replace(attempts[-1], kept=True)
    return finer, {
        **fields,
        "result": result,
        "solve_seconds": fields["solve_seconds"] + time.perf_counter() - began,
        "violations": violations_of(finer, result.x, rows),
        "objectives": finer.achieved(result.x),
        "attempts": tuple(attempts),
    }


def _starts(
    t: Transcription,
    start: str | Array | SolverResult,
    which: range,
    more: int,
    seed: int,
    hit: Callable[[StrikeTranscription, Array], tuple[StrikeTranscription, SolverResult]],
    refining: Refining,
) -> Starts:
    """Names of the starts, and what makes them; ``hit`` solves a strike.

    A few more than asked for while each ends with penetrating bodies: where a motion passes them on the
    wrong side, others may not.
    """
    if not isinstance(start, str):
        yield "given", lambda: start
        return
    strike = None
    if start == "strike":
        strike = StrikeTranscription(t.problem, t.coordinates, t.functions)
    blocked = True
    draws = drawn(which.stop + more, seed)
    for k in range(which.start, which.stop + more):
        if k >= which.stop and not blocked:
            return

        def make(draw: dict[str, Any] = draws[k]) -> Array:
            if strike is None:
                return first_iterate(t, **draw)
            found, result = hit(strike, strike_iterate(strike, **draw))
            return iterate_from_strike(t, found, result.x)

        yield f"{start} {k + 1}", make
        blocked &= refining.blocked
