"""Robot and presets: what is built is what the files say, and bad input is named with its fix."""

from __future__ import annotations

import dataclasses
import pickle
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

import impactopt
from impactopt import (
    GearLoad,
    InputError,
    Robot,
    Sole,
    Striker,
    g1,
    load_robot,
    planar_arm,
    scaled_gains,
    talos,
)
from impactopt.codegen.cache import model_hash
from impactopt.errors import check_array, did_you_mean
from impactopt.robots import presets

LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0.001" ixz="0" iyz="0"/></inertial></link>"""
URDF = f"""<robot name="arm">{"".join(LINK.format(name=name) for name in ("base", "upper", "lower", "tool"))}
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit effort="50" velocity="4"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit effort="30" velocity="5" lower="-1" upper="2"/></joint>
<joint name="slide" type="prismatic"><parent link="lower"/><child link="tool"/><origin xyz="0 0 0.3"/>
<axis xyz="1 0 1"/><limit effort="20" velocity="1" lower="0" upper="0.2"/></joint></robot>"""
SRDF = """<robot name="arm"><group name="all"><joint name="elbow"/></group>
<group_state name="bent" group="all"><joint name="elbow" value="1.5"/></group_state>
<rotor_params><joint name="elbow" mass="2e-5" gear_ratio="50"/></rotor_params></robot>"""


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF, encoding="utf-8")
    return path


@pytest.fixture
def arm_model() -> pin.Model:
    return pin.buildModelFromXML(URDF)


def arm(model: pin.Model, **options: Any) -> Robot:
    return Robot.from_model(model, **{"armature": 0.1, **options})


@pytest.fixture(scope="module")
def talos_robot() -> Robot:
    return talos()


@pytest.fixture(scope="module", params=["talos", "g1"])
def humanoid(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


def sole(**options: Any) -> Sole:
    return Sole(**{"name": "foot", "frame": "tool", "polygon": [[0.1, 0], [0, 0.1], [-0.1, 0]], **options})


# ---- presets


@pytest.mark.parametrize(("preset", "joints", "mass"), [(talos, 30, 90), (g1, 29, 33)])
def test_preset_is_the_robot_of_its_documentation(preset: Any, joints: int, mass: float) -> None:
    robot = preset()
    assert (robot.n, robot.nv, robot.nq) == (joints, joints + 6, joints + 7)
    assert robot.floating and len(robot.joint_names) == joints
    assert pin.computeTotalMass(robot.model) == pytest.approx(mass, abs=1)
    assert [s.name for s in robot.soles] == ["left", "right"]
    assert {"right_hand", "left_hand"} <= set(robot.strikers)
    assert np.all(robot.armature > 0) and np.all(robot.torque_limit > 0) and np.all(robot.kd > 0)


def test_preset_stands_flat_inside_its_limits_with_its_weight_over_its_soles(humanoid: Robot) -> None:
    q = humanoid.posture("half_sitting")
    humanoid.check_limits(q)
    humanoid.check_stance(q, height=1e-9, tilt=1e-9)
    data = humanoid.model.createData()
    com = pin.centerOfMass(humanoid.model, data, q)
    pin.framesForwardKinematics(humanoid.model, data, q)
    corners = []
    for foot in humanoid.soles:
        pose = data.oMf[humanoid.model.getFrameId(foot.frame)]
        assert pose.rotation[0, 0] > 0.99, "x of the sole frame points forward"
        corners += [(pose.act(np.array([*corner, 0.0])))[:2] for corner in foot.polygon]
    hull = ConvexHull(corners)
    assert np.all(hull.equations @ [*com[:2], 1] < -0.02)
    assert np.linalg.norm(np.mean(corners, axis=0)[1]) < 1e-6, "the robot stands over the origin"
    knees = [
        humanoid.joint_positions(q)[humanoid.joint_index(name)]
        for name in humanoid.joint_names
        if "knee" in name
    ]
    assert all(knee > 0.3 for knee in knees)


def test_preset_sides_mirror_each_other(humanoid: Robot) -> None:
    data = humanoid.model.createData()
    pin.framesForwardKinematics(humanoid.model, data, humanoid.posture("half_sitting"))
    for names in (("striker:left_hand", "striker:right_hand"), tuple(s.frame for s in humanoid.soles)):
        left, right = (data.oMf[humanoid.model.getFrameId(name)].translation for name in names)
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-4)
    for left_sole, right_sole in [humanoid.soles]:
        mirrored = (right_sole.polygon * [1, -1])[::-1]
        assert {tuple(p) for p in mirrored.round(9)} == {tuple(p) for p in left_sole.polygon.round(9)}


