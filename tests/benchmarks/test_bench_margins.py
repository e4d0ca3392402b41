"""The bench of margins: what it changes, what it keeps of each plan, its picture and command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fake_solution import IMPULSE, PROBLEM_FILE, simulation_of, still_problem, still_solution
from typer.testing import CliRunner

from benchmarks import margins
from benchmarks.__main__ import app
from benchmarks.margins import OPTIONS, Option
from benchmarks.pictures.margins import margins_picture
from benchmarks.report import Report
from impactopt import (
    Balance,
    ContactWrenchCone,
    ImpactProblem,
    InputError,
    Perturbation,
    PerturbationRanges,
    Robustness,
    Scenario,
    Solution,
    Status,
    TorqueLimit,
    draw_perturbations,
)
from impactopt.files.problem_file import ProblemFile
from impactopt.simulation import Simulation

VALUES = [(option, value) for option in OPTIONS for value in option.values]
EXPECTED_SLIP = np.array([1e-3, 0.5, 3e-3, 2e-3])  # [m] of four draws; the second falls


class World:
    """Stands in for solver and replays, and keeps what they were asked; every plan is the same one."""

    def __init__(self, solution: Solution, simulation: Simulation) -> None:
        self.solution, self.simulation = solution, simulation
        self.problems: list[ImpactProblem] = []
        self.perturbation: list[Perturbation] = []
        self.status: dict[int, Status] = {}  # of the k-th plan, where it is not solved
        self.error: InputError | None = None

    def solve(self, problem: ImpactProblem, **_options: Any) -> Solution:
        self.problems.append(problem)
        if self.error is not None:
            raise self.error
        status = self.status.get(len(self.problems) - 1)
        if status is None:
            return self.solution
        result = replace(self.solution.result, status=status, message=status.message)
        return replace(self.solution, result=result)

    def simulate(
        self, _problem: ImpactProblem, _reference: Any, *, perturbation: Any = None, **_options: Any
    ) -> Simulation:
        self.perturbation.append(perturbation if perturbation is not None else Perturbation())
        return replace(self.simulation, fall="fell" if self.perturbation[-1].missing else "")

    def robustness(
        self, _problem: ImpactProblem, _reference: Any, impulse: float, **_options: Any
    ) -> Robustness:
        n = len(EXPECTED_SLIP)
        return Robustness(
            perturbations=draw_perturbations(n),
            drawn_from=PerturbationRanges(),
            standing=np.array([True, False, True, True]),
            reason=("", "fell", "", ""),
            impulse=np.full(n, impulse),
            slip=EXPECTED_SLIP,
            lift=np.zeros(n),
            planned_impulse=impulse,
        )


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    """With terms and a scenario of its own, which the base must drop."""
    return still_problem(terms=(Balance(capture_margin=0.01),), scenarios=(Scenario(name="heavy", mass=2.0),))


@pytest.fixture(scope="module")
def made_up(problem: ImpactProblem) -> tuple[Solution, Simulation]:
    """A plan, whose motion takes a second to complete, and its replay."""
    solution = still_solution(problem=problem)
    return solution, simulation_of(solution)


@pytest.fixture(autouse=True)
def world(
    monkeypatch: pytest.MonkeyPatch,
    problem: ImpactProblem,
    made_up: tuple[Solution, Simulation],
    tmp_path: Path,
) -> World:
    world = World(*made_up)
    for name in ("solve", "simulate", "robustness"):
        monkeypatch.setattr(margins, name, getattr(world, name))
    monkeypatch.setattr(ProblemFile, "build", lambda self: problem)
    (tmp_path / "problems").mkdir()
    (tmp_path / "problems" / "punch.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return world


def measured(**options: Any) -> Report:
    return margins.run(lambda _text: None, draws=4, workers=1, **options)


# ---------------------------------------------------------------- the sweep
@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_an_option_holds_the_base_once_also_in_the_short_sweep(option: Option) -> None:
    base = [value for value in option.values if not value.changes]
    assert len(base) == 1 and base[0].quick
    assert len({value.label for value in option.values}) == len(option.values)
    assert sum(value.quick for value in option.values) > 1


@pytest.mark.parametrize(("option", "value"), VALUES, ids=lambda x: getattr(x, "name", None) or x.label)
def test_a_value_says_what_it_sets(option: Option, value: margins.Value, problem: ImpactProblem) -> None:
    changed = replace(problem, **{"scenarios": (), "terms": (), **value.changes})
    balance, torque, cone = (changed.term(kind) for kind in (Balance, TorqueLimit, ContactWrenchCone))
    numbers = {
        "capture margin after impact": {1e3 * (balance.capture_margin or 0.0)},
        "angular momentum after impact": {balance.angular_momentum},
        "torque, of limit": {torque.fraction, torque.collision},
        "CoP margin of each sole": {1e3 * cone.margin, 1e3 * cone.collision_margin},
        "friction used": {cone.friction},
    }
    if option.name in numbers:
        for number in numbers[option.name]:
            assert number == pytest.approx(float(value.label))
        assert not changed.scenarios and len(changed.terms) <= 1
    elif option.unit == "mm" and value.changes:
        (missing,) = changed.scenarios
        assert missing.missing and 1e3 * missing.capture_margin == pytest.approx(float(value.label))
    elif value.changes:
        for scenario in changed.scenarios:
            assert scenario.missing or scenario.mass != 1 or scenario.stiffness != 1


def test_the_base_has_neither_scenarios_nor_terms_of_its_own_and_is_planned_once(world: World) -> None:
    rows = measured().numbers["rows"]
    first = world.problems[0]
    assert first.scenarios == () and first.terms == ()
    assert len(world.problems) == 1 + sum(bool(value.changes) for _, value in VALUES)
    assert [(row["option"], row["value"]) for row in rows] == [(o.name, v.label) for o, v in VALUES]
    assert sum(row["base"] for row in rows) == len(OPTIONS)


def test_the_short_sweep_has_fewer_values(world: World) -> None:
    rows = measured(quick=True).numbers["rows"]
    assert [(r["option"], r["value"]) for r in rows] == [(o.name, v.label) for o, v in VALUES if v.quick]
    assert max(len(p.scenarios) for p in world.problems) <= 2


# ---------------------------------------------------------------- a row
def test_a_plan_is_replayed_as_planned_without_target_and_under_draws(world: World) -> None:
    row = measured().numbers["rows"][0]
    assert [perturbation.missing for perturbation in world.perturbation[:2]] == [False, True]
    assert row["status"] == "solved" and row["impulse_planned_Ns"] == IMPULSE
    assert row["impulse_replayed_Ns"] == pytest.approx(1.01 * IMPULSE)  # as the made-up replay has it
    assert row["standing"] is True and row["standing_missing"] is False
    assert row["standing_rate"] == 0.75
    stands = EXPECTED_SLIP[[0, 2, 3]]
    assert row["slip_p95_mm"] == pytest.approx(1e3 * np.quantile(stands, 0.95))


@pytest.mark.slow
def test_a_plan_that_is_not_solved_is_a_row_with_its_status(world: World) -> None:
    world.status = {1: Status.TIME_LIMIT}
    report = measured()
    rows = report.numbers["rows"]
    assert rows[1]["status"] == Status.TIME_LIMIT.value and rows[1]["reason"] == Status.TIME_LIMIT.message
    assert rows[1]["impulse_planned_Ns"] is None and rows[1]["standing_rate"] is None
    assert all(row["status"] == "solved" for row in rows[2:])
    assert Status.TIME_LIMIT.value in list(report.tables[0].columns[1].cells)
    texts = [text.get_text().strip() for text in report.figures["margins"]().axes[0].texts]
    assert texts == [Status.TIME_LIMIT.value]


def test_what_cannot_be_planned_stays_in_with_its_reason(world: World) -> None:
    world.error = InputError("no way")
    report = measured(quick=True)
    assert {(row["status"], row["reason"]) for row in report.numbers["rows"]} == {("error", "no way")}
    assert report.figures["margins"]() is not None


# ---------------------------------------------------------------- picture and command
def test_the_picture_has_two_axes_an_option_on_common_scales() -> None:
    figure = margins_picture(measured(quick=True).numbers["rows"])
    axes = figure.axes
    assert len(axes) == 2 * len(OPTIONS) + 1  # and the legend's
    assert len({axes[2 * k].get_ylim() for k in range(len(OPTIONS))}) == 1


def test_a_point_is_filled_where_a_missing_target_is_survived() -> None:
    rows = measured(quick=True).numbers["rows"]
    name = rows[0]["option"]
    chosen = [{**row, "standing_missing": k > 0} for k, row in enumerate(rows) if row["option"] == name]
    points = [line for line in margins_picture(chosen).axes[0].lines if line.get_marker() == "o"]
    assert [line.get_markerfacecolor() == line.get_color() for line in points] == [False, True]


def test_the_command_keeps_numbers_and_picture() -> None:
    arguments = ["margins", "--quick", "--draws", "4", "--workers", "1", "--out", "kept", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert {path.name for path in Path("kept").iterdir()} == {"margins.json", "margins.png"}
    numbers = json.loads(result.stdout)
    assert numbers["draws"] == 4 and {"rows", "seed", "seconds", "versions"} <= numbers.keys()


def test_with_all_others_it_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def run_bench(name: str, _say: Any, **options: Any) -> Report:
        asked[name] = options
        return Report(name=name, numbers={})

    monkeypatch.setattr("benchmarks.registry.run_bench", run_bench)
    assert CliRunner().invoke(app, ["all", "--draws", "200", "--json"]).exit_code == 0
    assert asked["margins"]["quick"] and asked["margins"]["draws"] < 40
