"""Robots from MJCFs against MuJoCo itself: mass matrix, inverse dynamics, Jacobians; drives and errors."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support import urdfs

from impactopt import FreeMass, ImpactProblem, InputError, Robot, Sole, SpringDamper, Striker
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.files.problem_file import ProblemFile
from impactopt.robots.mjcf import compile_mjcf, read_mjcf
from impactopt.simulation.mujoco_world import robot_bodies

mujoco = pytest.importorskip("mujoco")

Array = NDArray[np.float64]

# A floating base, two branches, a slide with a tilted axis, joints with an offset and a reference, inertias
# of geoms and by hand, a geom that does not collide, a link fixed to another, a ball beside the robot.
TREE = """
<mujoco model="tree">
  <compiler angle="degree"/>
  <default><joint damping="0.4" frictionloss="0.2" armature="0.03"/></default>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="trunk" pos="0.1 0.2 1" euler="10 20 30">
      <freejoint name="root"/>
      <geom type="box" size=".1 .15 .2" density="800"/>
      <site name="imu" pos="0 0 .1"/>
      <body name="upper" pos="0 .2 .1" euler="0 15 0">
        <joint name="shoulder" axis="1 2 0.5" pos="0.01 0.02 0.03" range="-90 80" ref="20"/>
        <geom type="capsule" size=".04" fromto="0 0 0 0 0.1 -.3"/>
        <body name="lower" pos="0 .1 -.3">
          <joint name="elbow" axis="0 1 0" range="-90 90"/>
          <geom type="cylinder" size=".03 .1" pos="0 0 -.1"/>
          <geom type="sphere" size=".05" pos="0 0 -.2" contype="0" conaffinity="0" rgba="1 0 0 1"/>
          <body name="hand" pos="0 0 -.2" quat="1 .2 .3 .1">
            <geom type="ellipsoid" size=".03 .04 .05" pos=".01 0 0"/>
            <site name="fist" pos="0.05 0 0" euler="0 90 0"/>
          </body>
        </body>
      </body>
      <body name="mast" pos="-.1 0 .2">
        <joint name="lift" type="slide" axis="0 .1 1" range="-.1 .2" ref=".05"/>
        <inertial mass="2" pos=".01 .02 .03" fullinertia=".02 .03 .04 .001 .002 -.001"/>
        <body name="top" pos="0 0 .1">
          <joint name="turn" axis="0 -1 1" limited="false"/>
          <geom type="box" size=".05 .02 .03" pos=".02 0 0"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="2 0 1"><freejoint/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <position name="a" joint="shoulder" kp="200" kv="7" gear="2" forcerange="-40 40"/>
    <motor joint="elbow" gear="50" ctrlrange="-1 1"/>
    <position joint="lift" kp="900"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0 0 1 1 0 0 0 .3 .2 0.1 2 2 0 1 1 0 0 0"/>
    <key name="broken" qpos="0 0 1 1 0 0 0 .3 9 0.1 1 2 0 1 1 0 0 0"/>
  </keyframe>
