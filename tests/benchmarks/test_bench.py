"""The benches: what they measure, the keys of their JSON, files and errors; solutions are made up."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fake_solution import (
    IMPULSE,
    PROBLEM_FILE,
    FakeSolution,
    MissingSolution,
    still_problem,
    still_solution,
)
from typer.testing import CliRunner

from benchmarks import replay, robustness, truth
from benchmarks.__main__ import app
from benchmarks.registry import BENCHES, run_bench
from benchmarks.report import Report, columns_table, make_table, save_report
from impactopt import (
    ImpactProblem,
    InputError,
    PerturbationRanges,
    Robustness,
    Solution,
    Status,
    draw_perturbations,
)
from impactopt.files.problem_file import ProblemFile
from impactopt.simulation import Simulation

HEADS = {"seconds", "versions", "machine"}

runner = CliRunner()


class Planner:
    """Stands in for `impactopt.planning.solve.solve`."""

    def __init__(self) -> None:
        self.status, self.kind = Status.SOLVED, FakeSolution

    def __call__(self, problem: ImpactProblem, **_options: Any) -> Solution:
        return still_solution(problem=problem, status=self.status, kind=self.kind)


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return still_problem()


@pytest.fixture(autouse=True)
def planner(monkeypatch: pytest.MonkeyPatch, problem: ImpactProblem, tmp_path: Path) -> Planner:
    """No solver and no big robot; one problem file in the directory that the benches run in."""
    planner = Planner()
    monkeypatch.setattr("benchmarks.planning.solve", planner)
    monkeypatch.setattr(ProblemFile, "build", lambda self: problem)
    monkeypatch.setattr(truth, "VARIANTS", {})
    monkeypatch.setattr(truth, "RUBBING", ())
    (tmp_path / "problems").mkdir()
    (tmp_path / "problems" / "punch.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return planner


def quiet(_text: str) -> None:
    pass


# ---------------------------------------------------------------- robustness
@pytest.mark.slow
def test_robustness_says_how_many_stand_and_keeps_every_draw() -> None:
    report = robustness.run(quiet, draws=2, workers=1)
    numbers = report.numbers
    assert numbers["draws"] == 2 and numbers["standing"] in (0, 1, 2)
    assert numbers["standing_rate"] == numbers["standing"] / 2
    assert numbers["standing"] == sum(numbers["rows"]["standing"])
    assert numbers["impulse_mean_Ns"] == pytest.approx(np.mean(numbers["rows"]["impulse_Ns"]))
    assert numbers["impulse_std_Ns"] == pytest.approx(np.std(numbers["rows"]["impulse_Ns"]))
    assert {len(column) for column in numbers["rows"].values()} == {2}
    assert sum(numbers["reasons"].values()) == 2 - numbers["standing"]


@pytest.mark.parametrize("stand", [True, False])
def test_a_table_of_draws_that_all_stand_or_all_fall_has_no_nan(stand: bool) -> None:
    """There is no mean of those that fall, or stand."""
    found = Robustness(
        perturbations=draw_perturbations(2),
        drawn_from=PerturbationRanges(),
        standing=np.full(2, stand),
        reason=("" if stand else "diverged",) * 2,
        impulse=np.full(2, 14.0 if stand else np.nan),
        slip=np.zeros(2),
        lift=np.zeros(2),
        planned_impulse=14.0,
    )
    tables = robustness.tables_of(found, "punch", still_solution().validate())
    cells = [cell for table in tables for column in table.columns for cell in column.cells]
    assert "-" in cells and not any("nan" in str(cell) for cell in cells)


def test_the_robust_problem_is_measured_where_there_is_one_and_solved(
    planner: Planner, tmp_path: Path
) -> None:
    planner.status = Status.TIME_LIMIT
    with pytest.raises(InputError, match=r"plan of problems/punch\.toml is not usable"):
        robustness.run(quiet, draws=1, workers=1)
    (tmp_path / "problems" / "punch_robust.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    with pytest.raises(InputError, match=r"plan of problems/punch_robust\.toml is not usable"):
        robustness.run(quiet, draws=1, workers=1)


# ---------------------------------------------------------------- replay
class FirstOrder(FakeSolution):
    """Its replays are off by 3 % for a millisecond's step, and in proportion."""

    def validate(self, *, engine: str = "", step: float = 0.0, **options: Any) -> Simulation:
        simulation = super().validate()
        off = 1 + 30 * step + (0.01 if options.get("iterations") == 10 else 0.0)
        peak = off * simulation.peak_force
        return dataclasses.replace(simulation, impulse=off * simulation.impulse, peak_force=peak)


