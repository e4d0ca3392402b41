"""Kinematic tree of a `pin.Model`: constants of its joints and links, and its symbolic coordinates q.

The frame of each joint with one degree of freedom is turned numerically by Q, so that its z is the joint's
axis. For axes x, y and z this permutes the frame's axes. Link frames in this package are the turned ones.

`"quaternion"` is Pinocchio's q: p, quaternion (x, y, z, w), joints; a continuous joint is (cos, sin).
`"rpy"` has one number for each velocity: p, (roll, pitch, yaw), joints; R = Rz(yaw) Ry(pitch) Rx(roll). A
fixed base has no pose, so the two differ there in continuous joints only.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError, check_array, did_you_mean, shortened
from impactopt.robots.checks import check_configuration
from impactopt.robots.model import RpyCoordinates, axis_of
from impactopt.robots.rigid_body._spatial import (
    IDENTITY,
    Matrix,
    Number,
    Scalar,
    Vector,
    add,
    cos,
    cross,
    pack_entries,
    pack_vector,
    product,
    scale,
    sin,
    subtract,
    tan,
    times,
    transpose_times,
    unpack_vector,
    zero_vector,
)

# Entries of rotations this near to 0, 1 or -1, and lengths this short [m], are rounded to these: structural
# zeros make the expressions smaller.
SNAP = 1e-14


class Kind(enum.Enum):
    """Type of a joint, seen in its turned frame."""

    FIXED = "the universe"
    FREE = "free-flyer"
    REVOLUTE = "turns about z"
    PRISMATIC = "slides along z"


_FOLLOWER = "Mimic"  # revolute or prismatic, which `_read_joint` finds out
_UNBOUNDED = ("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned")
_REVOLUTE = ("RX", "RY", "RZ", "RevoluteUnaligned", *_UNBOUNDED, _FOLLOWER)
_PRISMATIC = ("PX", "PY", "PZ", "PrismaticUnaligned")
_KINDS = {**dict.fromkeys(_REVOLUTE, Kind.REVOLUTE), **dict.fromkeys(_PRISMATIC, Kind.PRISMATIC)}
_KINDS["FreeFlyer"] = Kind.FREE


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One joint and the link that it moves; vectors and tensors are in the link's turned frame."""

    name: str
    kind: Kind
    parent: int
    v: int  # index of its (first) velocity; a follower's is its leader's
    q: int  # index of its (first) coordinate in Pinocchio's q
    follows: bool  # True for a follower: its velocity is its leader's times the ratio
    ratio: float  # 1 for other joints
    continuous: bool  # a revolute joint with coordinates (cos, sin) in Pinocchio's q
    turn: Any  # (3, 3) Q, from the turned frame to Pinocchio's joint frame
    rotation: Matrix  # of the joint's frame at q = 0, in the parent's frame
    translation: Vector  # [m]
    mass: float  # [kg]
    first_moment: Vector  # [kg m]
    tensor: Vector  # about the frame's origin [kg m2]

    def along(self, values: Vector) -> Number:
        """Velocity or acceleration of this joint, from those of the tree (nv)."""
        return self.ratio * values[self.v]


class Tree:
    """Joints of a `pin.Model` (index 0 is the universe), parents before children.

    Raises
    ------
    InputError : a joint of a type that is not supported (the joint is named), a free-flyer that is not the
        only root, or armature of the free-flyer.
    """

    def __init__(self, model: Any) -> None:
        if not isinstance(model, pin.Model):
            raise InputError(f"model must be a pin.Model, as that of a robot, not {shortened(repr(model))}")
        self.model = model
        self.nq, self.nv = int(model.nq), int(model.nv)
        self.gravity: Vector = [float(x) for x in model.gravity.linear]
        turns = [np.eye(3)]
        joints = [_universe()]
        for i in range(1, model.njoints):
            joints.append(_read_joint(model, i, turns))
            turns.append(joints[-1].turn)
        self.joints: tuple[Joint, ...] = tuple(joints)
        self.floating = any(joint.kind is Kind.FREE for joint in joints[1:])
        self.armature = [float(x) for x in model.armature]
        self._frames: dict[str, tuple[int, Matrix, Vector]] = {}
        if self.floating:
            self._check_free_flyer()
        self.root = 1 if self.floating else 0  # of the subtree with all moving mass

    def _check_free_flyer(self) -> None:
        roots = [i for i, joint in enumerate(self.joints) if i and joint.parent == 0]
        if roots != [1] or any(joint.kind is Kind.FREE for joint in self.joints[2:]):
            names = ", ".join(joint.name for joint in self.joints[1:] if joint.kind is Kind.FREE)
            raise InputError(
                f"free-flyer joint {names!r}: a free-flyer must be the one joint that hangs on the universe; "
                "build the model of one robot alone"
            )
        if any(self.armature[:6]):
            raise InputError(
                "armature: the free-flyer's six entries must be zero, rotors belong to joints; "
                "set model.armature[:6] = 0"
            )

    def __len__(self) -> int:
        return len(self.joints)

    def support(self, i: int) -> list[int]:
        """Joints from the root to joint i; empty for the universe."""
        chain = []
        while i:
            chain.append(i)
            i = self.joints[i].parent
        return chain[::-1]

    def frame(self, name: str) -> tuple[int, Matrix, Vector]:
        """(joint, rotation, translation [m]) of a frame in its link's turned frame.

        Raises
        ------
        InputError : the model has no such frame.
        """
        if name not in self._frames:
            self._frames[name] = self._read_frame(name)
        return self._frames[name]

    def _read_frame(self, name: str) -> tuple[int, Matrix, Vector]:
        if not self.model.existFrame(name):
            known = [frame.name for frame in self.model.frames]
            raise InputError(f"frame {name!r}: the model has no such frame{did_you_mean(name, known)}")
        frame = self.model.frames[self.model.getFrameId(name)]
        i = int(frame.parentJoint)
        turn, placement = self.joints[i].turn, frame.placement
        return (
            i,
            _snap(turn.T @ placement.rotation).tolist(),
            _clip(turn.T @ placement.translation, SNAP).tolist(),
        )


