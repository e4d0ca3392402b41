"""What feedback is worth: what is loosened, a row a controller, rows that are kept, and the picture."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fake_solution import still_problem
from typer.testing import CliRunner

from benchmarks import feedback
from benchmarks.__main__ import app
from benchmarks.pictures.feedback import COLOURS
from benchmarks.report import Report
from impactopt import (
    Balance,
    ContactWrenchCone,
    PerturbationRanges,
    Robustness,
    Status,
    TorqueLimit,
    draw_perturbations,
)
from impactopt.simulation import ControllerSettings

IMPULSES = {"stated": 14.0, "loosened": 15.0}
SLIP = np.array([1e-3, 0.5, 3e-3, 4e-3])  # [m] of four draws; with the servo the second falls


class World:
    """Stands in for solver and replays, and keeps what they were asked."""

    def __init__(self) -> None:
        self.planned: list[str] = []
        self.controllers: list[ControllerSettings | None] = []
        self.status = Status.SOLVED

    def solved(self, _file: Path, _say: Any, change: Any) -> Any:
        balance = "stated" if change is None else "loosened"
        self.planned.append(balance)

        def validate(*, controller: Any, **_options: Any) -> Any:
            return SimpleNamespace(impulse=1.01 * IMPULSES[balance], standing=controller is not None)

        given = {"problem": None, "trajectory": None, "validate": validate, "status": self.status}
        return SimpleNamespace(impulse=IMPULSES[balance], **given)

    def robustness(self, *_given: Any, draws: int, controller: Any, **_options: Any) -> Robustness:
        self.controllers.append(controller)
        stands = np.array([True, controller is not None, True, True])
        return Robustness(
            perturbations=draw_perturbations(draws),
            drawn_from=PerturbationRanges(),
            standing=stands,
            reason=tuple("" if s else "fell" for s in stands),
            impulse=np.full(4, 14.0),
            slip=SLIP,
            lift=np.zeros(4),
            planned_impulse=14.0,
        )


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> World:
    world = World()
    for name in ("solved", "robustness"):
        monkeypatch.setattr(feedback, name, getattr(world, name))
    monkeypatch.chdir(tmp_path)
    return world


def measured(**options: Any) -> Report:
    return feedback.run(lambda _text: None, **{"problems": ["punch"], "draws": 4, **options})


def test_what_is_loosened_are_places_of_pressure_and_the_capture_point() -> None:
    own = (
        ContactWrenchCone(margin=0.02, friction=0.4),
        Balance(angular_momentum=5.0),
        TorqueLimit(fraction=0.8),
    )
    loose = feedback.loosened(still_problem(terms=own))
    cone, balance = loose.term(ContactWrenchCone), loose.term(Balance)
    assert (cone.margin, cone.collision_margin, balance.capture_margin) == (0.0, 0.0, None)
    assert (cone.friction, balance.angular_momentum) == (0.4, 5.0) and loose.term(TorqueLimit) == own[2]
    assert len(loose.terms) == 3


def test_a_plan_is_made_once_and_replayed_with_both_controllers(world: World) -> None:
    rows = measured().numbers["rows"]
    assert [(row["balance"], row["controller"]) for row in rows] == [
        (balance, controller) for balance in IMPULSES for controller in ("servo", "wbc")
    ]
    assert world.planned == list(IMPULSES)
    assert [chosen is None for chosen in world.controllers] == [True, False] * 2
    servo, wbc = rows[:2]
    assert (servo["standing"], servo["standing_rate"], wbc["standing_rate"]) == (3, 0.75, 1.0)
    assert (servo["nominal_standing"], wbc["nominal_standing"]) == (False, True)
    assert servo["slip_median_mm"] == pytest.approx(3.0) and servo["slip_most_mm"] == pytest.approx(4.0)
    assert wbc["impulse_planned_Ns"] == 14.0 and wbc["impulse_replayed_Ns"] == pytest.approx(14.14)


def test_rows_of_the_same_draws_are_not_measured_again(world: World) -> None:
    before = measured().numbers["rows"]
    assert measured(resume=True).numbers["rows"] == before
    assert len(world.planned) == 2
    measured(resume=True, seed=1)
    assert len(world.planned) == 4


def test_a_plan_that_is_none_is_its_status(world: World) -> None:
    world.status = Status.TIME_LIMIT
    report = measured()
    assert {row["status"] for row in report.numbers["rows"]} == {Status.TIME_LIMIT.value}
    assert not world.controllers
    assert not report.figures["feedback"]().axes[0].containers


def test_the_picture_has_each_share_over_its_impulse() -> None:
    (axes,) = measured().figures["feedback"]().axes
    points = {
        (line.get_color(), float(line.get_xdata()[0])): float(line.get_ydata()[0])
        for line in axes.lines
        if line.get_marker() in ("o", "^")
    }
    servo, wbc = (colour for colour, _ in COLOURS.values())
    assert points == {(servo, 14.0): 75.0, (servo, 15.0): 75.0, (wbc, 14.0): 100.0, (wbc, 15.0): 100.0}
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert {float(line.get_ydata()[0]) for line in crosses} == {75.0}, (
        "with the servo alone it falls as planned"
    )


def test_the_command_takes_problems() -> None:
    arguments = ["feedback", "--problem", "punch", "--draws", "4", "--workers", "1", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert {row["problem"] for row in json.loads(result.stdout)["rows"]} == {"punch"}
    assert Path("results/bench/feedback.jsonl").exists()
