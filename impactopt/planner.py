"""One way from a problem to a solution, whichever solver carries it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.between import NO_MORE, MoreNodes, nodes_to_add
from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.nlp.contact_error import contact_error, refined_elements
from impactopt.nlp.mesh import Elements
from impactopt.nlp.start import carried_over, first_iterate, iterate_from_strike, strike_iterate
from impactopt.nlp.strike import StrikeTranscription
from impactopt.nlp.transcription import Transcription, block_functions
from impactopt.problem import ImpactProblem
from impactopt.program import Callback, SolverResult
from impactopt.solution import Solution
from impactopt.starts import Budget, Starts, check_solver, check_starts, drawn, solve_from

Array = NDArray[np.float64]
STARTS = ("reach", "strike")
_ROUNDS = 3  # of more nodes, at most


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
        thrice. ``Solution.nodes`` tells where they are. So does one whose contact is too coarse: it gets
        finer elements while their error is more than half a per cent of the impulse (``Solution.elements``,
        ``Solution.contact_error``).
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
    nodes: MoreNodes = NO_MORE
    elements: Elements = ()
    if isinstance(start, Solution):
        given, nodes, elements = start.result, start.nodes, start.elements
    else:
        given = start if isinstance(start, str) else check_array("start", start, (None,))
    if isinstance(given, str) and given not in STARTS:
        near = did_you_mean(given, STARTS)
        raise InputError(
            f"unknown start {given!r}{near}: give 'reach', 'strike', solver variables (n,) or a Solution"
        )
    began = time.perf_counter()
    functions = block_functions(problem, problem.coordinates, report, elements)
    t = Transcription(problem, problem.coordinates, functions, nodes, elements)
    if report is not None:
        report(f"program of {t.program.n} variables and {t.program.m} rows; {solver} starts")
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback)
    fields = solve_from(t, _starts(t, given, starts, seed, budget), budget, began)
    solution = _solution(t, fields)
    for _ in range(_ROUNDS if between else 0):
        finer = _with_more_nodes(solution, t, budget, report)
        if finer is None:
            break
        solution, t = finer
    return solution


def _solution(t: Transcription, fields: dict[str, Any]) -> Solution:
    """What the best result of a program stands for."""
    x, usable = fields["result"].x, fields["result"].status.usable
    return Solution(
        plan=t.decode(x),
        nodes=t.nodes,
        elements=t.elements if t.guarded else (),
        contact_error=contact_error(t, x) if usable else None,
        **fields,
    )


def _with_more_nodes(
    solution: Solution, t: Transcription, budget: Budget, report: Callable[[str], None] | None
) -> tuple[Solution, Transcription] | None:
    """The same motion with nodes where it leaves its limits between them, and its program; None where it does
    not, or where they end in none that is usable.
    """
    if not solution.status.usable or budget.left == 0:
        return None
    nodes = t.nodes
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        nodes = nodes_to_add(solution.plan, t.nodes)
    elements = refined_elements(solution.contact_error, t.elements)
    if nodes == t.nodes and elements is None:
        return None
    began, old = time.perf_counter(), solution.result
    finer_elements = elements or solution.elements
    functions = block_functions(t.problem, t.coordinates, report, finer_elements)
    finer = Transcription(t.problem, t.coordinates, functions, nodes, finer_elements)
    start: Array | SolverResult
    if solution.contact_error is not None and solution.contact_error.missed:
        start = first_iterate(finer)  # such an optimum is none of the finer program, nor near one
    else:
        x, y, z = carried_over(finer, t, old.x, old.multipliers, old.bound_multipliers)
        start = replace(old, x=x, multipliers=y, bound_multipliers=z)
    name = _more(nodes, elements)
    if report is not None:
        report(f"the plan is not what it says between nodes: {name}, and on from there")
    fields = solve_from(finer, [(name, lambda: start)], budget, began)
    new = fields["result"]
    if not new.status.usable:
        return None
    fields["result"] = _one_after_the_other(old, new)
    for key in ("build_seconds", "solve_seconds"):
        fields[key] += getattr(solution, key)
    before = tuple(replace(attempt, kept=False) for attempt in solution.attempts)
    fields["attempts"] = before + fields["attempts"]
    return _solution(finer, fields), finer


def _more(nodes: MoreNodes, elements: Elements | None) -> str:
    """What is more in a program, in words."""
    words = [f"{nodes.total} more node{'s' if nodes.total > 1 else ''}"] if nodes.total else []
    words += [f"{sum(map(len, elements))} contact elements"] if elements is not None else []
    return ", ".join(words)


def _one_after_the_other(old: SolverResult, new: SolverResult) -> SolverResult:
    """The new result, with the effort of both."""
    sums = ("iterations", "seconds", "seconds_functions", "seconds_qp")
    later = tuple(
        replace(r, iteration=old.iterations + r.iteration, seconds=old.seconds + r.seconds)
        for r in new.history
    )
    effort = {key: getattr(old, key) + getattr(new, key) for key in sums}
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