def _universe() -> Joint:
    # mass that is fixed to the universe is left out, as in Pinocchio
    return Joint(
        name="universe",
        kind=Kind.FIXED,
        parent=-1,
        v=-1,
        q=-1,
        follows=False,
        ratio=1.0,
        continuous=False,
        turn=np.eye(3),
        rotation=IDENTITY,
        translation=[0.0] * 3,
        mass=0.0,
        first_moment=[0.0] * 3,
        tensor=[0.0] * 6,
    )


def _read_joint(model: Any, i: int, turns: list[Any]) -> Joint:
    joint_model, name, parent = model.joints[i], model.names[i], int(model.parents[i])
    short = joint_model.shortname().removeprefix("JointModel")
    kind = _KINDS.get(short)
    if kind is None:
        raise InputError(
            f"joint {name!r}: type {joint_model.shortname()} is not supported; use revolute, continuous or "
            "prismatic joints and a free-flyer at the root, or lock it (pin.buildReducedModel)"
        )
    placement, inertia, turn, ratio = model.jointPlacements[i], model.inertias[i], np.eye(3), 1.0
    if kind is not Kind.FREE:
        placement, subspace, ratio = axis_of(model, i)
        kind = Kind.REVOLUTE if subspace[3:].any() else Kind.PRISMATIC
        turn = _turn_to_z(subspace[3:] if kind is Kind.REVOLUTE else subspace[:3])
    c = turn.T @ inertia.lever
    about_origin = turn.T @ inertia.inertia @ turn + inertia.mass * (c @ c * np.eye(3) - np.outer(c, c))
    about_origin = _clip(about_origin, 1e-14 * np.abs(about_origin).max())
    xx, xy, xz, _, yy, yz, _, _, zz = about_origin.ravel().tolist()
    return Joint(
        name=name,
        kind=kind,
        parent=parent,
        v=int(joint_model.idx_v),
        q=int(joint_model.idx_q),
        follows=short == _FOLLOWER,
        ratio=ratio,
        continuous=joint_model.nq == 2,
        turn=turn,
        rotation=_snap(turns[parent].T @ placement.rotation @ turn).tolist(),
        translation=_clip(turns[parent].T @ placement.translation, SNAP).tolist(),
        mass=float(inertia.mass),
        first_moment=(inertia.mass * _clip(c, SNAP)).tolist(),
        tensor=[xx, xy, yy, xz, yz, zz],
    )


def _turn_to_z(axis: Any) -> Any:
    """A rotation Q with Q z = axis; a permutation where the axis is x, y or z."""
    for k in range(3):
        if abs(axis[k] - 1.0) < 1e-14:
            return np.roll(np.eye(3), k + 1, axis=0)  # a cyclic permutation
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(axis, side), axis], axis=1)


def _snap(rotation: Any) -> Any:
    """A copy of a rotation, whose entries near to 0, 1 or -1 are that."""
    rotation = np.array(rotation, dtype=float)
    for value in (0.0, 1.0, -1.0):
        rotation[np.abs(rotation - value) < SNAP] = value
    return rotation


def _clip(array: Any, tolerance: float) -> Any:
    return np.where(np.abs(array) <= tolerance, 0.0, array)


BASES = ("quaternion", "rpy")


