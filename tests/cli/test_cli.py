"""The command line: exit codes, what is printed where, what is written; no solver, but a made-up solution."""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fake_solution import PROBLEM_FILE, FakeSolution, MissingSolution, still_problem, still_solution
from typer.testing import CliRunner

import impactopt
from impactopt import ImpactProblem, InputError, Solution, Status, load_record
from impactopt.cli.app import app
from impactopt.files.problem_file import ProblemFile
from impactopt.files.record import Record
from impactopt.planning.refinement import Attempt
from impactopt.report.pictures import PICTURES
from impactopt.simulation.workers import Died
from impactopt.solvers.program import IterationRecord, Violation

GOOD = f"""\
{PROBLEM_FILE.replace("still", "[still]")}
[solver]
name = "ipopt"
time_limit_s = 40
[solver.ipopt]
max_iter = 7
[solver.ipm]
price = 50.0
"""
FILES = {"solution.npz", "summary.json", *(f"{name}.png" for name in PICTURES)}

runner = CliRunner()


class Planner:
    """Stands in for `impactopt.planning.solve.solve`: remembers how it was called, and reports some
    progress.
    """

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.solution: dict[str, Any] = {}
        self.raises: BaseException | None = None
        self.warns = ""
        self.signal: int | None = None

    def __call__(self, problem: ImpactProblem, **options: Any) -> Solution:
        self.options = options
        options["report"]("compiling [something]")
        if self.raises is not None:
            raise self.raises
        if self.signal is not None:
            signal.raise_signal(self.signal)
        if self.warns:
            warnings.warn(self.warns, impactopt.NoCompilerWarning, stacklevel=2)
        for i in range(3):
            options["callback"](
                IterationRecord(
                    iteration=i, objective=-1.0, max_violation=1.0, kkt=np.nan, step=0.0, seconds=2.0 * i
                )
            )
        return still_solution(problem=problem, solver=options["solver"], **self.solution)


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return still_problem()


@pytest.fixture
def planner(monkeypatch: pytest.MonkeyPatch, problem: ImpactProblem) -> Planner:
    """No solver and no big robot: files are read, but the problem is a small one."""
    planner = Planner()
    monkeypatch.setattr("impactopt.planning.solve.solve", planner)
    monkeypatch.setattr("impactopt.cli.replays.has_mujoco", lambda: True)
    monkeypatch.setattr(ProblemFile, "build", lambda self: problem)
    return planner


