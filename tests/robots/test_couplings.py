"""Joints that follow others: S'HS, S'tau, J S of the tree whose joints are free, by Pinocchio and MuJoCo."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import urdfs
from support.rigid_body_cases import random_tree
from support.small_robots import arm, parallelogram, slider

from impactopt import (
    SDC,
    FreeMass,
    FullDynamics,
    InputError,
    MujocoDynamics,
    RigidBody,
    Robot,
    SoftGrip,
    SpringDamper,
    Striker,
    Tool,
)
from impactopt.codegen.cache import model_hash
from impactopt.robots.couplings import Coupling, coupled, couplings_of, with_followers
from impactopt.robots.model import mass_matrix
from impactopt.simulation.mujoco_world import MujocoOptions, MujocoRobot, mujoco_module, robot_bodies, spec_of

Array = NDArray[np.float64]
RATIOS = st.floats(0.2, 2.0) | st.floats(-2.0, -0.2) | st.sampled_from([-1.0, 1.0])


class Pair:
    """A tree whose joints are all free, the same with followers, and v = S v_coupled of the first."""

    def __init__(self, seed: int, floating: bool, laws: list[tuple[int, int, float, float]]) -> None:
        """laws : two of the joints with ends, by their order, ratio and offset [rad]."""
        self.free = random_tree(seed, floating)
        rng = np.random.default_rng(seed)
        self.free.armature = rng.uniform(0.0, 0.3, self.free.nv)
        if floating:
            self.free.armature[:6] = 0.0
        place = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
        for k, joint in enumerate((self.free.njoints - 1, self.free.njoints // 2)):
            self.free.addFrame(pin.Frame(f"frame {k}", joint, 0, place, pin.FrameType.OP_FRAME))
        names = [str(name) for name, j in zip(self.free.names, self.free.joints, strict=True) if j.nq == 1][
            1:
        ]
        self.laws = {}
        for one, other, ratio, offset in laws:
            leader, follower = sorted((one % len(names), other % len(names)))
            if leader != follower:
                self.laws.setdefault(names[follower], Coupling(names[leader], ratio, offset))
        self.model = coupled(self.free, self.laws)
        self.followers = [self.free.joints[self.free.getJointId(name)] for name in self.laws]
        rest = np.delete(np.arange(self.free.nv), [joint.idx_v for joint in self.followers])
        self.S = np.zeros((self.free.nv, self.model.nv))
        self.S[rest, np.arange(self.model.nv)] = 1.0
        for name in names:  # leaders come before their followers
            if name in self.laws:
                own, leader = (
                    self.free.joints[self.free.getJointId(n)].idx_v for n in (name, self.laws[name].leader)
                )
                self.S[own] = self.laws[name].ratio * self.S[leader]
        self.order = [name for name in names if name in self.laws]

    def q(self, q: Array) -> Array:
        """Configuration of the free tree."""
        out = np.insert(
            q, [j.idx_q - k for k, j in enumerate(sorted(self.followers, key=lambda j: j.idx_q))], 0.0
        )
        for name in self.order:
            law = self.laws[name]
            own, leader = (self.free.joints[self.free.getJointId(n)].idx_q for n in (name, law.leader))
            out[own] = law.ratio * out[leader] + law.offset
        return out

    def state(self) -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(1)
        q = pin.integrate(self.model, pin.neutral(self.model), rng.uniform(-2, 2, self.model.nv))
        return np.array(q), rng.normal(size=self.model.nv), rng.normal(size=self.model.nv)

    def mass(self, q: Array) -> Array:
        """S'HS of the free tree."""
        H = pin.crba(self.free, self.free.createData(), self.q(q))
        return self.S.T @ (np.triu(H) + np.triu(H, 1).T) @ self.S

    def robot(self) -> Robot:
        joints = [
            str(self.model.names[j]) for j in range(1, self.model.njoints) if self.model.joints[j].nv == 1
        ]
        return Robot.from_model(
            self.model,
            torque_limit=10.0,
            velocity_limit=5.0,
            position_limit=dict.fromkeys(joints, (-4.0, 4.0)),
            kp=0.0,
            kd=0.0,
        )


