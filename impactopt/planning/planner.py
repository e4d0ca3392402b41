"""One way from a problem to a solution, whichever solver carries it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.bodies.robot_bodies import Pair
from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.planning.keeping_apart import DEEP, Margins, Violated, rows_near, rows_to_add, same_bodies
from impactopt.planning.models import carried_start, climbed, model_error
from impactopt.planning.multistart import (
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
from impactopt.planning.rounds import Round, more_of, start_of
from impactopt.planning.solution import Solution
from impactopt.planning.strike import clear_strike
from impactopt.planning.verdict import second_look, with_reason
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Callback, SolverResult, Status
from impactopt.transcription.apart import ApartRow, Held
from impactopt.transcription.contact_error import ContactError, contact_error, refined_elements
from impactopt.transcription.mesh import Elements, Shares, contact_elements
from impactopt.transcription.mesh_refinement import NO_MORE, MoreNodes, nodes_to_add
from impactopt.transcription.rattle import rattle
from impactopt.transcription.start import carried_over, first_iterate, iterate_from_strike, strike_iterate
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]
STARTS = ("reach", "strike")
_LOST = 0.08  # [m] in each other: a way out from there may lead nowhere
_BARRIER = 1e-4  # where rows between bodies are new, which the solution before breaks
_BARRIER_DEEP = 1e-3  # and breaks by far
_STUCK = (Status.INFEASIBLE, Status.FAILED)
_ROUNDS, _NODE_ROUNDS, _DEEP_ROUNDS = 12, 3, 7  # at most: of all, with more nodes, from the start again


def solve(
    problem: ImpactProblem,
    *,
    solver: str = "sqp",
    start: str | ArrayLike | Solution = "reach",
    starts: int = 1,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    refine: bool = True,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Plan the motion that maximizes the problem's objectives, by default the impulse, within its terms.

    solver : "sqp", our own, or "ipopt". Ours is a primal-dual interior-point method: it takes one Newton step
        on each quadratic model of the program. ``options={"qp_solver": "piqp"}`` makes it a true SQP, which
        solves its QPs to their end, for small programs (:class:`impactopt.solvers.sqp.SQPOptions`).
    start : "reach", a plain reach to the target; "strike", the state at contact of the hardest blow near such
        a reach, which is a program of its own (:func:`impactopt.optimize_strike`); solver variables (n,); or
        the solution of a neighbouring problem, such as the same with its target moved by a few centimetres.
    starts : number of starts. The first one is plain, the others have perturbed postures and other speeds,
        drawn by ``seed``. The best motion is kept; ``Solution.attempts`` has all.
    options : the solver's own.  time_limit [s] : of all starts together, without compiling functions.
    refine : whether the mesh is refined. Nodes are added where a motion uses up more than half of a margin
        between two nodes, and it is solved again from the solution, at most three times (``Solution.nodes``).
        The contact gets finer elements while theirs make an error of more than half a per cent of the impulse
        (``Solution.elements``, ``Solution.contact_error``).
    report : called with a line of text while functions are built.  callback : called with every iteration's
        record; if it returns True, or on Ctrl-C, the solve stops with the best iterate.

    An infeasible problem is a status with named rows, not an exception.

    Raises
    ------
    InputError : unknown solver, option or start, a start of the wrong length, several of a given start.
    """
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback)
    check_starts(starts, seed, given=not isinstance(start, str))
    if problem.collision == "auto":
        common: dict[str, Any] = {"solver": solver, "options": options, "refine": refine}
        common |= {"report": report, "callback": callback}

        def run(chosen: ImpactProblem, other: Solution | None, left: float | None) -> Solution:
            if other is not None:
                return solve(chosen, start=other, time_limit=left, **common)
            return solve(chosen, start=start, starts=starts, seed=seed, time_limit=left, **common)

        return climbed(problem, run, time_limit=time_limit, report=report)
    given: str | Array | SolverResult
    nodes: MoreNodes = NO_MORE
    elements: Elements = ()
    shares: Shares = ()
    apart: Mapping[ApartRow, Held] = {}
    if isinstance(start, Solution):
        given, nodes, elements, shares = start.result, start.nodes, start.elements, start.shares
        if start.problem.keeps_apart and same_bodies(problem, start.problem):
            apart = start.apart
    else:
        given = start if isinstance(start, str) else check_array("start", start, (None,))
    if isinstance(given, str) and given not in STARTS:
        near = did_you_mean(given, STARTS)
        raise InputError(
            f"unknown start {given!r}{near}: give 'reach', 'strike', solver variables (n,) or a Solution"
        )
    began = time.perf_counter()
    functions = block_functions(problem, problem.coordinates, report, elements)
    budget = budget.started()
    t = Transcription(problem, problem.coordinates, functions, nodes, elements, shares)
    if isinstance(start, Solution):
        given = carried_start(t, partial(_program_of, start), start, apart)
    if not isinstance(given, str):
        check_array("start", given.x if isinstance(given, SolverResult) else given, (t.program.n,))
    if report is not None:
        report(f"program of {t.program.n} variables and {t.program.m} rows; {solver} starts")
    margins = Margins(problem) if problem.keeps_apart else None
    refining = _Refining(budget, margins, apart, report)
    # limbs that are in each other say nothing of what a start is worth: each is led to its end before they
    # compare
    each = refining.solve if margins is not None and refine else refining.first
    of_start = _starts(t, given, starts, seed, partial(clear_strike, budget, margins))
    t, fields = solve_from(t, of_start, budget, began, each)
    if margins is None and refine and fields["result"].status.usable:
        t, fields = _on(refining, t, fields)
    result = fields["result"] = with_reason(t, fields["result"])
    return Solution(
        plan=t.decode(result.x),
        nodes=t.nodes,
        elements=t.hit.elements if t.hit.guarded else (),
        shares=t.hit.shares,
        model_error=model_error(t, result.x) if result.status.usable else None,
        contact_error=refining.error(t, result.x) if result.status.usable else None,
        rattle=rattle(t, result.x) if result.status.usable else None,
        apart=t.apart_rows,
        **fields,
    )


