"""Numbers of robots that are sound by themselves and hard to believe are told, or refused."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs
from support.problem_texts import bolted_arm
from support.small_plans import biped_problem
from support.small_robots import biped
from typer.testing import CliRunner

from impactopt import Robot, Striker, arm7, load_problem, planar_arm, write_problem
from impactopt.cli.app import app
from impactopt.problem.feasibility import hopeless
from impactopt.problem.plausibility import doubts


def _with_soles(robot: Robot, **changes: dict[str, object]) -> Robot:
    soles = [dataclasses.replace(s, **changes.get(s.name, changes.get("each", {}))) for s in robot.soles]
    return dataclasses.replace(robot, soles=tuple(soles))


def _with_armature(robot: Robot, value: float) -> Robot:
    model = robot.model.copy()
    model.armature = np.concatenate([np.zeros(robot.nv - robot.n), np.full(robot.n, value)])
    return dataclasses.replace(robot, model=model, kp=0.01 * robot.kp, kd=0.01 * robot.kd)


def test_robots_of_the_package_are_believed() -> None:
    for robot in (biped(), planar_arm(), arm7()):
        assert [text for text in doubts(robot) if "no joint has armature" not in text] == []


@pytest.mark.parametrize(("value", "word"), [(1e-5, "too small"), (100.0, "too large")])
def test_armatures_that_no_drive_has_are_doubted(value: float, word: str) -> None:
    robot = _with_armature(arm7(), value)
    (told,) = doubts(robot)
    assert word in told and f"{value:.2g} kg m2" in told and "rotor inertia x gear ratio^2" in told


def test_a_robot_in_millimetres_is_doubted() -> None:
    robot = planar_arm()
    model = robot.model.copy()
    for j in range(1, model.njoints):
        model.jointPlacements[j] = pin.SE3(np.eye(3), 1e3 * model.jointPlacements[j].translation)
    assert any(
        "millimetres? Give lengths in metres" in text
        for text in doubts(dataclasses.replace(robot, model=model))
    )


def test_limits_in_degrees_are_doubted() -> None:
    robot = planar_arm()
    wrong = dataclasses.replace(robot, upper=np.rad2deg(robot.upper))
    told = [text for text in doubts(wrong) if "in degrees?" in text]
    assert len(told) == 1
    assert told[0].startswith("position limits of shoulder and 2 more joints: -2.6 to 149 rad are hard to")


@pytest.mark.parametrize(("angle", "told"), [("radian", 0), ("degree", 1)])
def test_angles_of_an_mjcf_in_radians_are_doubted_without_its_saying_so(
    tmp_path: Path, angle: str, told: int
) -> None:
    pytest.importorskip("mujoco")
    body = '<body name="{0}" pos="0 0 .3"><joint name="{0}" axis="0 1 0" range="-2.1 2.1"/><geom size=".1"/>'
    links = body.format("upper") + body.format("lower") + "</body></body>"
    path = tmp_path / "arm.xml"
    path.write_text(f'<mujoco><compiler angle="{angle}"/><worldbody>{links}</worldbody></mujoco>')
    robot = Robot.from_mjcf(path, torque_limit=50.0, velocity_limit=4.0)
    assert sum("are angles of the file in radians?" in text for text in doubts(robot)) == told


def test_the_inertia_of_a_body_lighter_than_foam_is_doubted() -> None:
    robot = planar_arm()
    model = robot.model.copy()
    model.inertias[2] = pin.Inertia(0.01, np.zeros(3), 1e-3 * np.eye(3))
    (told,) = doubts(dataclasses.replace(robot, model=model))
    assert told.startswith(f"inertia of {model.names[2]}: that of 0.01 kg in a box 0.77 m long")
    model.inertias[1] = model.inertias[2]
    (told,) = doubts(dataclasses.replace(robot, model=model))
    assert told.startswith(f"inertia of {model.names[1]} and 1 more joint: ")


def test_one_lost_mesh_is_told_as_one(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(urdfs.arm().replace('<box size="0.08 0.08 0.1"/>', '<mesh filename="gone.stl"/>'))
    told = doubts(Robot.from_urdf(path, floating=False, armature=0.1))
    assert any(text.startswith("1 mesh is lost, and boxes of inertia stand for links") for text in told)


def test_soles_in_millimetres_are_refused() -> None:
    problem = biped_problem()
    polygon = 1e3 * problem.robot.soles[0].polygon
    wrong = _with_soles(problem.robot, each={"polygon": polygon})
    told = hopeless(dataclasses.replace(problem, robot=wrong))
    assert len(told) == 2 and all("are its corners in millimetres?" in text for text in told)
    assert hopeless(problem) == []


def test_soles_on_the_wrong_side_and_unlike_ones_are_doubted() -> None:
    robot = biped()
    left, right = (next(s for s in robot.soles if s.name == name) for name in ("left", "right"))
    swapped = _with_soles(robot, left={"frame": right.frame}, right={"frame": left.frame})
    assert any("'left' is to the right of 'right'" in text for text in doubts(swapped))
    longer = _with_soles(robot, left={"polygon": left.polygon * [1.5, 1.0]})
    assert any("are not alike" in text for text in doubts(longer))


def test_torque_that_does_not_hold_the_start_is_doubted(tmp_path: Path) -> None:
    file = tmp_path / "weak.toml"
    text = write_problem(load_problem("arm7"))
    assert json.loads(_checked(file, text))["doubts"] == []
    told, *_ = json.loads(_checked(file, text, "robot.torque_limit_N_m=2.0"))["doubts"]
    assert told.startswith("the torque limits do not hold the robot's own weight: at rest at its start")


def test_distant_links_that_touch_at_the_start_are_doubted(tmp_path: Path) -> None:
    """A hand that begins in its pedestal is not kept apart from it."""
    (tmp_path / "robot.urdf").write_text(urdfs.arm(), "utf-8")
    file = tmp_path / "reach.toml"
    postures = {"raised": {"shoulder": 0.5, "elbow": 1.0}, "folded": {"shoulder": 1.7, "elbow": 2.3}}
    for start, touch in (("raised", False), ("folded", True)):
        text = bolted_arm(
            frame="wrist_link",
            tip=[0.0, 0.0, 0.1],
            point=[0.6, 0.0, 0.5],
            normal=[1.0, 0.0, 0.0],
            start=start,
            postures=postures,
        )
        found = json.loads(_checked(file, text))["doubts"]
        told = [doubt for doubt in found if doubt.startswith("links touch in the start posture")]
        assert ["'base' and 'wrist_link'" in doubt for doubt in told] == [True] * touch


def _checked(file: Path, text: str, *settings: str) -> str:
    file.write_text(text, encoding="utf-8")
    words = [word for setting in settings for word in ("--set", setting)]
    done = CliRunner().invoke(app, ["check", str(file), "--json", *words])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.parametrize(
    "shape",
    [
        '<capsule radius="0.04" />',
        '<capsule radius="0.04" length="-0.3" />',
        '<cylinder radius="nan" length="0.3" />',
        '<box size="0.08 0.08" />',
        '<sphere radius="4 cm" />',
        '<mesh filename="arm.stl" scale="1 1" />',
        '<cone radius="0.04" length="0.3" />',
    ],
)
def test_a_malformed_shape_is_told(tmp_path: Path, shape: str) -> None:
    text = urdfs.arm().replace('<box size="0.08 0.08 0.3"/>', shape, 1)
    (tmp_path / "robot.urdf").write_text(text)
    told = doubts(Robot.from_urdf(tmp_path / "robot.urdf", floating=False, armature=0.1))
    (line,) = [line for line in told if not line.startswith("1 mesh is lost")]
    assert line.startswith("a shape of link 'shoulder_link' is left out") and shape in line


def test_a_malformed_place_of_a_shape_is_told(tmp_path: Path) -> None:
    text = urdfs.arm().replace(
        '<collision><origin xyz="0.0 0.0 0.15"/>', '<collision><origin xyz="0.15"/>', 1
    )
    (tmp_path / "robot.urdf").write_text(text)
    (line,) = doubts(Robot.from_urdf(tmp_path / "robot.urdf", floating=False, armature=0.1))
    assert "shoulder_link" in line and '<origin xyz="0.15" />' in line


@pytest.mark.parametrize("xyz", ["0 0 150", "0 0 1500", "0 0 1e200"])
def test_a_shape_far_from_its_link_is_told(tmp_path: Path, xyz: str) -> None:
    """One beyond a kilometre was left out without a word."""
    text = urdfs.arm().replace(
        '<collision><origin xyz="0.0 0.0 0.15"/>', f'<collision><origin xyz="{xyz}"/>', 1
    )
    (tmp_path / "robot.urdf").write_text(text)
    told = doubts(Robot.from_urdf(tmp_path / "robot.urdf", floating=False, armature=0.1))
    (line,) = [line for line in told if line.startswith("a shape of link 'shoulder_link'")]
    assert "correct its <origin>" in line and ("left out" in line) is (xyz != "0 0 150")


@pytest.mark.parametrize(
    ("height", "doubted"), [("0.15", False), ("0.5", False), ("0.8", True), ("150", True)]
)
def test_a_centre_of_mass_far_outside_of_its_shapes_is_doubted(
    tmp_path: Path, height: str, doubted: bool
) -> None:
    """In millimetres, or in the base's frame; the link's box of 0.08 x 0.08 x 0.3 m ends at 0.3 m."""
    text = urdfs.arm().replace('<inertial><origin xyz="0.0 0.0 0.15"/>', "<inertial><origin/>", 1)
    (tmp_path / "robot.urdf").write_text(text.replace("<origin/>", f'<origin xyz="0 0 {height}"/>'))
    told = doubts(Robot.from_urdf(tmp_path / "robot.urdf", floating=False, armature=0.1))
    beyond = float(height) - 0.3
    line = f"the centre of mass of link 'shoulder_link' is {beyond:.2g} m outside of its shapes, which are "
    assert [text.startswith(line) for text in told] == [True] * doubted


def test_a_striking_link_without_shapes_is_doubted(tmp_path: Path) -> None:
    whole = urdfs.arm()
    before, _, hand = whole.partition('<link name="wrist_link">')
    bare = before + '<link name="wrist_link">' + re.sub(r"<collision>.*?</collision>", "", hand)
    told = []
    for text in (whole, bare):
        (tmp_path / "robot.urdf").write_text(text, "utf-8")
        hand_of = Striker(name="hand", frame="wrist_link", point=[0.0, 0.0, 0.1])
        robot = Robot.from_urdf(tmp_path / "robot.urdf", floating=False, strikers=[hand_of])
        told.append([line for line in doubts(robot) if "has no shapes" in line])
    assert told[0] == []
    assert len(told[1]) == 1 and "striker 'hand'" in told[1][0] and "give it a <collision>" in told[1][0]