PAIRS = st.builds(
    Pair,
    st.integers(0, 10_000),
    st.booleans(),
    st.lists(
        st.tuples(st.integers(0, 99), st.integers(0, 99), RATIOS, st.floats(-1, 1)), min_size=1, max_size=4
    ),
)


def close(ours: Any, reference: Any) -> None:
    scale = max(1.0, float(np.abs(reference).max()))
    np.testing.assert_allclose(
        np.array(ours).reshape(np.shape(reference)), reference, rtol=0, atol=1e-10 * scale
    )


@pytest.mark.slow
@given(pair=PAIRS, base=st.sampled_from(["quaternion", "rpy"]))
@settings(max_examples=15, deadline=None)
def test_symbolic_dynamics_are_those_of_the_free_tree(pair: Pair, base: str) -> None:
    body, (q, v, a) = RigidBody(pair.model, base=base), pair.state()
    b, H = ca.SX.sym("b", body.nv), body.mass_matrix()
    outputs = {
        "H": H,
        "rnea": body.rnea(body.v, body.a),
        "gravity": body.rnea(None, None),
        "A_g": body.centroidal_map(),
        "momentum": body.centroidal_momentum(body.v),
        "solve": H @ body.factorize().solve(b),
        "damped": (H + 3.0 * ca.SX.eye(body.nv)) @ body.factorize(H + 3.0 * ca.SX.eye(body.nv)).solve(b),
        **{f"J {k}": body.jacobian(f"frame {k}") for k in range(2)},
        **{f"velocity {k}": body.frame_velocity(f"frame {k}", body.v) for k in range(2)},
        **{f"acceleration {k}": body.frame_acceleration(f"frame {k}", body.v, body.a) for k in range(2)},
    }
    f = ca.Function("f", [body.q, body.v, body.a, b], [ca.densify(x) for x in outputs.values()])
    found = dict(zip(outputs, f(body.from_pin(q), v, a, a), strict=True))
    free, data, S = pair.free, pair.free.createData(), pair.S
    full, rate, second = pair.q(q), S @ v, S @ a
    close(found["H"], pair.mass(q))
    close(found["rnea"], S.T @ pin.rnea(free, data, full, rate, second))
    close(found["gravity"], S.T @ pin.computeGeneralizedGravity(free, data, full))
    close(found["A_g"], pin.computeCentroidalMap(free, data, full) @ S)
    close(found["momentum"], pin.computeCentroidalMomentum(free, data, full, rate).vector)
    close(found["solve"], a)
    close(found["damped"], a)
    pin.forwardKinematics(free, data, full, rate, second)
    pin.computeJointJacobians(free, data)
    pin.updateFramePlacements(free, data)
    for k in range(2):
        at = free.getFrameId(f"frame {k}")
        close(found[f"J {k}"], pin.getFrameJacobian(free, data, at, pin.LOCAL_WORLD_ALIGNED) @ S)
        close(found[f"velocity {k}"], pin.getFrameVelocity(free, data, at, pin.LOCAL_WORLD_ALIGNED).vector)
        moved = pin.getFrameClassicalAcceleration(free, data, at, pin.LOCAL_WORLD_ALIGNED)
        close(found[f"acceleration {k}"], moved.vector)


@given(pair=PAIRS)
@settings(max_examples=30, deadline=None)
def test_a_robots_model_is_the_free_tree_with_its_laws(pair: Pair) -> None:
    robot, (q, v, a) = pair.robot(), pair.state()
    model, data, free = robot.model, robot.model.createData(), pair.free
    assert not set(robot.joint_names) & set(pair.laws)
    assert couplings_of(model).keys() == pair.laws.keys()
    close(mass_matrix(model, data, q), pair.mass(q))
    other = free.createData()
    close(
        robot.inverse_dynamics(data, q, v, a),
        pair.S.T @ pin.rnea(free, other, pair.q(q), pair.S @ v, pair.S @ a),
    )
    pin.forwardKinematics(free, other, pair.q(q))
    rotation, translation = robot.forward_kinematics(q[None])
    close(rotation[0], np.array([place.rotation for place in other.oMi]))
    close(translation[0], np.array([place.translation for place in other.oMi]))