</mujoco>
"""
LACKS: dict[str, Any] = {"velocity_limit": 4.0, "torque_limit": {"lift": 100.0, "turn": 50.0}}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    path = tmp_path / "tree.xml"
    path.write_text(TREE)
    return path


class Both:
    """A robot's model beside MuJoCo's, at states drawn in Pinocchio's coordinates: qvel = S v."""

    def __init__(self, path: Path, *, mj: Any = None, model: Any = None) -> None:
        """A file's; or these."""
        self.mj = mujoco.MjModel.from_xml_path(str(path)) if mj is None else mj
        self.model = read_mjcf(path).model if model is None else model
        self.there, self.data = mujoco.MjData(self.mj), self.model.createData()

    def states(self, count: int) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
        """q, v, S, and dS/dt v, after a forward computation in MuJoCo."""
        rng, model = np.random.default_rng(0), self.model
        for _ in range(count):
            q = pin.integrate(model, pin.neutral(model), rng.standard_normal(model.nv))
            v = rng.standard_normal(model.nv)
            to, drift = np.zeros((self.mj.nv, model.nv)), np.zeros(self.mj.nv)
            for i in range(1, model.njoints):
                joint, other = model.joints[i], self.mj.joint(model.names[i])
                a, b = int(other.qposadr[0]), int(other.dofadr[0])
                if joint.nq == 7:
                    turn = pin.XYZQUATToSE3(q[:7]).rotation
                    self.there.qpos[a : a + 7] = q[[0, 1, 2, 6, 3, 4, 5]]
                    to[b : b + 3, :3], to[b + 3 : b + 6, 3:6] = turn, np.eye(3)
                    drift[b : b + 3] = turn @ np.cross(v[3:6], v[:3])
                else:
                    x = q[joint.idx_q : joint.idx_q + joint.nq]
                    self.there.qpos[a] = x[0] if joint.nq == 1 else np.arctan2(x[1], x[0])
                    to[b, joint.idx_v] = 1.0
            self.there.qvel[:] = to @ v
            mujoco.mj_forward(self.mj, self.there)
            yield q, v, to, drift, rng.standard_normal(model.nv)

    def mass(self) -> Array:
        """MuJoCo's mass matrix, by columns of its product with vectors."""
        out = np.zeros((self.mj.nv, self.mj.nv))
        for k, unit in enumerate(np.eye(self.mj.nv)):
            mujoco.mj_mulM(self.mj, self.there, out[k], unit)
        return out

    def check_dynamics(self) -> None:
        """Mass matrix and inverse dynamics are the same in both."""
        for q, v, to, drift, a in self.states(5):
            mass = self.mass()
            upper = np.triu(pin.crba(self.model, self.data, q))
            own = upper + np.triu(upper, 1).T
            assert np.abs(own - to.T @ mass @ to).max() < 1e-12 * np.abs(own).max()
            torque = to.T @ (mass @ (to @ a + drift) + self.there.qfrc_bias)
            other = pin.rnea(self.model, self.data, q, v, a)
            assert np.abs(torque - other).max() < 1e-12 * np.abs(other).max()


def test_both_engines_have_the_same_dynamics(tree: Path) -> None:
    Both(tree).check_dynamics()


# three hinges and a slide with offsets move the same body, as those of MuJoCo's own humanoid
SEVERAL = """
<joint name="sway" axis="1 0 0" pos="0 .1 0" range="-10 10" armature="0"/>
<joint name="slide" type="slide" axis="1 0 1" range="-.1 .1"/>
<joint name="nod" axis="2 1 1" pos=".02 .01 0" range="-20 20" ref="5"/>
"""


def test_several_joints_may_move_the_same_body(tree: Path) -> None:
    tree.write_text(
        TREE.partition("<keyframe>")[0].replace('<joint name="elbow"', SEVERAL + '<joint name="elbow"')
        + "</mujoco>"
    )
    Both(tree).check_dynamics()
    limits = {"lift": 100.0, "turn": 50.0, "sway": 50.0, "nod": 50.0, "slide": 50.0}
    robot = Robot.from_mjcf(tree, velocity_limit=4.0, torque_limit=limits, kp=1.0, kd=1.0)
    spec = mujoco.MjSpec()
    spec.compiler.degree, spec.compiler.balanceinertia = False, False
    robot_bodies(mujoco, spec, robot)
    Both(tree, mj=spec.compile(), model=robot.model).check_dynamics()
    # the bodies beside these joints are connected by them: they may touch
    model = robot.model
    carried = model.getJointId("elbow"), model.getJointId("shoulder")
    assert carried in bodies_of(robot).connected


def test_both_engines_have_the_same_sites(tree: Path) -> None:
    both = Both(tree)
    for q, _, to, _, _ in both.states(5):
        pin.computeJointJacobians(both.model, both.data, q)
        pin.updateFramePlacements(both.model, both.data)
        for name in ("imu", "fist"):
            site, frame = both.mj.site(name).id, both.model.getFrameId(name)
            along, about = np.zeros((2, 3, both.mj.nv))
            mujoco.mj_jacSite(both.mj, both.there, along, about, site)
            own = pin.getFrameJacobian(both.model, both.data, frame, pin.LOCAL_WORLD_ALIGNED)
            assert np.abs(np.vstack([along, about]) @ to - own).max() < 1e-12
            assert np.allclose(both.data.oMf[frame].translation, both.there.site_xpos[site], atol=1e-12)


