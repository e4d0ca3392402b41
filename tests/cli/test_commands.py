"""Commands about problem files and single collisions; what all commands share: settings, codes, loudness."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from rich.table import Table
from support.fake_solution import strike_record
from typer.main import get_command
from typer.testing import CliRunner

import impactopt
from impactopt import FullDynamics, InputError, Robot, load_problem, load_robot, problem_names
from impactopt.cli.app import app
from impactopt.cli.command import Quiet, Settings, command_line, complete_problem
from impactopt.collide.single_collision import collide_once
from impactopt.files.named_problems import problem_file
from impactopt.files.output import save_record
from impactopt.files.problem_file import key_place, read_problem_file, read_toml, write_toml
from impactopt.files.problem_file.reading import key_paths
from impactopt.planning.solution import Solved
from impactopt.report.console import output

ROOT = Path(__file__).parents[2]
DATA: dict[str, Any] = {
    "problem": {
        "robot": "planar_arm",
        "striker": "hammer",
        "start": "ready",
        "point_m": [0.7, 0.0, 0.75],
        "normal": [0.0, 0.0, -1.0],
    },
    "target": {"mass_kg": 0.5},
    "contact": {"stiffness_N_m": 1e5, "damping_N_s_m": 50.0},
}
runner = CliRunner()


def run(*arguments: object, code: int = 0) -> tuple[str, str]:
    """stdout and stderr of a command, whose exit code is checked."""
    result = runner.invoke(app, [str(a) for a in arguments])
    assert result.exit_code == code, result.output
    return result.stdout, result.stderr


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.toml"
    path.write_text(write_toml(DATA), encoding="utf-8")
    return path


# ---------------------------------------------------------------- check, new, problems, robots
@pytest.mark.slow
def test_check_tells_the_hash_and_takes_settings(file: Path) -> None:
    out, _ = run("check", file)
    assert "is sound" in out and load_problem(file).hash in out
    found = json.loads(run("check", file, "--json", "--set", "target.mass=0.75")[0])
    assert found["sound"] is True and "mass=0.75" in found["problem"]["target"]
    assert found["hash"] != load_problem(file).hash
    _, err = run("check", file, "--set", "target.mas=1", "--set", "contact.stif=2", code=2)
    assert "did you mean 'mass'" in err and "contact.stif" in err
    assert "KEY=VALUE" in run("check", file, "--set", "target.mass", code=2)[1]


def test_check_lists_every_mistake(file: Path) -> None:
    file.write_text(file.read_text().replace("0.5", "-1").replace("1e5", "nan").replace("100000.0", "nan"))
    found = json.loads(run("check", file, "--json", code=2)[0])
    assert found["sound"] is False and len(found["mistakes"]) == 2
    assert any("mass_kg: -1; give a number > 0" in mistake for mistake in found["mistakes"])
    file.write_text("[problem", encoding="utf-8")
    (mistake,) = json.loads(run("check", file, "--json", code=2)[0])["mistakes"]
    assert "is not TOML" in mistake


@pytest.mark.slow
def test_check_doubts_settings_that_have_no_effect(file: Path) -> None:
    given = (
        "terms.balance.angular_momentum=3",
        "terms.contact_wrench_cone.margin=0.01",
        "collision.auto_zmp_mm=1",
    )
    arguments = [word for setting in given for word in ("--set", setting)]
    doubts = " ".join(json.loads(run("check", file, "--json", *arguments)[0])["doubts"])
    for name in ("balance", "contact_wrench_cone"):
        assert f"[terms.{name}] has no effect: it is of soles on the ground" in doubts
    assert "[collision] auto_zmp_mm has no effect" in doubts and "auto_impulse_pct" not in doubts
    auto = json.loads(run("check", file, "--json", *arguments, "--set", "collision.model=auto")[0])
    assert "auto_zmp_mm" not in " ".join(auto["doubts"])


def test_verbose_shows_where_an_error_is_from(file: Path) -> None:
    arguments = ("check", file, "--set", "target.mass=-1")
    assert "Traceback" not in run(*arguments, code=2)[1]
    assert "Traceback" in run(*arguments, "-v", code=2)[1]


def test_new_prints_a_file_that_can_be_used(tmp_path: Path) -> None:
    listed = [line.split()[0] for line in run("new")[0].splitlines()]
    assert listed == list(problem_names())
    path = tmp_path / "my.toml"
    path.write_text(run("new", "arm_planar")[0], encoding="utf-8")
    assert load_problem(path).hash == load_problem("arm_planar").hash
    assert "did you mean 'arm_planar'" in run("new", "arm_plana", code=2)[1]
    assert run("new", "--reference")[0] == (ROOT / "docs" / "problem_files.md").read_text(encoding="utf-8")


def test_lists_as_json() -> None:
    listed = json.loads(run("problems", "--json")[0])
    assert listed["ok"]
    found = listed["problems"]
    assert [row["name"] for row in found] == list(problem_names())
    assert all(Path(row["file"]).is_file() and row["about"] for row in found)
    assert json.loads(run("new", "--json")[0]) == listed
    arms = {row["name"]: row for row in json.loads(run("robots", "--json")[0])["robots"]}
    assert arms["planar_arm"]["joints"] == 3 and arms["planar_arm"]["strikers"] == ["hammer"]
    assert arms["planar_arm"]["mass_kg"] == pytest.approx(9.65)  # links of 5, 3 and 1 kg, and the hammer


def test_a_robot_that_cannot_be_read_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> Robot:
        if name == "talos":
            raise InputError("its URDF is missing")
        return load_robot(name)

    monkeypatch.setattr("impactopt.robots.presets.load_robot", load)
    found = json.loads(run("robots", "--json", code=2)[0])
    assert found["ok"] is False and "joints" in found["robots"][-1]
    assert {"name": "talos", "error": "its URDF is missing"} in found["robots"]
    assert "talos: its URDF is missing" in run("robots", code=2)[0]


def test_bad_input_is_told_as_json_too() -> None:
    out, told = run("solve", "arm_plana", "--json", code=2)
    found = json.loads(out)
    assert found["ok"] is False and "arm_planar" in found["error"] and found["error"] in told
    assert run("solve", "arm_plana", code=2)[0] == ""


# ---------------------------------------------------------------- collide
def test_a_collision_of_two_masses_is_the_closed_form(file: Path) -> None:
    """A point of the effective mass on a spring without damping: impulse 2 mu v, half a period of contact."""
    file.write_text(file.read_text().replace("damping_N_s_m = 50.0", "damping_N_s_m = 0.0"))
    out, _ = run("collide", file, "--speed", 0.5, "--model", "virtual-mass", "--json", "--quiet")
    found = json.loads(out)
    mass = found["effective_mass_kg"]
    mu = mass * 0.5 / (mass + 0.5)
    assert found["hand_speed_m_s"] == pytest.approx(0.5)
    assert found["impulse_Ns"] == pytest.approx(2 * mu * 0.5, rel=1e-6)
    assert found["contact_ms"] == pytest.approx(1e3 * np.pi * np.sqrt(mu / 1e5), rel=1e-2)
    assert found["peak_force_N"] == pytest.approx(0.5 * np.sqrt(1e5 * mu), rel=1e-3)
    assert found["target"]["speed_m_s"] == pytest.approx(found["impulse_Ns"] / 0.5, rel=1e-9)
    assert found["joints"] == [] and "torque_ratio" not in found


def test_models_agree_on_a_short_blow(file: Path) -> None:
    """The arm hardly moves in 7 ms: what the models leave out is small."""
    found = {
        model: json.loads(run("collide", file, "--speed", 0.5, "--model", model, "--json")[0])
        for model in ("sdc", "sdc-paper", "full")
    }
    for key in ("impulse_Ns", "peak_force_N", "contact_ms"):
        assert found["sdc"][key] == pytest.approx(found["full"][key], rel=0.02)
        assert found["sdc-paper"][key] == pytest.approx(found["full"][key], rel=0.1)
    same = impactopt.collide_many(
        file, {"at_contact.speed": [0.5]}, outputs=("impulse_Ns", "peak_force_N", "effective_mass_kg")
    )
    for key in ("impulse_Ns", "peak_force_N", "effective_mass_kg"):
        assert found["sdc"][key] == pytest.approx(same[key][0], rel=1e-9)
    hardest = found["full"]["joints"][0]
    assert hardest["ratio"] == pytest.approx(found["full"]["torque_ratio"])
    assert hardest["ratio"] == pytest.approx(hardest["torque_Nm"] / hardest["limit_Nm"])
    assert hardest["unit"] == "N m"
    assert [j["ratio"] for j in found["sdc"]["joints"]] == sorted(
        (j["ratio"] for j in found["sdc"]["joints"]), reverse=True
    )


@pytest.mark.parametrize("model", ["sdc", "virtual-mass", "full"])
def test_collide_has_the_motion_of_a_target_across_the_normal(file: Path, model: str) -> None:
    rough = ("--set", "friction.coefficient=0.6", "--set", "friction.moves_target=true", "--model", model)
    found = json.loads(run("collide", file, "--speed", 0.5, *rough, "--json", "-q")[0])
    speeds = found["target"]["speed_m_s"], found["target"]["tangential_speed_m_s"]
    assert speeds[1] > 1e-3
    assert found["energy_J"] == pytest.approx(0.5 * 0.5 * np.square(speeds).sum(), rel=1e-6)
    assert "speed of the target across the normal" in run("collide", file, "--speed", 0.5, *rough)[0]


def test_collide_shows_a_table_and_takes_settings(file: Path) -> None:
    out, err = run("collide", file, "--speed", 0.5, "--set", "target.mass=2", "--posture", "ready")
    assert "impulse [N s]" in out and "shoulder" in out and "s  " in err
    light = collide_once(read_problem_file(file), {"speed_m_s": 0.5, "posture": "ready"})
    heavy = collide_once(read_problem_file(file, {"target.mass": 2}), {"speed_m_s": 0.5, "posture": "ready"})
    assert f"{heavy['impulse_Ns']:.3f}" in out
    assert heavy["impulse_Ns"] > light["impulse_Ns"]


def test_a_collision_needs_no_sections_of_plans(file: Path) -> None:
    words = ("collide", file, "--speed", 0.5, "--json", "-q")
    right = json.loads(run(*words)[0])
    wrong = f"{file.read_text()}\n[terms.ceiling]\n"
    file.write_text(wrong)
    assert json.loads(run(*words)[0]) == right
    assert "ceiling: unknown section" in run("check", file, code=2)[1]
    assert "no collision depends on [swing]" in run(*words, "--set", "swing.intervals=9", code=2)[1]
    file.write_text(wrong.replace("[contact]", "[contakt]"))
    assert "did you mean 'contact'" in run(*words, code=2)[1]
    keys = [key for key in key_paths(read_toml(wrong)) if key.startswith("collision.")]
    assert "collision.touches" in keys
    plan = "\n".join(f"{key} = 1" for key in keys if "restitution" not in key)
    file.write_text(f"{plan}\n{wrong}")
    assert json.loads(run(*words)[0]) == right
    file.write_text(f"collision.coefficient_of_restituton = 0.5\n{wrong}")
    assert "did you mean 'coefficient_of_restitution'" in run(*words, code=2)[1]


def test_a_collision_that_there_is_not_exits_1(file: Path) -> None:
    out, _ = run("collide", file, "--speed", 0.5, "--set", "problem.point.0=3", code=1)
    assert "no collision: the point is out of reach" in out
    soft = ("collide", file, "--speed", 0.5, "--set", "contact.stiffness=1e4", "--json", "-q")
    found = json.loads(run(*soft, "--horizon", 2e-3, code=1)[0])
    assert "raise it" in found["reason"] and "--horizon" in found["reason"]
    assert json.loads(run(*soft, "--horizon", 0.4)[0])["contact_ms"] > 2
    found = json.loads(run("collide", file, "--speed", 50, "--json", "-q", code=1)[0])
    assert "faster than its limit" in found["reason"] and "impulse_Ns" not in found
    assert "give --speed" not in run("collide", file, code=2)[1]
    assert "--speed" in run("collide", file, code=2)[1]
    assert "did you mean 'ready'" in run("collide", file, "--speed", 1, "--posture", "redy", code=2)[1]


def test_a_rigid_impact_has_no_peak_force(file: Path) -> None:
    out, _ = run("collide", file, "--speed", 0.5, "--model", "rigid")
    assert "no peak force" in out and "peak force [N]" not in out
    assert "rigid, restitution = 0\n" in re.sub(" +\n", "\n", out), "the file gives none"
    found = json.loads(run("collide", file, "--speed", 0.5, "--model", "rigid", "--json")[0])
    assert found["peak_force_N"] is None and found["impulse_Ns"] > 0


def test_collide_takes_a_saved_result(file: Path, tmp_path: Path) -> None:
    problem = load_problem(file)
    robot, rng = problem.robot, np.random.default_rng(0)
    posture, velocity = problem.start_posture, np.array([0.3, 0.4, 0.2])
    torque = rng.uniform(-5, 5, 3)
    state = (robot, posture, velocity, torque)
    save_record(strike_record(*state, problem=file.read_text(), problem_path=file), tmp_path / "strike")
    found = json.loads(run("collide", tmp_path / "strike", "--model", "full", "--json", "-q")[0])
    model = FullDynamics(
        robot=robot,
        striker="hammer",
        normal=problem.normal,
        law=problem.law,
        target=problem.target,
        step=1e-5,
    )
    expected = model.collide(posture, velocity, torque)
    assert found["impulse_Ns"] == pytest.approx(expected.impulse, rel=1e-3)
    assert found["hand_speed_m_s"] == pytest.approx(expected.hand_speed[0], rel=1e-6)
    twice = 2 * found["hand_speed_m_s"]
    faster = json.loads(run("collide", tmp_path / "strike", "--speed", twice, "--json", "-q")[0])
    assert faster["hand_speed_m_s"] == pytest.approx(twice)
    assert "leave it out" in run("collide", tmp_path / "strike", "--posture", "ready", code=2)[1]
    save_record(strike_record(*state), tmp_path / "python")
    assert "no problem file" in run("collide", tmp_path / "python", code=2)[1]
    (tmp_path / "empty").mkdir()
    run("collide", tmp_path / "empty", code=2)
    assert "there is no file" in run("collide", tmp_path / "none", code=2)[1], "not that --speed is missing"


# ---------------------------------------------------------------- what all of them share
@pytest.mark.parametrize("command", ["solve", "strike", "drive", "collide", "check"])
def test_settings_are_checked_before_work_starts(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--speed", "1"] if command == "collide" else []
    _, err = run(command, file, *options, "--set", "target.mass=-1", code=2)
    assert "as set, [target] mass_kg: -1; give a number > 0" in err
    _, err = run(command, file, *options, "--set", "contact.stiffness=1e99", code=2)
    assert "as set, [contact]: " in err and "stiffness [N/m]: 1e+99" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.toml"]


def test_quiet_and_verbose_exclude_each_other(file: Path) -> None:
    for command in ("solve", "strike", "drive", "validate"):
        assert "give one of them" in run(command, file, "-q", "-v", code=2)[1]


def test_a_fault_of_ours_is_no_answer(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A script that counts on exit code 1 for "not solved" must not take a crash for it."""

    def fail(*arguments: Any, **options: Any) -> Robot:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("impactopt.files.sections.robot.load_robot", fail)
    _, err = run("check", file, code=70)
    assert "ZeroDivisionError: a bug" in err and "fault of impactopt" in err


