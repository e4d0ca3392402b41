"""The rounds of a strike: on with more rows between bodies, from where it is, until none are too near."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import changed

from impactopt.bodies.shapes import Obstacle
from impactopt.planning import strike as strikes
from impactopt.planning.keeping_apart import FAR, NEAR, Margins, rows_near
from impactopt.planning.multistart import Budget
from impactopt.planning.too_near import missing_rows
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.start import strike_iterate
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
ITERATIONS = 7


@pytest.fixture(scope="module")
def strike(arm_transcription: Transcription) -> StrikeTranscription:
    t = arm_transcription
    return StrikeTranscription(t.problem, t.coordinates, t.functions)


@dataclass(frozen=True, kw_only=True)
class Scripted(Budget):
    """Solves nothing: it ends as it is told to, where it starts, and keeps what it was asked for."""

    ends: tuple[Status, ...] = ()
    asked: list[dict[str, Any]] = field(default_factory=list)

    def run(self, program: Any, start: Array | SolverResult, barrier: float | None = None) -> SolverResult:
        status = self.ends[len(self.asked)]
        given = start if isinstance(start, SolverResult) else None
        self.asked.append({**(self.options or {}), "given": given, "from": barrier})
        return SolverResult(
            x=start if given is None else given.x,
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


@pytest.fixture
def rounds(
    strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[StrikeTranscription, SolverResult, list[dict[str, Any]]]]:
    """A strike with scripted solves, one row more after each of the first; ``deep``: which are of bodies in
    each other. The rows are those of near bodies, which its first program is kept from having.
    """

    def run(*ends: Status, deep: tuple[bool, ...] = (), options: dict[str, Any] | None = None) -> Any:
        margins = Margins(strike.problem)
        x = strike_iterate(strike)
        rows = list(rows_near(strike, x, margins, 1.0).items())
        left = [dict([row]) for row, _ in zip(rows, deep, strict=False)]
        how = list(deep)
        monkeypatch.setattr(strikes, "rows_near", lambda *_: {})
        monkeypatch.setattr(strikes, "missing_rows", lambda *_, **__: left.pop(0) if left else {})
        monkeypatch.setattr(strikes, "_depth", lambda *_: 0.01 * how.pop(0))
        budget = Scripted(solver="sqp", options=options, time_limit=None, callback=None, ends=ends)
        t, result = strikes.clear_strike(budget, margins, strike, x)
        return t, result, budget.asked

    return run


def test_a_round_goes_on_with_the_multipliers_and_none_for_its_new_row(rounds: Any) -> None:
    t, result, (first, second) = rounds(Status.SOLVED, Status.SOLVED, deep=(False,))
    assert first["given"] is None
    before = t.program.m - 1
    np.testing.assert_array_equal(second["given"].multipliers, [*np.arange(1.0, before + 1), 0.0])
    assert second["from"] == strikes.BARRIER_NEAR
    assert result.iterations == 2 * ITERATIONS, "the effort of all is told"


def test_bodies_in_each_other_are_led_out_roughly_and_the_end_is_exact(rounds: Any) -> None:
    _, _, (_, out, end) = rounds(*[Status.SOLVED] * 3, deep=(True,))
    assert out["from"] == strikes.BARRIER_DEEP
    assert out["kkt_tolerance"] == strikes.ROUGHLY["kkt_tolerance"]
    assert "kkt_tolerance" not in end and end["given"] is not None


def test_the_last_round_is_exact_however_deep_bodies_are(rounds: Any) -> None:
    n = strikes.ROUNDS
    _, _, asked = rounds(*[Status.SOLVED] * (n + 1), deep=(True,) * n)
    assert ["kkt_tolerance" in each for each in asked] == [*[True] * n, False]


def test_a_round_that_is_stuck_begins_again_without_multipliers(rounds: Any) -> None:
    _, result, (*_, again) = rounds(Status.SOLVED, Status.FAILED, Status.SOLVED, deep=(True,))
    assert again["given"] is None and "kkt_tolerance" not in again
    assert result.status is Status.SOLVED and result.iterations == 3 * ITERATIONS


def test_what_no_round_mends_is_a_result_of_its_own_program(rounds: Any) -> None:
    t, result, _ = rounds(*[Status.SOLVED] * 2, Status.FAILED, Status.INFEASIBLE, deep=(False, False))
    assert result.status is Status.SOLVED
    assert result.multipliers.size == t.program.m and len(t.apart_rows) == 1


def test_solvers_of_whole_qps_do_not_repeat_a_round_that_has_failed(rounds: Any) -> None:
    ends = Status.SOLVED, Status.FAILED
    _, result, asked = rounds(*ends, deep=(False,), options={"qp_solver": "osqp"})
    assert result.status is Status.SOLVED and len(asked) == 2
    assert not any("kkt_tolerance" in each for each in asked), "they go on from a solution in a few steps"


def test_where_few_rows_lead_nowhere_it_begins_with_those_of_all_that_is_far(
    strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> None:
    within = list[float]()

    def near(*given: Any) -> dict[Any, Any]:
        within.append(given[-1])
        return {}

    monkeypatch.setattr(strikes, "rows_near", near)
    monkeypatch.setattr(strikes, "missing_rows", lambda *_, **__: {})
    ends = Status.FAILED, Status.SOLVED, Status.SOLVED
    budget = Scripted(solver="sqp", options=None, time_limit=None, callback=None, ends=ends)
    _, result = strikes.clear_strike(budget, Margins(strike.problem), strike, strike_iterate(strike))
    assert within == [NEAR, FAR]
    assert result.status is Status.SOLVED and result.iterations == 3 * ITERATIONS, "the effort of all is told"


def test_a_rough_result_is_never_told_as_a_solution(rounds: Any) -> None:
    ends = *[Status.SOLVED] * 3, Status.TIME_LIMIT
    t, result, _ = rounds(*ends, deep=(False, True))
    assert len(t.apart_rows) == 1 and result.multipliers.size == t.program.m, "but the one before it"
    assert result.status is Status.SOLVED and result.iterations == 4 * ITERATIONS
    _, result, _ = rounds(Status.SOLVED, Status.TIME_LIMIT, deep=(True,))
    assert result.status is Status.TIME_LIMIT
    t, result, _ = rounds(Status.SOLVED, Status.SOLVED, Status.INTERRUPTED, deep=(True,))
    assert result.status is Status.INTERRUPTED and result.multipliers.size == t.program.m


def test_it_ends_with_bodies_apart_though_it_began_with_no_row_for_them(
    arm_transcription: Transcription, strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A box stands where the elbow is when the arm hits hardest."""
    budget = Budget(solver="sqp", options=None, time_limit=None, callback=None)
    free = budget.run(strike.program, strike_iterate(strike))
    model = strike.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, strike.decode(free.x).posture)
    elbow = data.oMi[model.getJointId("elbow")]
    box = Obstacle(name="box", size=(0.06, 0.06, 0.06), position=elbow.act(np.array([0.0, 0.07, 0.0])))
    of_box = changed(arm_transcription, obstacles=(box,))
    t = StrikeTranscription(of_box.problem, of_box.coordinates, of_box.functions)
    margins = Margins(t.problem)
    assert missing_rows(t, free.x, margins)
    monkeypatch.setattr(strikes, "FAR", -1.0)
    t, result = strikes.clear_strike(budget, margins, t, strike_iterate(t))
    assert result.status is Status.SOLVED and result.kkt <= 1e-6 and result.max_violation <= 1e-6
    assert t.apart_rows and not missing_rows(t, result.x, margins)
    assert result.iterations == result.history[-1].iteration


