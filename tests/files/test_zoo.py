"""The problems that come with the package, by name; the arms and tools that they need."""

from __future__ import annotations

import dataclasses
import importlib
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import planned, transcribed

from impactopt import (
    FixedBase,
    FreeMass,
    ImpactProblem,
    Impulse,
    InputError,
    OneSole,
    Phase,
    Robot,
    SpringDamper,
    Tool,
    arm7,
    load_problem,
    load_robot,
    planar_arm,
    problem_names,
    robot_names,
    standin,
)
from impactopt.files import named_problems
from impactopt.files.problem_file import read_problem_file
from impactopt.robots.link_tables import ARM7, arm_model
from impactopt.simulation import simulate

ROOT = Path(__file__).resolve().parents[2]
FILES = {path.stem: path for path in (ROOT / "problems").glob("*.toml")}
HAMMER = Tool.hammer(frame="wrist")


# ---- by name


def test_every_file_has_a_name_and_every_name_says_what_it_is_about() -> None:
    assert set(problem_names()) == set(FILES) and len(FILES) > 10
    for name in problem_names():
        summary = named_problems.problem_summary(name)
        assert 20 < len(summary) < 130, (name, summary)
        assert "\n" not in summary


@pytest.mark.parametrize("name", sorted(FILES))
def test_every_problem_loads_and_is_sound(name: str) -> None:
    problem, read = load_problem(name), read_problem_file(FILES[name])
    assert read_problem_file(name).path == FILES[name]
    assert read.text.startswith("# ")
    assert problem.name == read.content.problem.name
    assert isinstance(problem.stance, FixedBase) == (not problem.robot.floating)
    # a plan starts at rest: what holds the robot has to hold it there
    if problem.soles:
        sole = problem.coordinates.legs[0].placement.translation
        assert abs(float(sole[2])) < 1e-3


def test_names_and_paths_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert named_problems.problem_file("punch") == FILES["punch"]
    assert named_problems.problem_file("problems/punch.toml") == Path("problems/punch.toml")
    with pytest.raises(InputError, match=r"no problem 'pucnh' .did you mean 'punch'.*arm7.*path of a file"):
        load_problem("pucnh")
    own = re.escape(str(FILES["punch"]))  # `show` takes no name
    with pytest.raises(InputError, match=rf"no file punch\.toml here; .* is named 'punch', .* file {own}"):
        load_problem("punch.toml")
    (tmp_path / "punch").write_text("[problem]\n", encoding="utf-8")
    assert named_problems.problem_file("punch") == Path("punch")


def test_a_wheel_has_them_inside_the_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    kept = wheel["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert {str(ROOT / inside): ROOT / folder for folder, inside in kept.items()} == {
        str(named_problems.FOLDERS[0]): FILES["punch"].parent
    }
    (tmp_path / "_problems").mkdir()
    (tmp_path / "_problems" / "inside.toml").write_text("# What it is.\n", encoding="utf-8")
    (tmp_path / "_problems" / "sweeps").mkdir()
    (tmp_path / "_problems" / "sweeps" / "many.toml").touch()
    monkeypatch.setattr(named_problems, "FOLDERS", (tmp_path / "_problems", *named_problems.FOLDERS[1:]))
    assert problem_names() == ("inside",) and named_problems.problem_summary("inside") == "What it is"
    assert named_problems.sweep_file("many") == tmp_path / "_problems" / "sweeps" / "many.toml"


# ---- one foot


