"""Robots for the tests of `impactopt.robots.rigid_body`, and what Pinocchio says of them."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

SAMPLES = 100
WORLD = pin.LOCAL_WORLD_ALIGNED


# ---------------------------------------------------------------- robots
@dataclass(frozen=True, kw_only=True)
class Case:
    model: Any
    frames: tuple[str, ...]  # at a tip, half-way, on the universe


def _read(path: str, floating: bool) -> Any:
    try:
        data = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("needs impactopt[robots]")
    file = str(data.locate_file("cmeel.prefix/share/example-robot-data/robots/" + path))
    return (
        pin.buildModelFromUrdf(file, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromUrdf(file)
    )


def _direction(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def _placement(rng: np.random.Generator) -> Any:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(scale=0.4, size=3))


def _inertia(rng: np.random.Generator) -> Any:
    """A box somewhere off the joint, turned somehow: physical, and full in every entry."""
    box = pin.Inertia.FromBox(rng.uniform(0.5, 5.0), *rng.uniform(0.1, 0.5, size=3))
    return box.se3Action(_placement(rng))


def _continuous(axis: np.ndarray) -> Any:
    """A continuous joint about any axis, which pin's bindings make from a URDF only."""
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joint = '<parent link="a"/><child link="b"/><axis xyz="{} {} {}"/>'.format(*map(repr, axis.tolist()))
    urdf = f'<robot name="r"><link name="a"/><link name="b">{mass}</link>'
    urdf += f'<joint name="j" type="continuous">{joint}</joint></robot>'
    return pin.buildModelFromXML(urdf).joints[1]