@given(pair=PAIRS)
@settings(max_examples=15, deadline=None)
def test_mujocos_tree_with_equalities_eliminated_by_hand_has_the_same_inertia_and_bias(pair: Pair) -> None:
    mujoco = pytest.importorskip("mujoco")
    assert mujoco_module() is mujoco
    robot, (q, v, _) = pair.robot(), pair.state()
    spec = spec_of(robot, MujocoOptions())
    robot_bodies(mujoco, spec, robot)
    there, gravity = MujocoRobot(robot, spec.compile()), np.array(robot.model.gravity.linear)
    if robot.floating:  # MuJoCo's free joints are in the world, this one is turned in it
        gravity = pair.free.jointPlacements[1].rotation.T @ gravity
    there.world.opt.gravity[:] = gravity
    there.put(q, v)
    mujoco.mj_forward(there.world, there.data)
    assert there.world.neq == len(pair.laws)
    np.testing.assert_allclose(there.data.efc_pos[: len(pair.laws)], 0.0, atol=1e-12)  # the laws hold
    # MuJoCo's columns: the base's linear velocity in the world's axes, joints in the order of the tree
    T, drift = np.zeros((there.world.nv, pair.free.nv)), np.zeros(there.world.nv)
    for j in range(1, pair.free.njoints):
        joint, dof = pair.free.joints[j], int(there.world.joint(pair.free.names[j]).dofadr[0])
        T[dof : dof + joint.nv, joint.idx_v : joint.idx_v + joint.nv] = np.eye(joint.nv)
        if joint.nv == 6:
            T[dof : dof + 3, joint.idx_v : joint.idx_v + 3] = there.base_rotation()
            drift[dof : dof + 3] = there.base_rotation() @ np.cross(v[3:6], v[:3])
    whole = np.array(there.data.qvel)
    close(T @ pair.S @ v, whole)
    H, to = np.zeros((there.world.nv,) * 2), T @ pair.S
    for k, unit in enumerate(np.eye(there.world.nv)):
        mujoco.mj_mulM(there.world, there.data, H[k], unit)
    armature = pair.S.T @ np.diag(pair.free.armature) @ pair.S
    own = to.T @ np.diag(there.world.dof_armature) @ to
    close(own, armature)
    close(to.T @ H @ to, pair.mass(q))
    bias = pin.nonLinearEffects(robot.model, robot.model.createData(), q, v)
    close(to.T @ (H @ drift + there.data.qfrc_bias), bias)


# ---- what is read of files


def described(tmp_path: Path, *laws: tuple[str, str], **options: Any) -> Robot:
    """An arm whose joints follow by these `<mimic>`s; without its gripper."""
    text = urdfs.arm()
    for joint, law in laws:
        text = urdfs.following(text, joint, law)
    (tmp_path / "robot.urdf").write_text(text)
    locked = {"slide_0": 0.0, "slide_1": 0.0}
    return Robot.from_urdf(tmp_path / "robot.urdf", floating=False, locked=locked, **options)


def test_a_leader_has_what_followers_have_by_joint(tmp_path: Path) -> None:
    law = 'joint="shoulder" multiplier="-2" offset="0.5"/><dynamics damping="3" friction="0.7"'
    robot = described(tmp_path, ("elbow", law), armature=0.1)
    assert robot.joint_names == ("turn", "shoulder", "wrist")
    shoulder = robot.joint_index("shoulder")
    # -2.4 <= 0.5 - 2 q <= 2.4, and |2 v| <= 4
    assert (robot.lower[shoulder], robot.upper[shoulder]) == pytest.approx((-0.95, 1.45))
    assert robot.velocity_limit[shoulder] == 2.0 and robot.velocity_limit[0] == 4.0
    actuator = robot.actuators[shoulder]
    assert (actuator.viscous_friction, actuator.coulomb_friction) == pytest.approx((12.0, 1.4))