def test_every_command_has_examples_that_name_its_options() -> None:
    commands = re.findall(r"(?m)^. (\w[\w-]*)  ", run("--help")[0].split("Commands")[1])
    assert {"solve", "strike", "collide", "validate", "new", "check", "robots", "problems"} <= {*commands}
    for command in commands:
        shown = run(command, "--help")[0]
        examples = re.findall(rf"impactopt {command}[^\n│]*", shown.split("Examples:")[-1])
        assert "Examples:" in shown and examples, command
        for option in re.findall(r" (--[\w-]+)", " ".join(examples)):
            assert option in shown.split("Examples:")[0], (command, option)


def test_no_help_has_brackets_which_are_taken_for_markup() -> None:
    commands = [get_command(app)]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        texts = [command.help, *(getattr(parameter, "help", "") for parameter in command.params)]
        assert not [text for text in texts if text and "[" in text], command.name


def test_help_and_completion_load_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "from impactopt.cli.app import app\n"
        "from impactopt.cli.command import complete_problem, complete_sweep\n"
        "assert 'punch' in complete_problem('pun')\n"
        "assert complete_sweep('collision_t') == ['collision_target']\n"
        "for arguments in (['--help'], ['solve', '--help'], ['collide', '-h'], []):\n"
        "    CliRunner().invoke(app, arguments)\n"
        # pydantic is not in it: newer versions of typer import it themselves
        "heavy = ('casadi', 'pinocchio', 'numpy', 'scipy', 'matplotlib', 'mujoco')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_completion_offers_names_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "punchy.toml").touch()
    (tmp_path / "puns").mkdir()
    (tmp_path / "puns" / "mine.toml").touch()
    (tmp_path / "pun.txt").touch()
    offered = complete_problem("pun")
    assert "punch" in offered and {"punchy.toml", "puns/"} <= {*offered} and "pun.txt" not in offered
    assert complete_problem("puns/") == complete_problem("puns/mi") == ["puns/mine.toml"]
    assert complete_problem("nowhere/x") == []
    assert "completion" in run("--help")[0]


