"""What `check` finds before anything is planned."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs
from support.small_plans import biped_problem
from support.small_robots import arm, biped
from typer.testing import CliRunner

from impactopt import (
    ContactWrenchCone,
    FixedBase,
    FreeMass,
    ImpactProblem,
    InputError,
    NotSolvedWarning,
    Obstacle,
    Phase,
    SpringDamper,
    load_problem,
    solve,
)
from impactopt.cli.app import app
from impactopt.files.draft.drafting import draft_problem
from impactopt.kinematics.stance import margin, support_polygon
from impactopt.problem.feasibility import blocked, hopeless, sticks_out, unusual
from impactopt.problem.plausibility import doubts
from impactopt.problem.strength import touches

LAW, BALL = SpringDamper(stiffness=1e4, damping=100.0), FreeMass(mass=1.0)


def _punch(point: list[float], normal: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> ImpactProblem:
    return ImpactProblem(
        robot=biped(), striker="fist", point=np.array(point), normal=np.array(normal), law=LAW, target=BALL
    )


def _fist(problem: ImpactProblem) -> np.ndarray:
    model = problem.robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, problem.start_posture)
    return np.array(data.oMf[model.getFrameId(f"striker:{problem.striker}")].translation)


@pytest.mark.parametrize(("out", "refused"), [(0.035, False), (0.045, True)])
def test_a_hinge_within_the_margin_of_an_edge_is_refused(out: float, refused: bool) -> None:
    """Soles 12 cm wide with a margin of 2 cm: the middle 8 cm may be on the hinge."""
    robot = biped(5)
    soles = [dataclasses.replace(sole, polygon=sole.polygon + np.array([0.0, out])) for sole in robot.soles]
    robot = dataclasses.replace(robot, soles=soles)
    mistake = r"'left' is on its hinge, the x axis .* margin of 0.02 m .* middle of the sole"
    with pytest.raises(InputError, match=mistake) if refused else contextlib.nullcontext():
        biped_problem(robot)


def test_a_point_that_only_a_fall_reaches_is_out_of_balance() -> None:
    start = _fist(_punch([0.45, -0.2, 1.0]))
    near, far = _punch(np.add(start, [0.1, 0.0, 0.0]).tolist()), _punch([1.15, start[1], start[2]])
    assert hopeless(near) == []
    # kinematics alone reach both, and the farther one by leaning out of the soles
    assert far.contact_posture is not None
    (said,) = hopeless(far)
    assert "out of balance's reach" in said and "left, right" in said
    centre = pin.centerOfMass(far.robot.model, far.robot.model.createData(), far.contact_posture)
    polygon = support_polygon(far.robot, far.coordinates)
    assert margin(polygon, np.array(centre)[None, :2])[0] < 0.0


def test_soles_that_must_bear_more_than_the_weight_are_told() -> None:
    """At rest they bear the weight: of a light robot, or of one on the moon, less than the default asks."""
    problem = _punch([0.45, -0.2, 1.0])
    weight = 9.81 * pin.computeTotalMass(problem.robot.model)
    for least, told in ((0.49 * weight, 0), (0.51 * weight, 1)):
        cone = ContactWrenchCone(minimum_force=least)
        found = hopeless(dataclasses.replace(problem, terms=(cone,)))
        assert len(found) == told
        assert all(f"minimum_force_N asks {least:g} N of each of 2 soles" in text for text in found)


def test_soles_that_are_lifted_in_a_motion_may_bear_more_than_the_weight_before() -> None:
    """`kick_g1` is solved so: 2 x 165 N, and it weighs 327 N."""
    kick = load_problem("kick_g1")
    terms = tuple(t for t in kick.terms if not isinstance(t, ContactWrenchCone))
    cone = dataclasses.replace(kick.term(ContactWrenchCone), minimum_force=165.0)
    assert 9.81 * pin.computeTotalMass(kick.robot.model) < 2 * 165.0
    assert hopeless(dataclasses.replace(kick, terms=(*terms, cone))) == []


def test_a_target_above_presses_the_soles_down() -> None:
    problem = _punch([0.45, -0.2, 1.0], (0.0, 0.0, 1.0))
    cone = ContactWrenchCone(minimum_force=0.51 * 9.81 * pin.computeTotalMass(problem.robot.model))
    assert hopeless(dataclasses.replace(problem, terms=(cone,))) == hopeless(problem)


def test_a_start_beyond_the_target_is_told_with_its_distance() -> None:
    start = _fist(_punch([0.45, -0.2, 1.0]))
    ahead = _punch(np.add(start, [0.08, 0.0, 0.0]).tolist(), (-1.0, 0.0, 0.0))
    (said,) = hopeless(ahead)
    assert "beyond the target" in said and "80 mm past" in said
    assert hopeless(_punch(np.add(start, [0.08, 0.0, 0.0]).tolist())) == []


def test_a_hit_point_inside_an_obstacle_is_told_before_a_stiffness() -> None:
    """The search for a cause named another stiffness, whose motion went through the obstacle."""
    problem = load_problem("arm_planar")
    below, above = ([*problem.point[:2], problem.point[2] + dz] for dz in (-0.3, 0.05))
    shelf = Obstacle(name="shelf", size=(0.3, 0.3, 0.1), position=tuple(below))
    assert blocked(dataclasses.replace(problem, obstacles=(shelf,))) == []
    inside = dataclasses.replace(problem, obstacles=(dataclasses.replace(shelf, position=tuple(above)),))
    (said,) = blocked(inside)
    assert "'shelf' by " in said
    with pytest.warns(NotSolvedWarning, match="Infeasible: " + re.escape(said)):
        solve(inside, options={"max_iterations": 10})


def test_an_obstacle_is_not_in_the_way_of_an_arm_that_reaches_round_it() -> None:
    """With the elbow up the arm is in the box, with the elbow down it is clear, and the plan is solved."""
    box = Obstacle(name="box", size=(0.076, 0.044, 0.068), position=(0.265, 0.026, 0.395))
    problem = load_problem("arm_planar")
    up = dataclasses.replace(problem, start=np.array([0.6, -1.7, -0.47]), terms=(), obstacles=(box,))
    assert touches(up, up.contact_posture)
    assert blocked(up) == [] and hopeless(up) == []


def test_a_fixed_base_is_not_asked_for_balance() -> None:
    problem = ImpactProblem(
        robot=arm(), striker="hand", point=np.array([0.55, 0.2, 0.6]), normal=np.array([1.0, 0.0, 0.0]),
        law=LAW, target=BALL, stance=FixedBase(), start="start",
    )  # fmt: skip
    assert [text for text in hopeless(problem) if "balance" in text] == []


def test_numbers_that_look_like_another_unit_are_doubted() -> None:
    problem = load_problem("arm_planar")
    assert unusual(problem) == []
    late, heavy = Phase(duration=40.0), FreeMass(mass=3000.0)
    (said,) = unusual(dataclasses.replace(problem, swing=late))
    assert said.startswith("[swing] duration_s") and "milliseconds" in said
    (said,) = unusual(dataclasses.replace(problem, target=heavy))
    assert said.startswith("[target] mass_kg: 3000 kg") and "grams" in said
    nail = dataclasses.replace(problem.target, mass=50.0, resistance=0.6)
    heavy_nail, soft = unusual(dataclasses.replace(problem, target=nail))
    assert heavy_nail.startswith("[target] mass_kg: 50 kg") and "grams" in heavy_nail
    assert soft.startswith("[target] resistance_N: 0.6 N") and "kN" in soft


def test_joints_without_rotors_are_named() -> None:
    assert doubts(arm()) == []
    soft = {"kp": 1.0, "kd": 1.0}
    (said,) = doubts(arm(armature={"turn": 0.1, "shoulder": 0.1, "wrist": 0.1}, **soft))
    assert "armature" in said and "elbow" in said and "turn" not in said
    (said,) = doubts(arm(armature=0.0, **soft))
    assert said.startswith("no joint has armature")


def _written(folder: Path, text: str) -> Path:
    (folder / "walker.urdf").write_text(text)
    file = folder / "walker.toml"
    file.write_text(draft_problem(folder / "walker.urdf", folder=folder).text)
    return file


def test_legs_come_before_lesser_findings(tmp_path: Path) -> None:
    file = _written(tmp_path, urdfs.biped())
    text = file.read_text()
    # a leg is a joint short now, and inertias, a striker and a frame are wrong too
    (tmp_path / "walker.urdf").write_text(
        urdfs.biped(moments='ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"').replace(
            'name="left_hip_yaw" type="revolute"', 'name="left_hip_yaw" type="fixed"'
        )
    )
    lines = [line for line in text.splitlines() if not line.startswith("left_hip_yaw")]
    file.write_text("\n".join(lines))
    said = CliRunner().invoke(app, ["check", str(file), "--json"])
    assert said.exit_code == 2
    first, *rest = json.loads(said.stdout)["mistakes"]
    assert "'left' has 5 joints" in first and "hinge" in first
    assert any("right_elbow" in text for text in rest)


def test_legs_come_first_where_the_robot_can_be_built(tmp_path: Path) -> None:
    file = _written(tmp_path, urdfs.biped())
    text = file.read_text().replace('striker = "right_hand"', 'striker = "nose"', 1)
    (tmp_path / "walker.urdf").write_text(
        urdfs.biped().replace('name="left_hip_yaw" type="revolute"', 'name="left_hip_yaw" type="fixed"')
    )
    file.write_text("\n".join(line for line in text.splitlines() if not line.startswith("left_hip_yaw")))
    first, second = json.loads(CliRunner().invoke(app, ["check", str(file), "--json"]).stdout)["mistakes"]
    assert "'left' has 5 joints" in first and "'nose'" in second


@pytest.mark.slow
def test_check_refuses_what_no_solve_can_fix(tmp_path: Path) -> None:
    file = _written(tmp_path, urdfs.biped())
    runner = CliRunner()
    sound = runner.invoke(app, ["check", str(file), "--json"])
    assert sound.exit_code == 0 and json.loads(sound.stdout)["doubts"] == []
    turned = runner.invoke(app, ["check", str(file), "--set", "problem.normal=[-1.0,0.0,0.0]"])
    assert turned.exit_code == 2 and "beyond the target" in turned.output
    soft = ["--set", "robot.kp_N_m_rad=100.0", "--set", "robot.kd_N_m_s_rad=5.0"]
    bare = runner.invoke(app, ["check", str(file), "--set", "robot.armature_kg_m2=0.0", *soft])
    assert bare.exit_code == 0 and "no joint has armature" in bare.output


def test_a_link_that_touches_before_its_striking_point_is_told() -> None:
    problem = load_problem("punch")
    assert sticks_out(problem) == []
    hand = problem.robot.striker("right_hand")
    behind = dataclasses.replace(hand, point=hand.point + np.array([0.0, 0.0, 0.027]))
    robot = dataclasses.replace(problem.robot, strikers={**problem.robot.strikers, "right_hand": behind})
    (said,) = sticks_out(dataclasses.replace(problem, robot=robot))
    assert "sticks out 27 mm" in said and "'right_hand'" in said