def test_followers_of_followers_follow_the_first_leader(tmp_path: Path) -> None:
    robot = described(
        tmp_path,
        ("elbow", 'joint="shoulder" multiplier="-0.5" offset="0.1"'),
        ("wrist", 'joint="elbow" multiplier="2" offset="0.3"'),
    )
    assert robot.couplings["wrist"] == pytest.approx(("shoulder", -1.0, 0.5))
    (shoulder,) = (k for k in robot.limb("wrist_link") if robot.joint_names[k] == "shoulder")
    assert robot.limb("wrist_link") == (0, shoulder)


def test_who_comes_before_a_leader_leads_it_by_the_inverse_law(tmp_path: Path) -> None:
    """shoulder = 2 elbow + 0.3, and the wrist follows the elbow."""
    others = ("wrist", 'joint="elbow" multiplier="-1" offset="0.2"')
    made = described(tmp_path, ("shoulder", 'joint="elbow" multiplier="2" offset="0.3"'), others)
    same = described(tmp_path, ("elbow", 'joint="shoulder" multiplier="0.5" offset="-0.15"'), others)
    for name in ("elbow", "wrist"):
        assert made.couplings[name] == pytest.approx(same.couplings[name])
    q = np.array([0.4, -0.7])
    for robot in (made, same):
        close(
            mass_matrix(robot.model, robot.model.createData(), q),
            mass_matrix(same.model, same.model.createData(), q),
        )
    for name in ("lower", "upper", "velocity_limit", "armature"):
        close(getattr(made, name), getattr(same, name))
    # the elbow's motor, whose power is the same at the shoulder's coordinate
    elbow = described(tmp_path).torque_limit[2]
    assert made.torque_limit[1] == pytest.approx(elbow / 2)
    assert made.source is not None and "'shoulder' leads" in "; ".join(made.source.notes)


def test_two_followers_of_a_later_leader_in_any_order(tmp_path: Path) -> None:
    """The first joint leads, whichever the file has first."""
    laws = [("shoulder", 'joint="wrist" multiplier="2"'), ("elbow", 'joint="wrist" multiplier="-1"')]
    one, other = (described(tmp_path, *order) for order in (laws, laws[::-1]))
    assert one.couplings == other.couplings
    assert one.couplings["wrist"] == pytest.approx(("shoulder", 0.5, 0.0))
    close(one.torque_limit, other.torque_limit)


@pytest.mark.parametrize(
    ("motors", "limit", "said"),
    [
        ({"j1": 50.0}, 50.0, "with its own motor"),
        ({"j2": 8.0}, 4.0, "with the motor of 'j2'"),
        ({"j1": 50.0, "j2": 8.0}, 4.0, "with the motor of 'j2'; the actuator of 'j1' is left out"),
    ],
)
def test_who_leads_has_the_motor_that_its_note_says(
    motors: dict[str, float], limit: float, said: str, tmp_path: Path
) -> None:
    """j1 = 2 j2, in an MJCF whose motors are told by the torque that they have."""
    link = '<geom type="capsule" fromto="0 0 0 0 0 .3" size=".03" mass="1"/>'
    joints = [f'<joint name="{joint}" axis="0 1 0" range="-90 90"/>{link}' for joint in ("j1", "j2")]
    actuators = "".join(f'<motor joint="{j}" ctrlrange="-{most} {most}"/>' for j, most in motors.items())
    path = tmp_path / "robot.xml"
    path.write_text(
        f"""<mujoco><worldbody><body><geom size=".1"/><body pos="0 0 .1">{joints[0]}
        <body pos="0 0 .3">{joints[1]}</body></body></body></worldbody>
        <equality><joint joint1="j1" joint2="j2" polycoef="0 2 0 0 0"/></equality>
        <actuator>{actuators}</actuator></mujoco>"""
    )
    robot = Robot.from_mjcf(path, velocity_limit=5.0)
    assert robot.torque_limit == pytest.approx([limit])
    assert robot.source is not None and "; ".join(robot.source.notes).endswith(said)


