"""The numbers of a `pin.Model`, re-arranged so that every joint turns about, or slides along, its own z axis.

Each one-degree-of-freedom joint's frame is turned once, numerically, by Q (z of the turned frame is the
joint's axis); for axes x, y and z this permutes the frame's axes. Link frames in this package are the turned
ones.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.errors import InputError, did_you_mean
from impactopt.robots.rigid_body._scalar import Matrix, Vector
from impactopt.robots.rigid_body._spatial import IDENTITY

SNAP = 1e-14  # rotation entries this near to 0, 1 or -1, lengths this short [m]: rounding, not design


class Kind(enum.Enum):
    """Type of a joint, seen in its turned frame."""

    FIXED = "the universe"
    FREE = "free-flyer"
    REVOLUTE = "turns about z"
    PRISMATIC = "slides along z"


_KINDS = {
    "JointModelFreeFlyer": Kind.FREE,
    **{f"JointModel{name}": Kind.REVOLUTE for name in ("RX", "RY", "RZ", "RevoluteUnaligned")},
    **{f"JointModel{name}": Kind.REVOLUTE for name in ("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned")},
    **{f"JointModel{name}": Kind.PRISMATIC for name in ("PX", "PY", "PZ", "PrismaticUnaligned")},
}

# Q of axes x, y, z: a cyclic permutation, Q z = axis.
_PERMUTATIONS = tuple(np.roll(np.eye(3), k + 1, axis=0) for k in range(3))


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One joint and the link that it moves; vectors and tensors are in the link's turned frame."""

    name: str
    kind: Kind
    parent: int
    v: int  # index of its (first) velocity
    q: int  # index of its (first) coordinate in Pinocchio's q
    continuous: bool  # a revolute joint with coordinates (cos, sin) in Pinocchio's q
    turn: Any  # (3, 3) Q, from the turned frame to Pinocchio's joint frame
    rotation: Matrix  # of the joint's frame at q = 0, in the parent's frame
    translation: Vector  # [m]
    mass: float  # [kg]
    first_moment: Vector  # [kg m]
    tensor: Vector  # about the frame's origin [kg m2]


class Tree:
    """Joints of a `pin.Model` (index 0 is the universe), parents before children.

    Raises
    ------
    InputError : a joint of a type that is not supported (the joint is named), a free-flyer that is not the
        only root, or armature on the free-flyer's rows.
    """

    def __init__(self, model: Any) -> None:
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
        # Where a subtree that holds all moving mass is rooted.
        self.root = 1 if self.floating else 0

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
                "armature: the free-flyer's six rows must be zero, rotors belong to joints; "
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

    def velocity_parents(self) -> list[int]:
        """Parent of each velocity index in the tree of single degrees of freedom, -1 at a root.

        The six of a free-flyer count as a chain (Featherstone 2008, expanded parent array).
        """
        parents = [-1] * self.nv
        for joint in self.joints[1:]:
            if joint.kind is Kind.FREE:
                parents[joint.v : joint.v + 6] = range(joint.v - 1, joint.v + 5)
            elif joint.parent:
                above = self.joints[joint.parent]
                parents[joint.v] = above.v + (5 if above.kind is Kind.FREE else 0)
        return parents

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
    # Mass that is fixed to the universe takes no part in anything, as in Pinocchio.
    return Joint(
        name="universe",
        kind=Kind.FIXED,
        parent=-1,
        v=-1,
        q=-1,
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
    kind = _KINDS.get(joint_model.shortname())
    if kind is None:
        raise InputError(
            f"joint {name!r}: type {joint_model.shortname()} is not supported; use revolute, continuous or "
            "prismatic joints and a free-flyer at the root, or lock it (pin.buildReducedModel)"
        )
    turn = np.eye(3) if kind is Kind.FREE else _turn_to_z(_axis(model, i, kind))
    placement, inertia = model.jointPlacements[i], model.inertias[i]
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
        continuous=joint_model.nq == 2,
        turn=turn,
        rotation=_snap(turns[parent].T @ placement.rotation @ turn).tolist(),
        translation=_clip(turns[parent].T @ placement.translation, SNAP).tolist(),
        mass=float(inertia.mass),
        first_moment=(inertia.mass * _clip(c, SNAP)).tolist(),
        tensor=[xx, xy, yy, xz, yz, zz],
    )


def _axis(model: Any, i: int, kind: Kind) -> Any:
    data = model.joints[i].createData()
    model.joints[i].calc(data, pin.neutral(model))
    S = np.asarray(data.S).reshape(6)
    return S[3:] if kind is Kind.REVOLUTE else S[:3]


def _turn_to_z(axis: Any) -> Any:
    """A rotation Q with Q z = axis; a permutation where the axis is x, y or z."""
    for k in range(3):
        if abs(axis[k] - 1.0) < 1e-14:
            return _PERMUTATIONS[k]
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(axis, side), axis], axis=1)


def _snap(rotation: Any) -> Any:
    rotation = np.array(rotation, dtype=float)
    for value in (0.0, 1.0, -1.0):
        rotation[np.abs(rotation - value) < SNAP] = value
    return rotation


def _clip(array: Any, tolerance: float) -> Any:
    return np.where(np.abs(array) <= tolerance, 0.0, array)
