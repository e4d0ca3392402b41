"""The bench of drawn problems: what is drawn, what rows say, and that none is lost; solutions are made up."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
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

from benchmarks import zoo
from benchmarks.__main__ import app
from benchmarks.zoo import BASES, cleanliness, draw, drawn_problem, row, run
from impactopt import FreeMass, ImpactProblem, InputError, Solution, Status, load_problem, standin
from impactopt.files.problem_file import ProblemFile
from impactopt.problem.feasibility import hopeless

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"


def quiet(_text: str) -> None:
    pass


@pytest.fixture(scope="module")
def punch() -> ImpactProblem:
    return load_problem(PROBLEMS / BASES["standin"].file)


# ---------------------------------------------------------------- what is drawn
def test_draws_are_within_what_is_said_and_fill_it(punch: ImpactProblem) -> None:
    around = np.array(BASES["standin"].around)
    drawn = [draw(punch, around, np.random.default_rng(k)) for k in range(400)]
    for name, bounds in (
        ("mass_kg", zoo.MASS),
        ("stiffness_N_m", zoo.STIFFNESS),
        ("damping_ratio", zoo.DAMPING_RATIO),
        ("swing_s", zoo.SWING),
    ):
        values = np.array([d[name] for d in drawn])
        low, high = bounds
        assert low <= values.min() and values.max() <= high, name
        # a quarter of them, more or less, in each quarter: of what is uniform
        scale = np.log if name in ("mass_kg", "stiffness_N_m") else np.asarray
        place = (scale(values) - scale(low)) / (scale(high) - scale(low))
        assert np.histogram(place, 4, (0, 1))[0].min() > 70, name
    for d in drawn:
        side = -1 if d["striker"] == "left_hand" else 1
        assert (np.abs(d["points"] - punch.point * [1, side, 1]) <= around).all()
        assert np.linalg.norm(d["normal"]) == pytest.approx(1.0)
        assert d["damping_N_s_m"] == pytest.approx(
            2 * d["damping_ratio"] * np.sqrt(d["stiffness_N_m"] * d["mass_kg"])
        )
    cosines = np.array([d["normal"] @ punch.normal for d in drawn])
    # heights on a sphere's cap are uniform
    assert np.histogram(cosines, 4, (np.cos(zoo.TILT), 1))[0].min() > 70
    assert 150 < sum(d["striker"] == "left_hand" for d in drawn) < 250


@pytest.mark.slow
def test_a_point_out_of_reach_is_drawn_again(punch: ImpactProblem) -> None:
    around = (0.5, 0.01, 0.01)
    for k in range(20):
        problem, numbers = drawn_problem(punch, around, np.random.default_rng(k), "far")
        if numbers["points_drawn"] > 1:
            break
    else:
        pytest.fail("half a metre away is within reach")
    points = draw(punch, around, np.random.default_rng(k))["points"]
    assert problem.point.tolist() == numbers["point_m"] == points[numbers["points_drawn"] - 1].tolist()
    for point in points[: numbers["points_drawn"] - 1]:
        with pytest.raises(InputError, match=r"out of (reach|balance)|beyond the target"):
            raise InputError(hopeless(dataclasses.replace(problem, point=point))[0])
    assert not hopeless(problem)
    assert problem.name == "far" and problem.striker == numbers["striker"]
    assert problem.swing.duration == (numbers["swing_s"],) * 2
    assert problem.swing.intervals == punch.swing.intervals and problem.terms == punch.terms
    # as problem files can say it, so that a row can be looked at
    assert repr(problem.target) == repr(FreeMass(mass=numbers["mass_kg"]))


def test_nothing_in_reach_is_an_error(punch: ImpactProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zoo, "TRIES", 2)
    monkeypatch.setattr("impactopt.problem.problem.inverse_kinematics", _unreachable)
    with pytest.raises(InputError, match="nowhere"):
        drawn_problem(punch, (0.1, 0.1, 0.1), np.random.default_rng(0))


def _unreachable(*_given: Any, **_options: Any) -> Any:
    raise InputError("nowhere")


# ---------------------------------------------------------------- rows
class Solver:
    """Stands in for `impactopt.solve`: problems in turn are solved, not solved, miss, and crash."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, problem: ImpactProblem, **_options: Any) -> Solution:
        self.calls += 1
        turn = (self.calls - 1) % 4
        if turn == 3:
            raise ZeroDivisionError("by zero")
        return still_solution(
            problem=still_problem(),
            status=Status.INFEASIBLE if turn == 1 else Status.SOLVED,
            kind=MissingSolution if turn == 2 else FakeSolution,
        )


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, punch: ImpactProblem) -> Solver:
    solver = Solver()
    monkeypatch.setattr(zoo, "solve", solver)
    monkeypatch.setattr(zoo, "load_problem", lambda _file: punch)
    monkeypatch.chdir(tmp_path)
    return solver