def test_polygons_run_counter_clockwise(humanoid: Robot) -> None:
    for foot in humanoid.soles:
        x, y = foot.polygon.T
        assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0


def test_talos_servo_and_rotors(talos_robot: Robot) -> None:
    np.testing.assert_allclose(talos_robot.kd, np.minimum(150, 1.5 * talos_robot.torque_limit))
    np.testing.assert_allclose(talos_robot.kp, 30 * talos_robot.kd)
    # the SRDF's rotors, 1e-5 kg m2 behind a gear of 100
    np.testing.assert_allclose(talos_robot.armature, 1e-5 * 100**2, rtol=1e-12)


def test_ankles_of_presets_hold_the_robot_up_without_balance_feedback(humanoid: Robot) -> None:
    """An inverted pendulum stands if its stiffness exceeds m g h."""
    com = pin.centerOfMass(humanoid.model, humanoid.model.createData(), humanoid.posture("half_sitting"))
    fifth = "ankle_pitch" if humanoid.name == "g1" else "leg_.*_5"
    ankles = [i for i, name in enumerate(humanoid.joint_names) if re.search(fifth, name)]
    assert len(ankles) == 2
    assert humanoid.kp[ankles].sum() > pin.computeTotalMass(humanoid.model) * 9.81 * com[2]


def test_preset_takes_overrides() -> None:
    robot = talos(kd=20.0, kp={"head_1_joint": 7.0}, torque_limit={"arm_right_4_joint": 5.0}, name="tuned")
    assert robot.name == "tuned" and np.all(robot.kd == 20)
    assert robot.kp[robot.joint_index("head_1_joint")] == 7
    assert robot.kp[robot.joint_index("head_2_joint")] == 30 * 20
    assert robot.torque_limit[robot.joint_index("arm_right_4_joint")] == 5


@pytest.mark.parametrize("preset", ["talos", "g1", "standin", "planar_arm", "arm7", "space_arm"])
def test_a_table_by_joint_changes_these_joints_of_a_preset_alone(preset: str) -> None:
    """G1's other joints lost their armature by one of an elbow, and others got gains of 150."""
    whole = load_robot(preset)
    other = whole.joint_names[1]
    for name in ("armature", "kd", "kp", "torque_limit", "velocity_limit"):
        found, before = getattr(load_robot(preset, **{name: {other: 1.5}}), name), getattr(whole, name)
        assert np.flatnonzero(found != before).tolist() == [1] and found[1] == 1.5, name
    added = load_robot(preset, postures={"mine": {other: 0.1}})
    assert {*added.postures} == {*whole.postures, "mine"}
    for name, q in whole.postures.items():
        np.testing.assert_array_equal(added.postures[name], q)


@pytest.mark.parametrize(
    ("preset", "joint"),
    [
        ("talos", "head_2_joint"),
        ("g1", "left_elbow_joint"),
        ("planar_arm", "wrist"),
        ("arm7", "joint_4"),
        ("space_arm", "joint_7"),
    ],
)
def test_presets_lock_the_joints_that_are_named_and_no_others(preset: str, joint: str) -> None:
    whole, locked = load_robot(preset), load_robot(preset, locked={joint: 0.1})
    kept = [k for k, name in enumerate(whole.joint_names) if name != joint]
    assert locked.joint_names == tuple(whole.joint_names[k] for k in kept)
    for name in ("armature", "torque_limit", "lower", "kp", "kd"):
        np.testing.assert_array_equal(getattr(locked, name), getattr(whole, name)[kept])


