"""Solves from several initial guesses: the problem has local optima, and the best of them is kept."""

from __future__ import annotations

import contextlib
import math
import pickle
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from impactopt.errors import InputError
from impactopt.planning.budget import Budget, rank_of
from impactopt.planning.gain_selection import with_room_for_gains
from impactopt.planning.models import climbed
from impactopt.planning.refinement import Guess, Outcome, Program, Solve
from impactopt.planning.solution import Solved
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.solvers.program import Status
from impactopt.transcription.transcription import block_functions

__all__ = ["best_of", "best_of_starts", "check_starts", "drawn_guesses"]

AnySolution = TypeVar("AnySolution", bound=Solved)
# problem, start, budget, numbers of the starts, and before which number to end -> the best solution
Run = Callable[[ImpactProblem, Any, Budget, range, int], AnySolution]
Guesses = Iterable[tuple[str, Callable[[], Guess[Program]]]]
MORE = 2  # starts, where all that were asked for end with solutions that are refused
ALIKE = 0.1  # relative difference of two violations, of refusals in the same words
SPEEDS, NOISE = (0.5, 3.0), (0.05, 0.5)  # [m/s], [rad] that the starts beside the plain one are drawn from


def check_starts(starts: int, seed: int, workers: int, callback: object, *, given: bool) -> None:
    """InputError if these are no numbers of starts and processes, or no seed; if a given start is to be
    several, or a callback would have to go to other processes.
    """
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise InputError(f"{name} is {value!r}; give a whole number >= {least}")
    if given and starts > 1:
        raise InputError(f"starts is {starts}, of one start that is given; leave one of the two out")
    if workers > 1 and callback is not None:
        raise InputError("callback is asked in this process alone: leave it out, or give workers=1")


def drawn(starts: int, seed: int) -> list[dict[str, Any]]:
    """Speed, noise and seed of each start's reach; the first one is the plain reach."""
    rng = np.random.default_rng(seed)
    others = [
        {
            "speed": float(rng.uniform(*SPEEDS)),
            "noise": float(rng.uniform(*NOISE)),
            "seed": int(rng.integers(2**31)),
        }
        for _ in range(starts - 1)
    ]
    return [{}, *others]


def drawn_guesses(
    name: str, make: Callable[[dict[str, Any]], Guess[Program]], which: range, seed: int
) -> Guesses[Program]:
    """Named initial guesses of drawn reaches, each made in its turn."""
    draws = drawn(which.stop, seed)
    return ((f"{name} {k + 1}", partial(make, draws[k])) for k in which)


def best_of_starts(
    one: Run[AnySolution],
    problem: ImpactProblem,
    start: Any,
    budget: Budget,
    *,
    starts: int,
    workers: int,
) -> AnySolution:
    """The best solution from a problem's starts, by the cheapest model of the collision that is good enough.

    one : a problem from some of the starts, in this process.  start : what it is started from.
    """
    if problem.collision == "auto":

        def run(chosen: ImpactProblem, other: AnySolution | None, left: Budget) -> AnySolution:
            given, count = (start, starts) if other is None else (other, 1)
            return best_of_starts(one, chosen, given, left, starts=count, workers=workers)

        return climbed(problem, run, budget)
    if workers > 1 and starts > 1:
        # compiled here, not by each worker
        block_functions(with_room_for_gains(problem), problem.coordinates, budget.report)
        return _best_side_by_side(partial(one, problem, start), budget, starts=starts, workers=workers)
    return one(problem, start, budget, range(starts), starts + MORE)


def best_of(
    guesses: Guesses[Program],
    solve: Solve[Program],
    budget: Budget,
    count: int,
) -> Outcome[Program]:
    """The best outcome, with the attempts of all.

    guesses : names, and what makes each when its turn comes. More than ``count`` are tried while each ends
        with a solution that is refused, such as for penetration: where a motion passes bodies on the wrong
        side, others may not; none more after two that end alike. An interrupted solve is the last one, and so
        is one after which no time is left.

    Of those that meet their constraints the one of least objective is best, else the one of least violation.
    """
    found = list[tuple[str, Outcome[Program]]]()
    alike = 1  # outcomes that are refused for the same
    for k, (name, make) in enumerate(guesses):
        if k >= count and (alike > 1 or not all(outcome.refused for _, outcome in found)):
            break
        new = solve(make())
        alike = max(alike, 1 + sum(_alike(new, outcome) for _, outcome in found))
        found.append((name, new))
        if new.result.status is Status.INTERRUPTED or budget.left == 0:
            break
    best = min((outcome for _, outcome in found), key=lambda outcome: rank_of(outcome.result))
    attempts = [replace(outcome.attempt(name), kept=outcome is best) for name, outcome in found]
    result = best.result
    if best.refused and alike > 1:
        ended = f"{alike} of {len(found)} starts ended alike."
        result = replace(result, message=f"{result.message} {ended}")
    return replace(best, result=result, attempts=tuple(attempts))


def _alike(one: Outcome[Program], other: Outcome[Program]) -> bool:
    """True if both are refused in the same words, with nearly the same numbers."""
    words, others = (re.sub(r"[\d.]+", "", outcome.result.message) for outcome in (one, other))
    worst = (outcome.result.max_violation for outcome in (one, other))
    return one.refused and other.refused and words == others and math.isclose(*worst, rel_tol=ALIKE)


def _best_side_by_side(
    run: Callable[[Budget, range, int], AnySolution], budget: Budget, *, starts: int, workers: int
) -> AnySolution:
    """The best of the solutions from each start, with the attempts of all in their order.

    run : picklable, and so are its solutions.  budget : of all together; what has not begun when its time is
    over is left out. Ctrl-C keeps what is there.

    Raises
    ------
    InputError : the problem cannot go to other processes, or none of them has come back with a solution.
    """
    try:
        pickle.dumps(run)
    except Exception as error:  # whatever a law or target of the user's own raises
        raise InputError(
            f"the problem cannot go to other processes: {error}; define its own laws, targets and terms in a "
            "module, or give workers=1"
        ) from None
    began = time.perf_counter()
    ends = None if budget.time_limit is None else time.time() + budget.time_limit
    found = dict[int, AnySolution]()
    jobs = each_on_workers(
        _one,
        (run, replace(budget, report=None), ends),
        enumerate(range(starts)),
        workers=min(workers, starts),
    )
    with contextlib.closing(jobs):  # type: ignore[type-var]
        try:
            for k, solution in jobs:
                if isinstance(solution, Died):
                    told = f"start {k + 1} has died (exit code {solution.code})"
                elif solution is None:
                    told = f"start {k + 1} is left out: no time is left"
                else:
                    found[k] = solution
                    told = f"start {k + 1}: {solution.attempts[-1].impulse:.2f} N s, {solution.status.value}"
                budget.say(told)
        except KeyboardInterrupt:
            if not found:
                raise
    if not found:
        raise InputError("no start has come to an end: give more time, or workers=1 to see why")
    best = min(found.values(), key=lambda solution: rank_of(solution.result))
    attempts = [
        replace(attempt, kept=attempt.kept and found[k] is best)
        for k in sorted(found)
        for attempt in found[k].attempts
    ]
    seconds = time.perf_counter() - began
    return replace(best, attempts=tuple(attempts), solve_seconds=seconds - best.build_seconds)


def _one(shared: tuple[Callable[..., Any], Budget, float | None], start: int) -> Any:
    run, budget, ends = shared
    left = None if ends is None else ends - time.time()
    if left is not None and left <= 0:
        return None
    return run(replace(budget, time_limit=left), range(start, start + 1), start + 1)