class Diverging(FirstOrder):
    """Its replays diverge with large steps."""

    def validate(self, *, engine: str = "", step: float = 0.0, **options: Any) -> Simulation:
        if step > 1e-4:
            raise InputError("the simulation diverged")
        return super().validate(engine=engine, step=step, **options)


def test_replay_finds_the_order_of_the_error(planner: Planner) -> None:
    planner.kind = FirstOrder
    numbers = replay.run(quiet).numbers
    # the smallest step's own error bends the line a little: log((h - e) / (h' - e)) over log(h / h')
    assert numbers["order"] == pytest.approx(1.0, abs=0.08)
    assert [row["step"] for row in numbers["steps"]] == sorted(replay.STEPS, reverse=True)
    finest = numbers["steps"][-1]
    assert finest["impulse_change_pct"] == finest["base_change_mm"] == 0.0
    for row in numbers["steps"]:
        expected = 100 * ((1 + 30 * row["step"]) / (1 + 30 * replay.STEPS[-1]) - 1)
        assert row["impulse_change_pct"] == pytest.approx(expected)
        assert row["peak_force_change_pct"] == pytest.approx(expected)


def test_other_settings_are_compared_at_the_same_step(planner: Planner) -> None:
    planner.kind = FirstOrder
    changes = {row["setting"]: row["impulse_change_pct"] for row in replay.run(quiet).numbers["settings"]}
    assert list(changes) == list(replay.OTHERS)
    for name, change in changes.items():
        expected = 1.0 / (1 + 30 * replay.STEP) if name == "iterations 10" else 0.0
        assert change == pytest.approx(expected, abs=1e-9), name


def test_a_replay_that_diverges_is_a_row_without_numbers(planner: Planner) -> None:
    planner.kind = Diverging
    report = replay.run(quiet)
    coarse = report.numbers["steps"][0]
    assert coarse == {"step": 7e-4, "standing": None, "reason": "the simulation diverged"}
    assert report.numbers["settings"] == []
    assert report.figures["replay"]() is not None


def test_the_smallest_step_must_work(planner: Planner) -> None:
    planner.kind = Diverging
    with pytest.raises(InputError, match=r"smallest step, 0\.001 s, fails: the simulation diverged"):
        replay.run(quiet, steps=(1e-3,))