def test_an_arm_has_the_base_that_it_has() -> None:
    with pytest.raises(InputError, match="floating: the base of 'arm7' is as it is; leave it out"):
        load_robot("arm7", floating=True)


def test_unknown_preset() -> None:
    with pytest.raises(InputError, match=r"'taols' \(did you mean 'talos'\?\).*talos, g1"):
        load_robot("taols")


def test_missing_robot_files_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(presets, "distribution", missing)
    with pytest.raises(InputError, match=r"pip install -e '\.\[robots\]'"):
        talos()


# ---- building


def test_locked_joints_leave_the_dynamics_of_the_whole_robot(talos_robot: Robot) -> None:
    """The reduced model's inverse dynamics are the whole one's with the grippers held still."""
    folder = presets.example_robots() / "talos_data"
    whole = pin.buildModelFromUrdf(str(folder / "robots" / "talos_reduced.urdf"), pin.JointModelFreeFlyer())
    whole.armature[6:] = 0.1
    locked = [whole.getJointId(f"gripper_{side}_joint") for side in ("left", "right")]
    keep_q = np.delete(np.arange(whole.nq), [whole.joints[j].idx_q for j in locked])
    keep_v = np.delete(np.arange(whole.nv), [whole.joints[j].idx_v for j in locked])
    model = talos_robot.model
    rng = np.random.default_rng(1)
    for _ in range(5):
        q = pin.normalize(model, rng.standard_normal(model.nq))
        v, a = rng.standard_normal((2, model.nv))
        whole_q, whole_v, whole_a = np.zeros(whole.nq), np.zeros(whole.nv), np.zeros(whole.nv)
        whole_q[keep_q], whole_v[keep_v], whole_a[keep_v] = q, v, a
        expected = pin.rnea(whole, whole.createData(), whole_q, whole_v, whole_a)[keep_v]
        np.testing.assert_allclose(pin.rnea(model, model.createData(), q, v, a), expected, rtol=0, atol=1e-9)


def test_locked_joint_is_held_at_its_angle(arm_file: Path) -> None:
    robot = Robot.from_urdf(arm_file, floating=False, armature=0.1, locked={"elbow": 0.7})
    assert robot.joint_names == ("shoulder", "slide")
    whole = Robot.from_urdf(
        arm_file, floating=False, armature=0.1, postures={"p": {"elbow": 0.7, "slide": 0.1}}
    )
    placed = {}
    for some, q in ((robot, np.array([1, 0, 0.1])), (whole, whole.posture("p"))):
        data = some.model.createData()
        pin.framesForwardKinematics(some.model, data, q)
        placed[some.n] = data.oMf[some.model.getFrameId("tool")].homogeneous
    np.testing.assert_allclose(placed[2], placed[3], atol=1e-12)


def test_rotor_adds_its_inertia_times_gear_squared_to_the_diagonal(arm_model: pin.Model) -> None:
    plain = arm(arm_model, armature=None, kd=1.0)
    geared = arm(arm_model, armature=None, kd=1.0, rotor={"elbow": (3e-5, 80.0)})
    q = pin.neutral(arm_model)
    inertia = [pin.crba(robot.model, robot.model.createData(), q) for robot in (plain, geared)]
    np.testing.assert_allclose(inertia[1] - inertia[0], np.diag([0, 3e-5 * 80**2, 0]), atol=1e-15)
    both = arm(arm_model, kd=1.0, rotor={"elbow": (3e-5, 80.0)}, armature={"slide": 0.5})
    np.testing.assert_allclose(both.armature, [0, 3e-5 * 80**2, 0.5])
    assert not np.any(arm_model.armature), "the caller's model is left alone"


def test_srdf_gives_postures_and_rotors(arm_file: Path, tmp_path: Path) -> None:
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(SRDF, encoding="utf-8")
    robot = Robot.from_urdf(arm_file, srdf=srdf, floating=False, kd=1.0, postures={"bent": {"slide": 0.1}})
    np.testing.assert_allclose(robot.armature, [0, 2e-5 * 50**2, 0])
    np.testing.assert_allclose(robot.joint_positions(robot.posture("bent")), [0, 1.5, 0.1])