@pytest.fixture(autouse=True)
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty files in place of pictures, which test_output draws."""

    def save(record: Record, directory: Path) -> list[Path]:
        paths = [directory / f"{name}.png" for name in PICTURES]
        for path in paths:
            path.touch()
        return paths

    monkeypatch.setattr("impactopt.report.pictures.save_pictures", save)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "punch.toml"
    path.write_text(GOOD, encoding="utf-8")
    return path


def run(*arguments: object, code: int = 0) -> tuple[str, str]:
    """stdout and stderr of a command, whose exit code is checked."""
    result = runner.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.stdout, result.stderr


def test_solve_prints_planned_beside_simulated_and_writes_everything(
    planner: Planner, file: Path, tmp_path: Path
) -> None:
    out, err = run("solve", file, "--out", tmp_path / "a" / "b")
    assert {path.name for path in (tmp_path / "a" / "b").iterdir()} == FILES
    (row,) = (line for line in out.splitlines() if "impulse [N s]" in line)
    assert "10.00" in row and "10.10" in row
    (row,) = (line for line in out.splitlines() if "torque demand / limit, collision" in line)
    assert "0.80" in row and "0.90" in row
    assert "stand [still]" in out
    assert all(name in out for name in FILES)
    assert "compiling [something]" in err and "iteration    2" in err
    assert load_record(tmp_path / "a" / "b").problem == GOOD


def test_results_go_beside_each_other_by_default(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run("solve", file)
    assert {path.name for path in (tmp_path / "results" / "punch").iterdir()} == FILES


def test_problems_are_listed_and_solved_by_name(
    planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    listed, _ = run("problems")
    assert [line.split()[0] for line in listed.splitlines()] == list(impactopt.problem_names())
    assert all(len(line.split()) > 3 for line in listed.splitlines())
    run("solve", "punch_left")
    text = load_record(tmp_path / "results" / "punch_left").problem
    assert 'striker = "left_hand"' in text
    assert "did you mean 'punch_left'" in run("solve", "punch_lefd", code=2)[1]


def test_json_is_the_summary_and_nothing_else(planner: Planner, file: Path, tmp_path: Path) -> None:
    out, _ = run("solve", file, "--out", tmp_path / "out", "--json")
    assert json.loads(out) == json.loads((tmp_path / "out" / "summary.json").read_text())
    assert json.loads(out)["simulated"]["impulse_error_pct"] == pytest.approx(1.0)


def test_quiet_says_nothing_on_the_way(planner: Planner, file: Path, tmp_path: Path) -> None:
    out, err = run("solve", file, "--out", tmp_path / "out", "--quiet")
    assert err == "" and "impulse" in out


def test_without_replay_there_are_planned_numbers_only(planner: Planner, file: Path, tmp_path: Path) -> None:
    out, _ = run("solve", file, "--out", tmp_path / "out", "--no-validate")
    assert "simulated" not in out and "planned" in out
    assert "simulated" not in json.loads((tmp_path / "out" / "summary.json").read_text())


def test_free_soles_have_a_column_where_mujoco_is_installed(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, _ = run("solve", file, "--out", tmp_path / "with")
    (row,) = (line for line in out.splitlines() if "stands at the end" in line)
    assert "free soles" in out and "yes" in row
    summary = json.loads((tmp_path / "with" / "summary.json").read_text())
    assert summary["replayed"]["engine"] == "mujoco" and summary["simulated"]["engine"] == "pinocchio"
    monkeypatch.setattr("impactopt.cli.replays.has_mujoco", lambda: False)
    out, err = run("solve", file, "--out", tmp_path / "without")
    assert "free soles" not in out and "whether the robot stands is not checked" in err
    assert "replayed" not in json.loads((tmp_path / "without" / "summary.json").read_text())


def test_the_baseline_is_reported_beside_the_plan(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Reach:
        def describe(self) -> dict[str, object]:
            return {"method": "minimum jerk", "impulse_Ns": 1.5, "hand_speed_m_s": 0.4}

    monkeypatch.setattr("impactopt.cli.replays.minimum_jerk_baseline", lambda problem: Reach())
    out, _ = run("solve", file, "--out", tmp_path / "out", "--baseline")
    assert "hardest minimum-jerk reach: 1.50 N s at 0.40 m/s" in out
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["baseline"]["impulse_Ns"] == 1.5

    def nothing(problem: ImpactProblem) -> Reach:
        raise impactopt.InputError("no reach keeps the limits")

    monkeypatch.setattr("impactopt.cli.replays.minimum_jerk_baseline", nothing)
    out, _ = run("solve", file, "--out", tmp_path / "out", "--baseline")
    assert "no reach keeps the limits" in out


@pytest.mark.slow
def test_replays_side_by_side_are_those_of_one_process(planner: Planner, file: Path, tmp_path: Path) -> None:
    summaries = []
    for workers in (1, 2):
        run("solve", file, "--out", tmp_path / "out", "--workers", str(workers))
        summaries.append(json.loads((tmp_path / "out" / "summary.json").read_text()))
    for part in ("simulated", "replayed"):
        assert summaries[0][part] == summaries[1][part]


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        (Died(code=-9, tries=1), "its process has died (exit code -9)"),
        (impactopt.InputError("the worker processes do not start"), "the worker processes do not start"),
        (KeyboardInterrupt(), "interrupted"),
    ],
    ids=["died", "not started", "interrupted"],
)
def test_a_plan_outlives_the_processes_that_replay_it(
    planner: Planner,
    file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ends: Died | BaseException,
    told: str,
) -> None:
    """The first replay is done, and stays; the other one and the baseline come to nothing."""

    def each(
        function: Callable[..., Any], shared: Any, inputs: Iterable[tuple[int, Any]], **options: Any
    ) -> Iterator[tuple[int, Any]]:
        (first, given), *rest = inputs
        yield first, function(shared, given)
        for k, _ in rest:
            if isinstance(ends, BaseException):
                raise ends
            yield k, ends

    monkeypatch.setattr("impactopt.cli.replays.each_on_workers", each)
    _, err = run("solve", file, "--out", tmp_path / "out", "--workers", "2", "--baseline")
    assert told in err and "replay on free soles" in err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["simulated"]["engine"] == "pinocchio" and "replayed" not in summary
    assert summary["baseline"] == {"method": "minimum jerk", "error": told}


def test_a_plan_outlives_a_replay_that_breaks_down(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results were written after the replays, so an engine's own error lost the plan."""

    def broken(self: Solution, *, engine: str, **options: Any) -> Any:
        raise ValueError(f"{engine} accepts no such body")

    monkeypatch.setattr(FakeSolution, "validate", broken)
    _, err = run("solve", file, "--out", tmp_path / "out")
    assert "ValueError: mujoco accepts no such body" in err
    summary = load_record(tmp_path / "out").summary
    assert summary["impulse_Ns"] > 0
    for engine in ("pinocchio", "mujoco"):
        assert f"ValueError: {engine} accepts no such body" in summary["note"]