def _program_of(solution: Solution) -> Transcription:
    """The program of a solution, without rows between bodies."""
    p = solution.problem
    functions = block_functions(p, p.coordinates, None, solution.elements)
    return Transcription(p, p.coordinates, functions, solution.nodes, solution.elements, solution.shares)


def _on(
    refining: _Refining, t: Transcription, fields: dict[str, Any]
) -> tuple[Transcription, dict[str, Any]]:
    """The best result's program with what it lacks, and the fields of its solution; a round is an attempt
    more.
    """
    began, old = time.perf_counter(), fields["result"]
    finer, result, rounds = refining.rounds(t, old, old.x)
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


class _Refining:
    """The way from a program's solution to one that is right between its rows too.

    A program has rows between the bodies that come near at its start, and nodes and elements where its mesh
    has them. Where its solution brings other bodies into each other, leaves its limits between nodes, or has
    a contact that is too coarse, it gets more of them there and is solved again: from where it is; or, where
    limbs are through each other, from the start.
    """

    def __init__(
        self,
        budget: Budget,
        margins: Margins | None,
        rows: Mapping[ApartRow, Held],
        report: Callable[[str], None] | None,
    ) -> None:
        self.budget, self.margins, self.given_rows, self.report = budget, margins, rows, report
        self._known: tuple[Transcription, Array, ContactError | None] | None = None
        self._tried: frozenset[Pair] = frozenset()  # pairs that were deep in each other, and had a way out
        self._refined = 0  # rounds with more nodes or elements
        self._clean: SolverResult | None = None  # the last that was looked at, if its bodies are apart

    def error(self, t: Transcription, x: Array) -> ContactError | None:
        """Of a program's contact at its solution; the last one that was asked for is known."""
        if self._known is None or self._known[0] is not t or self._known[1] is not x:
            self._known = t, x, contact_error(t, x)
        return self._known[2]

    def first(self, t: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        """The program with its first rows between bodies, and its result."""
        if self.margins is not None:
            warm = isinstance(start, SolverResult)
            x0 = start.x if isinstance(start, SolverResult) else start
            t = t.with_apart(self.given_rows if warm and self.given_rows else rows_near(t, x0, self.margins))
        if isinstance(start, SolverResult) and len(start.multipliers) != t.program.m:
            start = start.x  # of a program with other rows
        result = self.budget.run(t.program, start)
        if self.margins is None:
            result = self._looked_at(t, result, start.x if isinstance(start, SolverResult) else start)
        return t, result

    def _looked_at(self, t: Transcription, result: SolverResult, x0: Array) -> SolverResult:
        """A result without a verdict with that of another solver, from the same start."""
        new = second_look(self.budget, t.program, x0, result, self.report)
        return result if new is result else one_after_the_other(result, new)

    def solve(self, t: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        """The last program, and its result with the effort of all."""
        x0 = start.x if isinstance(start, SolverResult) else start
        free = t
        t, result = self.first(free, start)
        if result.status in _STUCK and t.apart_rows and self.budget.left != 0:
            t, result = self._led_out(free, t, result, x0)
        else:
            t, result, _ = self.rounds(t, result, x0)
            result = self._judged(t, result)
        looked = self._looked_at(t, result, x0)
        if looked is result or not looked.status.usable:
            return t, looked
        t, result, _ = self.rounds(t, looked, x0)
        return t, self._judged(t, result)

    def _led_out(
        self, free: Transcription, t: Transcription, stuck: SolverResult, x0: Array
    ) -> tuple[Transcription, SolverResult]:
        """What comes of a start that leads nowhere with the first rows between bodies of a program ``t``.

        That is where a solver stopped, not that there is no motion: the rows know the bodies as they are at
        the start. So the motion without them is led out of what it is in; where that fails too, the rows say
        what is in the way.
        """
        if self.report is not None:
            self.report("no motion was found from there with rows between bodies: first without them")
        last, result, _ = self.rounds(free, self.budget.run(free.program, x0), x0)
        result = self._judged(last, result)
        if result.status.usable:
            return last, one_after_the_other(stuck, result)
        return t, one_after_the_other(result, stuck)

    def rounds(
        self, t: Transcription, result: SolverResult, x0: Array
    ) -> tuple[Transcription, SolverResult, list[tuple[Transcription, str, SolverResult]]]:
        """The last program that was solved, its result with the effort of all, and what came of each
        round.
        """
        found: list[tuple[Transcription, str, SolverResult]] = []
        self._tried, self._refined = frozenset(), 0
        for again in range(_ROUNDS if self.margins is not None else _NODE_ROUNDS):
            if not result.status.usable or self.budget.left == 0:
                break
            following = self._next(t, result, x0, again)
            if following is None:
                break
            if self.report is not None:
                self.report(following.why)
            for start in following.starts:
                new = self.budget.run(following.program.program, start, following.barrier)
                if new.status.usable or self.budget.left == 0:
                    break
            if not new.status.usable:
                break
            if following.program.layout.n != len(x0):  # more nodes or elements: the start has them too
                x0 = start_of(following.program, t, x0)
            t, result = following.program, one_after_the_other(result, new)
            found.append((t, following.name, new))
        return t, result, found

    def _judged(self, t: Transcription, result: SolverResult) -> SolverResult:
        """A result that could not be mended is a solution only if nothing touches anything."""
        if self.margins is None or not result.status.usable or result is self._clean:
            return result
        with contextlib.suppress(InputError):
            left = rows_to_add(t, result.x, self.margins, share=1.0)
            if left is not None and left.depth > 0:
                names = sorted({" and ".join(self.margins.bodies.names(row[1:3])) for row in left.rows})
                message = (
                    f"Bodies are {1e3 * left.depth:.1f} mm in each other, and no solution was found where "
                    f"they are not: {'; '.join(names[:3])}."
                )
                # where nothing else is found it is still told, but goes before no start that is clean
                worst = max(result.max_violation, left.depth, 2 * VIOLATED)
                return replace(result, status=Status.FAILED, max_violation=worst, message=message)
        return result

    def _next(self, t: Transcription, old: SolverResult, x0: Array, again: int) -> Round | None:
        """What is to be solved next; None if the solution is right."""
        nodes, shares, violated = t.nodes, t.hit.shares, None
        elements: Elements | None = None
        error: ContactError | None = None
        with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
            violated = rows_to_add(t, old.x, self.margins) if self.margins is not None else None
        self._clean = old if violated is None else None
        if violated is not None and violated.depth > DEEP and again < _DEEP_ROUNDS:
            return self._apart_again(t, old, x0, violated)
        if self._refined < _NODE_ROUNDS:
            with contextlib.suppress(InputError):
                known = t.nodes if violated is None else violated.nodes
                nodes = nodes_to_add(t.decode(old.x), known)
            error = self.error(t, old.x)
            elements = refined_elements(error, t.hit.elements)
            shares = t.hit.drifted(old.x) or shares
            if shares != t.hit.shares:
                elements = contact_elements(t.problem, shares)
        if violated is None and nodes == t.nodes and elements is None:
            return None
        rows = {**t.apart_rows, **(violated.rows if violated is not None else {})}
        finer = t
        if nodes != t.nodes or elements is not None:
            self._refined += 1
            finer_elements = elements or (t.hit.elements if t.hit.guarded else ())
            functions = block_functions(t.problem, t.coordinates, self.report, finer_elements)
            finer = Transcription(t.problem, t.coordinates, functions, nodes, finer_elements, shares)
        finer = finer.with_apart(rows) if self.margins is not None else finer
        starts: tuple[Array | SolverResult, ...]
        if error is not None and error.missed:
            starts = (first_iterate(finer),)  # such an optimum is none of the finer program, nor near one
        else:
            x, y, z = carried_over(finer, t, old.x, old.multipliers, old.bound_multipliers)
            starts = (replace(old, x=x, multipliers=y, bound_multipliers=z),)
        if violated is not None and finer.layout.n == len(old.x):
            starts = (*starts, old.x, x0)
        name = more_of(nodes, elements, len(rows) - len(t.apart_rows))
        return Round(
            program=finer,
            starts=starts,
            barrier=None if violated is None else _BARRIER,
            name=name,
            why=f"the plan is not what it says between nodes: {name}, and on from there",
        )

    def _apart_again(self, t: Transcription, old: SolverResult, x0: Array, violated: Violated) -> Round:
        """On with rows between bodies that are deep in each other: from where they are, if that may lead out
        on the side they came in, and has not failed to, else from the start.
        """
        program = t.with_apart({**t.apart_rows, **violated.rows})
        words = f"bodies are {1e3 * violated.depth:.0f} mm in each other"
        round_of = partial(Round, program=program, name="rows between bodies")
        if violated.depth > _LOST or violated.deep & self._tried:
            self._tried = frozenset()
            return round_of(starts=(x0, old.x), why=f"{words}: from the start again, with rows between them")
        self._tried |= violated.deep
        x, y, z = carried_over(program, t, old.x, old.multipliers, old.bound_multipliers)
        warm = replace(old, x=x, multipliers=y, bound_multipliers=z)
        why = f"{words}: on with rows between them"
        return round_of(starts=(warm, x0, old.x), why=why, barrier=_BARRIER_DEEP)


def _starts(
    t: Transcription,
    start: str | Array | SolverResult,
    starts: int,
    seed: int,
    hit: Callable[[StrikeTranscription, Array], tuple[StrikeTranscription, SolverResult]],
) -> Starts:
    """Names of the starts, and what makes them; ``hit`` solves a strike."""
    if not isinstance(start, str):
        yield "given", lambda: start
        return
    strike = None
    if start == "strike":
        strike = StrikeTranscription(t.problem, t.coordinates, t.functions)
    for k, draw in enumerate(drawn(starts, seed)):

        def make(draw: dict[str, Any] = draw) -> Array:
            if strike is None:
                return first_iterate(t, **draw)
            found, result = hit(strike, strike_iterate(strike, **draw))
            return iterate_from_strike(t, found, result.x)

        yield f"{start} {k + 1}", make
