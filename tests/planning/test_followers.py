"""A plan for an arm whose hand follows its elbow: its replays, its check and its exports."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs
from support.problem_texts import bolted_arm
from typer.testing import CliRunner

from impactopt import Solution, Status, load_problem, solve
from impactopt.cli.app import app
from impactopt.files.output import record_of, save_record

PROBLEM = bolted_arm(
    name="parallelogram",
    frame="wrist_link",
    tip=[0.0, 0.0, 0.15],
    point=[0.55, 0.22, 0.465],
    normal=[0.0, 0.0, -1.0],
    start="ready",
    postures={"ready": {"turn": 0.385, "shoulder": 1.05, "elbow": -0.25}},
    robot="armature_kg_m2 = 0.05\nlocked_rad = {slide_0 = 0.0, slide_1 = 0.0}",
)
RATIO, OFFSET = -1.0, 1.7


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("followers")
    law = f'joint="elbow" multiplier="{RATIO}" offset="{OFFSET}"'
    (out / "robot.urdf").write_text(urdfs.following(urdfs.arm(), "wrist", law))
    (out / "problem.toml").write_text(PROBLEM)
    return out


@pytest.fixture(scope="module")
def plan(folder: Path) -> Solution:
    return solve(load_problem(folder / "problem.toml"))


@pytest.fixture(scope="module")
def saved(folder: Path, plan: Solution) -> Path:
    path = folder / "problem.toml"
    save_record(record_of(plan, problem=PROBLEM, problem_path=path), folder / "result")
    return folder / "result"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_engines_replay_the_plan(plan: Solution, engine: str) -> None:
    assert plan.status is Status.SOLVED
    replay = plan.validate(engine=engine)
    assert replay.impulse == pytest.approx(plan.impulse, rel=0.01) and not replay.fall


def test_the_hand_keeps_the_turn_of_the_upper_arm(plan: Solution) -> None:
    """By the free tree: the hand's pitch is that of shoulder, elbow and -elbow, and the offset."""
    robot = plan.problem.robot
    data, shoulder = robot.model.createData(), robot.joint_index("shoulder")
    for q in plan.trajectory.q[::50]:
        pin.forwardKinematics(robot.model, data, q)
        turn, upper = robot.joint_positions(q)[[robot.joint_index("turn"), shoulder]]
        wanted = pin.rpy.rpyToMatrix(0.0, upper + OFFSET, turn)
        np.testing.assert_allclose(data.oMi[robot.model.getJointId("wrist")].rotation, wanted, atol=1e-9)


def test_the_problem_is_told_with_its_followers(plan: Solution) -> None:
    assert plan.problem.describe()["followers"] == ["wrist = -1 elbow +1.7"]


def test_followers_have_no_motor(plan: Solution) -> None:
    assert plan.problem.robot.joint_names == ("turn", "shoulder", "elbow")
    assert plan.trajectory.torque.shape[1] == 3


def test_the_saved_plan_is_verified(saved: Path) -> None:
    result = CliRunner().invoke(app, ["verify", str(saved), "--json"])
    assert result.exit_code == 0, result.output


def test_another_law_is_found(plan: Solution, folder: Path) -> None:
    """`verify` knows the law: with another multiplier the motion misses its torques."""
    other = urdfs.following(urdfs.arm(), "wrist", 'joint="elbow" multiplier="-1.05" offset="1.7"')
    there = folder / "other"
    there.mkdir()
    (there / "robot.urdf").write_text(other)
    (there / "problem.toml").write_text(PROBLEM)
    record = record_of(plan, problem=PROBLEM, problem_path=there / "problem.toml")
    save_record(record, there / "result")
    assert CliRunner().invoke(app, ["verify", str(there / "result")]).exit_code != 0


@pytest.mark.slow
def test_exports_command_leaders_and_tell_followers(saved: Path, tmp_path: Path) -> None:
    law = {"name": "wrist", "joint": "elbow", "multiplier": RATIO, "offset": OFFSET}
    for word in ("csv", "ros2", "mcap", "mujoco"):
        out = tmp_path / word
        result = CliRunner().invoke(app, ["export", str(saved), "--to", word, "--out", str(out)])
        assert result.exit_code == 0, result.output
        meta = json.loads((out / "meta.json").read_text())
        assert [joint["name"] for joint in meta["joints"]] == ["turn", "shoulder", "elbow"]
        assert meta["followers"] == [law]
    result = CliRunner().invoke(app, ["export", str(saved), "--to", "mjlab", "--out", str(tmp_path / "lab")])
    assert result.exit_code == 2 and "'wrist'" in result.output


@pytest.mark.slow
def test_the_exported_scene_plays_the_plan(saved: Path, plan: Solution, tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    out = tmp_path / "scene"
    CliRunner().invoke(app, ["export", str(saved), "--to", "mujoco", "--out", str(out)])
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    place = [model.joint(name).qposadr[0] for name in ("elbow", "wrist")]
    for key in range(model.nkey):
        elbow, wrist = model.key_qpos[key][place]
        assert wrist == pytest.approx(RATIO * elbow + OFFSET, abs=1e-5)
    played = subprocess.run(
        [sys.executable, "play.py"], cwd=out, capture_output=True, text=True, check=True, timeout=300
    ).stdout
    impulse = float(played.split("impulse ")[1].split()[0])
    assert impulse == pytest.approx(plan.impulse, rel=0.02)


def test_a_plan_with_the_sdc_is_near_full_dynamics(plan: Solution) -> None:
    sdc = dataclasses.replace(plan.problem, collision="sdc")
    assert solve(sdc).impulse == pytest.approx(plan.impulse, rel=0.03)
