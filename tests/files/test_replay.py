"""`impactopt validate`: a result on disk is replayed, described and drawn; what does not fit is said so."""

from __future__ import annotations

import dataclasses
import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support import urdfs
from support.fake_solution import still_problem, still_solution
from support.problem_texts import bolted_arm
from typer.testing import CliRunner

from impactopt import InputError, Perturbation, Solution, load_problem, load_record
from impactopt.cli.app import app
from impactopt.cli.validate import validate
from impactopt.files.named_problems import problem_file
from impactopt.files.output import record_of, save_record
from impactopt.files.record import Record
from impactopt.files.replay import Planned, Replay, load_planned, replay
from impactopt.report.console import touch_message
from impactopt.report.pictures.animation import AROUND, FPS, SLOW, _Drawing, save_animation, shown_times
from impactopt.simulation.result import REPORT

FLAT = REPORT[:13]  # numbers for the whole motion; after them, what is by phase or by sole
ARM = problem_file("arm_planar")
QUICK = ("--step", "5e-4", "--settle", "1.0")
BRIEF = ("--step", "2e-4", "--settle", "0")

runner = CliRunner()


def saved_as_solved(solution: Solution, file: Path, folder: Path) -> Path:
    """What `impactopt solve` leaves, without its replays."""
    save_record(record_of(solution, problem=file.read_text("utf-8"), problem_path=file), folder)
    return folder


