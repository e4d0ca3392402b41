"""Records on disk: what is written is read back, what is damaged is said so; pictures of any record."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from support.fake_solution import MissingSolution, simulation_of, still_problem, still_solution

from impactopt import ImpactProblem, InputError, Plan, Status, load_record
from impactopt.files.output import record_of, save_record, write_file
from impactopt.files.record import FORMAT, Record, check_summary
from impactopt.kinematics.stance import margin
from impactopt.report.pictures import PICTURES, save_pictures
from impactopt.report.pictures.histories import _binned
from impactopt.report.pictures.style import DPI, STYLE


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return still_problem()


@pytest.fixture(scope="module")
def record(problem: ImpactProblem) -> Record:
    solution = still_solution(problem=problem)
    replay = solution.validate(engine="mujoco")
    return record_of(solution, simulation=solution.validate(), replay=replay, problem="[problem]  # text\n")


def numbers(summary: Any, path: str = "") -> Iterator[str]:
    """Names of all numbers in a summary, nested ones with dots."""
    for key, value in summary.items():
        if isinstance(value, dict):
            yield from numbers(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def test_the_summary_has_the_keys_that_readers_rely_on(record: Record) -> None:
    phases = ("swing", "collision", "follow")
    keys = ["status", "solver", "iterations", "solve_seconds", "build_seconds", "max_violation", "impulse_Ns"]
    keys += ["peak_force_N", "contact_ms", "hand_speed_m_s"]
    keys += ["simulated.impulse_Ns", "simulated.impulse_error_pct"]
    keys += ["simulated.sole_slip_mm"]
    for key in ("zmp_margin_m", "torque_ratio"):
        keys += [f"{where}{key}.{phase}" for where in ("", "simulated.") for phase in phases]
    for key in ("sole_cop_margin_mm", "sole_force_N"):
        keys += [f"simulated.{key}.{sole}.{phase}" for sole in ("left", "right") for phase in phases]
    assert set(keys) <= set(numbers(record.summary))
    assert record.summary["simulated"]["impulse_error_pct"] == pytest.approx(1.0)
    assert record.summary["simulated"]["torque_ratio"]["collision"] == pytest.approx(0.9)
    assert record.summary["replayed"]["torque_ratio"] == pytest.approx(0.9), "one number for the motion"
    assert record.summary["replayed"]["zmp_margin_m"] == min(
        record.summary["replayed"]["zmp_margin_by_phase_m"].values()
    )


def test_a_record_is_read_back_as_it_was_written(record: Record, tmp_path: Path) -> None:
    files = save_record(record, tmp_path / "new" / "place")
    assert [path.name for path in files] == ["solution.npz", "summary.json"]
    back = load_record(tmp_path / "new" / "place")
    assert back.summary == record.summary == json.loads(files[1].read_text())
    assert back.problem == record.problem
    assert back.problem_path is None
    assert back.arrays.keys() == record.arrays.keys()
    for name, value in record.arrays.items():
        np.testing.assert_array_equal(back.arrays[name], value, strict=True)


def test_a_record_knows_where_its_problem_was_after_both_have_moved(record: Record, tmp_path: Path) -> None:
    there = dataclasses.replace(record, problem_path=tmp_path / "here" / "problems" / "punch.toml")
    save_record(there, tmp_path / "here" / "results" / "punch")
    (tmp_path / "here").rename(tmp_path / "moved")
    for name in ("", "solution.npz"):
        back = load_record(tmp_path / "moved" / "results" / "punch" / name)
        assert back.problem_path == (tmp_path / "moved" / "problems" / "punch.toml").resolve()


def test_the_arrays_are_the_plan_and_the_replay(record: Record, problem: ImpactProblem) -> None:
    a, robot = record.arrays, problem.robot
    assert list(a["joints"]) == list(robot.joint_names)
    assert a["reference_q"].shape == (len(a["reference_time"]), robot.nq)
    assert a["reference_angle"].shape == a["reference_torque"].shape == (len(a["reference_time"]), robot.n)
    np.testing.assert_allclose(a["reference_angle"][0], robot.joint_positions(problem.start_posture))
    assert a["simulated_demand"].shape == (len(a["simulated_time"]), robot.n)
    assert a["history_objective"].tolist() == [0.0, -1.0, -2.0]
    corners = np.concatenate([a["sole_left"], a["sole_right"]])
    inside = margin(a["polygon"], corners)
    assert inside.min() > -1e-9, "soles lie in the support polygon"
    assert len(a["polygon"]) == 4


def test_what_is_not_finite_is_null_in_json(problem: ImpactProblem, tmp_path: Path) -> None:
    record = record_of(still_solution(problem=problem))
    summary = {**record.summary, "impulse_Ns": np.float64(np.nan), "x": [np.inf, np.int64(3)]}
    _, path = save_record(dataclasses.replace(record, summary=summary), tmp_path)

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    read = json.loads(path.read_text(), parse_constant=refuse)
    assert read["impulse_Ns"] is None and read["x"] == [None, 3]


@pytest.mark.slow
def test_a_replay_that_misses_the_target_is_kept_with_the_reason(
    problem: ImpactProblem, tmp_path: Path
) -> None:
    solution = still_solution(problem=problem, kind=MissingSolution)
    record = record_of(solution, simulation=solution.validate())
    assert "never touched" in record.summary["simulated"]["error"]
    assert record.summary["impulse_Ns"] == solution.impulse
    assert {path.stem for path in save_pictures(record, tmp_path)} == set(PICTURES) - {"replay"}


def test_a_plan_whose_legs_do_not_close_still_leaves_a_record(
    problem: ImpactProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Plan, **options: Any) -> None:
        raise InputError("a leg is too short")

    monkeypatch.setattr(Plan, "trajectory", refuse)
    record = record_of(still_solution(problem=problem, status=Status.INTERRUPTED))
    assert "a leg is too short" in record.summary["note"]
    assert record.summary["status"] == "interrupted"
    save_record(record, tmp_path)
    assert not load_record(tmp_path).completed
    assert save_pictures(record, tmp_path) == []


def test_a_record_that_is_not_there(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"there is no .*solution\.npz"):
            load_record(place)
    (tmp_path / "bad.npz").touch()
    with pytest.raises(InputError, match=r"bad\.npz is a file; give the directory of a result"):
        load_record(tmp_path / "bad.npz")


def test_a_record_of_nearly_that_name_is_suggested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results" / "punch").mkdir(parents=True)
    (tmp_path / "results" / "punch" / "solution.npz").touch()
    for name in ("punch", "results/pnch"):
        with pytest.raises(InputError, match=r"did you mean 'results/punch'\?"):
            load_record(name)
    with pytest.raises(InputError, match=r"no kick/solution\.npz; `impactopt solve NAME`"):
        load_record("kick")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x93NUMPY\x01\x00v\x00{'descr': '<f8'"])
def test_a_file_of_another_kind_is_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "solution.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"solution\.npz is damaged"):
        load_record(tmp_path)


def test_an_array_in_place_of_a_record_is_damaged(tmp_path: Path) -> None:
    with open(tmp_path / "solution.npz", "wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match=r"solution\.npz is damaged"):
        load_record(tmp_path)


def test_characters_that_there_are_not_are_damage(tmp_path: Path) -> None:
    save_record(Record(summary={}, problem="[problem]"), tmp_path)
    with np.load(tmp_path / "solution.npz") as file:
        arrays = dict(file)
    text = arrays["problem_toml"].reshape(1).view(np.uint32).copy()
    text[3] = 0x7FFFFFFF
    np.savez(tmp_path / "solution.npz", **{**arrays, "problem_toml": text.view("<U9")[0]})
    with pytest.raises(InputError, match=r"solution\.npz is damaged"):
        load_record(tmp_path)


def test_a_damaged_record_is_never_read_as_another(tmp_path: Path) -> None:
    """Cut, or one byte changed: an InputError or, where nothing hangs on the byte, the same record."""
    small = Record(summary={"status": "solved"}, problem="text", arrays={"x": np.arange(5.0), "y": np.eye(2)})
    path, _ = save_record(small, tmp_path)
    whole = path.read_bytes()
    damaged = [whole[:k] for k in range(0, len(whole), 37)]
    for k in range(0, len(whole), 3):
        damaged.append(whole[:k] + bytes([whole[k] ^ 0x5A]) + whole[k + 1 :])
    refused = 0
    for content in damaged:
        path.write_bytes(content)
        try:
            back = load_record(tmp_path)
        except InputError as error:
            refused += 1
            assert "damaged" in str(error) or "newer" in str(error)
            continue
        assert back.summary == small.summary and back.problem == small.problem
        for name, value in small.arrays.items():
            np.testing.assert_array_equal(back.arrays[name], value)
    assert refused > len(damaged) / 2


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reference_q", np.zeros((3, 2))),
        ("reference_time", np.array(["a"])),
        ("reference_time", np.full(4, np.nan)),
        ("reference_torque", None),
        ("strike_posture", np.zeros(3)),
        ("joints", np.zeros(3)),
        ("torque_limit", np.zeros(1)),
        ("collision_ground", None),
        ("collision_ground", np.zeros(4)),
        ("collision_sole_wrench", None),
        ("collision_sole_wrench", np.zeros((0, 12))),
        ("simulated_contact_time", None),
        ("simulated_contact_force", np.zeros(0)),
        ("sole_left", np.zeros(4)),
        ("sole_left", np.full((4, 2), np.nan)),
        ("plan_x", np.zeros(2, dtype="S3")),
        ("summary_json", np.array("[" * 100_000)),
        ("summary_json", np.array("[]")),
        ("summary_json", np.array('{"status": 3}')),
        ("format", np.zeros(2)),
    ],
)
def test_an_array_that_is_not_what_it_should_be_is_named(
    record: Record, tmp_path: Path, name: str, value: Any
) -> None:
    numbers, _ = save_record(record, tmp_path)
    with np.load(numbers) as file:
        arrays = {key: file[key] for key in file.files if key != name}
    np.savez(numbers, **arrays, **({} if value is None else {name: value}))
    with pytest.raises(InputError, match="is damaged"):
        load_record(tmp_path)


def test_a_sole_of_a_stance_phase_without_corners_is_damage(record: Record, tmp_path: Path) -> None:
    summary = {**record.summary, "stances": [{"soles": ["left", "right"], "from_s": 0.0, "to_s": 1.0}]}
    save_record(dataclasses.replace(record, summary=summary), tmp_path)
    assert load_record(tmp_path).summary["stances"] == summary["stances"]
    arrays = {name: array for name, array in record.arrays.items() if name != "sole_left"}
    save_record(dataclasses.replace(record, summary=summary, arrays=arrays), tmp_path)
    with pytest.raises(InputError, match="sole_left is missing"):
        load_record(tmp_path)


TOUCH = {"one": "a", "other": "b", "depth_mm": 1.0}
START = {"start": "s", "status": "solved", "impulse_Ns": 1.0, "seconds": 1.0, "iterations": 1, "kept": True}


@pytest.mark.parametrize(
    ("at", "value"),
    [
        ("target.speed_m_s", "x"),
        ("torque_ratio.swing", "x"),
        ("torque_ratio", 1.0),
        ("zmp_margin_m", 1.0),
        ("objectives.impulse", []),
        ("versions.numpy", 2.0),
        ("problem.point_m", ["x"]),
        ("problem.name", 3),
        ("impulse_Ns", True),
        ("impulses_Ns", [1.0, "x"]),
        ("replayed.grip_force_N", "x"),
        ("violations", [{"row": "x"}]),
        ("violations", [{"row": "x", "by": 3}]),
        ("starts", [{**START, "kept": 1}]),
        ("starts", [{k: v for k, v in START.items() if k != "seconds"}]),
        ("contacts_besides", [{**TOUCH, "depth_mm": "1"}]),
        ("contacts_besides", [[]]),
        ("collision_elements", [0.5]),
        ("scenarios", [{"impulse_Ns": 1.0}]),
        ("simulated.torque_ratio", 0.5),
        ("simulated.target", [1.0]),
        ("simulated.standing", "yes"),
        ("simulated.error", {}),
        ("replayed.torque_ratio_by_phase", [1.0]),
        ("replayed.zmp_margin_m", {"swing": 1.0}),
        ("replayed.contacts_besides", [{**TOUCH, "one": None}]),
    ],
)
def test_a_nested_value_of_a_wrong_kind_is_named(record: Record, at: str, value: Any) -> None:
    check_summary(record.summary, whole=True)
    summary = copy.deepcopy(record.summary)
    *above, last = at.split(".")
    table = summary
    for name in above:
        table = table[name]
    table[last] = value
    with pytest.raises(ValueError, match=re.escape(at)):
        check_summary(summary, whole=True)


def test_keys_of_a_newer_version_are_let_be(record: Record) -> None:
    summary = {
        **record.summary,
        "later": [{"x": 1}],
        "simulated": {**record.summary["simulated"], "later": {}},
    }
    summary |= {"contacts_besides": [TOUCH], "starts": [START]}
    check_summary(summary, whole=True)


def test_a_record_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "solution.npz", format=FORMAT + 1)
    with pytest.raises(InputError, match="newer impactopt"):
        load_record(tmp_path)


def test_a_record_of_the_first_format_has_todays_names(record: Record, tmp_path: Path) -> None:
    numbers, _ = save_record(record, tmp_path)
    pair = {"place": "0 %", "joint": 3, "other": -1, "number": 0, "travel": 0.0}
    old = {"rows": [["a", "b", 0]], "more": [[]], "apart": [{**pair, "way": [0.1, 0.2, 1.0], "reach": 0.03}]}
    with np.load(numbers) as file:
        arrays = {key: file[key] for key in file.files}
    np.savez(numbers, **{**arrays, "format": 1, "program_statement": json.dumps(old)})
    assert json.loads(str(load_record(tmp_path).arrays["program_statement"])) == {
        "constraints": [["a", "b", 0]],
        "added_nodes": [[]],
        "clearance": [{**pair, "vector": [0.1, 0.2, 1.0], "least_distance": 0.03}],
    }


def test_a_record_without_the_kinds_of_joints_is_one(record: Record, tmp_path: Path) -> None:
    """As those that were saved before there were any."""
    numbers, _ = save_record(record, tmp_path)
    with np.load(numbers) as file:
        arrays = {key: file[key] for key in file.files if key != "prismatic"}
    np.savez(numbers, **arrays)
    assert not load_record(tmp_path).slides


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "solution.npz"
    path.write_bytes(b"old")

    def half(file: IO[bytes]) -> None:
        file.write(b"half of the new")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_file(path, half)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["solution.npz"], "nothing is left beside it"


def test_a_place_that_cannot_be_a_directory(record: Record, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot make the directory"):
        save_record(record, tmp_path / "file")
    (tmp_path / "summary.json").mkdir()
    with pytest.raises(InputError, match=r"cannot write over .*summary\.json"):
        save_record(record, tmp_path)


@pytest.mark.slow
def test_pictures_of_a_record(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STYLE, "savefig.dpi", DPI / 10)  # to be written sooner
    written = save_pictures(record, tmp_path)
    assert {path.stem for path in written} == set(PICTURES)
    for path in written:
        assert path.read_bytes().startswith(b"\x89PNG")
    assert set(tmp_path.iterdir()) == set(written)


@pytest.mark.slow
def test_pictures_need_no_replay_and_stale_ones_go(
    record: Record, problem: ImpactProblem, tmp_path: Path
) -> None:
    save_pictures(record, tmp_path)
    plan = record_of(still_solution(problem=problem))
    assert not plan.simulated
    on_a_fixed_base = dataclasses.replace(plan, arrays={**plan.arrays, "polygon": np.zeros((0, 2))})
    made = {path.stem for path in save_pictures(on_a_fixed_base, tmp_path)}
    assert made == set(PICTURES) - {"zmp", "replay"}
    assert not (tmp_path / "zmp.png").exists()
    assert not (tmp_path / "replay.png").exists()


def test_torque_over_its_limit_is_seen(problem: ImpactProblem) -> None:
    solution = still_solution(problem=problem)
    record = record_of(solution, simulation=simulation_of(solution, peak=1.3))
    figure = PICTURES["torque"](record)
    assert figure is not None
    assert "1.30" in figure.axes[1].get_title()
    mesh = figure.axes[1].collections[0]
    assert (np.asarray(mesh.get_array()) > mesh.get_clim()[1]).any()


def test_binning_keeps_every_peak() -> None:
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(0, 2, 3000))
    values = rng.uniform(size=(3000, 4))
    for most in (1, 7, 500, 5000):
        edges, binned = _binned(time, values, most)
        np.testing.assert_array_equal(binned.max(axis=0), values.max(axis=0))
        assert len(edges) == len(binned) + 1 <= most + 1
        assert (np.diff(edges) > 0).all()