def test_the_posture_on_one_foot_is_at_rest_on_it() -> None:
    robot = standin()
    q = robot.posture("on_left_foot")
    robot.check_stance(q, ["left"])
    model = robot.model
    data = model.createData()
    left = robot.sole("left")
    centre = pin.centerOfMass(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    place = data.oMf[model.getFrameId(left.frame)]
    np.testing.assert_allclose(place.translation, 0, atol=1e-12)
    inside = place.actInv(centre)[:2]
    low, high = left.polygon.min(axis=0), left.polygon.max(axis=0)
    assert np.minimum(inside - low, high - inside).min() > 0.05  # [m] from every edge
    assert data.oMf[model.getFrameId("right_sole")].translation[2] > 0.08
    problem = load_problem("punch_one_foot")
    assert problem.stance == OneSole("left")
    with pytest.raises(InputError, match=r"centre of mass is 39 mm outside the support polygon of left;"):
        dataclasses.replace(problem, start="half_sitting")


KICKS = sorted(name for name in FILES if name.startswith("kick"))
BALL = 0.11  # [m] radius


@pytest.mark.parametrize("name", KICKS)
def test_a_kick_meets_the_middle_of_a_ball_with_the_front_of_the_foot(name: str) -> None:
    problem = load_problem(name)
    robot, model = problem.robot, problem.robot.model
    assert problem.stance == OneSole("left") and problem.point[2] == pytest.approx(BALL)
    assert problem.normal[2] == 0.0, "level: it meets the ball beside its middle"
    # the toe is in front of the right sole's edge or on it, above the sole and below the middle of the ball
    data = model.createData()
    pin.framesForwardKinematics(model, data, problem.start_posture)
    sole = robot.sole("right")
    place = data.oMf[model.getFrameId(sole.frame)]
    toe = place.actInv(data.oMf[model.getFrameId("striker:right_toe")].translation)
    assert sole.polygon[:, 0].max() <= toe[0] < sole.polygon[:, 0].max() + 0.03
    assert 0.0 < toe[2] < BALL and sole.polygon[:, 1].min() < toe[1] < sole.polygon[:, 1].max()
    # at rest the right foot is flat beside the left one, in the air unless it stands, behind the ball
    np.testing.assert_allclose(place.rotation[:, 2], [0, 0, 1], atol=2e-3)
    stands = "right" in [sole.name for sole in problem.soles]
    assert abs(place.translation[2]) < 1e-9 if stands else place.translation[2] > 0.05
    assert place.translation[1] < data.oMf[model.getFrameId(robot.sole("left").frame)].translation[1] - 0.1
    assert place.act(toe)[0] < problem.point[0]


def test_the_stand_ins_toes_are_at_the_front_of_its_feet() -> None:
    robot = standin()
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture("half_sitting"))
    # standing, the box of a foot is from the ground to 5 cm above it
    for side in ("left", "right"):
        sole = robot.sole(side)
        ground = data.oMf[robot.model.getFrameId(sole.frame)]
        toe = ground.actInv(data.oMf[robot.model.getFrameId(f"striker:{side}_toe")].translation)
        front = sole.polygon[:, 0].max()
        middle = (sole.polygon[:, 1].max() + sole.polygon[:, 1].min()) / 2
        np.testing.assert_allclose(toe, [front, middle, 0.025], atol=1e-12)


# ---- arms


@pytest.mark.parametrize("make", [planar_arm, arm7])
def test_arms_are_presets_without_files(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "impactopt.robots.presets.distribution", lambda name: pytest.fail("files were asked for")
    )
    robot = load_robot(make.__name__)
    assert robot.name == make.__name__ and robot.name in robot_names()
    assert not robot.floating and not robot.soles and "hammer" in robot.strikers and "ready" in robot.postures
    assert make(name="mine", kd=3.0).kd.tolist() == [3.0] * robot.n
    # ready to strike down: the hammer's handle is level, and its face down
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture("ready"))
    turned = data.oMf[robot.model.getFrameId("striker:hammer")].rotation
    np.testing.assert_allclose(turned @ [0, 0, 1], [1, 0, 0], atol=2e-3)
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 0, -1], atol=2e-3)


def test_the_planar_arm_stays_in_its_plane() -> None:
    robot = planar_arm()
    data = robot.model.createData()
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        pin.framesForwardKinematics(robot.model, data, q)
        for frame in data.oMf:
            assert abs(frame.translation[1]) < 1e-15


