"""One way from a problem to a solution, whichever solver carries it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.between import NO_MORE, nodes_to_add
from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.keeping_apart import DEEP, Margins, rows_near, rows_to_add
from impactopt.nlp.apart import ApartRow, Held
from impactopt.nlp.start import carried_over, first_iterate, iterate_from_strike, strike_iterate
from impactopt.nlp.strike import StrikeTranscription
from impactopt.nlp.transcription import Transcription, block_functions
from impactopt.problem import ImpactProblem
from impactopt.program import Callback, SolverResult, Status
from impactopt.solution import Solution
from impactopt.starts import Budget, Starts, check_solver, check_starts, drawn, solve_from

Array = NDArray[np.float64]
STARTS = ("reach", "strike")
_EFFORT = ("iterations", "seconds", "seconds_functions", "seconds_qp")
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
    between: bool = True,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Plan the motion that hits hardest within the problem's terms.

    solver : "sqp" (ours) or "ipopt".
    start : "reach", a plain reach to the target; "strike", the state at contact of the hardest blow near such
        a reach, which is a program of its own (:func:`impactopt.optimize_strike`); solver variables (n,); or
        the solution of a neighbouring problem, such as the same with its target moved by a few centimetres.
    starts : so many of them, the first one plain, the others with perturbed postures and other speeds, drawn
        by ``seed``; the best motion is kept, ``Solution.attempts`` tells of all.
    options : the solver's own.  time_limit [s] : of the solver, for all starts together.
    between : whether a motion that leaves its limits between the nodes of its program gets more of them
        there, and is solved once more from where it is: while it gives up half of a margin somewhere, at most
        thrice. ``Solution.nodes`` tells where they are.
    report : told in words what is being built; callback : called with every iteration's record; returning
        True, or Ctrl-C, stops with the best iterate.

    An infeasible problem is a status with named rows, not an exception.

    Raises
    ------
    InputError : unknown solver, option or start, a start of the wrong length, several of a given start.
    """
    check_solver(solver)
    check_starts(starts, seed, given=not isinstance(start, str))
    given: str | Array | SolverResult
    nodes, given_solution = NO_MORE, isinstance(start, Solution)
    if isinstance(start, Solution):
        given, nodes, apart = start.result, start.nodes, start.apart
    else:
        given = start if isinstance(start, str) else check_array("start", start, (None,))
    if isinstance(given, str) and given not in STARTS:
        near = did_you_mean(given, STARTS)
        raise InputError(
            f"unknown start {given!r}{near}: give 'reach', 'strike', solver variables (n,) or a Solution"
        )
    began = time.perf_counter()
    functions = block_functions(problem, problem.coordinates, report)
    t = Transcription(problem, problem.coordinates, functions, nodes)
    if report is not None:
        report(f"program of {t.program.n} variables and {t.program.m} rows; {solver} starts")
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback)
    keep = None if not problem.keeps_apart else Margins(problem)
    refining = _Refining(budget, keep, apart if given_solution else {}, between, report)
    t, fields = solve_from(t, _starts(t, given, starts, seed, budget), budget, began, refining.solve)
    return Solution(plan=t.decode(fields["result"].x), nodes=t.nodes, apart=t.apart_rows, **fields)


@dataclass(frozen=True, kw_only=True)
class _Round:
    """A program that is to be solved next, and from where: from one after the other, until it is."""

    program: Transcription
    starts: tuple[Array | SolverResult, ...]
    why: str


