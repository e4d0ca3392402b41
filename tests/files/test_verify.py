"""`impactopt verify`: a result is what it says, and one that was tampered with is not."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import arm_problem
from typer.testing import CliRunner

import impactopt
from impactopt import (
    Effort,
    FreeMass,
    GearLoad,
    HitRegion,
    Impulse,
    InputError,
    Penetration,
    SpringDamper,
    TargetEnergy,
    VelocityJump,
    load_problem,
    load_record,
    load_solution,
)
from impactopt.cli.app import app
from impactopt.files.output import record_of, save_record
from impactopt.files.problem_file import read_problem_file
from impactopt.files.record import Record
from impactopt.files.verify import motion_of_record, verify_record
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve

ARM = Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml"
runner = CliRunner()


@pytest.fixture(scope="module")
def record(hammered: Solution) -> Record:
    return record_of(hammered, problem=ARM.read_text("utf-8"), problem_path=ARM)


# The hammer in a soft grip, gears' loads, and a price on effort.
SOFT = """
[terms.gear_load]
limit = 2.5

[objectives.effort]
weight = 0.02

[robot]
preset = "planar_arm"

[robot.grips.hammer]
axis = [0.0, 1.0, 0.0]
point_m = [0.0, 0.0, 0.05]
stiffness_N_m_rad = 200.0
damping_N_m_s_rad = 2.0
"""


@pytest.fixture(scope="module")
def soft_record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    text = ARM.read_text("utf-8").replace('robot = "planar_arm"\n', "") + SOFT
    path = tmp_path_factory.mktemp("soft") / "soft.toml"
    path.write_text(text, "utf-8")
    return record_of(solve(load_problem(path), refine=False), problem=text, problem_path=path)


def verified(directory: Path, *, code: int) -> dict[str, Any]:
    result = runner.invoke(app, ["verify", str(directory), "--json"])
    assert result.exit_code == code, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def test_a_result_is_verified(record: Record, tmp_path: Path) -> None:
    save_record(record, tmp_path)
    found = verified(tmp_path, code=0)
    assert found["ok"] is True and found["reason"] == ""
    assert found["max_violation"] < 1e-5 and found["kkt"] < 1e-5
    assert found["objective"] == pytest.approx(float(record.arrays["solver_objective"]), abs=1e-9)
    terms = {
        "torque limit",
        "contact law",
        "collision dynamics",
        "hit point",
        "distance of bodies",
        "summary",
    }
    assert terms <= found["rows"].keys()
    assert set(found["rows"]["contact law"]) == {"violation", "where"}


@pytest.mark.slow
def test_drives_and_grips_are_verified(soft_record: Record, tmp_path: Path) -> None:
    save_record(soft_record, tmp_path)
    found = verified(tmp_path, code=0)
    assert found["ok"] is True and found["kkt"] < 1e-5
    assert {"gear load", "spring of a joint", "effort of a node"} <= found["rows"].keys()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("limit = 2.5", "limit = 0.7", "gear load"),
        ("stiffness_N_m_rad = 200.0", "stiffness_N_m_rad = 190.0", "spring of a joint"),
        ("damping_N_m_s_rad = 2.0", "damping_N_m_s_rad = 1.5", "spring of a joint"),
        ("weight = 0.02", "weight = 0.021", "objective"),
    ],
)
def test_a_plan_of_other_drives_is_not(
    soft_record: Record, tmp_path: Path, old: str, new: str, word: str
) -> None:
    """The plan is called that of a problem with tighter gears, a stiffer grip, dearer effort."""
    assert old in soft_record.problem
    save_record(dataclasses.replace(soft_record, problem=soft_record.problem.replace(old, new)), tmp_path)
    assert verified(tmp_path, code=1)["rows"][word]["violation"] > 1e-5


@pytest.mark.parametrize("group", ["torque, follow-through, 40 %", "first force", "effort of a node"])
def test_variables_of_drives_are_not_believed(soft_record: Record, tmp_path: Path, group: str) -> None:
    arrays = {name: np.array(array) for name, array in soft_record.arrays.items()}
    groups = json.loads(str(arrays["program_statement"]))["groups"]
    at = [name for name, _, _ in groups].index(group)
    arrays["solver_x"][sum(count * size for _, count, size in groups[:at])] += 1e-3
    save_record(dataclasses.replace(soft_record, arrays=arrays), tmp_path)
    assert verified(tmp_path, code=1)["ok"] is False


def turned(name: str, by: float) -> Callable[[dict[str, Any]], None]:
    """One joint angle of an array moved [rad], or one number of it."""

    def change(arrays: dict[str, Any]) -> None:
        arrays[name].flat[arrays[name].size // 2] += by

    return change


def emptied(name: str) -> Callable[[dict[str, Any]], None]:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] *= 0.0

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "word"),
    [
        (turned("reference_q", 1e-3), "reference_q"),
        (turned("reference_angle", 1e-3), "reference_angle"),
        (turned("swing_control", 1e-3), "swing_control"),
        (turned("reference_torque", 1.0), "reference_torque"),
        (turned("collision_force", 1e3), "collision_force"),
        (turned("solver_x", 1e-3), ""),
        (emptied("solver_multipliers"), "KKT residual"),
        (emptied("solver_bound_multipliers"), "KKT residual"),
    ],
)
def test_what_was_tampered_with_is_not(
    record: Record, tmp_path: Path, change: Callable[[dict[str, Any]], None], word: str
) -> None:
    arrays = {name: np.array(array) for name, array in record.arrays.items()}
    change(arrays)
    save_record(dataclasses.replace(record, arrays=arrays), tmp_path)
    found = verified(tmp_path, code=1)
    assert found["ok"] is False and word in found["reason"]


@pytest.mark.parametrize("key", ["impulse_Ns", "hand_speed_m_s", "contact_ms"])
def test_a_number_of_the_summary_is_not_believed(record: Record, tmp_path: Path, key: str) -> None:
    summary = {**record.summary, key: 1.001 * record.summary[key]}
    save_record(dataclasses.replace(record, summary=summary), tmp_path)
    assert f"summary, {key}" in verified(tmp_path, code=1)["reason"]


@pytest.mark.slow
def test_the_summary_beside_is_the_one_inside(record: Record, tmp_path: Path) -> None:
    save_record(record, tmp_path)
    path = tmp_path / "summary.json"
    path.write_text(path.read_text().replace('"impulse_Ns"', '"impulse_Ns_too"'))
    assert "summary.json" in verified(tmp_path, code=1)["reason"]
    path.write_text("[" * 100_000, encoding="utf-8")
    assert "summary.json" in verified(tmp_path, code=1)["reason"], "nested too deeply to be read"


def test_multipliers_of_other_rows_do_not_fit(record: Record, tmp_path: Path) -> None:
    arrays = {name: np.array(array) for name, array in record.arrays.items()}
    arrays["solver_multipliers"] = np.roll(arrays["solver_multipliers"], 1)
    save_record(dataclasses.replace(record, arrays=arrays), tmp_path)
    assert "KKT residual" in verified(tmp_path, code=1)["reason"]


def test_a_result_that_says_nothing_of_its_program(record: Record, tmp_path: Path) -> None:
    arrays = {name: a for name, a in record.arrays.items() if name != "program_statement"}
    save_record(dataclasses.replace(record, arrays=arrays), tmp_path)
    result = runner.invoke(app, ["verify", str(tmp_path)])
    assert result.exit_code == 2 and "before `verify`; solve again" in " ".join(result.output.split())
    with pytest.raises(InputError, match="it is a strike, the impact alone"):
        verify_record(dataclasses.replace(record, arrays={"strike_posture": np.zeros(3)}), load_problem(ARM))


def test_a_result_of_another_program_is_said(record: Record, tmp_path: Path) -> None:
    """Another model of the collision has other variables: nothing is called right that was not looked at."""
    text = ARM.read_text("utf-8") + '\n[collision]\nmodel = "sdc"\nfreezes = 1\n'
    save_record(dataclasses.replace(record, problem=text), tmp_path)
    found = verified(tmp_path, code=1)
    assert found["kkt"] is None and "its program is not the one" in found["reason"]
    assert load_record(tmp_path).problem == text


@pytest.mark.slow
def test_a_plan_by_a_model_that_is_frozen_on_the_way_is_verified(tmp_path: Path) -> None:
    text = ARM.read_text("utf-8") + '\n[collision]\nmodel = "sdc"\nfreezes = 2\n'
    (tmp_path / "frozen.toml").write_text(text, "utf-8")
    solution = solve(load_problem(tmp_path / "frozen.toml"))
    assert solution.status.usable
    save_record(record_of(solution, problem=text, problem_path=ARM), tmp_path / "result")
    assert verified(tmp_path / "result", code=0)["kkt"] < 1e-5


@pytest.mark.slow
def test_a_plan_of_the_cheapest_model_is_verified(tmp_path: Path) -> None:
    """Its file leaves the model open, and its program has the one that was chosen."""
    file = read_problem_file("arm_planar", {"collision.model": "auto"})
    plan = solve(file.build())
    save_record(record_of(plan, problem=file.text, problem_path=file.path), tmp_path / "auto")
    assert plan.problem.collision == "sdc" and verified(tmp_path / "auto", code=0)["ok"]
    assert load_solution(tmp_path / "auto").problem.hash == plan.problem.hash


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"terms": (VelocityJump(limit=9.0), GearLoad())},  # in another order than in the file
        {
            "target": FreeMass(mass=2.0),
            "law": SpringDamper(stiffness=1e5, damping=100.0),
            "objectives": (Effort(weight=0.01), Penetration(weight=-10.0), TargetEnergy(), Impulse()),
        },
        {"terms": (HitRegion(radius=0.03),)},  # hit away from its middle
    ],
)
def test_a_plan_that_is_saved_in_python_is_verified(changes: dict[str, Any], tmp_path: Path) -> None:
    plan = impactopt.solve(dataclasses.replace(load_problem("arm_planar"), **changes))
    found = verified(plan.save(tmp_path / "result"), code=0)
    assert found["ok"], found["reason"]
    assert load_solution(tmp_path / "result").result.x == pytest.approx(plan.result.x, abs=0.0)


def test_the_motion_is_looked_at_by_pinocchio(record: Record) -> None:
    problem = load_problem(ARM)
    arrays = {name: np.array(array) for name, array in record.arrays.items()}
    good = {name: by for name, by, _ in motion_of_record(problem, arrays)}
    assert max(good.values()) < 1e-5 and len(good) >= 5
    for name, word in (("q", "hit point"), ("v", "rates"), ("torque", "equation of motion")):
        other = dict(arrays)
        other[f"reference_{name}"] = arrays[f"reference_{name}"] * 1.01 + 1e-3
        found = {what: by for what, by, _ in motion_of_record(problem, other) if by > 1e-5}
        assert f"reference: {word}" in found


def test_a_continuous_joint_may_creep() -> None:
    """Histories are rounded, and its cosine and sine are then off the unit circle."""
    problem, time = arm_problem(), np.linspace(0.0, 0.1, 101)
    start = problem.start_posture
    v = np.zeros((len(time), problem.robot.nv))
    v[:, 0] = 0.01
    q = np.array([pin.integrate(problem.robot.model, start, t * v[0]) for t in time])
    arrays = {"time": time, "phase": np.full(len(time), 2), "v": v, "a": 0 * v, "torque": 0 * v}
    arrays["q"] = q.astype(np.float32).astype(float)
    found = motion_of_record(problem, {f"reference_{name}": array for name, array in arrays.items()})
    assert max(by for what, by, _ in found if what == "reference: rates") < 1e-6
