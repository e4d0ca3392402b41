"""The stand-in for HRP-2: public numbers as they are, the rest physical, and fit to be planned with."""

from __future__ import annotations

import time
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt import InputError, Robot, load_problem, load_robot, standin
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.robots import presets
from impactopt.robots.link_tables import LINKS, PELVIS

Array = NDArray[np.float64]
LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_yaw", "wrist_pitch")
JOINTS = (
    *(f"{side}_{joint}" for side in ("right", "left") for joint in LEG),
    *("chest_yaw", "chest_pitch", "head_yaw", "head_pitch"),
    *(f"{side}_{joint}" for side in ("right", "left") for joint in ARM),
)
# As sot_utils.py has them: columns of legs, chest and head, arms.
TORQUE = ((86, 175, 151, 168, 131, 73), (151, 278, 9.6, 9.6), (160, 100, 48, 108, 13.9, 63))
SPEED = (
    (3.541, 3.810, 4.422, 3.980, 5.079, 9.143),
    (4.402, 2.396, 6.877, 6.877),
    (4.170, 2.419, 4.157, 2.238, 4.728, 3.167),
)
RATIO = (
    (384, 240, 180, 200, 180, 100),
    (207.69, 381.54, 100, 100),
    (219.23, 231.25, 266.67, 250, 145.45, 350),
)
ROTOR_1e6 = ((1.01, 6.96, 1.34, 1.34, 6.96, 6.96), (6.96, 6.96, 1.1, 1.1), (6.96, 6.6, 1, 6.6, 1.1, 1))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return standin()


def whole(parts: tuple[tuple[float, ...], ...]) -> Array:
    leg, trunk, arm = parts
    return np.array([*leg, *leg, *trunk, *arm, *arm], dtype=np.float64)