def test_the_seven_joint_arm_has_the_public_numbers() -> None:
    robot = arm7()
    np.testing.assert_array_equal(robot.torque_limit, [176, 176, 110, 110, 110, 40, 40])
    speed = np.array([98, 98, 100, 130, 140, 180, 180])
    np.testing.assert_allclose(np.degrees(robot.velocity_limit), speed)
    np.testing.assert_allclose(np.degrees(robot.upper), [170, 120, 170, 120, 170, 120, 175])
    np.testing.assert_allclose(robot.lower, -robot.upper)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, np.zeros(7))
    heights = [data.oMi[k].translation[2] for k in (2, 4, 6)]
    np.testing.assert_allclose(heights, [0.34, 0.74, 1.14], atol=1e-12)
    fist = data.oMf[robot.model.getFrameId("striker:fist")].translation
    np.testing.assert_allclose(fist, [0, 0, 1.266], atol=1e-12)
    moving = sum(float(body.mass) for body in arm_model("bare", ARM7).inertias)
    assert moving < 23.9  # the whole arm's, with the part that is bolted down


def test_an_arm_plans_and_both_engines_replay_it() -> None:
    problem = dataclasses.replace(
        load_problem("arm_planar"),
        law=SpringDamper(stiffness=1e5, damping=100.0),
        target=FreeMass(mass=2.0),
        contact_duration=(0.003, 0.01),
        objectives=(Impulse(),),
        terms=(),
        swing=Phase(duration=0.4, intervals=6),
        follow=Phase(duration=0.6, intervals=6),
    )
    done = planned(transcribed(problem))
    assert done.result.status.usable and done.plan.impulse > 1.0
    assert done.simulation.impulse == pytest.approx(done.plan.impulse, rel=0.02)
    free = simulate(problem, done.trajectory, engine="mujoco", settle=0.2)
    assert free.impulse == pytest.approx(done.plan.impulse, rel=0.02)
    assert not free.fall and free.sole_ground.shape[1] == 0
    limits = {"torque_limit": problem.robot.torque_limit, "polygon": done.plan.polygon}
    report = free.report(**limits, planned_impulse=done.plan.impulse)
    assert report["zmp_margin_m"] is None and report["torque_ratio"] < 1


# ---- tools


def bare(**options: Any) -> Robot:
    return Robot.from_model(planar_arm().model, name="bare", **options)


def test_a_hammers_inertia_is_that_of_its_rod_and_bar() -> None:
    """By hand: parallel axes about the common centre of mass; x along the bar, z along the rod."""
    rod, bar, length, long, wide = 0.2, 0.6, 0.3, 0.12, 0.04
    tool = Tool.hammer(
        frame="wrist",
        grip=[0.0, 0.0, 0.05],
        length=length,
        handle_mass=rod,
        head_mass=bar,
        head_length=long,
        head_width=wide,
    )
    centre = (rod * length / 2 + bar * length) / (rod + bar)
    apart = rod * (centre - length / 2) ** 2 + bar * (length - centre) ** 2
    across = rod * length**2 / 12 + apart
    expected = [
        across + bar * (wide**2 + wide**2) / 12,
        across + bar * (long**2 + wide**2) / 12,
        bar * (long**2 + wide**2) / 12,
    ]
    assert tool.mass == pytest.approx(rod + bar)
    np.testing.assert_allclose(tool.center, [0, 0, 0.05 + centre], atol=1e-15)
    np.testing.assert_allclose(tool.inertia, np.diag(expected), atol=1e-15)
    np.testing.assert_allclose(tool.head, [long / 2, 0, 0.05 + length], atol=1e-15)


