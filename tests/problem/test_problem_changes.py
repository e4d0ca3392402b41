"""Problem files as data: other values by key paths, text and back, and the hash of what came out."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impactopt import CustomLaw, FreeMass, ImpactProblem, InputError, Phase, Striker, load_problem
from impactopt.files.problem_file import (
    ProblemFile,
    change_data,
    key_place,
    parse_settings,
    read_problem_file,
    read_toml,
    write_toml,
)
from impactopt.problem import objectives, terms
from impactopt.problem.hashing import problem_hash

DATA: dict[str, Any] = {
    "problem": {
        "robot": "planar_arm",
        "striker": "hammer",
        "start": "ready",
        "point_m": [0.7, 0.0, 0.75],
        "normal": [0.0, 0.0, -1.0],
    },
    "target": {"mass_kg": 0.5},
    "contact": {"stiffness_N_m": 1e4, "damping_N_s_m": 30.0},
    "swing": {"duration_s": [0.4, 0.8]},
    "scenarios": [{"name": "missing", "missing": True}, {"name": "heavy", "mass": 2.0}],
}


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return ProblemFile.from_data(DATA, Path("arm.toml")).build()


def message(settings: dict[str, Any]) -> str:
    with pytest.raises(InputError) as caught:
        change_data(DATA, settings)
    return str(caught.value)


def test_keys_may_leave_their_unit_out_and_name_entries_of_lists() -> None:
    before = write_toml(DATA)
    data = change_data(
        DATA,
        {
            "target.mass": np.float64(8),
            "contact.stiffness_N_m": 2e4,
            "problem.point.1": 0.1,
            "problem.normal": np.array([1.0, 0.0, 0.0]),
            "scenarios.heavy.mass": 3,
            "scenarios.0.abort_after": 0.03,
            "swing.duration": (0.5, 0.6),
            "terms.torque_limit.fraction": 0.7,
            "solver.ipopt.tol": 1e-5,
        },
    )
    assert data["target"] == {"mass_kg": 8.0} and type(data["target"]["mass_kg"]) is float
    assert data["contact"] == {"stiffness_N_m": 2e4, "damping_N_s_m": 30.0}
    assert data["problem"]["point_m"] == [0.7, 0.1, 0.75]
    assert data["problem"]["normal"] == [1.0, 0.0, 0.0]
    assert data["scenarios"][1]["mass"] == 3 and data["scenarios"][0]["abort_after_s"] == 0.03
    assert data["swing"]["duration_s"] == [0.5, 0.6]
    assert data["terms"] == {"torque_limit": {"fraction": 0.7}}
    assert data["solver"] == {"ipopt": {"tol": 1e-5}}
    assert write_toml(DATA) == before, "the data that were given are left alone"
    assert key_place(DATA, "scenarios.heavy.mass") == ("scenarios", 1, "mass")


def test_keys_of_the_collision_may_leave_their_unit_out() -> None:
    given = {"duration": [0.0, 0.01], "auto_impulse": 0.1, "auto_zmp": 1.0}
    data = change_data(DATA, {f"collision.{key}": value for key, value in given.items()})
    assert data["collision"] == {"duration_s": [0.0, 0.01], "auto_impulse_pct": 0.1, "auto_zmp_mm": 1.0}


def test_a_key_of_the_robot_makes_a_section_of_its_preset() -> None:
    data = change_data(DATA, {"robot.kp": 500.0, "robot.torque_limit.elbow": 30.0})
    assert data["robot"] == {
        "preset": "planar_arm",
        "kp_N_m_rad": 500.0,
        "torque_limit_N_m": {"elbow": 30.0},
    }
    assert "robot" not in data["problem"]
    assert change_data(DATA, {"problem.robot": "arm7"})["problem"]["robot"] == "arm7"


def test_another_kind_has_other_keys() -> None:
    data = change_data(DATA, {"target": {"kind": "nail", "mass_kg": 0.1}, "target.resistance": 300})
    assert data["target"] == {"kind": "nail", "mass_kg": 0.1, "resistance_N": 300}
    assert "resistance" in message({"target.resistance": 300})


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("target.mas", ["[target]", "'mas'", "did you mean 'mass'"]),
        ("targets.mass", ["targets.mass", "did you mean 'target'"]),
        ("contact.law.x", ["contact.law has no parts"]),
        ("scenarios.hevy.mass", ["did you mean 'heavy'", "missing, heavy", "0 to 1"]),
        ("scenarios.2.mass", ["'2'", "0 to 1"]),
        ("scenarios.heavy.mas", ["[scenarios.1]", "did you mean 'mass'"]),
        ("problem.point.3", ["problem.point_m", "0 to 2"]),
        ("collision.compression.0", ["collision.compression is not in the file"]),
        ("terms.balance.capture", ["[terms.balance]", "capture_margin"]),
        ("", ["has no key ''", "known are problem"]),
    ],
)
def test_unknown_keys_are_named_with_the_fix(key: str, parts: list[str]) -> None:
    text = message({key: 1.0})
    assert [part for part in parts if part not in text] == []
    with pytest.raises(InputError):
        key_place(DATA, key)


def test_all_unknown_keys_are_named_at_once() -> None:
    rows = message({"target.mas": 1, "target.mass": 2, "contact.stif": 3}).splitlines()
    assert "2 mistakes" in rows[0] and "target.mas" in rows[1] and "contact.stif" in rows[2]


def test_a_value_that_is_wrong_is_told_as_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(write_toml({**DATA, "contact": {"stiffness_N_m": -1.0, "damping_N_s_m": 1.0}}))
    with pytest.raises(InputError, match=r"line \d+, \[contact\] stiffness_N_m"):
        read_problem_file(path)
    path.write_text(write_toml(DATA))
    with pytest.raises(InputError, match=r"arm.toml, as set, \[target\] mass_kg: -1; give a number > 0"):
        read_problem_file(path, {"target.mass": -1})
    with pytest.raises(InputError, match=r"arm.toml: target.mas: .*did you mean"):
        read_problem_file(path, {"target.mas": 1})
    with pytest.raises(InputError, match=r"case 7, \[target\] mass_kg|case 7: \[target\] mass_kg"):
        ProblemFile.from_data(change_data(DATA, {"target.mass": 0}), Path("case 7")).build()


def test_a_changed_files_text_says_what_is_solved(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(write_toml(DATA))
    read = read_problem_file(path, {"target.mass": 0.75})
    assert read.build().target == FreeMass(mass=0.75)
    path.write_text(read.text)
    assert load_problem(path).hash == read.build().hash
    assert read_problem_file(path, {}).text == path.read_text(), "without a change its text is its own"


def test_settings_of_a_command_line() -> None:
    texts = [
        "target.mass = 8",
        "problem.striker=left_hand",
        "target={kind='wall'}",
        "swing.duration=[0.5, 1]",
    ]
    assert parse_settings(texts) == {
        "target.mass": 8,
        "problem.striker": "left_hand",
        "target": {"kind": "wall"},
        "swing.duration": [0.5, 1],
    }
    for text in ("target.mass", "=8", "target.mass=", "target.mass=8 kg", "a=1\nb=2", "a=__import__('os')"):
        with pytest.raises(InputError, match="KEY=VALUE"):
            parse_settings([text])
    with pytest.raises(InputError, match="2 mistakes"):
        parse_settings(["a", "b", "c=1"])


NUMBER = st.floats(allow_nan=False) | st.integers(-(2**53), 2**53) | st.booleans()
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
VALUE = st.recursive(NUMBER | TEXT, lambda v: st.lists(v, max_size=3) | st.dictionaries(TEXT, v, max_size=3))


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(TEXT, VALUE, max_size=4))
def test_toml_gives_back_what_was_written(data: dict[str, Any]) -> None:
    assert read_toml(write_toml(data)) == data
    assert read_toml(write_toml(data, lambda place: "a comment")) == data


def test_the_hash_is_of_the_content(problem: ImpactProblem) -> None:
    def changed(**changes: Any) -> str:
        return dataclasses.replace(problem, **changes).hash

    same = [
        changed(name="another"),
        changed(target=FreeMass(mass=0.5)),
        changed(terms=terms.DEFAULT_TERMS[::-1]),
        changed(objectives=(objectives.Impulse(weight=1),)),
        changed(start=problem.start_posture, point=tuple(problem.point)),
        ProblemFile.from_data(read_toml(write_toml(DATA)), Path("elsewhere")).build().hash,
    ]
    assert set(same) == {problem.hash} and problem.hash == problem_hash(problem)
    near = problem.contact_posture
    named = dataclasses.replace(problem.robot, postures={**problem.robot.postures, "near": near})
    assert changed(near_contact=near) == changed(near_contact="near", robot=named)
    hammer = problem.robot.striker("hammer")
    moved = Striker(name="hammer", frame=hammer.frame, point=hammer.point + np.array([0.001, 0, 0]))
    law: dict[str, Any] = {"compression": lambda x, rate, k: k * x, "k": 1e4}
    other = [
        changed(target=FreeMass(mass=0.5 + 1e-15)),
        changed(scenarios=()),
        changed(near_contact=near),
        changed(terms=(terms.TorqueLimit(fraction=0.8),)),
        changed(objectives=(objectives.Impulse(weight=2.0),)),
        changed(swing=Phase(duration=(0.4, 0.8), intervals=13)),
        changed(point=problem.point + np.array([0.001, 0, 0])),
        changed(robot=dataclasses.replace(problem.robot, kp=problem.robot.kp * 1.01)),
        changed(robot=problem.robot.with_striker(moved)),
        changed(law=CustomLaw(**law)),
        changed(law=CustomLaw(**{**law, "compression": lambda x, rate, k: k * x + 0.1 * rate})),
        changed(law=CustomLaw(**{**law, "k": 2e4})),
    ]
    assert len({problem.hash, *other}) == 1 + len(other)


@pytest.mark.slow
def test_the_hash_is_the_same_in_another_process(problem: ImpactProblem) -> None:
    code = (
        "from pathlib import Path\n"
        "from impactopt.files.problem_file import ProblemFile\n"
        f"print(ProblemFile.from_data({DATA!r}, Path('arm.toml')).build().hash)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == problem.hash


def test_every_field_of_a_problem_counts_in_its_hash(problem: ImpactProblem) -> None:
    """A field that could differ unseen would make two problems one in a sweep's table."""
    source = (Path(problem_hash.__code__.co_filename)).read_text(encoding="utf-8")
    assert "dataclasses.fields(problem)" in source
    for name, value in (
        ("smoothness", 2e-5),
        ("wrench_price", 2e-3),
        ("return_price", 0.2),
        ("collision_stages", 2),
        ("contact_duration", (0.002, 0.1)),
        ("collision_elements", ((0.3, 0.7), (1.0,))),
    ):
        assert dataclasses.replace(problem, **{name: value}).hash != problem.hash, name


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("hsllib", "{folder}/evil.so"),
        ("pardisolib", "{folder}/evil.so"),
        ("output_file", "{folder}/written.txt"),
        ("option_file_name", "{folder}/options.txt"),
        ("resto.hsllib", "{folder}/evil.so"),
        ("resto.tol", 1e-5),
        ("linear_solver", "ma77"),
        ("tol", [1e-5]),
    ],
)
def test_a_file_loads_no_library_and_writes_no_file(tmp_path: Path, option: str, value: Any) -> None:
    given = value.format(folder=tmp_path) if isinstance(value, str) else value
    with pytest.raises(InputError, match=rf"\[solver\] ipopt: {option}"):
        ProblemFile.from_data({**DATA, "solver": {"ipopt": {option: given}}}, Path("arm.toml")).build()
    assert list(tmp_path.iterdir()) == []


