"""Motors and gears: what is known of them, of which joints, and what a motion asks of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import urdfs
from support.small_robots import arm

from impactopt import Actuator, GearLoad, ImpactProblem, InputError, Robot, g1, load_problem, write_problem
from impactopt.robots.loads import DriveLoads, gear_torque, motor_power, motor_use

FILE = """
[problem]
striker = "hammer"
start = "ready"
point_m = [0.65, 0.0, 0.4]
normal = [0.0, 0.0, -1.0]
[robot]
preset = "arm7"
[target]
mass_kg = 1.0
[contact]
stiffness_N_m = 1e5
damping_N_s_m = 100.0
{more}
"""


def given(**numbers: Any) -> Robot:
    return arm().with_actuators({"elbow": Actuator(**numbers)})


def from_text(folder: Path, more: str) -> ImpactProblem:
    (folder / "own.toml").write_text(FILE.format(more=more), encoding="utf-8")
    return load_problem(folder / "own.toml")


def test_a_pattern_is_of_many_joints_and_the_last_that_fits_holds() -> None:
    robot = arm().with_actuators(
        {"*": Actuator(power_limit=100.0), "*ist": Actuator(armature=0.3, momentary_torque=60.0)}
    )
    assert [a.power_limit for a in robot.actuators] == [100.0, 100.0, 100.0, None]
    np.testing.assert_array_equal(robot.armature, [0.05, 0.05, 0.05, 0.3])
    np.testing.assert_allclose(robot.gear_limit, [2.0, 2.0, 2.0, 60.0 / 40.0])


def test_the_armature_of_an_actuator_is_the_robots() -> None:
    """From the start, as light wrists are refused without one."""
    bare = {"actuators": {}, "armature": 0.0}
    with pytest.raises(InputError, match="give the joint its armature"):
        arm(**bare)
    robot = arm(**bare | {"actuators": {"*": Actuator(armature=0.05)}})
    np.testing.assert_array_equal(robot.armature, arm().armature)
    assert all(a.armature is None for a in robot.actuators)
    with pytest.raises(InputError, match="which sets the model"):
        replace(robot, actuators=[Actuator(armature=0.1)] * 4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Actuator(momentary_torque=-1.0), r"momentary_torque \[N m\]: -1; give a number > 0"),
        (lambda: Actuator(viscous_friction=-1.0), r"viscous_friction .*: -1; give a number >= 0"),
        (lambda: Actuator(armature=float("nan")), "armature"),
        (lambda: Actuator(stall_torque=3.0), "stall_torque and no_load_speed .* give both, or neither"),
        (lambda: Actuator(peak_torque=3.0, momentary_torque=2.0), "peak_torque is 3 N m, and momentary"),
        (lambda: given(peak_torque="much"), "peak_torque"),
        (lambda: arm().with_actuators({"elbw": Actuator()}), "no joint is called 'elbw'.*mean 'elbow'"),
        (
            lambda: arm().with_actuators({"leg_*": Actuator()}),
            "no joint is called 'leg_[*]'; there are turn",
        ),
        (lambda: arm().with_actuators({"elbow": 3.0}), "give an Actuator"),  # type: ignore[dict-item]
        (lambda: replace(arm(), actuators=[Actuator()] * 3), "3 actuators for 4 joints"),
    ],
)
def test_what_makes_no_sense_is_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_friction_is_the_files_until_an_actuator_has_its_own(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(urdfs.arm().replace("</joint>", '<dynamics damping="3.0" friction="1.5"/></joint>'))
    more: dict[str, Any] = {"floating": False, "armature": 0.1}
    robot = Robot.from_urdf(path, **more, actuators={"elbow": Actuator(bandwidth=50.0)})
    other = robot.with_actuators({"turn": Actuator(viscous_friction=0.5)})
    k, j = robot.joint_index("elbow"), robot.joint_index("turn")
    assert (robot.actuators[k].viscous_friction, robot.actuators[k].coulomb_friction) == (3.0, 1.5)
    assert robot.actuators[k].bandwidth == 50.0
    assert (other.actuators[j].viscous_friction, other.actuators[j].coulomb_friction) == (0.5, 1.5)
    # at 2 rad/s and 10 N m a motor gives 10 + 1.5 + 3 x 2 N m
    assert motor_power(robot, np.full(robot.n, 10.0), np.full(robot.n, 2.0))[k] == pytest.approx(2 * 17.5)
    path.write_text(urdfs.arm().replace("</joint>", '<dynamics damping="-3.0"/></joint>', 1))
    with pytest.raises(InputError, match="joint 'turn': damping -3"):
        Robot.from_urdf(path, **more)


def test_springs_are_the_files_until_an_actuator_has_its_own(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    spring = "<springStiffness>90</springStiffness><springReference>0.3</springReference>"
    path.write_text(urdfs.arm().replace("</robot>", f'<gazebo reference="elbow">{spring}</gazebo></robot>'))
    robot = Robot.from_urdf(path, floating=False, armature=0.1, actuators={"*": Actuator(bandwidth=50.0)})
    assert robot.springs == {"elbow": (90.0, 0.3)}
    assert robot.with_actuators({"elbow": Actuator(spring_stiffness=20.0)}).springs == {"elbow": (20.0, 0.3)}
    assert not robot.with_actuators({"*": Actuator(spring_stiffness=0.0)}).springs
    with pytest.raises(InputError, match="joint 'turn' has a spring and is continuous"):
        arm().with_actuators({"turn": Actuator(spring_stiffness=9.0)})


def test_files_name_classes_of_joints(tmp_path: Path) -> None:
    problem = from_text(
        tmp_path,
        """
