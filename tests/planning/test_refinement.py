"""Order of the oracles in the refinement loop, failed additions, and the effort of all rounds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from impactopt import Slide, Status
from impactopt.planning.budget import Budget, rank_of
from impactopt.planning.diagnosis import with_limits_kept
from impactopt.planning.refinement import Additions, Guess, Outcome, refine
from impactopt.planning.solution import Solution
from impactopt.solvers.program import SolverResult

FAILS = -1.0  # a guess from which there is no solution


def solved(guess: Guess[Any]) -> Outcome[Any]:
    """Ten iterations from any guess, to a solution at the guess itself."""
    result = SolverResult(
        x=guess.x,
        multipliers=np.zeros(0),
        bound_multipliers=np.zeros(0),
        objective=0.0,
        status=Status.INFEASIBLE if FAILS in guess.x else Status.SOLVED,
        iterations=10,
        seconds=0.1,
        seconds_functions=0.0,
        seconds_qp=0.0,
        max_violation=float(FAILS in guess.x),
        kkt=0.0,
        message="Told.",
        history=(),
    )
    return Outcome.of(guess.program, result, guess)


PROGRAM: Any = SimpleNamespace(impulse=lambda x: float(x.sum()))


class Lacking:
    """Oracle that has one entry of x raised to a value, from guesses some of which fail."""

    most = 5
    of_refused = False

    def __init__(
        self, entry: int, value: float, asked: list[int], *, fails: int = 0, without: str = ""
    ) -> None:
        self.entry, self.value, self.asked, self.fails, self.without = entry, value, asked, fails, without

    def missing(self, outcome: Outcome[Any]) -> Additions[Any] | None:
        self.asked.append(self.entry)
        x = outcome.result.x
        if x[self.entry] >= self.value:
            return None

        def guesses() -> Iterator[Guess[Any]]:
            for k in range(2):
                there = np.where(np.arange(2) == self.entry, x + 1, 0 * x)  # loses what others have added
                yield Guess(program=PROGRAM, start=np.append(there, FAILS) if k < self.fails else there)

        return Additions(name="more", why="more", guesses=guesses(), without=self.without)


def refined(*oracles: Lacking) -> Outcome[Any]:
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    return refine(solved(Guess(program=PROGRAM, start=np.zeros(2))), oracles, solved, budget)


def test_what_an_oracle_adds_is_refined_by_those_before_it() -> None:
    asked = list[int]()
    found = refined(Lacking(0, 1.0, asked), Lacking(1, 2.0, asked))
    assert asked[:4] == [0, 0, 1, 0], "the second one is asked once the first lacks nothing"
    assert found.result.x[0] == 1.0, "and the first one again, of what the second one has led to"


@pytest.mark.parametrize("without", ["", "Without it there is a plan."])
def test_a_failed_addition_is_an_answer_only_if_it_is_needed(without: str) -> None:
    found = refined(Lacking(0, 1.0, [], fails=2, without=without))
    assert found.usable is not bool(without)
    assert found.result.message == f"Told. {without}".strip()


@pytest.mark.parametrize("without", ["", "Without it there is a plan."])
@pytest.mark.parametrize("value", [2.0, 3.0])
def test_the_solution_of_the_last_round_is_checked_too(value: float, without: str) -> None:
    oracle = Lacking(0, value, [], without=without)
    oracle.most = 2
    found = refined(oracle)
    assert found.result.x[0] == 2.0
    assert found.usable is (value == 2.0 or not without)
    assert found.usable or (found.result.message.endswith(without) and rank_of(found.result)[0])


@pytest.mark.parametrize("limit", ["velocity", "torque"])
def test_a_joint_beyond_its_limit_between_nodes_makes_a_plan_acceptable(
    hammered: Solution, limit: str
) -> None:
    """As when the time is over before the mesh is refined. The elbow's limit is lowered below its use."""
    robot, t = hammered.problem.robot, hammered.trajectory
    used = {"velocity": t.v, "torque": t.torque}[limit][:, robot.joint_index("elbow")]
    lower = np.array(getattr(robot, f"{limit}_limit"))
    lower[robot.joint_index("elbow")] = np.abs(used).max() / 1.05
    weaker = replace(robot, **{f"{limit}_limit": lower})
    given = hammered.result, hammered.plan, hammered.collision
    assert with_limits_kept(*given, robot) is hammered.result
    found = with_limits_kept(*given, weaker)
    assert found.status is Status.ACCEPTABLE
    assert f"elbow has 1.05 times its {limit} limit" in found.message


