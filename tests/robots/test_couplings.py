"""Joints that follow others: S'HS, S'tau, J S of the tree whose joints are free, by Pinocchio and MuJoCo."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.rigid_body_cases import random_tree

from impactopt import RigidBody, Robot
from impactopt.robots.couplings import Coupling, coupled, couplings_of
from impactopt.robots.dynamics import inverse_dynamics
from impactopt.robots.mass_matrix import mass_matrix
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
        "damped": (H + 3.0 * ca.SX.eye(body.nv)) @ body.factorize(damping=3.0).solve(b),
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
        inverse_dynamics(robot, data, q, v, a),
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
    there = MujocoRobot(robot, spec.compile())
    there.put(q, v)
    mujoco.mj_forward(there.world, there.data)
    assert there.world.neq == len(pair.laws)
    np.testing.assert_allclose(there.data.efc_pos[: len(pair.laws)], 0.0, atol=1e-12)  # the laws hold
    # MuJoCo's columns: the base's linear velocity in the world's axes, joints in the order of the tree
    T = np.zeros((there.world.nv, pair.free.nv))
    for j in range(1, pair.free.njoints):
        joint, dof = pair.free.joints[j], int(there.world.joint(pair.free.names[j]).dofadr[0])
        T[dof : dof + joint.nv, joint.idx_v : joint.idx_v + joint.nv] = np.eye(joint.nv)
        if joint.nv == 6:
            T[dof : dof + 3, joint.idx_v : joint.idx_v + 3] = there.base_rotation()
    whole = np.array(there.data.qvel)
    close(T @ pair.S @ v, whole)
    H, to = np.zeros((there.world.nv,) * 2), T @ pair.S
    for k, unit in enumerate(np.eye(there.world.nv)):
        mujoco.mj_mulM(there.world, there.data, H[k], unit)
    armature = pair.S.T @ np.diag(pair.free.armature) @ pair.S
    own = to.T @ np.diag(there.world.dof_armature) @ to
    close(own, armature)
    close(to.T @ H @ to, pair.mass(q))