def test_a_strike_whose_bodies_stay_in_each_other_is_none(
    strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = next(iter(rows_near(strike, strike_iterate(strike), Margins(strike.problem), 1.0)))
    monkeypatch.setattr(strikes, "missing_rows", lambda *_, **__: {row: None})
    monkeypatch.setattr(strikes, "_depth", lambda *_: 0.012)
    budget = Scripted(solver="sqp", options=None, time_limit=None, callback=None, ends=(Status.SOLVED,))
    solved = budget.run(strike.program, strike_iterate(strike))
    monkeypatch.setattr(strikes, "clear_strike", lambda *_: (strike, solved))
    _, result = strikes._clean_strike(budget, Margins(strike.problem), strike, strike_iterate(strike))
    assert result.status is Status.FAILED and "12.0 mm in each other" in result.message


def test_with_rows_on_demand_it_goes_on_from_the_solution_without_them(
    strike: StrikeTranscription, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strikes, "missing_rows", lambda *_, **__: {})
    ends = Status.SOLVED, Status.FAILED, Status.SOLVED, Status.SOLVED
    budget = Scripted(solver="sqp", options=None, time_limit=None, callback=None, ends=ends)
    solved = budget.run(strike.program, strike_iterate(strike))
    _, result = strikes.clear_strike(budget, Margins(strike.problem), strike, solved)
    _, on, anew, _ = budget.asked
    assert on["given"] is solved and on["from"] == strikes.BARRIER_DEEP
    assert anew["given"] is None, "where that leads nowhere"
    assert result.status is Status.SOLVED and result.iterations == 3 * ITERATIONS
