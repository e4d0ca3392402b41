"""Strikes whose bodies keep apart: with constraints that enter on the way, from a solution or the start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import changed

from impactopt import Obstacle, Status
from impactopt.planning import strike as strikes
from impactopt.planning.budget import Budget
from impactopt.planning.clearance_constraints import Margins, deepest_penetration
from impactopt.planning.refinement import Guess, Outcome
from impactopt.solvers.program import SolverResult
from impactopt.transcription.initial_guess import strike_iterate
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
ITERATIONS = 7


@pytest.fixture(scope="module")
def strike(arm_transcription: Transcription) -> StrikeTranscription:
    t = arm_transcription
    return StrikeTranscription(t.problem, t.functions)


@dataclass(frozen=True, kw_only=True)
class Scripted(Budget):
    """Solves nothing: it ends as it is told to, where it starts, and keeps what it was asked for."""

    ends: tuple[Status, ...] = ()
    asked: list[dict[str, Any]] = field(default_factory=list)

    def run(self, program: Any, start: Array | SolverResult, *given: Any, **more: Any) -> SolverResult:
        status = self.ends[len(self.asked)]
        result = start if isinstance(start, SolverResult) else None
        barrier = given[0] if given else None
        self.asked.append({"given": result, "from": barrier})
        return SolverResult(
            x=start.x if isinstance(start, SolverResult) else start,
            multipliers=np.arange(1.0, program.m + 1),
            bound_multipliers=np.ones(program.n),
            objective=0.0,
            status=status,
            iterations=ITERATIONS,
            seconds=0.0,
            seconds_functions=0.0,
            seconds_qp=0.0,
            max_violation=0.0,
            kkt=0.0,
            message="",
        )


def boxed(arm_transcription: Transcription, strike: StrikeTranscription) -> tuple[Any, Array]:
    """The strike with a box where its elbow is when the arm hits hardest, and that blow."""
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    free = budget.run(strike.program, strike_iterate(strike))
    model = strike.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, strike.decode(free.x).posture)
    elbow = data.oMi[model.getJointId("elbow")]
    box = Obstacle(name="box", size=(0.06, 0.06, 0.06), position=elbow.act(np.array([0.0, 0.07, 0.0])))
    of_box = changed(arm_transcription, obstacles=(box,))
    return StrikeTranscription(of_box.problem, of_box.functions), free.x


@pytest.mark.parametrize(("solver", "options"), [("ipm", {}), ("sqp", {"qp_solver": "active_set"})])
def test_it_ends_with_bodies_apart_though_it_began_with_no_constraint_for_them(
    arm_transcription: Transcription, strike: StrikeTranscription, solver: str, options: dict[str, Any]
) -> None:
    """Other solvers than the interior-point method are not asked on the way, but at their end."""
    t, free = boxed(arm_transcription, strike)
    margins = Margins(t.problem)
    assert deepest_penetration(t, free, margins)[0] > 0
    budget = Budget(solver=solver, options=options, time_limit=None, callback=None)
    outcome = strikes.clear_strike(budget, margins, Guess(program=t, start=strike_iterate(t)))
    t, result = outcome.program, outcome.result
    assert result.status is Status.SOLVED and result.kkt <= 1e-6 and result.max_violation <= 1e-6
    assert t.clearance_constraints and deepest_penetration(t, result.x, margins)[0] <= 0
    assert result.multipliers.size == t.program.m
    assert result.iterations == result.history[-1].iteration, "the effort of all is told"


def test_a_strike_whose_bodies_stay_in_each_other_is_none(
    arm_transcription: Transcription, strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> None:
    t, free = boxed(arm_transcription, strike)
    budget = Scripted(solver="ipm", options=None, time_limit=None, callback=None, ends=(Status.SOLVED,))
    solved = budget.run(t.program, free)
    guess = Guess(program=t, start=free)
    monkeypatch.setattr(strikes, "clear_strike", lambda *_: Outcome.of(t, solved, guess))
    result = strikes._clean_strike(budget, Margins(t.problem), guess).result
    assert result.status is Status.FAILED and "Bodies penetrate each other" in result.message


def test_with_rows_on_demand_it_goes_on_from_the_solution_without_them(strike: StrikeTranscription) -> None:
    ends = Status.SOLVED, Status.FAILED, Status.SOLVED
    budget = Scripted(solver="ipm", options=None, time_limit=None, callback=None, ends=ends)
    solved = budget.run(strike.program, strike_iterate(strike))
    guess = Guess(program=strike, start=solved)
    result = strikes.clear_strike(budget, Margins(strike.problem), guess).result
    _, on, anew = budget.asked
    assert np.array_equal(on["given"].x, solved.x) and on["from"] == strikes.BARRIER_WARM
    assert anew["given"] is None, "where that leads nowhere"
    assert result.status is Status.SOLVED and result.iterations == 2 * ITERATIONS