@pytest.mark.parametrize("locked", ["shoulder", "elbow"])
def test_a_locked_leader_or_follower_leaves_the_other_joint_its_own_motor(
    locked: str, tmp_path: Path
) -> None:
    path = tmp_path / "robot.urdf"
    made = []
    for text in (urdfs.arm(), urdfs.following(urdfs.arm(), "shoulder", 'joint="elbow" multiplier="2"')):
        path.write_text(text)
        made.append(Robot.from_urdf(path, floating=False, locked=("slide_0", "slide_1", locked)))
    for name in ("kp", "kd", "torque_limit", "velocity_limit"):
        close(*(getattr(robot, name) for robot in made))


@pytest.mark.parametrize(
    ("laws", "said"),
    [
        ([("elbow", 'joint="should"')], "'elbow' follows 'should'.*no such joint.*'shoulder'"),
        ([("elbow", 'joint="wrist"'), ("wrist", 'joint="elbow"')], "'elbow', 'wrist' follow each other"),
        ([("elbow", 'joint="shoulder"'), ("elbow", 'joint="turn"')], "'elbow' follows 'shoulder' and 'turn'"),
        ([("elbow", 'joint="shoulder" multiplier="0"')], "multiplier is 0"),
        ([("elbow", 'joint="shoulder" offset="9"')], "do not overlap: .*-11.4 to -6.6 rad"),
    ],
)
def test_what_cannot_follow_is_refused_by_name(
    laws: list[tuple[str, str]], said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said):
        described(tmp_path, *laws)


def test_a_joint_that_turns_without_end_neither_leads_nor_follows() -> None:
    with pytest.raises(InputError, match=r"'turn' is continuous.*lock it"):
        coupled(arm().model, {"elbow": Coupling("turn", 1.0, 0.0)})


def test_springs_of_followers_add_to_their_leaders() -> None:
    """The potential energy of both springs, at any angle, but for a constant."""
    law, springs = Coupling("one", -1.5, 0.4), {"one": (20.0, 0.3), "two": (50.0, -0.2)}
    stiffness, rest = with_followers(springs, {"two": law})["one"]
    q = np.linspace(-1, 1, 7)
    each = 10.0 * (q - 0.3) ** 2 + 25.0 * (law.ratio * q + law.offset + 0.2) ** 2
    assert np.ptp(each - stiffness / 2 * (q - rest) ** 2) < 1e-12


@pytest.mark.parametrize("frame", ["tip", "shoulder"])
def test_laws_outlive_another_joint_in_the_model(frame: str) -> None:
    """A tool in a soft grip has a joint of its own, before that of the counterweight in the tree."""
    grip = SoftGrip(axis=np.array([1.0, 0.0, 0.0]), stiffness=50.0, damping=1.0)
    tool = {
        "mass": 0.5,
        "center": np.zeros(3),
        "inertia": 1e-2 * np.eye(3),
        "head": np.array([0.1, 0.0, 0.0]),
    }
    before = parallelogram()
    after = before.with_tool(Tool(name="hammer", frame=frame, grip=grip, **tool))
    assert after.couplings == before.couplings and after.n == before.n + 1
    kept = [after.joint_index(name) for name in before.joint_names]
    np.testing.assert_array_equal(after.armature[kept], before.armature)
    q = after.posture("start")
    for robot, at in ((before, before.posture("start")), (after, q)):
        pin.forwardKinematics(robot.model, data := robot.model.createData(), at)
        places = [data.oMi[robot.model.getJointId(name)].homogeneous for name in before.couplings]
        if robot is before:
            wanted = places
    np.testing.assert_allclose(places, wanted, atol=1e-14)
    body = RigidBody(after.model)
    H = ca.Function("H", [body.q], [ca.densify(body.mass_matrix())])(q)
    close(H, mass_matrix(after.model, after.model.createData(), q))