def test_continuous_joint_has_no_position_limits_but_an_angle(arm_model: pin.Model) -> None:
    robot = arm(arm_model, postures={"turned": {"shoulder": 3.0, "elbow": -0.5}})
    np.testing.assert_array_equal(robot.lower, [-np.inf, -1, 0])
    np.testing.assert_array_equal(robot.upper, [np.inf, 2, 0.2])
    np.testing.assert_allclose(robot.joint_positions(robot.posture("turned")), [3.0, -0.5, 0])
    bounded = arm(arm_model, position_limit={"shoulder": (-1.0, 1.0)})
    with pytest.raises(InputError, match="'shoulder' at 3"):
        bounded.check_limits(robot.posture("turned"))


def test_values_by_joint(arm_model: pin.Model) -> None:
    robot = arm(arm_model, kd={"elbow": 3.0}, kp=[1, 2, 3], velocity_limit=2.0)
    np.testing.assert_allclose(robot.kd, [75, 3, 30])
    np.testing.assert_allclose(robot.kp, [1, 2, 3])
    np.testing.assert_allclose(robot.velocity_limit, 2)


def test_limb_is_the_joints_that_move_the_frame(humanoid: Robot) -> None:
    model, data = humanoid.model, humanoid.model.createData()
    pin.computeJointJacobians(model, data, humanoid.posture("half_sitting"))
    for frame in ("striker:left_hand", humanoid.soles[1].frame):
        jacobian = pin.getFrameJacobian(model, data, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)
        moving = np.flatnonzero(np.any(jacobian[:, 6:] != 0, axis=0))
        assert humanoid.limb(frame) == tuple(moving)


def test_place_moves_the_robot_rigidly_to_the_origin_of_the_ground(talos_robot: Robot) -> None:
    robot, model = talos_robot, talos_robot.model
    standing = robot.posture("half_sitting")
    motion = pin.SE3(pin.utils.rotate("z", 2.1), np.array([1.0, -2.0, 0.3]))
    moved = standing.copy()
    moved[:7] = pin.SE3ToXYZQUAT(motion * pin.XYZQUATToSE3(standing[:7]))
    back = robot.place(moved)
    np.testing.assert_allclose(back[7:], standing[7:])
    np.testing.assert_allclose(
        pin.XYZQUATToSE3(back[:7]).homogeneous, pin.XYZQUATToSE3(standing[:7]).homogeneous, atol=1e-12
    )
    one = robot.place(moved, [robot.sole("right")])
    data = model.createData()
    pin.framesForwardKinematics(model, data, one)
    np.testing.assert_allclose(
        data.oMf[model.getFrameId("right_sole_link")].homogeneous, np.eye(4), atol=1e-12
    )


def test_capture_point_is_where_the_inverted_pendulum_comes_to_rest(humanoid: Robot) -> None:
    """With p at the capture point, x'' = (g / z) (x - p) has the solution x - p ~ exp(-t sqrt(g / z))."""
    q, v = np.array(humanoid.posture("half_sitting")), np.zeros(humanoid.nv)
    data = humanoid.model.createData()
    com = np.array(pin.centerOfMass(humanoid.model, humanoid.model.createData(), q))
    p, rate = humanoid.capture_point(data, q, v), np.sqrt(9.81 / com[2])
    np.testing.assert_allclose(p, com[:2], atol=1e-12)
    v[:2] = 0.3, -0.2  # of the base, whose axes are the world's here
    np.testing.assert_allclose((com[:2] - humanoid.capture_point(data, q, v)) * -rate, v[:2], atol=1e-9)