@pytest.mark.slow
def test_every_problem_is_a_row_whatever_becomes_of_it(solver: Solver) -> None:
    report = run(quiet, random=8, robot="standin", seed=3)
    numbers = report.numbers
    assert numbers["problems"] == len(numbers["rows"]) == 8 and numbers["seed"] == 3
    assert numbers["solved"] == 4 and numbers["standing"] == 2 and numbers["clean"] is None
    assert numbers["statuses"] == {"solved": 4, "infeasible": 2, "error": 2}
    assert numbers["worst_error_pct"] == pytest.approx(1.0)  # as the made-up replay has it
    assert numbers["median_seconds"] == pytest.approx(0.3)
    good, hopeless, missed, crashed = numbers["rows"][:4]
    assert good["impulse_planned_Ns"] == IMPULSE and good["stands"] is True
    assert good["impulse_replayed_Ns"] == pytest.approx(1.01 * IMPULSE)
    assert hopeless["reason"] and "stands" not in hopeless
    assert missed["status"] == "solved" and "never touched" in missed["error"]
    assert crashed["status"] == "error" and crashed["error"] == "ZeroDivisionError: by zero"
    drawn = {"robot", "number", "striker", "point_m", "normal", "mass_kg", "stiffness_N_m", "damping_N_s_m"}
    assert all(drawn <= r.keys() for r in numbers["rows"])
    assert [len(list(table.columns[0].cells)) for table in report.tables] == [8, 8]


@pytest.mark.slow
def test_a_robots_problems_are_the_same_however_many_are_drawn(solver: Solver) -> None:
    def drawn(**options: Any) -> dict[str, Any]:
        rows = run(quiet, seed=1, **options).numbers["rows"]
        return {r["problem"]: (r["point_m"], r["mass_kg"], r["swing_s"]) for r in rows}

    few, many = drawn(random=2, robot="standin"), drawn(random=6)
    assert list(many) == ["talos 0", "g1 0", "standin 0", "talos 1", "g1 1", "standin 1"]
    assert few == {name: many[name] for name in ("standin 0", "standin 1")}
    assert len({str(numbers) for numbers in many.values()}) == 6


@pytest.mark.slow
def test_rows_are_kept_as_they_come_and_taken_up(solver: Solver) -> None:
    class Stopped(BaseException):
        pass

    def stop(text: str) -> None:
        if text.startswith("2 of"):
            raise Stopped

    with pytest.raises(Stopped):
        run(stop, random=4, robot="standin")
    lines = zoo.ROWS.read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["problem"] for line in lines] == ["standin 0", "standin 1"]
    before = solver.calls
    rows = run(quiet, random=4, robot="standin", resume=True).numbers["rows"]
    assert solver.calls == before + 2 and [r["status"] for r in rows][:2] == ["solved", "infeasible"]
    # of another seed nothing is known, and without --resume all is made anew
    assert run(quiet, random=2, robot="standin", seed=1, resume=True).numbers["seed"] == 1
    assert solver.calls == before + 4
    run(quiet, random=1, robot="standin")
    assert len(zoo.ROWS.read_text(encoding="utf-8").splitlines()) == 1
    zoo.ROWS.write_text("nonsense", encoding="utf-8")
    with pytest.raises(InputError, match=r"zoo\.jsonl cannot be used"):
        run(quiet, random=1, resume=True)