def test_a_slide_beyond_its_limit_between_points_makes_a_plan_acceptable(hammered: Solution) -> None:
    """The limit is lowered below the slide, along the tangent in the arm's plane."""
    for share, status in ((1.05, Status.ACCEPTABLE), (0.99, Status.SOLVED)):
        terms = (*hammered.problem.terms, Slide(most=hammered.slide / share))
        plan = replace(hammered.plan, problem=replace(hammered.problem, terms=terms))
        found = with_limits_kept(hammered.result, plan, hammered.collision, plan.problem.robot)
        assert found.status is status
        assert (f"slides {1e3 * hammered.slide:.3g} mm across" in found.message) == (share > 1)


def test_an_attempt_that_fails_worse_is_listed_too() -> None:
    """Its iterations were counted, and it was in no table."""
    first = solved(Guess(program=PROGRAM, start=np.array([0.0, FAILS])))
    first = replace(first, attempts=(first.attempt("reach 1"),))
    worse = replace(first, result=replace(first.result, max_violation=2.0))
    found = first.else_then(worse, "other posture")
    assert [(a.start, a.kept) for a in found.attempts] == [("reach 1", True), ("other posture", False)]
    assert found.result.max_violation == 1.0 and found.result.iterations == 20


def test_the_effort_of_all_guesses_and_rounds_is_counted() -> None:
    found = refined(Lacking(0, 2.0, [], fails=1))
    assert found.usable and found.result.x.tolist() == [2.0, 0.0]
    assert found.result.iterations == 10 + 2 * (10 + 10)
    assert [a.iterations for a in found.attempts] == [20, 20] and [a.kept for a in found.attempts] == [
        False,
        True,
    ]


@pytest.mark.parametrize("met", [True, False])
@pytest.mark.parametrize(("of_refused", "fails"), [(True, 0), (True, 2), (False, 0)])
def test_an_oracle_may_mend_a_refused_solution_but_no_violated_program(
    met: bool, of_refused: bool, fails: int
) -> None:
    """As a push that slides off its target, which its replay refuses until the slide is bounded."""
    own = SimpleNamespace(  # a program whose one constraint is met, or not
        x_lower=np.full(2, -np.inf),
        x_upper=np.full(2, np.inf),
        g_lower=np.array([0.0 if met else 1.0]),
        g_upper=np.ones(1),
        constraints=lambda x: np.zeros(1),
    )
    program: Any = SimpleNamespace(impulse=PROGRAM.impulse, program=own)

    def solve(guess: Guess[Any]) -> Outcome[Any]:
        outcome = solved(guess)
        if guess.x[0] > 0:
            return outcome
        failed = replace(outcome.result, status=Status.FAILED, max_violation=1.0)
        return replace(outcome, result=failed)

    asked = list[int]()
    oracle = Lacking(0, 1.0, asked, fails=fails, without="It slides.")
    oracle.of_refused = of_refused
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    first = solve(Guess(program=program, start=np.zeros(2)))
    assert first.refused is met
    found = refine(first, [oracle], solve, budget)
    assert bool(asked) is (met and of_refused)
    assert found.usable is (bool(asked) and not fails)
    assert found.usable or found.result.message == first.result.message, "the reason of the refusal stays"