def test_with_striker_adds_a_frame_to_a_copy(talos_robot: Robot) -> None:
    elbow = Striker(name="elbow", frame="arm_left_4_link", point=[0.0, 0.1, 0.0])
    robot = talos_robot.with_striker(elbow)
    assert not talos_robot.model.existFrame("striker:elbow") and "elbow" not in talos_robot.strikers
    moved = robot.with_striker(dataclasses.replace(elbow, point=[0.3, 0.1, 0.0]))
    tips = []
    for some in (robot, moved):
        data = some.model.createData()
        pin.framesForwardKinematics(some.model, data, some.posture("half_sitting"))
        link = data.oMf[some.model.getFrameId("arm_left_4_link")]
        tips.append(
            link.actInv(data.oMf[some.model.getFrameId(some.striker("elbow").model_frame)].translation)
        )
    np.testing.assert_allclose(tips, [[0, 0.1, 0], [0.3, 0.1, 0]], atol=1e-12)


def test_robot_is_read_only_and_checked_again_when_changed(talos_robot: Robot) -> None:
    with pytest.raises(ValueError, match="read-only"):
        talos_robot.kd[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        talos_robot.kd = talos_robot.kp  # type: ignore[misc]
    talos_robot.posture("half_sitting")[:] = 0
    assert talos_robot.posture("half_sitting")[2] > 0.5
    with pytest.raises(InputError, match="kd of joint 'leg_left_1_joint' is -1"):
        dataclasses.replace(talos_robot, kd=-np.ones(30))


def test_robot_goes_to_other_processes(talos_robot: Robot) -> None:
    copy = pickle.loads(pickle.dumps(talos_robot))
    assert model_hash(copy.model) == model_hash(talos_robot.model)
    np.testing.assert_array_equal(copy.kp, talos_robot.kp)


# ---- bad input


def test_parts_of_another_type_are_refused() -> None:
    robot = load_robot("arm7")
    with pytest.raises(InputError, match=r"strikers must be a list of Strikers, not .*'fist'"):
        Robot.from_model(robot.model, strikers=robot.strikers)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="soles must be a list of Soles, not 'left'"):
        Robot.from_model(robot.model, soles="left")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="striker must be a Striker, not 'fist'"):
        robot.with_striker("fist")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="tool must be a Tool, not 'hammer'"):
        robot.with_tool("hammer")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="grip must be a SoftGrip, not None"):  # was left rigid
        robot.with_grip("hammer", None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mass", "moments", "message"),
    [
        (0, (1, 1, 1), r"joint 'elbow'.*mass 0 kg; give"),
        (-1, (1, 1, 1), r"joint 'elbow'.*mass -1 kg"),
        (1, (0, 1, 1), r"joint 'elbow'.*not positive definite; correct"),
        (1, (-1, 2, 2), r"joint 'elbow'.*not positive definite"),
        (1, (1, 1, 2.1), r"joint 'elbow'.*one exceeds the sum of the others"),
    ],
)
def test_matter_that_cannot_be(mass: float, moments: tuple[float, float, float], message: str) -> None:
    link = LINK.format(name="lower")
    inertia = '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>'.format(
        *moments
    )
    changed = link.replace('mass value="2"', f'mass value="{mass}"').split("<inertia ")[0] + inertia
    with pytest.raises(InputError, match=message):
        arm(pin.buildModelFromXML(URDF.replace(link, changed)))


def test_published_robot_with_impossible_inertias_is_refused() -> None:
    with pytest.raises(InputError, match=r"joint '\w+' .*(not positive definite|exceeds the sum)"):
        Robot.from_urdf(presets.example_robots() / "icub_description" / "robots" / "icub.urdf", armature=0.1)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('effort="30"', 'effort="0"', r"'elbow' has no usable torque limit.*torque_limit=\{'elbow'"),
        ('velocity="5"', 'velocity="0"', r"'elbow' has no usable velocity limit.*velocity_limit=\{'elbow'"),
        ('lower="-1" upper="2"', "", r"'elbow' has no usable position limits.*position_limit=\{'elbow'"),
        ('lower="-1"', 'lower="3"', r"'elbow' has no usable position limits \(lower 3, upper 2"),
        ('<limit effort="50" velocity="4"/>', "", r"'shoulder' has no usable torque limit"),
    ],
)
def test_missing_limits(before: str, after: str, message: str) -> None:
    assert before in URDF
    with pytest.raises(InputError, match=message):
        arm(pin.buildModelFromXML(URDF.replace(before, after)))