def test_cleanliness_is_read_where_the_summary_has_it() -> None:
    def said(**replayed: Any) -> Any:
        return SimpleNamespace(summary=lambda replay: {"status": "solved", "replayed": replayed})

    nothing = {"clean": None, "clearance_mm": None, "contacts_besides": None}
    assert cleanliness(said(standing=True), None) == nothing
    clean = {"clean": True, "clearance_mm": 12.0, "contacts_besides": []}
    assert cleanliness(said(contacts_besides=[], clearance_mm=12.0), None) == clean
    assert cleanliness(said(contacts_besides=["hand and thigh"]), None)["clean"] is False
    made = row("one", lambda out: still_solution())
    assert made["stands"] is True and {name: made[name] for name in nothing} == nothing


@pytest.mark.slow
def test_clean_ones_are_counted(solver: Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    found = iter(({"clean": True}, {}, {"clean": False}))  # the second one misses
    monkeypatch.setattr(zoo, "cleanliness", lambda *_: next(found))
    numbers = run(quiet, random=8, robot="standin").numbers
    assert numbers["clean"] == 1 and [r["clean"] for r in numbers["rows"] if "clean" in r] == [True, False]


# ---------------------------------------------------------------- every file, and the command
@pytest.fixture
def files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Three files, of which one is wrong and one is hopeless."""
    monkeypatch.setattr("benchmarks.planning.solve", lambda problem, **_: still_solution())
    monkeypatch.setattr(ProblemFile, "build", lambda self: still_problem())
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "problems"
    folder.mkdir()
    for name in ("punch", "punch_infeasible"):
        (folder / f"{name}.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    (folder / "wrong.toml").write_text("[problem]\n", encoding="utf-8")
    return folder


def test_without_draws_every_file_is_a_row(files: Path) -> None:
    report = run(quiet)
    punch, wrong = report.numbers["rows"]
    assert punch["problem"] == "punch" and punch["stands"] is True and "mass_kg" not in punch
    assert wrong["problem"] == "wrong" and wrong["status"] == "error" and wrong["error"]
    assert len(report.tables) == 1
    own = still_problem().robot.name
    assert [r["problem"] for r in run(quiet, robot=own).numbers["rows"]] == ["punch"]
    with pytest.raises(InputError, match=r"no problem to solve in problems for the robot nobody"):
        run(quiet, robot="nobody")


def test_the_command(solver: Solver) -> None:
    runner = CliRunner()
    options = ["zoo", "--random", "3", "--robot", "standin", "--seed", "2", "--quiet", "--json"]
    done = runner.invoke(app, options)
    assert done.exit_code == 0, done.output
    numbers = json.loads(done.stdout)
    heads = {"problems", "solved", "standing", "clean", "worst_error_pct", "median_seconds", "seed", "rows"}
    assert heads <= numbers.keys() and numbers["problems"] == 3 and numbers["seed"] == 2
    for arguments, text in (
        (["--random", "0"], "--random"),
        (["--random", "1", "--robot", "standim"], "did you mean 'standin'"),
    ):
        bad = runner.invoke(app, ["zoo", *arguments])
        assert bad.exit_code == 2 and text in bad.output and "Traceback" not in bad.output


def test_the_bases_are_problems_of_their_robots() -> None:
    standin_base = load_problem(PROBLEMS / BASES["standin"].file)
    assert standin_base.robot.name == "standin"
    assert {"right_hand", "left_hand", "right_toe", "left_toe"} == set(standin().strikers)
    for base in BASES.values():
        text = (PROBLEMS / base.file).read_text(encoding="utf-8")
        assert 'striker = "right_hand"' in text and 0.1 <= min(base.around) <= max(base.around) <= 0.25