@pytest.mark.parametrize("copy", [lambda robot: pickle.loads(pickle.dumps(robot)), deepcopy])
def test_laws_outlive_a_way_to_another_process(copy: Callable[[Robot], Robot]) -> None:
    robot, v = parallelogram(), np.array([0.3, -0.5])
    there, q = copy(robot), robot.posture("start")
    assert there.couplings == robot.couplings and model_hash(there.model) == model_hash(robot.model)
    found, wanted = (r.inverse_dynamics(r.model.createData(), q, v, v) for r in (there, robot))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


MJCF = """
<mujoco><compiler angle="radian"/><worldbody><body name="one" pos="0 0 .3">
  <joint name="a" axis="0 1 0" range="-1 1" ref=".2" actuatorfrcrange="-50 50" armature=".1"/>
  <geom type="box" size=".05 .05 .2" pos="0 0 .2"/>
  <body name="two" pos="0 0 .4">
    <joint name="b" axis="0 1 1" pos="0 .1 0" ref="-.3" armature=".02"/>
    <geom type="box" size=".04 .05 .15" pos=".1 0 .2"/>
    <body name="three" pos="0 0 .3"><joint name="c" type="slide" axis="1 0 0" ref=".1" range="-1 1"/>
    <geom size=".1" pos=".1 .1 0"/></body>
  </body></body></worldbody>
  <equality><joint joint1="b" joint2="a" polycoef=".3 -1.2 0 0 0"/>
  <joint joint1="c" joint2="b" polycoef="0 .5 0 0 0"/></equality>
  <actuator><motor joint="a"/><motor name="m" joint="b"/></actuator></mujoco>
"""