def test_drives_are_those_of_actuators_and_joints(tree: Path) -> None:
    robot = Robot.from_mjcf(tree, **LACKS)
    k = {name: robot.joint_index(name) for name in robot.joint_names}
    assert robot.kp[k["shoulder"]] == 200 * 2**2 and robot.kd[k["shoulder"]] == 7 * 2**2
    assert robot.torque_limit[k["shoulder"]] == 80.0  # forcerange x gear
    assert robot.torque_limit[k["elbow"]] == 50.0  # ctrlrange x gear
    assert robot.kp[k["lift"]] == 900 and robot.kd[k["lift"]] == 0.4  # the joint's damping is its servo's
    assert robot.actuators[k["lift"]].viscous_friction == 0.0
    assert robot.actuators[k["elbow"]].viscous_friction == 0.4
    assert [a.coulomb_friction for a in robot.actuators] == [0.2] * 4
    assert (robot.armature == 0.03).all()
    assert robot.lower[k["elbow"]] == pytest.approx(-np.pi / 2) and robot.upper[k["lift"]] == 0.2
    assert robot.lower[k["turn"]] == -np.inf
    assert robot.source is not None
    assert any(note.startswith("no actuator moves 'turn':") for note in robot.source.notes)


def test_sites_that_move_strike_and_keyframes_inside_the_limits_are_postures(tree: Path) -> None:
    robot = Robot.from_mjcf(tree, **LACKS)
    assert list(robot.strikers) == ["fist"]  # the trunk's is on what no joint of the robot moves
    assert list(robot.postures) == ["home"]
    assert robot.joint_positions(robot.posture("home")) == pytest.approx([0.3, 0.2, 0.1, 2.0])


TWO = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="one" axis="0 1 0" range="-1 1" actuatorfrcrange="-50 50" armature=".1"/>
<geom size=".1" mass="1"/>
<body pos=".3 0 0"><joint name="two" axis="0 1 0" range="-1 1" actuatorfrcrange="-50 50" armature=".1"/>
<geom size=".1" mass="1"/></body></body></worldbody>%s
<keyframe><key name="far" qpos="0.9 0.9"/><key name="zero" qpos="0 0"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("more", "options"),
    [
        ("", {"position_limit": {"one": (-0.5, 0.5)}}),
        (
            '<tendon><fixed name="sum" range="-1 1" limited="true"><joint joint="one" coef="1"/>'
            '<joint joint="two" coef="1"/></fixed></tendon>',
            {},
        ),
        ('<equality><joint joint1="two" joint2="one" polycoef="0 2 0 0 0"/></equality>', {}),
    ],
    ids=["a user's limit", "a tendon", "a follower"],
)
def test_a_keyframe_outside_a_narrower_range_is_left_out(
    more: str, options: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "two.xml"
    path.write_text(TWO % more)
    robot = Robot.from_mjcf(path, velocity_limit=5.0, **options)
    assert list(robot.postures) == ["zero"]
    assert robot.source is not None and "keyframe 'far' is left out" in "; ".join(robot.source.notes)
    with pytest.raises(InputError, match="posture 'far': outside its position limits"):
        Robot.from_mjcf(path, velocity_limit=5.0, postures={"far": {"one": 0.9}}, **options)


def test_a_free_joint_can_be_taken_out(tree: Path) -> None:
    robot = Robot.from_mjcf(tree, floating=False, **LACKS)
    assert not robot.floating and robot.n == 4
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, pin.neutral(robot.model))
    assert data.oMf[robot.model.getFrameId("trunk")].translation == pytest.approx([0.1, 0.2, 1.0])


SIX = "".join(
    f'<joint name="base_{kind}{k}" type="{kind}" axis="{axis}" armature="0" frictionloss="0"/>'
    for kind in ("slide", "hinge")
    for k, axis in enumerate(("1 0 0", "0 0 1", "0 -1 0"))
)