def test_the_files_solver_settings_reach_the_solver(planner: Planner, file: Path, tmp_path: Path) -> None:
    run("solve", file, "--out", tmp_path / "out")
    assert (planner.options["solver"], planner.options["time_limit"]) == ("ipopt", 40)
    assert planner.options["options"] == {"max_iter": 7}


def test_options_go_over_the_file(planner: Planner, file: Path, tmp_path: Path) -> None:
    run("solve", file, "--out", tmp_path / "out", "--solver", "ipm", "--time-limit", 3)
    assert (planner.options["solver"], planner.options["time_limit"]) == ("ipm", 3)
    assert planner.options["options"] == {"price": 50.0}, "the other solver's options are not its own"


def test_starts_reach_the_solver_and_are_told(planner: Planner, file: Path, tmp_path: Path) -> None:
    run("solve", file, "--out", tmp_path / "a")
    assert [planner.options[name] for name in ("start", "starts", "seed")] == ["reach", 1, 0]
    told: dict[str, Any] = {"status": Status.SOLVED, "max_violation": 0.0, "iterations": 7, "seconds": 1.5}
    planner.solution["attempts"] = (
        Attempt(start="strike 1", impulse=12.345, objective=-12.0, kept=True, **told),
        Attempt(start="strike 2", impulse=3.21, objective=-3.0, **told),
    )
    out, _ = run("solve", file, "--out", tmp_path / "b", "--start", "strike", "--starts", 2, "--seed", 5)
    assert [planner.options[name] for name in ("start", "starts", "seed")] == ["strike", 2, 5]
    assert "strike 1, kept" in out and "12.35" in out and "strike 2, kept" not in out and "3.21" in out
    summary = json.loads((tmp_path / "b" / "summary.json").read_text(encoding="utf-8"))
    assert [start["kept"] for start in summary["starts"]] == [True, False]


def test_an_infeasible_problem_names_its_rows_and_exits_1(
    planner: Planner, file: Path, tmp_path: Path
) -> None:
    row = "torque limit, swing at 0.61 s, elbow"
    planner.solution = {
        "status": Status.INFEASIBLE,
        "violations": (
            Violation(row, "406 % over its limit", 4.06),
            Violation("torque limit, swing at 0.63 s, elbow", "333 % over its limit", 3.33),
            Violation("hit point", "200 mm away", 0.2),
            Violation("velocity limit, swing at 0.2 s, elbow", "0.02 % over its limit", 2e-4),
        ),
    }
    out, err = run("solve", file, "--out", tmp_path / "out", code=1)
    assert row in out and "406 % over its limit" in out and "infeasible" in out
    assert "(and 1 more)" in " ".join(out.split()) and "333 %" not in out, "one row a term"
    assert "200 mm away" in out
    assert Status.INFEASIBLE.message in " ".join(out.split()), "the reason"
    assert "velocity limit" not in out, "what is off by little only follows from the others"
    assert len(json.loads((tmp_path / "out" / "summary.json").read_text())["violations"]) == 4
    assert "no replay" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