class Coordinates:
    """Symbols q of a tree, and each joint's cosine and sine, or travel, as expressions of them."""

    def __init__(self, tree: Tree, base: str) -> None:
        if base not in BASES:
            raise InputError(f"base={base!r}: use 'quaternion' or 'rpy'{did_you_mean(str(base), BASES)}")
        self.tree, self.base = tree, base
        self.nq = tree.nq if base == "quaternion" else tree.nv
        self.q = ca.SX.sym("q", self.nq)
        q: list[Any] = unpack_vector(self.q)
        self._cos_sin: dict[int, tuple[Number, Number]] = {}
        self._travel: dict[int, Number] = {}
        for i, joint in enumerate(tree.joints[1:], start=1):
            k = joint.q if base == "quaternion" else joint.v
            if joint.kind is Kind.PRISMATIC:
                self._travel[i] = joint.ratio * q[k]
            elif joint.continuous and base == "quaternion":
                self._cos_sin[i] = (q[k], q[k + 1])
            elif joint.kind is Kind.REVOLUTE:
                self._cos_sin[i] = (cos(joint.ratio * q[k]), sin(joint.ratio * q[k]))
        self._position: Vector = zero_vector()
        self._rotation: Matrix = IDENTITY
        if tree.floating:
            self._position = q[:3]
            if base == "quaternion":
                self._quaternion = q[3:7]
                self._rotation = _quaternion_matrix(*q[3:7])
            else:
                (cr, sr), (cp, sp), (cy, sy) = [(cos(angle), sin(angle)) for angle in q[3:6]]
                self._tan_pitch = tan(q[4])
                self._rpy = (cr, sr, cp, sp)
                self._rotation = [
                    [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                    [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                    [-sp, cp * sr, cp * cr],
                ]

    def cos_sin(self, i: int) -> tuple[Number, Number]:
        """Cosine and sine of revolute joint i."""
        return self._cos_sin[i]

    def travel(self, i: int) -> Number:
        """Travel of prismatic joint i [m]."""
        return self._travel[i]

    def base_pose(self) -> tuple[Matrix, Vector]:
        """(R, p [m]) of the free-flyer's link in the world."""
        root = self.tree.joints[1]
        return product(root.rotation, self._rotation), add(
            root.translation, times(root.rotation, self._position)
        )

    # ------------------------------------------------------------ q and v
    def velocity_map(self) -> Any:
        """T(q), (nv, nv) sparse, with v = T dq/dt; needs nq = nv."""
        self._require_nq_equal_nv("velocity_map")
        if not self.tree.floating:
            return ca.SX.eye(self.tree.nv)
        entries: dict[tuple[int, int], Number] = {}
        W = self._rpy_rates_to_angular_velocity()
        for r in range(3):
            for c in range(3):
                entries[r, c] = self._rotation[c][r]
                entries[3 + r, 3 + c] = W[r][c]
        return ca.diagcat(pack_entries((6, 6), entries), ca.SX.eye(self.tree.nv - 6))

    def acceleration(self, rate: Vector, second: Vector) -> Any:
        """a = dv/dt = T d2q/dt2 + dT/dt dq/dt, SX (nv), from dq/dt and d2q/dt2."""
        self._require_nq_equal_nv("acceleration")
        if not self.tree.floating:
            return pack_vector(second)
        (cr, sr, cp, sp), (dr, dp, dy) = self._rpy, rate[3:6]
        W = self._rpy_rates_to_angular_velocity()
        angular_velocity = times(W, rate[3:6])
        velocity = transpose_times(self._rotation, rate[:3])
        # v is given along axes that turn with the base, hence the term -w x v of its derivative
        linear = subtract(transpose_times(self._rotation, second[:3]), cross(angular_velocity, velocity))
        rate_of_W_times_rate = [
            -(cp * dp * dy),
            (cp * cr * dr - sp * sr * dp) * dy - sr * dr * dp,
            -(cp * sr * dr + sp * cr * dp) * dy - cr * dr * dp,
        ]
        angular = add(times(W, second[3:6]), rate_of_W_times_rate)
        return pack_vector([*linear, *angular, *second[6:]])

    def tangent_map(self) -> Any:
        """Matrix G, (nq, nv) sparse, with dq/dt = G v. With "rpy" it is singular at pitch = +-90 deg."""
        entries: dict[tuple[int, int], Number] = {}
        if self.tree.floating:
            G = self._angular_velocity_to_rates()
            for c in range(3):
                entries.update({(r, c): self._rotation[r][c] for r in range(3)})
                entries.update({(3 + r, 3 + c): row[c] for r, row in enumerate(G)})
        for i, joint in enumerate(self.tree.joints[1:], start=1):
            k = joint.q if self.base == "quaternion" else joint.v
            if joint.kind is Kind.FREE:
                continue
            if joint.continuous and self.base == "quaternion":
                c_, s_ = self._cos_sin[i]
                entries[k, joint.v], entries[k + 1, joint.v] = 0.0 - s_, c_
            else:
                entries[k, joint.v] = 1.0
        return pack_entries((self.nq, self.tree.nv), entries)

    def integrate(self, d: Any) -> Any:
        """q after moving with the constant velocity d, SX (nv), for one second, as pin.integrate; for
        "quaternion"."""
        if self.base != "quaternion":
            raise InputError("integrate: needs Pinocchio's q; build with base='quaternion'")
        q = ca.SX(self.q)
        if self.tree.floating:
            # pose times exp(d): the product of two quaternions (vector, scalar)
            shift, quaternion = _exponential(d[:3], d[3:6])
            x, y, z, w = self._quaternion
            entries = {(r, c): self._rotation[r][c] for r in range(3) for c in range(3)}
            rotation = pack_entries((3, 3), entries)
            vector, scalar = ca.vertcat(x.x, y.x, z.x), w.x
            q[:3] += ca.mtimes(rotation, shift)
            q[3:6] = scalar * quaternion[:3] + quaternion[3] * vector + ca.cross(vector, quaternion[:3])
            q[6] = scalar * quaternion[3] - ca.dot(vector, quaternion[:3])
        for joint in self.tree.joints[1:]:
            if joint.kind is Kind.FREE or joint.follows:
                continue
            if joint.continuous:
                c, s = self.q[joint.q], self.q[joint.q + 1]
                turn = d[joint.v]
                q[joint.q] = c * ca.cos(turn) - s * ca.sin(turn)
                q[joint.q + 1] = s * ca.cos(turn) + c * ca.sin(turn)
            else:
                q[joint.q] += d[joint.v]
        return q

    def _require_nq_equal_nv(self, method: str) -> None:
        if self.nq != self.tree.nv:
            raise InputError(
                f"{method}: needs nq = nv, but nq = {self.nq}, nv = {self.tree.nv}; build with base='rpy'"
            )

    def _rpy_rates_to_angular_velocity(self) -> Matrix:
        cr, sr, cp, sp = self._rpy
        return [[1.0, 0.0, 0.0 - sp], [0.0, cr, cp * sr], [0.0, 0.0 - sr, cp * cr]]

    def _angular_velocity_to_rates(self) -> Matrix:
        if self.base == "quaternion":
            x, y, z, w = self._quaternion
            return [scale(0.5, row) for row in ([w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z])]
        cr, sr, cp, _ = self._rpy
        t = self._tan_pitch
        return [[1.0, sr * t, cr * t], [0.0, cr, 0.0 - sr], [0.0, sr / cp, cr / cp]]

    # ------------------------------------------------------------ numeric
    @cached_property
    def _rpy_coordinates(self) -> RpyCoordinates:
        return RpyCoordinates(self.tree.model)

    def from_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """These coordinates (nq,) of Pinocchio's q; angles of continuous joints in (-pi, pi]."""
        q = check_configuration(self.tree.model, q, "q (pinocchio)")
        return q if self.base == "quaternion" else self._rpy_coordinates.from_pin(q)

    def to_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """Pinocchio's q, (..., model.nq), of one configuration (nq,) or of several (k, nq)."""
        q = check_array("q", q, (self.nq,) if np.ndim(q) < 2 else (None, self.nq))
        return q if self.base == "quaternion" else self._rpy_coordinates.to_pin(q)


def _quaternion_matrix(x: Scalar, y: Scalar, z: Scalar, w: Scalar) -> Matrix:
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def _exponential(linear: Any, angular: Any) -> tuple[Any, Any]:
    """(translation (3), quaternion (4)) of the twist's exponential, by series for small angles."""
    square = ca.dot(angular, angular)
    # Below 1e-3 rad the terms that the series leave out are less than 2e-15, while the closed forms lose
    # digits by cancellation and are 0/0 at zero.
    small = square < 1e-6
    angle = ca.sqrt(ca.if_else(small, 1.0, square))
    half = ca.if_else(small, 0.5 - square / 48.0, ca.sin(angle / 2) / angle)
    first = ca.if_else(small, 0.5 - square / 24.0, (1 - ca.cos(angle)) / angle**2)
    second = ca.if_else(small, 1.0 / 6.0 - square / 120.0, (angle - ca.sin(angle)) / angle**3)
    turned = ca.cross(angular, linear)
    shift = linear + first * turned + second * ca.cross(angular, turned)
    cosine = ca.if_else(small, 1.0 - square / 8.0 + square**2 / 384.0, ca.cos(angle / 2))
    return shift, ca.vertcat(half * angular, cosine)