class _Refining:
    """One start's way to a motion that is right between its program's rows too.

    A program has rows between the bodies that come near at its start, and nodes where its mesh has them. Where its
    solution brings other bodies into each other, or leaves its limits between nodes, it gets rows and nodes there
    and is solved again: from where it is; or, where limbs are deep in each other, from the start, as the way out may
    lead nowhere.
    """

    def __init__(
        self,
        budget: Budget,
        margins: Margins | None,
        rows: Mapping[ApartRow, Held],
        between: bool,
        report: Callable[[str], None] | None,
    ) -> None:
        self.budget, self.margins, self.rows = budget, margins, rows
        self.between, self.report = between, report

    def solve(self, t: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        """The last program, and its result with the effort of all."""
        x0 = start.x if isinstance(start, SolverResult) else start
        if self.margins is not None:
            rows = (
                self.rows if self.rows and isinstance(start, SolverResult) else rows_near(t, x0, self.margins)
            )
            t = t.with_apart(rows)
        result = self.budget.run(t.program, start)
        for again in range(_ROUNDS if self.between else 0):
            if not result.status.usable or self.budget.left == 0:
                return t, result
            following = self._next(t, result, x0, again)
            if following is None:
                return t, result
            if self.report is not None:
                self.report(following.why)
            for start in following.starts:
                new = self.budget.run(following.program.program, start)
                result = _one_after_the_other(result, new) if new.status.usable else _with_effort(result, new)
                if new.status.usable or self.budget.left == 0:
                    break
            if not new.status.usable:
                break
            t = following.program
        return t, self._judged(t, result) if self.between else result

    def _judged(self, t: Transcription, result: SolverResult) -> SolverResult:
        """A result that could not be mended is a solution only if nothing touches anything."""
        if self.margins is None:
            return result
        with contextlib.suppress(InputError):
            left = rows_to_add(t, result.x, self.margins, share=1.0)
            if left is not None and left.depth > 0:
                names = sorted({" and ".join(self.margins.bodies.names(row[1:3])) for row in left.rows})
                message = (
                    f"Bodies are {1e3 * left.depth:.0f} mm in each other, and no solution was found where they are not: "
                    f"{'; '.join(names[:3])}."
                )
                return replace(result, status=Status.FAILED, message=message)
        return result

    def _next(self, t: Transcription, old: SolverResult, x0: Array, again: int) -> _Round | None:
        """What is to be solved next; None if the solution is right."""
        nodes, violated = t.nodes, None
        with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
            nodes = nodes_to_add(t.decode(old.x), t.nodes) if again < _NODE_ROUNDS else t.nodes
            violated = rows_to_add(t, old.x, self.margins) if self.margins is not None else None
        if violated is None and nodes == t.nodes:
            return None
        rows = {**t.apart_rows, **(violated.rows if violated is not None else {})}
        if violated is not None and violated.depth > DEEP and again < _DEEP_ROUNDS:
            why = f"bodies are {1e3 * violated.depth:.0f} mm in each other: from the start again, with rows between them"
            return _Round(program=t.with_apart(rows), starts=(x0, old.x), why=why)
        if nodes == t.nodes:
            finer = t.with_apart(rows)
        else:
            finer = Transcription(t.problem, t.coordinates, t.functions, nodes)
            finer = finer.with_apart(rows)
        x, y, z = carried_over(finer, t, old.x, old.multipliers, old.bound_multipliers)
        added = len(rows) - len(t.apart_rows)
        again_from = (x0,) if finer.layout.n == len(x0) else ()
        what = [f"{nodes.total - t.nodes.total} more nodes"] * (nodes != t.nodes)
        what += [f"{added} more rows between bodies"] * (violated is not None)
        return _Round(
            program=finer,
            starts=(replace(old, x=x, multipliers=y, bound_multipliers=z), x, *again_from),
            why=f"between its rows the plan leaves its limits: {' and '.join(what)}, and on from there",
        )


def _with_effort(old: SolverResult, failed: SolverResult) -> SolverResult:
    """The old result, with the effort of one that came to nothing too."""
    effort = {key: getattr(old, key) + getattr(failed, key) for key in _EFFORT}
    return replace(old, **effort)


def _one_after_the_other(old: SolverResult, new: SolverResult) -> SolverResult:
    """The new result, with the effort of both."""
    later = tuple(
        replace(r, iteration=old.iterations + r.iteration, seconds=old.seconds + r.seconds)
        for r in new.history
    )
    effort = {key: getattr(old, key) + getattr(new, key) for key in _EFFORT}
    return replace(new, history=old.history + later, **effort)


def _starts(
    t: Transcription, start: str | Array | SolverResult, starts: int, seed: int, budget: Budget
) -> Starts:
    """Names of the starts, and what makes them."""
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
            hit = budget.run(strike.program, strike_iterate(strike, **draw))
            return iterate_from_strike(t, strike, hit.x)

        yield f"{start} {k + 1}", make