@pytest.mark.parametrize("status", [s for s in Status if not s.usable])
def test_a_best_iterate_is_written_and_exits_1(
    planner: Planner, file: Path, tmp_path: Path, status: Status
) -> None:
    planner.solution = {"status": status}
    run("solve", file, "--out", tmp_path / "out", code=1)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["status"] == status.value


def test_a_solve_that_fails_leaves_a_good_result_as_it_is(
    planner: Planner, file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run("solve", file, "--out", out)
    (out / "report.html").write_text("page of the good one", encoding="utf-8")
    good = {path.name: path.read_bytes() for path in out.iterdir()}
    planner.solution = {"status": Status.INFEASIBLE}
    printed, _ = run("solve", file, "--out", out, code=1)
    assert f"{out} holds a good result, which is kept" in printed
    assert f"{out / 'failed'}: solution.npz" in printed
    summary = json.loads(run("solve", file, "--out", out, "--json", code=1)[0])
    assert summary["set_aside"] == {"directory": str(out / "failed"), "kept": str(out)}
    assert summary == json.loads((out / "failed" / "summary.json").read_text(encoding="utf-8"))
    assert {path.name for path in (out / "failed").iterdir()} == FILES
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == good
    planner.solution = {}
    run("solve", file, "--out", out)
    assert {path.name for path in out.iterdir()} == FILES, "no page of the old one, no failed one"


def test_a_plan_that_misses_when_it_is_replayed_is_kept(planner: Planner, file: Path, tmp_path: Path) -> None:
    planner.solution = {"kind": MissingSolution}
    out, _ = run("solve", file, "--out", tmp_path / "out")
    assert "never touched the target" in out
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_an_interrupted_replay_keeps_the_plan(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(self: Solution, **options: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FakeSolution, "validate", stop)
    _, err = run("solve", file, "--out", tmp_path / "out")
    assert "interrupted" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_an_interrupt_before_there_is_a_plan(planner: Planner, file: Path, tmp_path: Path) -> None:
    planner.raises = KeyboardInterrupt()
    _, err = run("solve", file, "--out", tmp_path / "out", code=130)
    assert "interrupted" in err and not (tmp_path / "out").exists()
    planner.raises = InputError("no")
    run("solve", file, "--out", tmp_path / "out", code=2)
    assert {path.name for path in tmp_path.iterdir()} == {file.name}
    run("validate", tmp_path, "--out", tmp_path / "out", "--animation", tmp_path / "a" / "b.gif", code=2)
    assert {path.name for path in tmp_path.iterdir()} == {file.name}


def test_sigterm_is_as_ctrl_c(planner: Planner, file: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    planner.signal = signal.SIGTERM
    _, err = run("solve", file, "--out", tmp_path / "out", code=130)
    assert "interrupted" in err
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_was_interrupted_gets_no_baseline_and_an_interrupted_baseline_keeps_the_plan(
    planner: Planner, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reach(problem: ImpactProblem) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("impactopt.cli.replays.minimum_jerk_baseline", reach)
    _, err = run("solve", file, "--out", tmp_path / "out", "--baseline")
    assert "without results of: search for" in err and load_record(tmp_path / "out").completed
    planner.solution = {"status": Status.INTERRUPTED}
    _, err = run("solve", file, "--out", tmp_path / "cut", "--baseline", code=1)
    assert "baseline" not in err
    assert "baseline" not in json.loads((tmp_path / "cut" / "summary.json").read_text())


@pytest.mark.parametrize(
    ("status", "off", "told"),
    [
        (Status.INTERRUPTED, 1e-9, "no replay after an interruption"),
        (Status.TIME_LIMIT, 3e-3, "no replay: the constraints are violated by up to 0.003"),
    ],
)
def test_what_is_no_plan_is_not_replayed(
    planner: Planner,
    file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    status: Status,
    off: float,
    told: str,
) -> None:
    def replay(self: Solution, **options: Any) -> None:
        pytest.fail("it is replayed")

    monkeypatch.setattr(FakeSolution, "validate", replay)
    violations = (Violation("hit point", "3 mm away", off),) if off > 1e-6 else ()
    planner.solution = {"status": status, "violations": violations}
    _, err = run("solve", file, "--out", tmp_path / "out", code=1)
    assert told in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_warnings_are_lines_without_source(planner: Planner, file: Path, tmp_path: Path) -> None:
    planner.warns = "no C compiler [here]"
    _, err = run("solve", file, "--out", tmp_path / "out", "--quiet")
    assert err.strip() == "warning: no C compiler [here]"


@pytest.mark.parametrize("command", ["solve", "check"])
@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("mass_kg", "mas_kg", ["line 8", "mas_kg", "did you mean 'mass_kg'"]),
        ("right_hand", "right_hnd", ["line 4", "did you mean 'right_hand'"]),
        ("[0.6, -0.25, 1.1]", "[3.0, -0.25, 1.1]", ["out of reach", "right_hand"]),
    ],
)
def test_bad_input_is_one_message_and_exits_2(
    file: Path, tmp_path: Path, command: str, old: str, new: str, parts: list[str]
) -> None:
    file.write_text(GOOD.replace(old, new), encoding="utf-8")
    out = tmp_path / "out"
    options = ["--out", out] if command == "solve" else []
    stdout, err = run(command, file, *options, code=2)
    assert [part for part in parts if part not in err] == []
    assert sum(line.startswith("error:") for line in err.splitlines()) == 1
    assert stdout == ""
    assert not out.exists(), "no directory is made for a problem that cannot be solved"


def test_bad_arguments_exit_2(file: Path, tmp_path: Path, planner: Planner) -> None:
    for arguments in (
        ["--solver", "ipotp"],
        ["--time-limit", "-1"],
        ["--time-limit", "nan"],
        ["--outt", "x"],
    ):
        run("solve", file, *arguments, code=2)
    run("solve", tmp_path / "nowhere.toml", code=2)
    (tmp_path / "taken").write_text("")
    _, err = run("solve", file, "--out", tmp_path / "taken", code=2)
    assert "cannot make the directory" in err
    _, err = run("solve", file, "--solver", "spq", code=2)
    assert "did you mean 'sqp'" in " ".join(err.replace("│", "").split())


def test_check_says_what_is_planned(file: Path) -> None:
    out, _ = run("check", file)
    assert "sound" in out and "talos" in out and "0.6, -0.25, 1.1" in out


def test_robots_lists_what_a_file_can_name() -> None:
    out, _ = run("robots")
    for name in ("talos", "g1", "right_hand", "half_sitting"):
        assert name in out


def test_help_and_version() -> None:
    out, _ = run("--help")
    assert all(command in out for command in ("solve", "check", "robots"))
    out, _ = run("--version")
    assert out.strip() == impactopt.__version__


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, impactopt.cli.app\n"
        "heavy = ('casadi', 'pinocchio', 'numpy', 'scipy', 'matplotlib', 'pydantic')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_whatever_modules_were_imported() -> None:
    exports = impactopt._all_exports()
    for module in set(exports.values()):
        importlib.import_module(f"impactopt.{module}")
    assert {
        "Board",
        "CustomLaw",
        "Effort",
        "HitCone",
        "Objective",
        "Target",
        "Term",
        "solve",
    } <= exports.keys()
    for name, module in exports.items():
        assert getattr(impactopt, name) is getattr(sys.modules[f"impactopt.{module}"], name)
    modules = {path.stem for path in Path(str(impactopt.__file__)).parent.iterdir()}
    assert not modules & set(exports), "a module would hide the name once it is imported"


def test_places_that_cannot_be_written_are_refused_before_the_work(
    planner: Planner, file: Path, tmp_path: Path
) -> None:
    below = file / "below"  # a file has no room for one
    _, error = run("solve", file, "--store", below, "--out", tmp_path / "out", code=2)
    assert f"cannot make the directory {below}" in error and not planner.options
    _, error = run("show", tmp_path / "out", "--sheet", below / "sheet.png", code=2)
    assert f"cannot make the directory {below}" in error
    _, error = run("show", tmp_path / "out", "--sheet", "sheet.svg", code=2)
    assert "give 'sheet.svg' the ending .png" in error
    _, error = run("validate", tmp_path / "out", "--animation", "motion.mp4", code=2)
    assert "give 'motion.mp4' the ending .gif" in error
    (tmp_path / "motion.gif").mkdir()
    _, error = run("validate", tmp_path / "out", "--animation", tmp_path / "motion.gif", code=2)
    assert "motion.gif' is a folder" in error