# ---------------------------------------------------------------- truth
def test_truth_has_a_row_for_every_problem_file(tmp_path: Path) -> None:
    (tmp_path / "problems" / "another.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    rows = truth.run(quiet).numbers["rows"]
    assert [row["problem"] for row in rows] == ["another.toml", "punch.toml"]
    for row in rows:
        assert row["status"] == "solved" and row["impulse_planned_Ns"] == IMPULSE
        assert row["impulse_error_pct"] == pytest.approx(1.0)  # as the made-up replay has it
        assert row["replay_impulse_error_pct"] == pytest.approx(1.0)
        assert {"zmp_margin_m", "torque_ratio", "force_held", "cop_planned", "replay_slip_mm"} <= row.keys()
        assert "standing" in row


def test_truth_keeps_what_fails(planner: Planner, tmp_path: Path) -> None:
    (tmp_path / "problems" / "broken.toml").write_text("[problem]\n", encoding="utf-8")
    planner.kind = MissingSolution
    broken, missed = truth.run(quiet).numbers["rows"]
    assert broken["status"] == "error" and "broken.toml" in broken["error"]
    assert missed["status"] == "solved" and "impulse_planned_Ns" in missed and missed["error"]


def test_the_demo_is_a_row_once() -> None:
    truth.VARIANTS["demo"] = {}
    assert [name for name, _ in truth.problems(Path("problems"), quiet)] == ["punch.toml"]
    Path("problems/punch.toml").unlink()
    assert [name for name, _ in truth.problems(Path("problems"), quiet)] == ["demo"]


# ---------------------------------------------------------------- reports
def test_what_is_not_finite_is_null_in_json(tmp_path: Path) -> None:
    report = Report(name="made up", numbers={"a": [np.float64("nan"), 1.0], "b": np.int64(3)})
    (path,) = save_report(report, tmp_path)
    assert json.loads(path.read_text(encoding="utf-8")) == {"a": [None, 1.0], "b": 3}


def test_cells_are_text_not_markup() -> None:
    table = make_table("a [red]", ["b [red]"], [["c [red]"]])
    assert list(table.columns[0].cells) == ["c \\[red]"]


def test_rows_by_key_fill_columns() -> None:
    columns = (("what", "name", 0), ("a", "a", 2), ("b", "b", ".1e"), ("c", "c", 0))
    rows = [{"name": "one", "a": 1.2345, "b": 1.2345e-5, "c": True, "unseen": 1}, {"name": "two", "a": None}]
    table = columns_table("title", columns, rows)
    assert [column.header for column in table.columns] == ["what", "a", "b", "c"]
    found = [list(column.cells) for column in table.columns]
    assert found == [["one", "two"], ["1.23", "-"], ["1.2e-05", "-"], ["yes", "-"]]


def test_every_report_says_where_it_comes_from() -> None:
    numbers = run_bench("truth", quiet).numbers
    assert numbers.keys() >= HEADS
    assert numbers["machine"].keys() == {"platform", "processor", "cpus"}
    assert {"impactopt", "mujoco", "pin"} <= numbers["versions"].keys()


# ---------------------------------------------------------------- commands
def run(*arguments: str) -> Any:
    return runner.invoke(app, [*arguments])


@pytest.mark.slow
def test_json_has_the_keys_that_are_promised() -> None:
    result = run("robustness", "problems/punch.toml", "--draws", "1", "--workers", "1", "--json")
    assert result.exit_code == 0, result.output
    numbers = json.loads(result.stdout)
    assert {"draws", "standing", "impulse_mean_Ns", "impulse_std_Ns"} | HEADS <= numbers.keys()
    assert numbers["problem"] == "problems/punch.toml"


def test_out_keeps_numbers_and_pictures(planner: Planner) -> None:
    planner.kind = FirstOrder
    result = run("replay", "--out", "kept", "--quiet")
    assert result.exit_code == 0, result.output
    assert {path.name for path in Path("kept").iterdir()} == {"replay.json", "replay.png"}
    assert "replay.json, replay.png" in result.stdout and result.stderr == ""
    assert json.loads(Path("kept/replay.json").read_text(encoding="utf-8")).keys() >= HEADS


@pytest.mark.slow
def test_all_runs_every_bench(planner: Planner, monkeypatch: pytest.MonkeyPatch) -> None:
    planner.kind = FirstOrder
    benches = {name: f"benchmarks.{name}" for name in ("truth", "robustness", "replay")}
    monkeypatch.setattr("benchmarks.registry.BENCHES", benches)
    result = run("all", "--draws", "1", "--workers", "1", "--out", "kept", "--json")
    assert result.exit_code == 0, result.output
    assert list(json.loads(result.stdout)) == list(benches)
    names = {path.name for path in Path("kept").iterdir()}
    assert names == {*(f"{name}.json" for name in benches), "robustness.png", "replay.png"}


def test_every_bench_has_a_command() -> None:
    result = run("--help")
    assert result.exit_code == 0
    assert all(name in result.stdout for name in [*BENCHES, "all"])


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nothing"], "nothing"),
        (["robustness", "--draws", "0"], "--draws"),
        (["robustness", "--draws", "many"], "--draws"),
        (["robustness", "--seed", "-1"], "--seed"),
        (["robustness", "--workers", "0"], "--workers"),
        (["robustness", "problems/punc.toml"], "did you mean 'punch.toml'"),
        (["replay", "--out", "problems/punch.toml"], "cannot make the directory"),
    ],
)
def test_bad_input_is_one_message_and_exit_code_2(arguments: list[str], text: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert text in result.output and "Traceback" not in result.output


def test_an_unknown_bench_is_named_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no bench 'thruth' \(did you mean 'truth'\?\): there are truth"):
        run_bench("thruth", quiet)
