"""Starts on several processes: the same as one after the other, and what becomes of those that do not end."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from impactopt import ImpactProblem, InputError, Status, StrikeSolution, load_problem, optimize_strike, solve
from impactopt.planning import multistart, solution
from impactopt.simulation.workers import Died
from impactopt.transcription import plan as planned


@pytest.fixture(scope="module")
def arm() -> ImpactProblem:
    return load_problem("arm_planar")


@pytest.fixture(scope="module")
def strike(arm: ImpactProblem) -> StrikeSolution:
    return optimize_strike(arm)


@pytest.mark.slow
@pytest.mark.parametrize("plan", [optimize_strike, solve])
def test_processes_find_what_one_finds(plan: Any, arm: ImpactProblem) -> None:
    told: list[str] = []
    alone, both = plan(arm, starts=3), plan(arm, starts=3, workers=2, report=told.append)
    assert [a.start for a in both.attempts] == [a.start for a in alone.attempts]
    assert [a.kept for a in both.attempts] == [a.kept for a in alone.attempts]
    assert [a.impulse for a in both.attempts] == pytest.approx([a.impulse for a in alone.attempts], rel=1e-6)
    assert both.result.x == pytest.approx(alone.result.x, abs=1e-5)
    assert sum("N s, solved" in line for line in told) == 3


def test_a_problem_and_its_solution_are_pickled(arm: ImpactProblem, strike: StrikeSolution) -> None:
    again = pickle.loads(pickle.dumps(strike))
    assert again.impulse == strike.impulse
    assert np.array_equal(again.problem.coordinates.start, arm.coordinates.start)
    assert again.problem.hash == strike.problem.hash


def test_a_pickle_of_another_version_is_refused_with_both_versions(
    strike: StrikeSolution, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a class is looked for that this version may not have."""
    pickled = pickle.dumps(strike)
    made_by = solution.__version__
    monkeypatch.setattr(solution, "__version__", "99.0")
    monkeypatch.delattr(planned, "PlannedStrike")
    with pytest.raises(
        InputError, match=f"StrikeSolution was pickled by impactopt {re.escape(made_by)}, .* this is 99.0"
    ):
        pickle.loads(pickled)


def given(monkeypatch: pytest.MonkeyPatch, *found: Any) -> None:
    """Let these come of the first starts; an exception is raised in their place."""

    def each(*_: Any, **__: Any) -> Iterator[Any]:
        for k, one in enumerate(found):
            if isinstance(one, BaseException):
                raise one
            yield k, one

    monkeypatch.setattr(multistart, "each_on_workers", each)


def test_what_dies_or_gets_no_time_is_told(
    arm: ImpactProblem, strike: StrikeSolution, monkeypatch: pytest.MonkeyPatch
) -> None:
    given(monkeypatch, Died(code=-9, tries=1), None, strike)
    told: list[str] = []
    found = optimize_strike(arm, starts=3, workers=2, time_limit=60.0, report=told.append)
    assert found.impulse == strike.impulse
    assert [a.kept for a in found.attempts] == [True]
    assert any("start 1 has died (exit code -9)" in line for line in told)
    assert any("start 2 is left out" in line for line in told)


def test_one_that_meets_its_rows_goes_before_one_that_does_not(
    arm: ImpactProblem, strike: StrikeSolution, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = replace(strike.result, status=Status.FAILED, max_violation=1.0, objective=-1e3)
    given(monkeypatch, replace(strike, result=failed), strike)
    found = optimize_strike(arm, starts=2, workers=2)
    assert found.status is Status.SOLVED
    assert [a.kept for a in found.attempts] == [False, True]


def test_an_interrupt_keeps_what_is_there(
    arm: ImpactProblem, strike: StrikeSolution, monkeypatch: pytest.MonkeyPatch
) -> None:
    given(monkeypatch, strike, KeyboardInterrupt())
    assert optimize_strike(arm, starts=2, workers=2).impulse == strike.impulse
    given(monkeypatch, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        optimize_strike(arm, starts=2, workers=2)


def test_without_any_solution_it_says_so(arm: ImpactProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, Died(code=-9, tries=1), None)
    with pytest.raises(InputError, match="no start has ended"):
        optimize_strike(arm, starts=2, workers=2)


@pytest.mark.parametrize("plan", [optimize_strike, solve])
@pytest.mark.parametrize("name", ["callback", "report"])
def test_callbacks_are_functions(plan: Any, arm: ImpactProblem, name: str) -> None:
    with pytest.raises(InputError, match=f"{name} must be a function, not 3"):
        plan(arm, **{name: 3})


@pytest.mark.parametrize("plan", [optimize_strike, solve])
def test_bad_numbers_of_processes_are_refused(plan: Any, arm: ImpactProblem) -> None:
    for workers in (0, 1.5, True):
        with pytest.raises(InputError, match="workers"):
            plan(arm, starts=2, workers=workers)
    with pytest.raises(InputError, match="callback"):
        plan(arm, starts=2, workers=2, callback=lambda _: False)


def test_what_cannot_go_to_processes_is_told(arm: ImpactProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    class Local(type(arm.law)):  # type: ignore[misc]
        """A law that no other process knows."""

    own = replace(arm, law=Local(**{name: getattr(arm.law, name) for name in arm.law.parameters}))
    with pytest.raises(InputError, match=r"cannot go to other processes.*workers=1"):
        optimize_strike(own, starts=2, workers=2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::impactopt.NotSolvedWarning")
def test_another_posture_is_tried_once_whatever_starts_fail(
    arm: ImpactProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each failed start of its own process tried it, and took as long again."""

    def each(one: Any, shared: Any, jobs: Any, **_: Any) -> Iterator[Any]:
        run, budget, ends = shared
        for k, start in jobs:
            yield k, one((run, replace(budget, report=told.append), ends), start)

    def drawn(problem: ImpactProblem) -> Any:
        return problem.contact_posture + 0.05

    told: list[str] = []
    monkeypatch.setattr(multistart, "each_on_workers", each)
    quick = replace(arm, swing=replace(arm.swing, duration=(0.1, 0.15)))
    assert solve(quick, starts=2, workers=2).status is Status.INFEASIBLE
    assert not any("another posture" in line for line in told), "this arm has one posture"
    monkeypatch.setattr("impactopt.planning.solve.drawn_posture", drawn)
    assert solve(quick, starts=2, workers=2).status is Status.INFEASIBLE
    assert sum("another posture" in line for line in told) == 1