def boxes(robot: Robot, q: Array) -> list[tuple[float, Array]]:
    """Mass and corners (8, 3) in the world of every link's box."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    links = [("pelvis", PELVIS), *((link.joint, link.box) for link in LINKS)]
    poses = [data.oMf[robot.model.getFrameId(name)] for name, _ in links]
    return [
        (box.mass, box.corners() @ pose.rotation.T + pose.translation)
        for pose, (_, box) in zip(poses, links, strict=True)
    ]


def frame_at(robot: Robot, q: Array, name: str) -> Any:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(name)]


def corners_on_the_ground(robot: Robot, q: Array) -> dict[str, Array]:
    return {
        sole.name: np.array([frame_at(robot, q, sole.frame).act(np.array([*c, 0.0])) for c in sole.polygon])
        for sole in robot.soles
    }


# ---- what is public


def test_the_joints_are_the_papers_28_in_the_sources_order(robot: Robot) -> None:
    assert robot.joint_names == JOINTS and robot.n == 28 and robot.floating


def test_limits_and_armature_are_the_sources(robot: Robot) -> None:
    np.testing.assert_array_equal(robot.torque_limit, whole(TORQUE))
    np.testing.assert_array_equal(robot.velocity_limit, whole(SPEED))
    armature = whole(ROTOR_1e6) * 1e-6 * whole(RATIO) ** 2
    np.testing.assert_allclose(robot.armature, armature, rtol=1e-12)
    assert armature.min() > 0.01 and armature.max() < 1.02


def test_armature_is_on_the_diagonal_of_the_inertia_matrix(robot: Robot) -> None:
    bare = robot.model.copy()
    bare.armature = np.zeros(bare.nv)
    q = robot.posture("half_sitting")
    added = pin.crba(robot.model, robot.model.createData(), q) - pin.crba(bare, bare.createData(), q)
    expected = np.diag(np.concatenate([np.zeros(6), robot.armature]))
    np.testing.assert_allclose(np.triu(added), expected, atol=1e-12)


def test_it_weighs_58_kg_and_stands_154_cm_tall(robot: Robot) -> None:
    assert pin.computeTotalMass(robot.model) == pytest.approx(58.0, abs=1e-12)
    upright = robot.place(pin.neutral(robot.model))
    robot.check_stance(upright, height=1e-9, tilt=1e-9)
    heights = np.concatenate([corners[:, 2] for _, corners in boxes(robot, upright)])
    assert heights.max() == pytest.approx(1.54, abs=1e-12)
    assert heights.min() == pytest.approx(0.0, abs=1e-12), "the feet end where the soles are"


def test_soles_are_the_sources_rectangle_about_the_ankle(robot: Robot) -> None:
    for sole, y in ((robot.sole("right"), (-0.075, 0.056)), (robot.sole("left"), (-0.056, 0.075))):
        (back, low), (front, high) = sole.polygon.min(axis=0), sole.polygon.max(axis=0)
        assert (back, front) == (-0.1, 0.13) and (low, high) == y
        ankle = frame_at(robot, pin.neutral(robot.model), f"{sole.name}_ankle_roll")
        there = ankle.actInv(frame_at(robot, pin.neutral(robot.model), sole.frame))
        np.testing.assert_allclose(
            there.homogeneous, pin.SE3(np.eye(3), np.array([0, 0, -0.105])).homogeneous
        )


# ---- what is ours is physical


def test_left_and_right_mirror_each_other(robot: Robot) -> None:
    """Reflecting a configuration in y = 0 reflects inertia matrix and gravity; limits are reflected too."""
    names = robot.joint_names
    other = {"left": "right", "right": "left"}
    swapped = ["_".join([other.get(n.split("_")[0], n.split("_")[0]), *n.split("_")[1:]]) for n in names]
    order = np.array([names.index(name) for name in swapped])
    sign = np.array([-1.0 if name.endswith(("yaw", "roll")) else 1.0 for name in names])
    reflection = np.zeros((34, 34))
    reflection[range(6), range(6)] = [1, -1, 1, -1, 1, -1]
    reflection[6 + np.arange(28), 6 + order] = sign

    model = robot.model
    rng = np.random.default_rng(3)
    for _ in range(3):
        angles = rng.uniform(robot.lower, robot.upper)
        here = np.concatenate([[0, 0, 0, 0, 0, 0, 1], angles])
        there = np.concatenate([here[:7], sign * angles[order]])
        h, mirrored_h = (np.triu(pin.crba(model, model.createData(), q)) for q in (here, there))
        h, mirrored_h = (upper + np.triu(upper, 1).T for upper in (h, mirrored_h))
        np.testing.assert_allclose(mirrored_h, reflection @ h @ reflection.T, rtol=0, atol=1e-10)
        g, mirrored_g = (pin.computeGeneralizedGravity(model, model.createData(), q) for q in (here, there))
        np.testing.assert_allclose(mirrored_g, reflection @ g, rtol=0, atol=1e-10)
    low, high = sign * robot.lower[order], sign * robot.upper[order]
    np.testing.assert_array_equal(robot.lower, np.minimum(low, high))
    np.testing.assert_array_equal(robot.upper, np.maximum(low, high))
    for value in (robot.kp, robot.kd, robot.torque_limit, robot.velocity_limit, robot.armature):
        np.testing.assert_array_equal(value, value[order])


def test_inertias_are_those_of_matter(robot: Robot) -> None:
    for body in list(robot.model.inertias)[1:]:
        small, middle, large = np.linalg.eigvalsh(body.inertia)
        assert body.mass > 0 and small > 0 and small + middle > large


def test_the_inertia_of_the_whole_is_that_of_its_boxes(robot: Robot) -> None:
    """A solid box has a third of the second moment that its mass has, evenly at its eight corners."""
    q = robot.posture("half_sitting")
    parts = boxes(robot, q)
    center = sum(m * c.mean(axis=0) for m, c in parts) / sum(m for m, _ in parts)
    data = robot.model.createData()
    np.testing.assert_allclose(pin.centerOfMass(robot.model, data, q), center, atol=1e-12)
    second = np.zeros((3, 3))
    for m, corners in parts:
        middle = corners.mean(axis=0)
        second += m * (np.cov(corners.T, bias=True) / 3 + np.outer(middle - center, middle - center))
    pin.ccrba(robot.model, data, q, np.zeros(robot.nv))
    np.testing.assert_allclose(data.Ig.inertia, np.trace(second) * np.eye(3) - second, atol=1e-10)


def test_legs_and_arms_stay_on_their_own_side(robot: Robot) -> None:
    for link, (_, corners) in zip(LINKS, boxes(robot, pin.neutral(robot.model))[1:], strict=True):
        if link.joint.startswith("left"):
            assert corners[:, 1].min() > 0, link.joint


# ---- it stands and reaches


def test_half_sitting_is_flat_and_holds_its_weight_over_its_soles(robot: Robot) -> None:
    q = robot.posture("half_sitting")
    robot.check_limits(q)
    ground = corners_on_the_ground(robot, q)
    for corners in ground.values():
        np.testing.assert_allclose(corners[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(
        ground["left"].mean(axis=0), ground["right"].mean(axis=0) * [1, -1, 1], atol=1e-12
    )
    assert ground["left"][:, 1].min() - ground["right"][:, 1].max() > 0.05, "feet side by side, apart"
    com = pin.centerOfMass(robot.model, robot.model.createData(), q)
    hull = ConvexHull(np.concatenate(list(ground.values()))[:, :2])
    assert np.all(hull.equations @ [*com[:2], 1] < -0.05)
    assert robot.joint_positions(q)[robot.joint_index("left_knee")] == pytest.approx(0.7)


def test_ankles_hold_it_up_without_balance_feedback(robot: Robot) -> None:
    """An inverted pendulum stands if its stiffness exceeds m g h."""
    com = pin.centerOfMass(robot.model, robot.model.createData(), robot.posture("half_sitting"))
    ankles = [robot.joint_index(f"{side}_ankle_pitch") for side in ("left", "right")]
    assert robot.kp[ankles].sum() > 2 * 58.0 * 9.81 * com[2]


def test_its_torque_limits_carry_it_with_room_to_move(robot: Robot) -> None:
    """Half of the weight on each sole under its centre: no joint needs more than a third of its limit."""
    model, q = robot.model, robot.posture("half_sitting")
    data = model.createData()
    torque = np.array(pin.computeGeneralizedGravity(model, data, q))
    com = pin.centerOfMass(model, model.createData(), q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    for sole in robot.soles:
        fid = model.getFrameId(sole.frame)
        jac = pin.getFrameJacobian(model, data, fid, pin.LOCAL_WORLD_ALIGNED)
        lever = np.array([com[0], data.oMf[fid].translation[1], 0.0]) - data.oMf[fid].translation
        force = np.array([0, 0, 58.0 * 9.81 / 2])
        torque -= jac.T @ np.concatenate([force, np.cross(lever, force)])
    np.testing.assert_allclose(torque[:6], 0, atol=1e-9)
    assert np.all(np.abs(torque[6:]) < robot.torque_limit / 3)


@pytest.fixture(scope="module")
def coordinates(robot: Robot) -> StanceCoordinates:
    return StanceCoordinates(robot, robot.soles, robot.posture("half_sitting"))


def test_legs_of_six_joints_close_on_held_soles(robot: Robot, coordinates: StanceCoordinates) -> None:
    for sole in robot.soles:
        assert [robot.joint_names[j] for j in robot.limb(sole.frame)] == [f"{sole.name}_{j}" for j in LEG]
    assert np.all(np.abs(coordinates.start_determinants) > 1e-3)
    start = robot.posture("half_sitting")
    y, legs = coordinates.split(start)
    y[:6] += [0.03, -0.04, -0.05, 0.1, 0.15, -0.2]
    moved = coordinates.join(y, coordinates.solve_legs(y, legs))
    robot.check_limits(moved)
    before, after = corners_on_the_ground(robot, start), corners_on_the_ground(robot, moved)
    for name in before:
        np.testing.assert_allclose(after[name], before[name], atol=1e-10)


@pytest.mark.parametrize(("hand", "y"), [("right_hand", -0.2), ("left_hand", 0.2)])
def test_both_hands_are_in_front_and_reach_40_cm_ahead_of_the_chest(
    robot: Robot, coordinates: StanceCoordinates, hand: str, y: float
) -> None:
    start = robot.posture("half_sitting")
    chest = frame_at(robot, start, "chest_pitch").translation
    begins = frame_at(robot, start, f"striker:{hand}").translation
    assert begins[0] > chest[0] + 0.2
    point = np.array([chest[0] + 0.4, y, 1.0])
    q = inverse_kinematics(coordinates, hand, point, start)
    np.testing.assert_allclose(frame_at(robot, q, f"striker:{hand}").translation, point, atol=1e-7)
    robot.check_limits(q)
    robot.check_stance(q)


def test_the_striking_point_is_the_front_of_the_gripper(robot: Robot) -> None:
    for side, link in (("right", LINKS[21]), ("left", LINKS[27])):
        assert link.joint == f"{side}_wrist_pitch"
        point = robot.striker(f"{side}_hand").point
        np.testing.assert_allclose(point, [0, 0, link.box.corners()[:, 2].min()], atol=1e-12)


# ---- it is a preset like the others


def test_servo_is_that_of_the_sample_controller(robot: Robot) -> None:
    for name, kp, kd in zip(robot.joint_names, robot.kp, robot.kd, strict=True):
        if name.startswith("head"):
            assert (kp, kd) == (pytest.approx(30 * 1.5 * 9.6), pytest.approx(1.5 * 9.6))
        else:
            arm = name.split("_", 1)[1] in ARM
            assert (kp, kd) == (3000.0 if arm else 8000.0, 100.0), name


def test_it_needs_no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(presets, "distribution", missing)
    assert load_robot("standin").name == "standin"
    with pytest.raises(InputError, match=r"not 'standin'.*\[robots\]"):
        load_robot("talos")


def test_it_loads_fast() -> None:
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        standin()
        times.append(time.perf_counter() - begin)
    assert min(times) < 0.5


def test_it_takes_what_the_other_presets_take() -> None:
    tuned = standin(kd=20.0, kp={"head_yaw": 7.0}, name="tuned")
    assert tuned.name == "tuned" and np.all(tuned.kd == 20) and tuned.kp[tuned.joint_index("head_yaw")] == 7
    free = standin()
    fixed = standin(floating=False)
    assert fixed.joint_names == free.joint_names and not fixed.floating
    np.testing.assert_array_equal(fixed.armature, free.armature)
    stiff = standin(locked={"head_yaw": 0.0, "left_elbow": -1.0})
    kept = [free.joint_index(name) for name in stiff.joint_names]
    assert set(free.joint_names) - set(stiff.joint_names) == {"head_yaw", "left_elbow"}
    assert pin.computeTotalMass(stiff.model) == pytest.approx(58.0, abs=1e-12)
    for name in ("armature", "torque_limit", "velocity_limit", "lower", "upper", "kp"):
        np.testing.assert_array_equal(getattr(stiff, name), getattr(free, name)[kept])
    stiff.check_stance(stiff.posture("half_sitting"))


def test_its_punch_is_sound() -> None:
    problem = load_problem(Path(__file__).resolve().parents[2] / "problems" / "punch_standin.toml")
    assert problem.robot.name == "standin"