def test_missing_limits_can_be_given() -> None:
    model = pin.buildModelFromXML(
        URDF.replace('effort="30"', 'effort="0"').replace('lower="-1" upper="2"', "")
    )
    robot = arm(model, torque_limit={"elbow": 9.0}, position_limit={"elbow": (-1, 1)})
    assert robot.torque_limit[1] == 9 and robot.upper[1] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kp": {"elbo": 1.0}}, r"kp: no joint 'elbo' \(did you mean 'elbow'\?\)"),
        ({"armature": {"Elbow ": 1.0}}, r"armature: no joint 'Elbow ' \(did you mean 'elbow'\?\)"),
        ({"rotor": {"x": (1.0, 2.0)}}, r"rotor: no joint 'x'; there are shoulder, elbow, slide"),
        ({"rotor": {"elbow": 1.0}}, r"rotor of joint 'elbow' .*shape \(2\), got \(\)"),
        ({"torque_limit": {"slid": 1.0}}, r"torque_limit: no joint 'slid' \(did you mean 'slide'\?\)"),
        ({"position_limit": {"slid": (0, 1)}}, r"position_limit: no joint 'slid'"),
        ({"position_limit": {"slide": (np.nan, 1)}}, r"position_limit of joint 'slide'.*nan"),
        ({"postures": {"up": {"elbw": 1.0}}}, r"posture 'up': no joint 'elbw' \(did you mean 'elbow'\?\)"),
        ({"postures": {"up": {"elbow": 2.5}}}, r"posture 'up': outside.*'elbow' at 2.5 \(limits -1 to 2\)"),
        ({"postures": {"up": [1, 0, 0]}}, r"posture 'up': expected shape \(4\), got \(3,\)"),
        (
            {"postures": {"up": [2, 0, 0, 0]}},
            r"posture 'up': the \(cosine, sine\) of joint 'shoulder' has norm 2",
        ),
        ({"kd": [1, 2]}, r"kd: expected shape \(3\), got \(2,\)"),
        ({"kd": [1, np.nan, 2]}, r"kd: nan at index 1"),
        ({"kd": "stiff"}, r"kd: expected numbers, got 'stiff'"),
        ({"kp": -1.0}, r"kp of joint 'shoulder' is -1; give"),
        ({"armature": -0.1}, r"armature of joint 'shoulder' is -0.1"),
        ({"torque_limit": -3.0}, r"'shoulder' has no usable torque limit \(-3"),
        (
            {"soles": [sole(frame="tol")]},
            r"sole 'foot': the model has no frame 'tol' \(did you mean 'tool'\?\)",
        ),
        ({"soles": [sole(), sole()]}, r"two soles have the same name"),
        (
            {"soles": [sole(frame="f", parent="tol", placement=pin.SE3.Identity())]},
            r"sole 'foot'.*frame 'tol'",
        ),
        ({"soles": [sole(parent="base", placement=pin.SE3.Identity())]}, r"has a frame 'tool' already"),
        ({"strikers": [Striker(name="fist", frame="tol", point=[0, 0, 0])]}, r"striker 'fist'.*frame 'tol'"),
    ],
)
def test_bad_options(arm_model: pin.Model, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        arm(arm_model, **options)


@pytest.mark.parametrize("gains", [{"kd": {"slide": 1e7}}, {"kd": 1.0, "kp": {"slide": 1e11}}])
def test_absurd_gains_name_the_joint_and_the_fix(arm_model: pin.Model, gains: dict[str, Any]) -> None:
    with pytest.raises(
        InputError, match=r"servo of joint 'slide'.*1/s.*armature.*lower Kd below.*and Kp below"
    ):
        arm(arm_model, **gains)


def test_light_foot_without_armature_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"'left_ankle_roll_joint'.*armature \(rotor inertia x gear\^2, now 0 kg"
    ):
        g1(armature=0.0, kd=30.0)