[[robot.actuators]]
joints = ["joint_[1-5]"]
momentary_torque_N_m = 220
[[robot.actuators]]
joints = ["joint_6", "joint_7"]
armature_kg_m2 = 0.2
stall_torque_N_m = 60
no_load_speed_rad_s = 5
[terms.gear_load]
""",
    )
    robot = problem.robot
    np.testing.assert_allclose(robot.gear_limit, [1.25, 1.25, 2.0, 2.0, 2.0, 2.0, 2.0])
    np.testing.assert_array_equal(robot.armature[5:], 0.2)
    assert [a.stall_torque for a in robot.actuators] == [None] * 5 + [60.0] * 2
    (tmp_path / "again.toml").write_text(write_problem(problem), encoding="utf-8")
    again = load_problem(tmp_path / "again.toml")
    assert again.robot.actuators == robot.actuators
    assert again.hash == problem.hash


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('[[robot.actuators]]\njoints = ["joint_9"]', r"\[robot\] actuators: .*no joint is called 'joint_9'"),
        ('[[robot.actuators]]\njoints = ["joint_1"]\npower_limit_W = -3', "power_limit_W"),
        ("[[robot.actuators]]\npower_limit_W = 3", "joints"),
        ("[terms.gear_load]\nlimit = -1", "limit"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path: Path, more: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        from_text(tmp_path, more)


def test_actuators_are_part_of_a_problem_only_where_it_asks_for_them(arm_transcription: Any) -> None:
    base = arm_transcription.problem
    plain = replace(base, terms=(*base.terms, GearLoad(enabled=False)))
    other = replace(plain, robot=plain.robot.with_actuators({"*": Actuator(momentary_torque=90.0)}))
    assert other.hash == plain.hash
    one, two = (replace(p, terms=(*base.terms, GearLoad())) for p in (plain, other))
    assert one.hash != two.hash


def test_loads_are_those_of_their_formulas() -> None:
    """Two instants, four joints, of which one's motor is known."""
    robot = arm(actuators={}).with_actuators(
        {
            "elbow": Actuator(
                stall_torque=100.0, no_load_speed=10.0, coulomb_friction=2.0, viscous_friction=0.5
            )
        }
    )
    torque = np.array([[6.0, -8.0, 30.0, 4.0], [0.0, 0.0, -20.0, 0.0]])
    velocity = np.array([[1.0, 0.5, -4.0, 0.0], [0.0, 0.0, 6.0, 0.0]])
    acceleration = np.array([[0.0, 0.0, 400.0, 0.0], [0.0, 0.0, 1000.0, 100.0]])
    gear = gear_torque(robot, torque, acceleration)
    np.testing.assert_allclose(gear, torque - 0.05 * acceleration)
    np.testing.assert_allclose(motor_use(robot, torque, velocity)[:, 2], [0.34 + 0.4, 0.25 + 0.6])
    np.testing.assert_allclose(motor_power(robot, torque, velocity)[:, 2], [34.0 * 4, 25.0 * 6])
    loads = DriveLoads.of(robot, gear=gear, torque=torque, velocity=velocity, jump=[1.0, -3.0, 2.0, 0.0])
    assert loads.summary() == {
        "gear_ratio": pytest.approx(70.0 / 60.0),
        "gear_joint": "elbow",
        "motor_ratio": pytest.approx(0.85),
        "motor_joint": "elbow",
        "power_W": pytest.approx(150.0),
        "power_joint": "elbow",
        "velocity_jump_rad_s": 3.0,
        "velocity_jump_joint": "shoulder",
    }
    assert loads.beyond_peak() == ""
    weak = robot.with_actuators({"elbow": Actuator(momentary_torque=35.0)})
    again = DriveLoads.of(weak, gear=gear, torque=torque, velocity=velocity, jump=np.full(4, np.nan))
    assert (
        "gear of elbow: 1.17 times its torque limit, above its momentary peak of 0.583" in again.beyond_peak()
    )
    assert again.summary()["velocity_jump_joint"] is None and again.summary()["motor_ratio"] is None


def test_a_motors_line_goes_through_its_knee() -> None:
    """G1's motors have their torque up to a speed, and from there on less."""
    robot = g1()
    k = robot.joint_index("left_knee_joint")
    use = motor_use(robot, np.full(robot.n, 111.0), np.full(robot.n, 14.5))[k]
    friction = (2.4 + 0.24 * 14.5) / robot.actuators[k].stall_torque
    assert use - friction == pytest.approx(1.0)