def random_tree(seed: int, floating: bool) -> Any:
    """A branched tree: two joints of every supported type; random axes, placements, inertias and gravity."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.gravity.linear = 9.81 * _direction(rng)
    if floating:
        model.addJoint(0, pin.JointModelFreeFlyer(), _placement(rng), "root")
        model.appendBodyToJoint(1, _inertia(rng), pin.SE3.Identity())
    aligned = [getattr(pin, f"JointModel{kind}{axis}") for kind in ("R", "RUB", "P") for axis in "XYZ"]
    skew = [pin.JointModelRevoluteUnaligned, pin.JointModelPrismaticUnaligned, _continuous]
    joints = [kind() for kind in 2 * aligned] + [kind(_direction(rng)) for kind in 2 * skew]
    for k, joint in enumerate(joints[i] for i in rng.permutation(len(joints))):
        # Pinocchio's own CRBA needs depth-first numbering: branch off the last joint's ancestors only.
        support = [i for i in model.supports[model.njoints - 1] if i > 0 or not floating]
        parent = int(rng.choice(support[-4:]))
        model.addJoint(parent, joint, _placement(rng), f"joint {k}")
        model.appendBodyToJoint(model.njoints - 1, _inertia(rng), pin.SE3.Identity())
    return model


NAMES = ("talos", "g1", "panda", "tree floating 1", "tree floating 2", "tree fixed 3", "tree fixed 4")


@cache
def case(name: str) -> Case:
    if name == "talos":
        model, frames = (
            _read("talos_data/robots/talos_reduced.urdf", True),
            ("gripper_right_joint", "arm_right_4_link"),
        )
    elif name == "g1":
        model = _read("g1_description/urdf/g1_29dof_rev_1_0.urdf", True)
        frames = ("right_wrist_yaw_link", "left_knee_link")
    elif name == "panda":
        model, frames = _read("panda_description/urdf/panda.urdf", False), ("panda_link8", "panda_link4")
    else:
        _, base, seed = name.split()
        model = random_tree(int(seed), base == "floating")
        frames = ("tip", "middle")
        rng = np.random.default_rng(int(seed))
        for frame, joint in (("tip", model.njoints - 1), ("middle", model.njoints // 2)):
            model.addFrame(pin.Frame(frame, joint, 0, _placement(rng), pin.FrameType.OP_FRAME))
    rng = np.random.default_rng(sum(map(ord, name)))
    armature = rng.uniform(0.01, 0.3, size=model.nv)
    if model.names[1] in ("root", "root_joint"):
        armature[:6] = 0.0
    model.armature = armature
    model.addFrame(pin.Frame("on the ground", 0, 0, _placement(rng), pin.FrameType.OP_FRAME))
    return Case(model=model, frames=(*frames, "on the ground"))


def configurations(model: Any, count: int = SAMPLES) -> tuple[np.ndarray, ...]:
    """Random (q, v, a, b), each (count, ...): q beyond joint limits, any attitude; b a right-hand side."""
    rng = np.random.default_rng(7)
    q0 = pin.neutral(model)
    # In one step from neutral every joint moves by up to a turn; the step's base attitude is anything.
    q = np.array([pin.integrate(model, q0, rng.uniform(-3.0, 3.0, size=model.nv)) for _ in range(count)])
    return (q, *rng.normal(size=(3, count, model.nv)))


# ---------------------------------------------------------------- Pinocchio's
def _symmetric(H: np.ndarray) -> np.ndarray:
    return np.asarray(np.triu(H) + np.triu(H, 1).T)


def reference_values(
    c: Case, q: np.ndarray, v: np.ndarray, a: np.ndarray, b: np.ndarray
) -> dict[str, np.ndarray]:
    model, data = c.model, c.model.createData()
    zero = np.zeros(model.nv)
    H = _symmetric(pin.crba(model, data, q))
    out = {
        "H": H,
        "rnea": pin.rnea(model, data, q, v, a),
        "gravity": pin.rnea(model, data, q, zero, zero),
        "rnea at rest": pin.rnea(model, data, q, zero, a),
        "com": pin.centerOfMass(model, data, q),
        "A_g": pin.computeCentroidalMap(model, data, q),
        "momentum": pin.computeCentroidalMomentum(model, data, q, v).vector,
    }
    out = {name: np.array(x) for name, x in out.items()}
    out["rnea without gravity"] = out["rnea"] - out["gravity"]
    pin.forwardKinematics(model, data, q, v, a)
    pin.computeJointJacobiansTimeVariation(model, data, q, v)
    pin.updateFramePlacements(model, data)
    for frame in c.frames:
        k = model.getFrameId(frame)
        out[f"R {frame}"] = data.oMf[k].rotation.copy()
        out[f"p {frame}"] = data.oMf[k].translation.copy()
        out[f"J {frame}"] = pin.getFrameJacobian(model, data, k, WORLD)
        out[f"Jdot v {frame}"] = pin.getFrameJacobianTimeVariation(model, data, k, WORLD) @ v
    pin.forwardKinematics(model, data, q, v, a)
    for frame in c.frames:
        k = model.getFrameId(frame)
        out[f"velocity {frame}"] = pin.getFrameVelocity(model, data, k, WORLD).vector
        out[f"acceleration {frame}"] = pin.getFrameClassicalAcceleration(model, data, k, WORLD).vector
    return out


def reference_derivatives(c: Case, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> dict[str, np.ndarray]:
    model, data = c.model, c.model.createData()
    k = model.getFrameId(c.frames[0])
    pin.computeRNEADerivatives(model, data, q, v, a)
    out = {
        "d rnea/dq": data.dtau_dq.copy(),
        "d rnea/dv": data.dtau_dv.copy(),
        "d rnea/da": _symmetric(data.M),
    }
    weightless = model.copy()
    weightless.gravity.setZero()
    other = weightless.createData()
    pin.computeRNEADerivatives(weightless, other, q, 0.0 * v, a)
    out["d(H a)/dq"] = other.dtau_dq.copy()
    out["dp/dq"] = pin.computeFrameJacobian(model, data, q, k, WORLD)[:3].copy()
    out["d com/dq"] = pin.jacobianCenterOfMass(model, data, q).copy()
    pin.computeJointJacobiansTimeVariation(model, data, q, v)
    pin.updateFramePlacements(model, data)
    out["dJ/dt v"] = out["d velocity/dt"] = pin.getFrameJacobianTimeVariation(model, data, k, WORLD) @ v
    pin.dccrba(model, data, q, v)
    out["dA_g/dt v"] = out["d momentum/dt"] = data.dAg @ v
    return out