def test_six_joints_that_move_a_root_like_a_free_one_are_one(tree: Path, tmp_path: Path) -> None:
    """As in models that stem from OpenSim; a thing beside the robot on six such joints is no robot."""
    sprung = SIX.replace('name="base_hinge2"', 'name="base_hinge2" stiffness="5"')
    text = TREE.replace('<freejoint name="root"/>', sprung).replace(
        "<freejoint/>", SIX.replace("base", "ball")
    )
    home = ".1 .2 .3 .4 .5 .6 .3 .2 0.1 2 2 0 1 1 0 0"
    text = re.sub(
        r"<keyframe>.*</keyframe>", f'<keyframe><key name="home" qpos="{home}"/></keyframe>', text, flags=re.S
    )
    path = tmp_path / "six.xml"
    path.write_text(text)
    read, free = read_mjcf(path), read_mjcf(tree)
    assert read.model.nq == free.model.nq
    assert "read as a free joint of body 'trunk', damping and stiffness left out" in str(read.notes)
    rng = np.random.default_rng(0)
    q = pin.integrate(free.model, pin.neutral(free.model), rng.standard_normal(free.model.nv))
    masses = [np.array(pin.crba(m, m.createData(), q)) for m in (read.model, free.model)]
    assert masses[0] == pytest.approx(masses[1])
    mj = mujoco.MjModel.from_xml_path(str(path))
    there = mujoco.MjData(mj)
    mujoco.mj_resetDataKeyframe(mj, there, 0)
    mujoco.mj_kinematics(mj, there)
    data = read.model.createData()
    pin.framesForwardKinematics(read.model, data, read.model.referenceConfigurations["home"])
    for body in ("trunk", "hand", "top"):
        at = data.oMf[read.model.getFrameId(body)].translation
        assert at == pytest.approx(there.body(body).xpos, abs=1e-9), body
    assert "ball" not in [frame.name for frame in read.model.frames]


@pytest.mark.parametrize(
    "held",
    [
        '<actuator><motor joint="base_slide1"/></actuator>',
        '<tendon><fixed name="rope" stiffness="9"><joint joint="base_slide1" coef="1"/></fixed></tendon>',
        '<equality><joint joint1="base_slide1"/></equality>',
        "",
    ],
    ids=["driven", "on a tendon", "at rest", "limited"],
)
def test_six_joints_with_a_motor_or_a_limit_are_six(tmp_path: Path, held: str) -> None:
    text = TREE[: TREE.index("<keyframe>")] + f"{held}</mujoco>"
    text = text.replace('<freejoint name="root"/>', SIX)
    if not held:
        text = text.replace('name="base_hinge0"', 'name="base_hinge0" range="-30 30"')
    (tmp_path / "six.xml").write_text(
        text.replace('<body name="ball" pos="2 0 1"><freejoint/><geom size=".1"/></body>', "")
    )
    read = read_mjcf(tmp_path / "six.xml")
    assert read.model.existJointName("base_slide0") and read.model.nv == 10


def test_own_numbers_win_over_the_files(tree: Path) -> None:
    robot = Robot.from_mjcf(tree, locked=["turn"], velocity_limit=4.0, torque_limit=7.0, kp={"lift": 5.0})
    assert (robot.torque_limit == 7.0).all() and robot.kp[robot.joint_index("lift")] == 5.0
    assert robot.kp[robot.joint_index("shoulder")] == 800.0


GRIPPER = """
<mujoco><worldbody><body name="turntable" pos="0 0 1"><joint name="j1" axis="0 0 1" range="-3 3"/>
  <inertial pos="0.1 0 0" mass="9" diaginertia=".1 .1 .1"/>
  <body name="arm" gravcomp="{arm}"><joint name="j2" axis="0 1 0" range="-3 3"/>
    <inertial pos="0.3 0 0" mass="4" diaginertia=".1 .1 .1"/>
    <body name="finger" pos="0.6 0 0" gravcomp="{finger}">
      <joint name="j3" type="slide" axis="0 1 0" range="0 .1"/>
      <inertial pos="0.1 0 0" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>
</body></body></body></worldbody>
<actuator><motor joint="j2" ctrlrange="-50 50"/></actuator></mujoco>
"""


