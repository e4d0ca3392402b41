"""Multistart: solves from several initial guesses, of which the best local optimum is kept."""

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
from impactopt.planning.budget import Budget, rank_of, stopping
from impactopt.planning.gain_selection import with_room_for_gains
from impactopt.planning.models import climbed
from impactopt.planning.refinement import Guess, Outcome, Program, Solve
from impactopt.planning.solution import Solved
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.solvers.program import Status
from impactopt.transcription.transcription import block_functions

AnySolution = TypeVar("AnySolution", bound=Solved)
# problem, start, budget, numbers of the starts, and the number that further starts end before -> best
# solution
Run = Callable[[ImpactProblem, Any, Budget, range, int], AnySolution]
# names, and functions that make the guesses
Guesses = Iterable[tuple[str, Callable[[], Guess[Program]]]]
EXTRA_STARTS = 2  # at most, if the solutions of all requested starts are refused
ALIKE = 0.1  # relative difference of the violations of two refusals with the same message
# [m/s], [rad] ranges of all starts but the first: speed of the reach, and noise of its posture
SPEEDS, NOISE = (0.5, 3.0), (0.05, 0.5)


def check_starts(starts: int, seed: int, workers: int, callback: object, *, given: bool) -> None:
    """Checks arguments of `solve`.

    given : whether the user gives an initial guess.

    Raises
    ------
    InputError : numbers that are not whole or too small; several starts from a given guess; a callback with
        several processes.
    """
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0), ("workers", workers, 1)):
        # True is an int, too.
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise InputError(f"{name} is {value!r}; give a whole number >= {least}")
    if given and starts > 1:
        raise InputError(f"starts is {starts}, but start gives a single one; leave one of the two out")
    if workers > 1 and callback is not None:
        raise InputError("callback is called in this process only: leave it out, or give workers=1")


def drawn(starts: int, seed: int) -> list[dict[str, Any]]:
    """Speed, noise and seed of each start's reach; the first one is unperturbed."""
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
    """Named initial guesses of drawn reaches, each made when it is needed."""
    # All draws up to the last, so that a worker's start is the one that a single process would draw.
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
    """Best solution from a problem's starts, with the cheapest collision model that is accurate enough.

    one : solves a problem from some of the starts, in this process.  start : kind of initial guess, or the
    given one.
    """
    if problem.collision == "auto":

        def run(chosen: ImpactProblem, other: AnySolution | None, left: Budget) -> AnySolution:
            # the second model starts from the first one's solution
            given, count = (start, starts) if other is None else (other, 1)
            return best_of_starts(one, chosen, given, left, starts=count, workers=workers)

        with stopping() as stop:
            return climbed(problem, run, replace(budget, stop=stop))
    if workers > 1 and starts > 1:
        # compiled here, not by each worker
        block_functions(with_room_for_gains(problem), budget.report)
        return _best_on_workers(partial(one, problem, start), budget, starts=starts, workers=workers)
    with stopping() as stop:
        return one(problem, start, replace(budget, stop=stop), range(starts), starts + EXTRA_STARTS)


def best_of(
    guesses: Guesses[Program],
    solve: Solve[Program],
    budget: Budget,
    count: int,
) -> Outcome[Program]:
    """Best outcome of several guesses, with the attempts of all.

    count : number of guesses. More are tried while all solutions are refused, such as for penetration, as
        another motion may pass a body on another side; but not after two refusals that are alike.

    The search ends after an interrupted solve, and when no time is left. Outcomes are compared by `rank_of`.
    """
    found = list[tuple[str, Outcome[Program]]]()
    alike = 1  # largest number of outcomes that are refused for the same reason
    for k, (name, make) in enumerate(guesses):
        if k >= count and (alike > 1 or not all(outcome.refused for _, outcome in found)):
            break
        budget.begin_start()
        new = solve(make())
        alike = max(alike, 1 + sum(_alike(new, outcome) for _, outcome in found))
        found.append((name, new))
        if new.result.status is Status.INTERRUPTED or budget.left == 0:
            break
    # Of equals the first one is kept.
    best = min((outcome for _, outcome in found), key=lambda outcome: rank_of(outcome.result))
    attempts = [replace(outcome.attempt(name), kept=outcome is best) for name, outcome in found]
    result = best.result
    if best.refused and alike > 1:
        result = replace(result, message=f"{result.message} {alike} of {len(found)} starts ended alike.")
    return replace(best, result=result, attempts=tuple(attempts))


def _alike(one: Outcome[Program], other: Outcome[Program]) -> bool:
    """True if both are refused with the same message but for its numbers, and similar violations."""
    text, other_text = (re.sub(r"[\d.]+", "", outcome.result.message) for outcome in (one, other))
    violations = (outcome.result.max_violation for outcome in (one, other))
    return one.refused and other.refused and text == other_text and math.isclose(*violations, rel_tol=ALIKE)


def _best_on_workers(
    run: Callable[[Budget, range, int], AnySolution], budget: Budget, *, starts: int, workers: int
) -> AnySolution:
    """Best of the solutions from each start, on worker processes, with the attempts of all in their order.

    run : picklable, as are its solutions.  budget : of all together; starts that have not begun when its time
    is over are left out. Ctrl-C keeps the solutions that are finished.

    Raises
    ------
    InputError : the problem cannot be pickled, or no worker has returned a solution.
    """
    try:
        pickle.dumps(run)
    except Exception as error:  # a user's own law or target may raise anything
        raise InputError(
            f"the problem cannot go to other processes: {error}; define its own laws, targets and terms in a "
            "module, or give workers=1"
        ) from None
    began = time.perf_counter()
    ends = None if budget.time_limit is None else time.time() + budget.time_limit
    found = dict[int, AnySolution]()
    jobs = each_on_workers(
        _one,
        # Functions of the caller may not be picklable.
        (run, replace(budget, report=None), ends),
        enumerate(range(starts)),
        workers=min(workers, starts),
    )
    # Closing ends the workers, also after Ctrl-C.
    with contextlib.closing(jobs):  # type: ignore[type-var]
        try:
            for k, solution in jobs:
                if isinstance(solution, Died):
                    message = f"start {k + 1} has died (exit code {solution.code})"
                elif solution is None:
                    message = f"start {k + 1} is left out: no time is left"
                else:
                    found[k] = solution
                    impulse = solution.attempts[-1].impulse
                    message = f"start {k + 1}: {impulse:.2f} N s, {solution.status.value}"
                budget.say(message)
        except KeyboardInterrupt:
            if not found:
                raise
    if not found:
        raise InputError("no start has ended: give more time, or workers=1 to see why")
    best = min(found.values(), key=lambda solution: rank_of(solution.result))
    # In the order of the starts, not in that in which workers ended.
    attempts = [
        replace(attempt, kept=attempt.kept and found[k] is best)
        for k in sorted(found)
        for attempt in found[k].attempts
    ]
    seconds = time.perf_counter() - began
    # Wall time of all starts; the best one's build is counted by itself.
    return replace(best, attempts=tuple(attempts), solve_seconds=seconds - best.build_seconds)


def _one(shared: tuple[Callable[..., Any], Budget, float | None], start: int) -> Any:
    """Solution from one start, in a worker; None if no time is left.

    shared : run, budget, and the time (of the wall clock, as processes share no other) at which it is over.
    """
    run, budget, ends = shared
    left = None if ends is None else ends - time.time()
    if left is not None and left <= 0:
        return None
    return run(replace(budget, time_limit=left), range(start, start + 1), start + 1)