def test_a_joint_that_an_mjcf_holds_still_follows_none(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    held = re.sub(
        "<equality>.*</equality>", '<equality><joint joint1="b"/></equality>', MJCF, flags=re.DOTALL
    )
    (tmp_path / "robot.xml").write_text(held)
    with pytest.raises(InputError, match=r"'b' is fixed by the equality.*lock it"):
        Robot.from_mjcf(tmp_path / "robot.xml", velocity_limit=5.0)


def test_a_leader_behind_its_follower_brings_its_servo(tmp_path: Path) -> None:
    """b = 0.1 - 2 a, by an equality in which a follows b."""
    pytest.importorskip("mujoco")
    text = re.sub("<equality>.*</actuator>", "%s", MJCF, flags=re.DOTALL).replace(
        'ref="-.3"', 'ref="-.3" range="-3 3"'
    )
    equality = '<equality><joint joint1="a" joint2="b" polycoef="0 -.5 0 0 0"/></equality>'
    servo = '<actuator><position joint="b" kp="80" kv="4" forcerange="-30 30"/></actuator>'
    (tmp_path / "robot.xml").write_text(text % (equality + servo))
    robot = Robot.from_mjcf(tmp_path / "robot.xml", velocity_limit=5.0, torque_limit={"c": 9.0})
    assert robot.joint_names == ("a", "c") and robot.couplings["b"].ratio == pytest.approx(-2.0)
    # where both are as compiled, the law holds: b + 0.3 = -2 (a - 0.2)
    assert robot.couplings["b"].offset == pytest.approx(0.1)
    assert (robot.kp[0], robot.kd[0], robot.torque_limit[0]) == pytest.approx((320.0, 16.0, 60.0))
    assert robot.source is not None and "no actuator moves 'a'" not in "; ".join(robot.source.notes)


def test_followers_of_an_mjcf_are_where_mujoco_has_them(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(MJCF)
    robot = Robot.from_mjcf(tmp_path / "robot.xml", velocity_limit=5.0)
    assert robot.joint_names == ("a",) and robot.source is not None
    assert any(
        "the actuator of 'b' is left out: the motor of 'a' moves both" in n for n in robot.source.notes
    )
    mj = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    there, data = mujoco.MjData(mj), robot.model.createData()
    for angle in (-0.7, 0.1, 0.6):
        b = -0.3 + 0.3 - 1.2 * (angle - 0.2)
        there.qpos[:] = angle, b, 0.1 + 0.5 * (b + 0.3)
        mujoco.mj_forward(mj, there)
        np.testing.assert_allclose(there.efc_pos[:2], 0.0, atol=1e-12)
        pin.framesForwardKinematics(robot.model, data, np.array([angle]))
        for body in ("one", "two", "three"):
            at = data.oMf[robot.model.getFrameId(body, pin.FrameType.BODY)]
            np.testing.assert_allclose(at.translation, there.body(body).xpos, atol=1e-12)
        H, S = np.zeros((3, 3)), np.array([1.0, -1.2, -0.6])
        for k, unit in enumerate(np.eye(3)):
            mujoco.mj_mulM(mj, there, H[k], unit)
        assert mass_matrix(robot.model, data, np.array([angle]))[0, 0] == pytest.approx(S @ H @ S, rel=1e-12)
        gravity = pin.computeGeneralizedGravity(robot.model, data, np.array([angle]))
        assert gravity[0] == pytest.approx(S @ there.qfrc_bias, rel=1e-10)


# ---- collisions


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [-2.0, 0.5])
def test_two_coupled_masses_hit_as_one_of_their_effective_mass(ratio: float) -> None:
    """Of masses 2 and 3 kg on rails, the first strikes: 2 + 3 ratio^2."""
    model = pin.Model()
    for k, mass in enumerate((2.0, 3.0)):
        joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), f"rail {k}")
        model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, 0.05), pin.SE3.Identity())
        model.addJointFrame(joint)
    two = Robot.from_model(
        coupled(model, {"rail 1": Coupling("rail 0", ratio, 0.3)}),
        kp=0.0,
        kd=0.0,
        torque_limit=1e4,
        velocity_limit=10.0,
        position_limit={"rail 0": (-5.0, 5.0)},
        strikers=[Striker(name="tip", frame="rail 0", point=np.zeros(3))],
    )
    settings: dict[str, Any] = {"striker": "tip", "normal": np.array([1.0, 0.0, 0.0])}
    settings |= {"law": SpringDamper(stiffness=1e4, damping=50.0), "target": FreeMass(mass=4.0)}
    state = np.zeros(1), np.ones(1), np.zeros(1)
    one = SDC(robot=slider(2.0 + 3.0 * ratio**2), **settings).collide(*state).impulse
    for kind, within in ((SDC, 1e-9), (FullDynamics, 1e-6), (MujocoDynamics, 1e-4)):
        assert kind(robot=two, **settings).collide(*state).impulse == pytest.approx(one, rel=within)


@pytest.mark.slow
def test_full_dynamics_of_followers_are_mujocos() -> None:
    robot = parallelogram()
    settings: dict[str, Any] = {"robot": robot, "striker": "tip", "normal": np.array([0.0, 0.0, -1.0])}
    settings |= {"law": SpringDamper(stiffness=1e4, damping=50.0), "target": FreeMass(mass=2.0)}
    q, v = robot.posture("start"), np.array([2.0, 1.0])
    torque = np.array(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))
    full = FullDynamics(**settings).collide(q, v, torque)
    other = FullDynamics(form="pinocchio", **settings).collide(q, v, torque)
    assert other.impulse == pytest.approx(full.impulse, rel=1e-8)
    mujoco = MujocoDynamics(**settings).collide(q, v, torque)
    assert mujoco.impulse == pytest.approx(full.impulse, rel=1e-4)
    np.testing.assert_allclose(mujoco.velocity, full.velocity, rtol=1e-3, atol=1e-4)
    assert SDC(**settings).collide(q, v, torque).impulse == pytest.approx(full.impulse, rel=0.02)
