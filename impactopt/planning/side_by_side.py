"""Starts of one problem on several processes: each goes its own way, and the best solution is kept."""

from __future__ import annotations

import contextlib
import pickle
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from impactopt.errors import InputError
from impactopt.planning.multistart import Budget, rank_of
from impactopt.planning.solution import Solved
from impactopt.simulation.workers import Died, each_on_workers

__all__ = ["best_side_by_side", "check_workers"]

AnySolution = TypeVar("AnySolution", bound=Solved)
# a budget, the numbers of the starts, and whom to tell -> what comes of them
Run = Callable[[Budget, range, None], AnySolution]


def check_workers(workers: int, callback: object) -> None:
    """InputError if this is no number of processes, or if a callback would have to go to them."""
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise InputError(f"workers is {workers!r}; give a whole number >= 1")
    if workers > 1 and callback is not None:
        raise InputError("callback is asked in this process alone: leave it out, or give workers=1")


def best_side_by_side(
    run: Run[AnySolution],
    budget: Budget,
    *,
    starts: int,
    workers: int,
    report: Callable[[str], None] | None,
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
    jobs = each_on_workers(_one, (run, budget, ends), enumerate(range(starts)), workers=min(workers, starts))
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
                if report is not None:
                    report(told)
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


def _one(shared: tuple[Run[Any], Budget, float | None], start: int) -> Any:
    run, budget, ends = shared
    left = None if ends is None else ends - time.time()
    if left is not None and left <= 0:
        return None
    return run(replace(budget, time_limit=left), range(start, start + 1), None)
