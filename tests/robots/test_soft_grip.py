"""Tools that are held softly: the joint that a grip makes, and the robots that a blow meets at its ends."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.meshes import Meshes

from impactopt import (
    SDC,
    Actuator,
    Effects,
    FreeMass,
    FullDynamics,
    InputError,
    Robot,
    SoftGrip,
    SpringDamper,
    Tool,
    VirtualMass,
    arm7,
    effective_mass,
    holding_torque,
    planar_arm,
    striking_velocity,
    talos,
)
from impactopt.robots.tools import extended
from impactopt.simulation.motors import Servo

ONLY_SERVO = Effects(bias=False, jdot=False, saturation=False, feedforward=False)
NORMAL = np.array([0.6, 0.0, -0.8])
MASS = 1.0  # [kg] of the target


def grip(**changes: Any) -> SoftGrip:
    numbers = {"axis": [0, 1, 0], "stiffness": 20.0, "damping": 0.5, "point": [0.0, 0.0, 0.08]}
    return SoftGrip(**numbers | changes)


def _inertia(robot: Robot, q: Any) -> Any:
    return np.array(pin.crba(robot.model, robot.model.createData(), q, pin.Convention.WORLD))


def _whole(upper: Any) -> Any:
    return np.triu(upper) + np.triu(upper, 1).T


def test_the_page_of_soft_grips_gives_the_natural_frequency_of_its_hammer() -> None:
    """By the parallel axis theorem, from the tool alone."""
    (hammer,), soft = planar_arm().tools, grip()
    lever = np.cross(soft.axis, hammer.center - soft.point)
    inertia = soft.axis @ hammer.inertia @ soft.axis + hammer.mass * lever @ lever
    frequency = np.sqrt(soft.stiffness / inertia)
    page = Path(__file__).resolve().parents[2] / "docs" / "howto" / "gears.md"
    assert f"sqrt(k / J): {frequency:.0f} rad/s here" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("frame", ["wrist", "elbow"])
def test_a_grip_at_rest_makes_the_robot_with_the_firm_tool(frame: str) -> None:
    """Of a tool at the end, and of one in the middle, whose joint is not the last."""
    arm = planar_arm(gravity=[2.0, 1.0, -3.0])
    firm = arm.with_tool(Tool.hammer(frame=frame, name="second", face=[0.0, 1.0, 0.0]))
    axis = np.array([0.6, 0.0, 0.8])
    soft = firm.with_grip("second", grip(axis=axis))
    q = pin.randomConfiguration(firm.model, firm.lower, firm.upper)
    q_soft = extended(firm.model, soft.model, q)
    own = soft.joint_index("second_grip")
    others = np.delete(np.arange(soft.n), own)
    assert [soft.joint_names[k] for k in others] == list(firm.joint_names)
    H, expected = _whole(_inertia(soft, q_soft)), _whole(_inertia(firm, q))
    np.testing.assert_allclose(H[np.ix_(others, others)], expected, atol=1e-12)
    # about its own axis: the tool's, by the parallel axis theorem; a spring has no rotor
    tool = firm.tools[-1]
    lever = tool.center - np.array([0.0, 0.0, 0.08])
    about = axis @ tool.inertia @ axis + tool.mass * (lever @ lever - (axis @ lever) ** 2)
    assert H[own, own] == pytest.approx(about)
    places, weights = [], []
    for robot, at in ((firm, q), (soft, q_soft)):
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, at)
        places.append(np.array(data.oMf[robot.model.getFrameId("striker:second")].homogeneous))
        weights.append(np.array(pin.computeGeneralizedGravity(robot.model, data, at)))
    np.testing.assert_allclose(*places, atol=1e-12)
    np.testing.assert_allclose(weights[1][others], weights[0], atol=1e-12)


def test_other_joints_keep_their_numbers() -> None:
    firm = planar_arm().with_actuators({"wrist": Actuator(momentary_torque=70.0, armature=0.07)})
    soft = firm.with_tool(Tool.hammer(frame="elbow", name="second")).with_grip("second", grip())
    others = np.array([soft.joint_index(name) for name in firm.joint_names])
    for name in ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper", "armature", "gear_limit"):
        np.testing.assert_array_equal(getattr(soft, name)[others], getattr(firm, name), name)
    own = soft.joint_index("second_grip")
    assert (soft.kp[own], soft.kd[own], soft.armature[own]) == (20.0, 0.5, 0.0)
    assert soft.gear_limit[own] == np.inf
    assert list(np.flatnonzero(soft.passive)) == [own]
    assert not firm.passive.any()
    np.testing.assert_array_equal(soft.posture("ready")[others], firm.posture("ready"))


def _impulse(robot: Robot, factor: float) -> float:
    """[N s] of a blow in which spring and damper are so much stronger."""
    q, kp, kd = robot.posture("ready"), robot.kp.copy(), robot.kd.copy()
    kp[robot.passive] *= factor
    kd[robot.passive] *= factor
    v = np.zeros(robot.nv)
    firm = arm7()
    v[~robot.passive] = striking_velocity(firm, firm.posture("ready"), "hammer", NORMAL, 1.0)
    law, target = SpringDamper(stiffness=1e5, damping=100.0), FreeMass(mass=MASS)
    model = SDC(
        robot=robot,
        striker="hammer",
        normal=NORMAL,
        law=law,
        target=target,
        effects=ONLY_SERVO,
        kp=kp,
        kd=kd,
        accuracy=None,
    )
    return float(model.collide(q, v).impulse)


def test_a_stiff_grip_hits_as_a_firm_one() -> None:
    """What it lacks falls with the first power of stiffness and damping."""
    firm, soft = arm7(), arm7().with_grip("hammer", grip(stiffness=100.0, damping=1.0))
    whole = _impulse(firm, 1.0)
    lacks = np.array([whole - _impulse(soft, factor) for factor in (1e3, 1e4, 1e5)])
    assert lacks[0] > 1e-4 * whole
    np.testing.assert_allclose(lacks[1:] / lacks[:-1], 0.1, rtol=0.02)


def test_without_a_spring_it_hits_as_a_hinge_does() -> None:
    """The effective mass of an arm whose hammer turns freely, in the closed form of two masses."""
    soft = arm7().with_grip("hammer", grip())
    bare = dataclasses.replace(soft, kp=0 * soft.kp, kd=0 * soft.kd)
    mass = float(effective_mass(soft, striker="hammer", normal=NORMAL)(soft.posture("ready")))
    assert mass < 0.8 * float(
        effective_mass(arm7(), striker="hammer", normal=NORMAL)(arm7().posture("ready"))
    )
    reduced = 1 / (1 / mass + 1 / MASS)
    z = 100.0 / (2 * np.sqrt(1e5 * reduced))
    closed = reduced * (1 + np.exp(-z * np.arccos(z) / np.sqrt(1 - z**2)))
    assert _impulse(bare, 1.0) == pytest.approx(closed, rel=1e-6)


def _moving() -> tuple[Robot, Any, Any, Any, dict[str, Any]]:
    """Arm, q, v, torque and scene of a blow in which the hammer turns in the hand."""
    robot, normal = planar_arm().with_grip("hammer", grip()), np.array([0.0, 0.0, -1.0])
    q = robot.posture("ready")
    v = striking_velocity(robot, q, "hammer", normal, 1.0)
    law, target = SpringDamper(stiffness=1e4, damping=50.0), FreeMass(mass=2.0)
    scene = {"robot": robot, "striker": "hammer", "normal": normal, "law": law, "target": target}
    return robot, q, v, holding_torque(robot, q, v), scene


def test_in_full_dynamics_its_angle_of_rest_does_not_coast() -> None:
    robot, q, v, torque, scene = _moving()
    hit, own = FullDynamics(**scene).collide(q, v, torque), robot.sprung
    assert abs(v[own]) > 1.0
    moved, change = (hit.configuration - q)[own], (hit.velocity - v)[own]
    np.testing.assert_allclose(hit.torque[-1, own], torque[own] - 20.0 * moved - 0.5 * change, atol=1e-6)


def test_an_sdc_refuses_one_that_moves() -> None:
    """Its servos all coast: the impulse would be a tenth too large."""
    robot, q, v, torque, scene = _moving()
    model = SDC(**scene)
    with pytest.raises(InputError, match=r"hammer_grip: in SDC the rest angle.*take FullDynamics"):
        model.collide(q, v, torque)
    with pytest.raises(InputError, match="hammer_grip"):
        model.batch(q[None], v[None], torque)
    with pytest.raises(InputError, match="hammer_grip"):
        model.function()
    assert VirtualMass(**scene).collide(q, v).separated, "it has no servo"
    v[robot.sprung] = 0.0
    assert model.collide(q, v, torque).separated


def test_its_servo_is_a_spring_whatever_the_reference_says() -> None:
    robot = planar_arm().with_grip("hammer", grip())
    own, rng = robot.passive, np.random.default_rng(1)
    reference = type("Reference", (), {})()
    reference.time = np.array([0.0, 0.1, 0.2])
    reference.q, reference.v = rng.normal(size=(3, robot.nq)), rng.normal(size=(3, robot.nv))
    reference.torque = rng.normal(size=(3, robot.n))
    servo = Servo(robot, reference)
    angles, rates = np.full(robot.n, 30.0), np.full(robot.n, 300.0)
    demand, torque = servo.torque(0.15, angles, rates)
    spring = reference.torque[0, own] - 20.0 * (30.0 - reference.q[0, own]) - 0.5 * 300.0
    np.testing.assert_allclose(demand[own], spring)
    np.testing.assert_allclose(torque[own], spring, err_msg="nothing saturates")
    assert (np.abs(torque[~own]) == robot.torque_limit[~own]).all()


def test_the_meshes_of_its_urdf_do_not_need_the_grip() -> None:
    robot = talos().with_tool(Tool.hammer(frame="gripper_right_base_link")).with_grip("hammer", grip())
    rest = robot.posture("half_sitting")
    through = rest.copy()
    for joint in ("arm_left_4_joint", "arm_left_2_joint", "head_2_joint"):  # the last is beyond the grip
        through[robot.model.joints[robot.model.getJointId(joint)].idx_q] = 0.0
    meshes = Meshes(robot, rest)
    assert meshes.touching(rest[None]) == []
    assert any("arm_left" in one or "arm_left" in two for one, two in meshes.touching(through[None]))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: grip(axis=[0, 2, 0]), "no unit vector; divide it by its length"),
        (lambda: grip(stiffness=0.0), r"stiffness \[N m/rad\]: 0; give a number > 0"),
        (lambda: grip(damping=-1.0), r"damping \[N m s/rad\]: -1; give a number > 0"),
        (lambda: planar_arm().with_grip("hamer", grip()), "has no tool 'hamer'.*did you mean 'hammer'"),
        (
            lambda: planar_arm().with_grip("hammer", grip()).with_grip("hammer", grip()),
            "holds 'hammer' softly already",
        ),
    ],
)
def test_grips_that_are_none_are_refused(make: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()