def test_completion_offers_the_keys_of_the_problem_that_is_named() -> None:
    def offered(problem: str, incomplete: str, command: str = "solve") -> list[str]:
        line = f"impactopt {command} {problem} --set {incomplete}"
        at = len(line.split()) - bool(incomplete)
        shell = {"_IMPACTOPT_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(at)}
        return runner.invoke(app, [], prog_name="impactopt", env=shell).stdout.split()

    assert offered("nailing", "target.res") == ["target.resistance_N="], "only a nail has one"
    for other in ("drive", "collide"):
        assert offered("punch", "target.res", other) == [], other
    assert offered("punch", "target.res") == [] and "target.mass_kg=" in offered("punch", "target.")
    assert "scenarios.missing.abort_after_s=" in offered("punch", "scenarios.")
    assert "swing.duration_s=" in offered("", "swing.") and "swing.duration_s=" in offered(
        "nowhere", "swing."
    )
    for key in offered("punch", ""):
        assert key_place(read_toml(problem_file("punch").read_text()), key.removesuffix("=")), key


def test_a_record_keeps_the_command_as_it_can_be_given_again() -> None:
    again = typer.Typer(add_completion=False)

    @again.command()
    def solve(context: typer.Context, file: str, settings: Settings = None, quiet: Quiet = False) -> None:
        typer.echo(command_line(context))

    words = ["punch", "--set", "target.mass=8", "--set", "problem.name=a b", "--quiet"]
    told = shlex.split(runner.invoke(again, words, prog_name="solve").stdout)
    assert told == ["impactopt", "solve", *words]


def test_python_m_impactopt_is_the_command_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "impactopt", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == impactopt.__version__


def test_the_page_about_the_command_line_names_every_command_and_code() -> None:
    page = (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8")
    commands = re.findall(r"(?m)^. (\w[\w-]*)  ", run("--help")[0].split("Commands")[1])
    assert [name for name in commands if f"`{name}`" not in page] == []
    for code in ("0", "1", "2", "70", "130"):
        assert re.search(rf"(?m)^\| {code} \|", page), code


# ---------------------------------------------------------------- what scripts read
def test_success_has_one_key_in_json() -> None:
    sound = json.loads(run("check", "arm_planar", "--json")[0])
    assert sound["ok"] is True and sound["sound"] is True
    wrong = json.loads(run("check", "arm_planar", "--set", "target.mass=-1", "--json", code=2)[0])
    assert wrong["ok"] is False and "mass" in wrong["mistakes"][0]
    found = json.loads(run("collide", "arm_planar", "--speed", "0.5", "--model", "virtual-mass", "--json")[0])
    assert found["ok"] is True


def test_a_draft_is_quiet_if_asked_and_never_made_for_a_file_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drafted(*_: Any, report: Any, **__: Any) -> None:
        report("trying strikes")
        raise InputError("no posture is found")

    monkeypatch.setattr("impactopt.files.draft.drafting.draft_problem", drafted)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text("<robot/>")
    for option, said in (("--json", True), ("-q", False)):
        told = run("new", "--urdf", urdf, "--out", tmp_path / "robot.toml", option, code=2)
        assert ("trying strikes" in "".join(told)) == said
    (tmp_path / "robot.toml").write_text("")
    error = run("new", "--urdf", urdf, "--out", tmp_path / "robot.toml", code=2)[1]
    assert "already; give another --out" in error and "trying strikes" not in error


def test_a_file_that_comes_while_another_is_drafted_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "robot.toml"

    def drafted(*_: Any, **__: Any) -> Any:
        out.write_text("mine")
        return SimpleNamespace(text="x = 1\n", said=[])

    monkeypatch.setattr("impactopt.files.draft.drafting.draft_problem", drafted)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text("<robot/>")
    assert "already" in run("new", "--urdf", urdf, "--out", out, code=2)[1] and out.read_text() == "mine"


def test_a_new_file_as_json_is_its_text_and_its_tables(tmp_path: Path) -> None:
    text = run("new", "arm_planar")[0]
    told = json.loads(run("new", "arm_planar", "--json")[0])
    assert told == {"ok": True, "file": None, "toml": text, "data": read_toml(text)}
    path = tmp_path / "arm.toml"
    assert json.loads(run("new", "arm_planar", "--json", "--out", path)[0])["file"] == str(path)
    assert path.read_text(encoding="utf-8") == text
    run("new", "--reference", "--json", code=2)


def test_tables_in_a_pipe_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    table = Table("name")
    table.add_row("x" * 300)
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        output().print(table)
    assert "x" * 300 in shown.getvalue()


def test_flags_have_no_type() -> None:
    for command in ("solve", "check", "show"):
        assert "bool" not in run(command, "--help")[0]


def test_keys_that_are_offered_come_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second time nothing heavy is loaded."""
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path / "cache"))
    code = (
        "import sys\n"
        "from types import SimpleNamespace\n"
        "from impactopt.cli.command import complete_setting\n"
        "print(complete_setting(SimpleNamespace(params={'file': 'punch'}, args=[]), 'target.m'))\n"
        "print([m for m in ('pydantic', 'scipy', 'casadi', 'pinocchio') if m in sys.modules])"
    )
    done = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True) for _ in range(2)]
    first, second = (each.stdout.splitlines() for each in done)
    assert first[0] == second[0] == "['target.mass_kg=']"
    assert second[1] == "[]" != first[1]


def test_a_strike_has_its_caution_beside_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without progress, too, which says it first."""
    monkeypatch.setattr(Solved, "caution", property(lambda self: "the hand meets the target again"))
    assert "the hand meets the target again" in run("strike", "arm_planar", "--starts", 1, "--quiet")[0]
