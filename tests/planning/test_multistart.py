"""Starts: their limits, and those beyond the ones asked for, while solutions are refused and differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from support.small_plans import Planned

from impactopt import NotSolvedWarning, Status, load_problem, solve
from impactopt.planning import multistart
from impactopt.planning.budget import Budget
from impactopt.planning.multistart import best_of
from impactopt.planning.refinement import Guess, Outcome
from impactopt.solvers.program import SolverResult
from impactopt.transcription.transcription import Transcription

DEEP = "Bodies penetrate each other by {:.1f} mm, and no motion was found in which they do not: {}."


def found(plan: Planned, refusals: Sequence[tuple[float, str] | None]) -> Outcome[Transcription]:
    """Best of starts that end with penetrations [mm] of pairs, or with a solution; one was asked for."""
    program, good = plan.transcription, plan.result
    ends = iter(refusals)

    def solved(guess: Guess[Transcription]) -> Outcome[Transcription]:
        end = next(ends)
        if end is None:
            return Outcome.of(guess.program, good)
        depth, pair = end
        refused = {
            "status": Status.FAILED,
            "max_violation": 1e-3 * depth,
            "message": DEEP.format(depth, pair),
        }
        return Outcome.of(guess.program, replace(good, **refused))

    def guess() -> Guess[Transcription]:
        return Guess(program=program, start=good.x)

    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    return best_of([(f"reach {k}", guess) for k in range(3)], solved, budget, 1)


def test_two_starts_that_end_alike_are_the_last(arm_plan: Planned) -> None:
    best = found(arm_plan, [(20.0, "arm and board"), (20.4, "arm and board"), None])
    assert len(best.attempts) == 2 and not best.usable
    assert best.result.message.endswith("2 of 2 starts ended alike.")


@pytest.mark.parametrize("second", [(30.0, "arm and board"), (20.0, "hand and board")])
def test_starts_that_end_otherwise_are_followed_by_another(
    arm_plan: Planned, second: tuple[float, str]
) -> None:
    best = found(arm_plan, [(20.0, "arm and board"), second, None])
    assert len(best.attempts) == 3 and best.usable
    assert [attempt.kept for attempt in best.attempts] == [False, False, True]
    assert "alike" not in best.result.message


@pytest.mark.parametrize(
    ("message", "kept"),
    [
        ("Bodies keep less than half of their clearance: arm and board 1 mm instead of 10.", 1),
        (Status.ACCEPTABLE.message, 0),  # of the solver, for a motion that keeps all clearances
    ],
)
def test_a_plan_that_loses_a_clearance_goes_after_one_that_keeps_all(
    arm_plan: Planned, message: str, kept: int
) -> None:
    program, good = arm_plan.transcription, arm_plan.result
    harder = replace(good, status=Status.ACCEPTABLE, message=message, objective=good.objective - 1.0)
    ends = iter([harder, good])
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    guess = Guess(program=program, start=good.x)
    best = best_of(
        [(f"reach {k}", lambda: guess) for k in range(2)],
        lambda guess: Outcome.of(guess.program, next(ends)),
        budget,
        2,
    )
    assert [attempt.kept for attempt in best.attempts] == [k == kept for k in range(2)]


@pytest.mark.slow
def test_a_limit_of_iterations_is_of_all_programs_of_each_start() -> None:
    """The seventh iterate of this arm lacks a clearance constraint, so that a second program is solved."""
    with pytest.warns(NotSolvedWarning, match="iteration limit"):
        solution = solve(load_problem("arm7"), options={"max_iterations": 10}, starts=2)
    assert solution.status is Status.ITERATION_LIMIT
    assert [attempt.iterations for attempt in solution.attempts] == [10, 10]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_start_that_loses_a_limit_goes_after_one_that_keeps_all(
    monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    """Only the best of all starts was checked, and was kept as acceptable beside solved ones."""
    arm = load_problem("arm7")

    def lost(result: SolverResult, *_: object) -> SolverResult:
        return (
            replace(result, status=Status.ACCEPTABLE, message="lost") if result.objective < limit else result
        )

    def each(one: Any, shared: Any, jobs: Any, **_: Any) -> Iterator[Any]:
        for k, start in jobs:
            yield k, one(shared, start)

    monkeypatch.setattr(multistart, "each_on_workers", each)  # the same process, which knows what is lost
    first, second = sorted(solve(arm, starts=2).attempts, key=lambda a: a.objective)
    limit = (first.objective + second.objective) / 2
    monkeypatch.setattr("impactopt.planning.solve.with_limits_kept", lost)
    again = solve(arm, starts=2, workers=workers)
    assert again.status is Status.SOLVED and again.result.objective == pytest.approx(second.objective)