@pytest.fixture(scope="module")
def punched(punch: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved_as_solved(punch, problem_file("punch"), tmp_path_factory.mktemp("results") / "punch")


@pytest.fixture(scope="module")
def saved(hammered: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved_as_solved(hammered, ARM, tmp_path_factory.mktemp("results") / "arm")


def resaved(saved: Path, directory: Path, **changes: Any) -> Path:
    save_record(dataclasses.replace(load_record(saved), **changes), directory)
    return directory


def run(*arguments: object, code: int = 0) -> tuple[str, str]:
    """stdout and stderr of `validate`, whose exit code is checked."""
    result = runner.invoke(app, ["validate", *(str(a) for a in arguments)])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output
    return result.stdout, result.stderr


@pytest.mark.slow
def test_json_is_the_flat_report(punched: Path, punch: Solution, tmp_path: Path) -> None:
    out, _ = run(punched, "--json", "--out", tmp_path / "new" / "place", *QUICK)
    report = json.loads(out)
    assert tuple(report) == ("ok", *REPORT, "controller")
    assert report["engine"] == "mujoco" and report["standing"] is True and report["reason"] == ""
    for name in FLAT[3:]:
        assert np.isfinite(report[name]), name
    assert report["impulse_error_pct"] == pytest.approx(100 * (report["impulse_Ns"] / punch.impulse - 1))
    assert report["zmp_margin_m"] == min(report["zmp_margin_by_phase_m"].values())
    assert report["torque_ratio"] == max(report["torque_ratio_by_phase"].values())
    assert report["sole_cop_margin_mm"].keys() == {"left", "right"}
    written = {path.name for path in (tmp_path / "new" / "place").iterdir()}
    assert written == {"replay.json", "replay.png"}
    assert json.loads((tmp_path / "new" / "place" / "replay.json").read_text()) == report


@pytest.mark.slow
def test_held_soles_cannot_say_whether_it_stands(punched: Path) -> None:
    out, _ = run(punched / "solution.npz", "--engine", "pinocchio", "--json", "--step", "5e-4")
    report = json.loads(out)
    assert report["standing"] is None and "fixed" in report["reason"]
    assert abs(report["impulse_error_pct"]) < 2


@pytest.mark.slow
def test_a_missed_blow_is_replayed_on_held_soles_too(punched: Path) -> None:
    out, _ = run(punched, "--engine", "pinocchio", "--missing", "--json", "--step", "5e-4")
    report = json.loads(out)
    assert report["impulse_Ns"] == 0 and report["impulse_error_pct"] is None
    assert report["torque_ratio_by_phase"].keys() == report["zmp_margin_by_phase_m"].keys()
    assert report["torque_ratio_by_phase"].keys() == {"swing", "missed"}
    assert report["torque_ratio"] < 1.05 and report["zmp_margin_m"] > 0


def test_an_unsolved_plan_and_a_blow_that_does_not_hit_are_said(hammered: Solution, tmp_path: Path) -> None:
    record = record_of(hammered, problem=problem_file("arm_planar").read_text("utf-8"))
    save_record(record, tmp_path)
    assert "not hit" not in run(tmp_path, *BRIEF)[0]
    bad = {**record.summary, "status": "time_limit", "message": "Stopped at the time limit."}
    save_record(dataclasses.replace(record, summary=bad), tmp_path)
    out, _ = run(tmp_path, "--distance", 0.2, *BRIEF)
    assert out.splitlines()[-2:] == ["Stopped at the time limit.", "the target is not hit"]


@pytest.mark.slow
def test_a_fall_exits_1_and_says_when(punched: Path) -> None:
    out, _ = run(punched, "--payload", 30, "--missing", "--step", "1e-3", code=1)
    assert "stands at the end" in out and "! no" in out
    assert "-100" not in out and "impulse error" not in out, "nothing is hit, so nothing is wrong about it"
    out, _ = run(punched, "--payload", 30, "--missing", "--step", "1e-3", "--json", code=1)
    report = json.loads(out)
    assert report["reason"].startswith("fell: ") and " at t = " in report["reason"]
    assert report["impulse_Ns"] == 0 and report["standing"] is False


def test_every_condition_is_an_option_with_its_default() -> None:
    options = inspect.signature(validate).parameters
    for f in dataclasses.fields(Perturbation):
        assert options[f.name].default == f.default, f.name


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--friction", "-1"], ["friction is -1"]),
        (["--engine", "pinocchio", "--mass", "2"], ["pinocchio", "take engine 'mujoco'"]),
        (["--step", "0"], ["step [s]: 0"]),
        (["--animation", "punch.mp4", "--step", "1e-3", "--settle", "0"], ["punch.mp4", ".gif"]),
    ],
)
def test_bad_options_are_one_message_and_exit_2(saved: Path, arguments: list[str], parts: list[str]) -> None:
    out, err = run(saved, *arguments, code=2)
    assert out == "" and err.count("error:") == 1
    assert [part for part in parts if part not in err] == []


def test_a_result_that_is_not_there(tmp_path: Path) -> None:
    _, err = run(tmp_path, code=2)
    assert "solution.npz" in err and "impactopt solve" in err


def test_a_result_without_its_problem_file_asks_for_it(saved: Path, tmp_path: Path) -> None:
    lonely = resaved(saved, tmp_path / "lonely", problem="", problem_path=None)
    with pytest.raises(InputError, match="holds no problem file: give it with --problem FILE"):
        load_planned(lonely)
    planned = load_planned(lonely, problem_file=ARM)
    assert planned.problem.robot.name == "planar_arm"
    np.testing.assert_array_equal(planned.reference.q, load_record(saved).arrays["reference_q"])


def test_a_urdf_that_has_moved_is_one_clear_error(saved: Path, tmp_path: Path) -> None:
    text = ARM.read_text("utf-8").replace('robot = "planar_arm"', "#") + '\n[robot]\nurdf = "gone.urdf"\n'
    moved = resaved(saved, tmp_path / "results", problem=text, problem_path=tmp_path / "problems" / "my.toml")
    with pytest.raises(InputError, match=r"problems/gone\.urdf(.|\n)*--problem FILE"):
        load_planned(moved)