def test_the_weight_above_a_turntable_needs_no_compensation(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(GRIPPER.format(arm=1, finger=1, mass=0.2))
    robot = Robot.from_mjcf(tmp_path / "robot.xml", velocity_limit=3.0, torque_limit=50.0, floating=False)
    assert not robot.model.gravity.linear.any()
    assert any("all bodies that joints lift have gravcomp 1" in note for note in robot.source.notes)


def test_a_light_finger_may_be_compensated_if_it_is_locked(tmp_path: Path) -> None:
    """MuJoCo's own passive force on the shoulder of the stretched arm is what the note bounds."""
    path = tmp_path / "robot.xml"
    given: dict[str, Any] = {"velocity_limit": 3.0, "torque_limit": 50.0, "floating": False}
    path.write_text(GRIPPER.format(arm=0, finger=1, mass=0.2))
    with pytest.raises(InputError, match=r"gravcomp of 'finger' is not that of the rest.*lock it"):
        Robot.from_mjcf(path, **given)
    robot = Robot.from_mjcf(path, locked=["j3"], **given)
    mj = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(mj)
    mujoco.mj_forward(mj, data)
    load = float(abs(data.qfrc_gravcomp[1]))
    told = re.search(r"at most ([\d.]+) N m of 'j2', ([\d.]+) % of the file's", " ".join(robot.source.notes))
    assert told is not None
    most, share = map(float, told.groups())
    # the bound also has the finger's travel of 0.1 m, whatever its direction
    assert load < most < 1.2 * load and share == pytest.approx(100 * most / 50, rel=0.05)
    path.write_text(GRIPPER.format(arm=0, finger=1, mass=1.0))
    with pytest.raises(InputError, match="lock it"):
        Robot.from_mjcf(path, locked=["j3"], **given)
    # at the end of a telescope of 1 m, which loads the shoulder with 3.3 N m
    text = GRIPPER.format(arm=0, finger=1, mass=0.2)
    slide = 'name="j3" type="slide" axis="0 1 0" range="0 .1"'
    path.write_text(text.replace(slide, 'name="j3" type="slide" axis="1 0 0" range="0 1"'))
    with pytest.raises(InputError, match=r"gravcomp of 'finger' is not that of the rest.*lock all of j3, j2"):
        Robot.from_mjcf(path, **given)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            '<joint name="elbow" axis="0 1 0" range="-90 90"/>',
            '<joint name="elbow" type="ball"/>',
            "'elbow' is a ball",
        ),
        (
            "<actuator>",
            '<equality><weld name="rod" body1="hand" body2="top"/></equality><actuator>',
            "closes a loop by the equality 'rod'",
        ),
        (
            "<actuator>",
            '<equality><joint joint1="elbow" joint2="turn"/></equality><actuator>',
            "'elbow' cannot follow 'turn': 'turn' is continuous.*lock it",
        ),
        (
            '<freejoint/><geom size=".1"/>',
            '<freejoint/><geom size=".1"/><body><joint/><geom size=".1"/></body>',
            "has several robots, 'trunk', 'ball'",
        ),
        ("<mujoco model", "<mujoco nonsense='1' model", "MJCF .*tree.xml: .*nonsense"),
    ],
)
def test_what_is_no_robot_here_is_refused(tree: Path, old: str, new: str, said: str) -> None:
    text = TREE.replace(old, new)
    if "<joint/>" in new:  # more numbers than its keyframes have
        text = text.partition("<keyframe>")[0] + "</mujoco>"
    tree.write_text(text)
    with pytest.raises(InputError, match=said):
        Robot.from_mjcf(tree, **LACKS)