def test_an_options_file_in_the_working_directory_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = tmp_path / "ipopt.opt"
    planted.write_text("output_file written.txt\nfile_print_level 5\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    ProblemFile.from_data({**DATA, "solver": {"ipopt": {"tol": 1e-5}}}, Path("arm.toml")).build()
    assert list(tmp_path.iterdir()) == [planted]


@pytest.mark.parametrize(
    "text", ["__import__('os').system('touch x')", "{0.__class__}", "%(x)s", "$(touch x)"]
)
def test_text_stays_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    data = change_data(DATA, {"problem.name": text})
    assert ProblemFile.from_data(read_toml(write_toml(data)), Path("x.toml")).build().name == text
    assert list(tmp_path.iterdir()) == []


def test_what_python_can_say_a_file_can_too(problem: ImpactProblem) -> None:
    """None and infinity have their words; a configuration and a matrix their lists."""
    balance = {"capture_margin": "anywhere", "vertical_speed": float("inf"), "angular_momentum": float("inf")}
    data = change_data(DATA, {f"terms.balance.{key}": value for key, value in balance.items()})
    data = change_data(data, {"terms.incidence.speed": float("inf"), "problem.start": problem.start_posture})
    made = ProblemFile.from_data(data, Path("x.toml")).build()
    free = terms.Balance(capture_margin=None, vertical_speed=np.inf, angular_momentum=np.inf)
    assert made.term(terms.Balance) == free
    assert made.term(terms.Incidence) == terms.Incidence(speed=np.inf)
    np.testing.assert_array_equal(made.start_posture, problem.start_posture)
    for key, value, said in (
        ("terms.balance.capture_margin", "nowhere", "anywhere"),
        ("terms.balance.vertical_speed", float("nan"), ">= 0"),
        ("problem.start", [0.1, float("nan")], "a list of numbers"),
        ("problem.start", [0.1, 0.2], r"expected shape \(3\)"),
        ("robot.position_limit.elbow", [1.0, float("nan")], "must not exceed"),
    ):
        with pytest.raises(InputError, match=said):
            ProblemFile.from_data(change_data(DATA, {key: value}), Path("x.toml")).build()


def test_all_that_is_wrong_with_a_problem_is_said_at_once(problem: ImpactProblem) -> None:
    gaze = terms.Gaze(frame="heed", axis=(1, 0, 0))
    rate = terms.TorqueRate(limit={"elbo": 1.0, "wrst": 1.0})
    with pytest.raises(InputError) as caught:
        dataclasses.replace(
            problem,
            striker="hamer",
            normal=[1.0, 1.0, 0.0],
            smoothness=-1.0,
            contact_duration=(0.2, 0.1),
            terms=(gaze, rate),
        )
    said = ["'hammer'", "unit vector", "smoothness", "contact_duration", "'heed'", "'elbow'", "'wrist'"]
    assert len(caught.value.mistakes) == len(said)
    assert "the problem has 7 mistakes" in str(caught.value)
    for fix in said:
        assert sum(fix in mistake for mistake in caught.value.mistakes) == 1, fix


def test_all_that_is_wrong_with_a_robot_is_said_with_its_lines(tmp_path: Path) -> None:
    data = {**DATA, "problem": {k: v for k, v in DATA["problem"].items() if k != "robot"}}
    hand = {"name": "hand", "frame": "hnd", "point_m": [0.0, 0.0, 0.1]}
    robot = {"preset": "planar_arm", "kp_N_m_rad": {"elbw": 1.0}, "kd_N_m_s_rad": {"wrst": 1.0}}
    path = tmp_path / "arm.toml"
    path.write_text(write_toml({**data, "robot": {**robot, "strikers": [hand]}}), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_problem(path)
    rows = str(caught.value).splitlines()
    assert "3 mistakes" in rows[0]
    lines = path.read_text(encoding="utf-8").splitlines()
    for row, (key, meant) in zip(rows[1:], (("elbw", "elbow"), ("wrst", "wrist"), ("hnd", "")), strict=True):
        number = int(row.split("line ")[1].split(",")[0])
        assert key in row and meant in row
        assert key in "".join(lines[number - 2 : number + 2])


def test_names_in_terms_are_told_beside_other_names() -> None:
    data = change_data(DATA, {"problem.striker": "hamer", "problem.start": "redy"})
    data = change_data(data, {"terms.gaze": {"frame": "elbw", "axis": [1.0, 0.0, 0.0]}})
    with pytest.raises(InputError) as caught:
        ProblemFile.from_data(data, Path("arm.toml")).build()
    text = str(caught.value)
    assert "3 mistakes" in text and "[terms.gaze]" in text
    assert all(meant in text for meant in ("'hammer'", "'ready'", "'elbow'"))