def test_a_plan_of_another_robot_is_refused(saved: Path, tmp_path: Path) -> None:
    arrays = dict(load_record(saved).arrays)
    arrays["joints"] = arrays["joints"][::-1]
    other = resaved(saved, tmp_path / "other", arrays=arrays)
    with pytest.raises(InputError, match="planned for other joints than those of the robot 'planar_arm'"):
        load_planned(other)


def test_a_problem_that_has_changed_since_its_plan_is_told(saved: Path, tmp_path: Path) -> None:
    """As by another URDF under the same name: a replay's error would be taken for the plan's."""
    text = ARM.read_text("utf-8").replace("mass_kg = 0.05", "mass_kg = 0.055")
    heavier = resaved(saved, tmp_path / "heavier", problem=text)
    with pytest.warns(
        UserWarning, match="heavier is another one today .* after a change of its robot's files"
    ):
        assert not load_planned(heavier).of_other_problem


def hulls_of_arm(folder: Path, old: str, new: str) -> str:
    """Hash of the shapes of an arm's links, with a change in its URDF."""
    assert old in urdfs.arm()
    (folder / "robot.urdf").write_text(urdfs.arm().replace(old, new, 1), "utf-8")
    text = bolted_arm(
        frame="wrist_link",
        tip=[0.0, 0.0, 0.1],
        point=[0.6, 0.0, 0.5],
        normal=[1.0, 0.0, 0.0],
        start="raised",
        postures={"raised": {"shoulder": 0.5, "elbow": 1.0}},
    )
    (folder / "arm.toml").write_text(text, "utf-8")
    return str(load_problem(folder / "arm.toml").describe()["hulls"])


def test_a_link_that_has_grown_since_the_plan_is_told(saved: Path, tmp_path: Path) -> None:
    """The plan keeps clear of the old shape."""
    before, after = (
        hulls_of_arm(tmp_path, "0.08 0.08 0.3", size) for size in ("0.08 0.08 0.3", "0.5 0.08 0.3")
    )
    assert before != after
    summary = load_record(saved).summary
    known = {**summary, "problem": {**summary["problem"], "hulls": before}}
    with pytest.warns(UserWarning, match="grown is another one today"):
        load_planned(resaved(saved, tmp_path / "grown", summary=known))


def test_a_shape_that_differs_by_rounding_alone_is_the_same(tmp_path: Path) -> None:
    """A plate of an eighth of an inch, 1587.5 um from its middle to each face, also turned over."""
    shape = '<origin xyz="0.0 0.0 0.15"{}/><geometry><box size="0.08 {} 0.3"/>'
    found = [
        hulls_of_arm(tmp_path, shape.format("", 0.08), shape.format(f' rpy="0 0 {angle}"', 0.003175))
        for angle in (0.0, np.pi)
    ]
    assert found[0] == found[1]


def test_a_result_without_a_motion_has_nothing_to_replay(tmp_path: Path) -> None:
    save_record(Record(summary={"note": "stopped early"}), tmp_path)
    with pytest.raises(InputError, match="no motion to replay: stopped early"):
        load_planned(tmp_path)


@pytest.mark.slow
def test_the_links_hull_is_told_beside_the_striking_point(hammered: Solution) -> None:
    planned = Planned(record=record_of(hammered), problem=hammered.problem, reference=hammered.trajectory)
    report = replay(planned, contact="link").report
    assert report["contact"] == "link"
    assert report["point"]["impulse_Ns"] == pytest.approx(hammered.impulse, rel=0.01)
    assert report["impulse_Ns"] == pytest.approx(hammered.impulse, rel=0.05)
    assert abs(report["first_touch_ms"]) < 1.0 and abs(report["point"]["first_touch_ms"]) < 0.3
    assert touch_message(report).startswith(f"contact of the link's hull: {report['impulse_Ns']:.2f} N s")
    assert touch_message({}) == ""
    missed = {"impulse_Ns": 0.0, "first_touch_ms": None}
    assert "striking point: 0.00 N s, no touch" in touch_message({**report, "point": missed})
    with pytest.raises(InputError, match="take engine 'mujoco'"):
        replay(planned, engine="pinocchio", contact="link")