def test_a_spring_of_a_continuous_joint_counts_its_turns(tree: Path) -> None:
    turn = 'name="turn" axis="0 -1 1" limited="false"'
    tree.write_text(TREE.replace(turn, f'{turn} stiffness="3" springref="40"'))
    robot = Robot.from_mjcf(tree, **LACKS)
    assert np.isinf(robot.lower[robot.joint_names.index("turn")])
    mj, angle = mujoco.MjModel.from_xml_path(str(tree)), 9.0  # more than a turn from the spring's rest
    there, joint = mujoco.MjData(mj), mj.joint("turn")
    there.qpos[joint.qposadr] = angle
    mujoco.mj_forward(mj, there)
    q = pin.neutral(robot.model)
    q[robot.model.joints[robot.model.getJointId("turn")].idx_q] = angle
    found = robot.spring_torque(q)[robot.joint_names.index("turn")]
    assert found == pytest.approx(-there.qfrc_spring[joint.dofadr[0]], rel=1e-12)


def test_missing_limits_are_mended_in_the_files_own_words(tree: Path) -> None:
    with pytest.raises(InputError) as found:
        Robot.from_mjcf(tree, torque_limit={"lift": 100.0})
    said = str(found.value)
    assert "'turn' has no usable torque limit" in said and "`actuatorfrcrange` in the MJCF" in said
    assert "velocity limit" in said and "an MJCF has none" in said and "URDF" not in said


def test_soles_stand_where_gravity_is_along_z(tmp_path: Path) -> None:
    path = tmp_path / "walker.urdf"
    path.write_text(urdfs.biped())
    sizes = {"length": 0.2, "width": 0.1, "center": (0.04, 0.0)}
    down = pin.SE3(np.eye(3), np.array([0.0, 0.0, -urdfs.ANKLE]))
    soles = [
        Sole.box(name=s, frame=f"{s}_sole", parent=f"{s}_ankle_roll_link", placement=down, **sizes)
        for s in ("left", "right")
    ]
    bent = {"hip_pitch": -0.4, "knee": 0.8, "ankle_pitch": -0.4}
    posture = {f"{side}_{joint}": angle for side in ("left", "right") for joint, angle in bent.items()}
    fist = Striker(name="fist", frame="right_elbow_link", point=np.zeros(3))
    robot = Robot.from_urdf(path, armature=0.1, soles=soles, strikers=[fist], postures={"ready": posture})
    model = robot.model.copy()
    model.gravity = pin.Motion(np.array([1.0, 0.0, -9.0]), np.zeros(3))
    with pytest.raises(InputError, match=r"gravity is \[1.0, 0.0, -9.0\] .*along -z"):
        ImpactProblem(
            robot=dataclasses.replace(robot, model=model),
            striker="fist",
            start="ready",
            point=[0.3, -0.3, 0.9],
            normal=[1.0, 0.0, 0.0],
            target=FreeMass(mass=1.0),
            law=SpringDamper(stiffness=1e4, damping=100.0),
        )


def test_a_file_without_joints_is_no_robot(tmp_path: Path) -> None:
    path = tmp_path / "stone.xml"
    path.write_text('<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>')
    with pytest.raises(InputError, match="no hinges or slides"):
        read_mjcf(path)
    with pytest.raises(InputError, match="no such file"):
        read_mjcf(tmp_path / "none.xml")