def test_bad_files(arm_file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"URDF .*nowhere.urdf: no such file"):
        Robot.from_urdf(tmp_path / "nowhere.urdf")
    with pytest.raises(InputError, match=r"SRDF .*nowhere.srdf: no such file"):
        Robot.from_urdf(arm_file, srdf=tmp_path / "nowhere.srdf")
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot", encoding="utf-8")
    with pytest.raises(InputError, match=r"URDF .*broken.urdf"):
        Robot.from_urdf(broken)
    with pytest.raises(InputError, match=r"SRDF .*broken.urdf"):
        Robot.from_urdf(arm_file, srdf=broken)


@pytest.mark.parametrize(
    ("locked", "message"),
    [
        (["elbw"], r"locked: no joint 'elbw' \(did you mean 'elbow'\?\)"),
        ({"elbow": np.inf}, r"locked: joint 'elbow': inf"),
        ("elbow", r"locked: give a list"),
    ],
)
def test_bad_locks(arm_file: Path, locked: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Robot.from_urdf(arm_file, locked=locked)


def test_joint_of_several_degrees_of_freedom(arm_model: pin.Model) -> None:
    joint = arm_model.addJoint(3, pin.JointModelSpherical(), pin.SE3.Identity(), "ball")
    arm_model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    with pytest.raises(
        InputError, match=r"joint 'ball' is a JointModelSpherical with 3 degrees.*split.*or lock"
    ):
        arm(arm_model)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        ([[0, 0], [1, 0]], "2 corners; give at least 3"),
        ([[0, 0], [0, 1], [1, 1], [1, 0]], "clockwise; reverse"),
        ([[0, 0], [2, 0], [1, 0.2], [1, 2]], "not convex"),
        ([[0, 0], [1, 0], [1, 0], [1, 1]], "repeats a corner"),
        (np.c_[np.cos(np.arange(5) * 0.8 * np.pi), np.sin(np.arange(5) * 0.8 * np.pi)], "not convex"),
        ([[0, 0], [1, 0], [1, np.inf]], r"inf at index \(2, 1\)"),
        ([0, 1, 2], r"expected shape \(any, 2\)"),
    ],
)
def test_bad_polygons(polygon: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"sole 'foot'.*{message}"):
        sole(polygon=polygon)


def test_bad_parts() -> None:
    with pytest.raises(InputError, match="sole 'foot': give parent and placement together"):
        sole(parent="base")
    with pytest.raises(InputError, match=r"striker 'fist': point .*expected shape \(3\)"):
        Striker(name="fist", frame="tool", point=[0, 0])
    with pytest.raises(TypeError, match="poygon"):
        Sole(name="foot", frame="tool", poygon=[])  # type: ignore[call-arg]


def test_bad_names_are_answered_with_the_near_one(talos_robot: Robot) -> None:
    for ask, message in (
        (
            lambda: talos_robot.joint_index("arm_rigth_4_joint"),
            r"'arm_rigth_4_joint' \(did you mean 'arm_right_4_joint'",
        ),
        (lambda: talos_robot.striker("rigth_hand"), r"no striker 'rigth_hand' \(did you mean 'right_hand'"),
        (
            lambda: talos_robot.posture("halfsitting"),
            r"no posture 'halfsitting' \(did you mean 'half_sitting'",
        ),
        (lambda: talos_robot.sole("rigt"), r"no sole 'rigt' \(did you mean 'right'"),
        (
            lambda: talos_robot.limb("right_sole_lnk"),
            r"frame 'right_sole_lnk' \(did you mean 'right_sole_link'",
        ),
    ):
        with pytest.raises(InputError, match=message):
            ask()