def test_a_tool_adds_its_inertia_as_the_hand_feels_it() -> None:
    """H with the tool less H without it is J^T M J of a body at the tool's centre of mass."""
    without = bare()
    turned = pin.utils.rotate("y", 0.4) @ np.diag([2e-3, 3e-3, 4e-3]) @ pin.utils.rotate("y", -0.4)
    tool = Tool(
        name="axe", frame="elbow", mass=0.7, center=[0.1, 0.02, 0.2], inertia=turned, head=[0.2, 0, 0.25]
    )
    robot = without.with_tool(tool)
    q = np.array([0.3, -0.8, 0.5])
    inertia = [np.triu(pin.crba(r.model, r.model.createData(), q)) for r in (robot, without)]
    model, data = without.model, without.model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    frame = model.getFrameId("elbow")
    jac = np.array(pin.getFrameJacobian(model, data, frame, pin.LOCAL))
    linear = jac[:3] - np.cross(tool.center, jac[3:], axisb=0).T  # v + w x r = v - r x w
    expected = tool.mass * linear.T @ linear + jac[3:].T @ tool.inertia @ jac[3:]
    np.testing.assert_allclose(inertia[0] - inertia[1], np.triu(expected), atol=1e-12)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    head = data.oMf[robot.model.getFrameId("elbow")].act(tool.head)
    np.testing.assert_allclose(data.oMf[robot.model.getFrameId("striker:axe")].translation, head)
    assert "axe" not in without.strikers and set(robot.strikers) == {"axe"}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mass": 0.0}, "mass [kg]: 0; give a number > 0"),
        ({"inertia": [1e-3, 1e-3]}, "inertia"),
        ({"inertia": [[1e-3, 1e-4, 0], [0, 1e-3, 0], [0, 0, 1e-3]]}, "not symmetric"),
        ({"inertia": [1.0, 1e-3, 1e-3]}, "which no body has"),
        ({"head": [0.0, np.nan, 0.0]}, "head"),
        ({"frame": "wirst"}, "did you mean 'wrist'"),
        ({"frame": "base"}, "no joint moves the frame 'base'"),
    ],
)
def test_tools_that_cannot_be(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        bare().with_tool(dataclasses.replace(HAMMER, **changes))


def test_more_tools_that_cannot_be() -> None:
    with pytest.raises(InputError, match="has a striker 'hammer' already"):
        planar_arm().with_tool(HAMMER)
    with pytest.raises(InputError, match="no unit vectors at right angles"):
        Tool.hammer(frame="wrist", face=[0, 0, 1])


def test_a_file_can_put_a_tool_into_a_hand(tmp_path: Path) -> None:
    text = FILES["arm_planar"].read_text(encoding="utf-8").replace('robot = "planar_arm"\n', "")
    text = text.replace('striker = "hammer"', 'striker = "axe"')
    tool = """
[robot]
preset = "planar_arm"
[[robot.tools]]
name = "axe"
frame = "wrist"
mass_kg = 0.7
center_m = [0.0, 0.0, 0.2]
inertia_kg_m2 = [2e-3, 3e-3, 4e-3]
head_m = [0.1, 0.0, 0.25]
"""
    path = tmp_path / "axe.toml"
    path.write_text(text + tool, encoding="utf-8")
    problem: ImpactProblem = load_problem(path)
    expected = planar_arm().with_tool(
        Tool(
            name="axe",
            frame="wrist",
            mass=0.7,
            center=[0, 0, 0.2],
            inertia=[2e-3, 3e-3, 4e-3],
            head=[0.1, 0, 0.25],
        )
    )
    for a, b in zip(problem.robot.model.inertias, expected.model.inertias, strict=True):
        assert a.isApprox(b)
    assert set(problem.robot.strikers) == {"hammer", "axe"}
    path.write_text(text + tool.replace("mass_kg = 0.7", "mass_kg = -0.7"), encoding="utf-8")
    with pytest.raises(InputError, match=r"\[robot.*mass_kg: -0.7; give a number > 0"):
        load_problem(path)