def test_a_part_of_a_scene_is_told_where_the_whole_is(tmp_path: Path) -> None:
    """Contact pairs, meshes' folders and defaults may be in the file that includes the robot's."""
    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body name="arm"><joint name="hinge"/><geom name="hand" size=".1" pos="0 0 .3"/>'
        '</body></worldbody><contact><pair geom1="hand" geom2="floor"/></contact></mujoco>'
    )
    (tmp_path / "broken.xml").write_text("<mujoco>")
    with pytest.raises(InputError, match="'floor' not found") as alone:
        read_mjcf(tmp_path / "robot.xml")
    assert "includes" not in str(alone.value)
    (tmp_path / "scene.xml").write_text(
        '<mujoco><include file="robot.xml"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(InputError, match=r"scene\.xml includes this file: give that one"):
        read_mjcf(tmp_path / "robot.xml")
    assert read_mjcf(tmp_path / "scene.xml").model.nv == 1
    (tmp_path / "scene.xml").write_text(
        '<mujoco><include file="robot.xml"/><asset><mesh name="lost" file="lost.stl"/></asset></mujoco>'
    )
    with pytest.raises(InputError, match="'floor' not found") as lost:
        read_mjcf(tmp_path / "robot.xml")
    assert "includes" not in str(lost.value)


def test_a_urdf_and_an_mjcf_that_are_taken_for_each_other_are_told(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(InputError, match=r"its first element is <mujoco>, not <robot>.*--mjcf"):
        Robot.from_urdf(tmp_path / "arm.xml")
    for shape in ('<mesh filename="package://a.stl"/>', '<sphere radius="0.1"/>'):  # MuJoCo reads the sphere
        link = f'<link name="base"><collision><geometry>{shape}</geometry></collision></link>'
        (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{link}</robot>')
        with pytest.raises(InputError, match=r"it is a URDF: give it by --urdf"):
            Robot.from_mjcf(tmp_path / "arm.urdf")


def test_a_problem_file_can_name_an_mjcf(tree: Path) -> None:
    data: dict[str, Any] = {
        "problem": {
            "striker": "fist",
            "point_m": [0.2, 0.6, 0.6],
            "normal": [1.0, 0.0, 0.0],
            "start": "home",
        },
        "robot": {
            "mjcf": "tree.xml",
            "floating": False,
            "velocity_limit_rad_s": 4.0,
            "torque_limit_N_m": {"lift": 100.0, "turn": 50.0},
        },
        "target": {"mass_kg": 1.0},
        "contact": {"stiffness_N_m": 1e4, "damping_N_s_m": 100.0},
    }
    with pytest.raises(InputError, match="out of reach"):
        ProblemFile.from_data(
            {**data, "problem": {**data["problem"], "point_m": [9.0, 0.0, 0.0]}}, tree.parent / "p"
        ).build()
    with pytest.raises(InputError, match="one of preset, urdf and mjcf"):
        ProblemFile.from_data({**data, "robot": {**data["robot"], "urdf": "x"}}, tree.parent / "p").build()
    with pytest.raises(InputError, match="srdf belongs to urdf"):
        ProblemFile.from_data({**data, "robot": {**data["robot"], "srdf": "x"}}, tree.parent / "p").build()


def test_a_mesh_with_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(
        f'<mujoco><asset><mesh name="link" file="{"a" * 5000}.stl"/></asset><worldbody><body>'
        '<joint name="hinge"/><geom type="mesh" mesh="link"/></body></worldbody></mujoco>'
    )
    with pytest.raises(InputError, match=r"robot\.xml: .*aaa"):
        read_mjcf(tmp_path / "robot.xml")


def test_a_file_is_compiled_again_only_if_one_of_its_sources_has_changed(tmp_path: Path) -> None:
    """A draft reads its file ten times, and MuJoCo takes seconds for the hulls of large meshes."""
    (tmp_path / "meshes").mkdir()
    robot, arm, mesh = tmp_path / "robot.xml", tmp_path / "arm.mjcf", tmp_path / "meshes" / "link.obj"

    def write(density: float, size: float) -> None:
        text = (
            '<mujoco><asset><mesh name="link" file="link.obj"/></asset>'
            f'<worldbody><body name="arm"><joint name="hinge"/><geom type="mesh" mesh="link" '
            f'density="{density}"/></body></worldbody></mujoco>'
        )
        if not arm.exists() or arm.read_text() != text:
            arm.write_text(text)
        corners = "".join(f"v {x} {y} {z}\n" for x, y, z in np.vstack([np.zeros(3), size * np.eye(3)]))
        mesh.write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")

    robot.write_text('<mujoco><compiler meshdir="meshes"/><include file="arm.mjcf"/></mujoco>')
    write(1000.0, 0.1)
    first = compile_mjcf(robot)
    assert compile_mjcf(robot) is first
    mass = read_mjcf(robot).model.inertias[1].mass
    for density, size in ((2000.0, 0.1), (2000.0, 0.2)):
        write(density, size)
        os.utime(mesh, (1e9 * size, 1e9 * size))  # MuJoCo keeps meshes itself, by a time in seconds
        factor = density / 1000.0 * (size / 0.1) ** 3
        assert read_mjcf(robot).model.inertias[1].mass == pytest.approx(factor * mass, rel=1e-6)