def test_bad_configurations_and_velocities(talos_robot: Robot) -> None:
    q = talos_robot.posture("half_sitting")
    for change, message in (
        (q[:-1], r"q: expected shape \(37\), got \(36,\)"),
        (np.where(np.arange(37) == 9, np.nan, q), "q: nan at index 9"),
        (
            np.where(np.arange(37) == 6, 0.9, q),
            r"quaternion \(x, y, z, w\) of joint 'root_joint' has norm 0.9; norm",
        ),
    ):
        with pytest.raises(InputError, match=message):
            talos_robot.check_configuration(change)
    with pytest.raises(InputError, match=r"v: expected shape \(36\), got \(37,\)"):
        talos_robot.check_velocity(np.zeros(37))
    with pytest.raises(InputError, match="v: inf at index 3"):
        talos_robot.check_velocity(np.where(np.arange(36) == 3, np.inf, 0))


def test_stance_off_the_ground_or_tilted(talos_robot: Robot) -> None:
    q = talos_robot.posture("half_sitting")
    up = q + 0.002 * np.eye(37)[2]
    with pytest.raises(InputError, match=r"sole 'left' is 2 mm above the ground.*Robot.place"):
        talos_robot.check_stance(up)
    talos_robot.check_stance(talos_robot.place(up))
    with pytest.raises(InputError, match="below the ground"):
        talos_robot.check_stance(q - 0.002 * np.eye(37)[2])
    rolled = q.copy()
    rolled[7 + talos_robot.joint_index("leg_right_6_joint")] += 0.01
    with pytest.raises(InputError, match=r"sole 'right' is tilted by 0.01 rad.*ankle"):
        talos_robot.check_stance(rolled)
    talos_robot.check_stance(rolled, ["left"])
    crouched = q.copy()  # knee of one leg bent further, its sole level but higher
    for joint, change in (
        ("leg_right_3_joint", -0.1),
        ("leg_right_4_joint", 0.2),
        ("leg_right_5_joint", -0.1),
    ):
        crouched[7 + talos_robot.joint_index(joint)] += change
    with pytest.raises(InputError, match=r"sole 'right' is .* mm above"):
        talos_robot.check_stance(crouched)


def test_did_you_mean() -> None:
    assert did_you_mean("impuls", ["impulse", "peak"]) == " (did you mean 'impulse'?)"
    assert did_you_mean("xyz", ["impulse", "peak"]) == ""


def test_check_array_copies() -> None:
    given = np.arange(3)
    array = check_array("x", given, (3,))
    array[0] = 5
    assert given[0] == 0 and array.dtype == np.float64
    assert check_array("x", [np.inf], (1,), finite=False)[0] == np.inf
    with pytest.raises(InputError, match="x: nan at index 0; give a number"):
        check_array("x", [np.nan], (1,), finite=False)


# ---- the package


def test_public_names_are_there_and_cost_nothing_until_used() -> None:
    for name in impactopt.__all__:
        assert getattr(impactopt, name) is not None
        assert name in dir(impactopt)
    with pytest.raises(AttributeError, match=r"no attribute 'Robt' \(did you mean 'Robot'\?\)"):
        _ = impactopt.Robt  # type: ignore[attr-defined]
    code = "import sys, impactopt; print(sorted({'numpy', 'casadi', 'pinocchio'} & set(sys.modules)))"
    root = Path(impactopt.__file__).parent.parent
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=True
    )
    assert printed.stdout.strip() == "[]"


def test_a_table_by_joint_may_be_a_pandas_series() -> None:
    """By its names: as an array it would count in its own order."""
    pandas = pytest.importorskip("pandas")
    table = {"wrist": 0.5, "shoulder": 0.9}

    def made(given: Any) -> Robot:
        robot = planar_arm(kp=given, armature=given, postures={"raised": given})
        return scaled_gains(robot, given)

    one, other = made(table), made(pandas.Series(table))
    for name in ("kp", "kd", "armature"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.posture("raised"), other.posture("raised"))
    assert planar_arm(locked=pandas.Series({"wrist": 0.5})).joint_names == ("shoulder", "elbow")
    assert GearLoad(limit=pandas.Series(table)) == GearLoad(limit=table)
    # without names it is an array
    kp = pandas.Series([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(planar_arm(kp=kp).kp, kp)
    with pytest.raises(InputError, match="has 'wrist' twice"):
        planar_arm(kp=pandas.Series([1.0, 2.0, 3.0], index=["wrist", "elbow", "wrist"]))