# ---- pictures


@pytest.fixture(scope="module")
def still() -> Replay:
    """The small biped stands still before a target that is pushed into its fist."""
    problem = still_problem()
    solution = still_solution(problem=problem)
    planned = Planned(record=record_of(solution), problem=problem, reference=solution.trajectory)
    return replay(planned, perturbation=Perturbation(distance=-0.001), step=5e-4, settle=0.05)


def test_a_replay_takes_the_place_of_an_older_one(still: Replay) -> None:
    assert still.record.replayed and not still.planned.record.replayed
    assert still.record.summary["replayed"] == still.report
    assert list(still.record.arrays["replayed_soles"]) == ["left", "right"]


def test_the_animation_draws_the_world_where_the_replay_has_it(still: Replay) -> None:
    problem = still.planned.problem
    (target,) = _Drawing(still).look(0).world
    ahead = np.sort((target - problem.point) @ problem.normal)
    assert ahead == pytest.approx(np.repeat([-0.001, 0.179], 4)), "1 mm nearer, 18 cm deep"
    gone = dataclasses.replace(still, perturbation=Perturbation(missing=True))
    assert _Drawing(gone).look(0).world == []


def test_the_hand_stays_in_the_picture(still: Replay) -> None:
    """That of a robot that falls left it: it is beyond the last joint."""
    drawing = _Drawing(still)
    scene = drawing.look(0)
    far = dataclasses.replace(scene, hand=scene.hand + np.array([1.0, 0.0, 0.5]))
    drawing.set_up([scene, far])
    for axes, view in zip(drawing.panels[:2], drawing.views, strict=False):
        for at, (low, high) in zip(view @ far.hand, (axes.get_xlim(), axes.get_ylim()), strict=True):
            assert low < at < high


@pytest.mark.slow
def test_the_animation_is_a_gif_with_every_instant(still: Replay, tmp_path: Path) -> None:
    sim = still.simulation
    assert sim.contact_start == 0 and still.report["hand_speed_m_s"] is not None
    path = save_animation(still, tmp_path / "still.gif")
    times, _ = shown_times(sim.contact_start, sim.contact_end, float(sim.time[-1]))
    with Image.open(path) as picture:
        # pictures that are alike are one that stays longer
        assert 2 <= picture.n_frames <= len(times) + 1
        durations = []
        for k in range(picture.n_frames):
            picture.seek(k)
            durations.append(picture.info["duration"])
    assert sum(durations) >= len(times) * 1000 // FPS
    assert path.stat().st_size < 1_000_000


@pytest.mark.slow
def test_a_robot_without_soles_is_drawn_from_above(hammered: Solution) -> None:
    planned = Planned(record=record_of(hammered), problem=hammered.problem, reference=hammered.trajectory)
    drawing = _Drawing(replay(planned))
    scene = drawing.look(0)
    drawing.set_up([scene])
    *_, above = drawing.panels
    gone = np.asarray(drawing.draw(dataclasses.replace(scene, sticks=scene.sticks + 100.0), ""))
    whole = np.asarray(drawing.draw(scene, ""))
    box = above.get_window_extent()
    columns = slice(int(box.x0), int(box.x1))
    assert above.get_title() == "from above" and (gone[:, columns] != whole[:, columns]).any()


def test_time_runs_slower_around_contact() -> None:
    times, paces = shown_times(0.8, 0.86, 2.0)
    slow = (times >= 0.8 - AROUND) & (times < 0.86 + AROUND)
    np.testing.assert_array_equal(paces, np.where(slow, SLOW, 1))
    np.testing.assert_allclose(np.diff(times), 1 / FPS / paces[:-1])
    times, paces = shown_times(np.nan, np.nan, 0.99)
    assert (paces == 1).all() and len(times) == FPS
