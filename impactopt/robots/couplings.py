"""Couplings, by which joints follow others, and tendons, which bound weighted sums of joint angles.

A coupling is a `<mimic>` of a URDF or a joint equality of an MJCF, a tendon a limited fixed one of MuJoCo.

A follower's angle is a multiple of its leader's, plus an offset. In the `pin.Model` it is a
`JointModelMimic`, without a coordinate of its own: with v_all = S v, where v_all are the velocities of all
joints, inertias are S'HS, forces S'tau and Jacobians J S.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.errors import InputError, Mistakes
from impactopt.robots.build import (
    friction,
    joint_index,
    joint_indices,
    set_friction,
    set_velocity_limit,
    velocity_limit,
)
from impactopt.robots.model import MIMIC, axis_of


class Coupling(NamedTuple):
    """Law of a follower: its angle is `ratio` times the leader's, plus `offset` [rad]."""

    leader: str
    ratio: float
    offset: float


def couplings_of(model: pin.Model) -> dict[str, Coupling]:
    """Couplings of a model, by the follower's name."""
    leaders = {int(model.joints[j].idx_v): str(model.names[j]) for j in joint_indices(model)}
    out = {}
    for j in range(1, model.njoints):
        if model.joints[j].shortname() == MIMIC:
            kind = model.joints[j].extract()
            leader = leaders[int(model.joints[j].idx_v)]
            out[str(model.names[j])] = Coupling(leader, float(kind.scaling), float(kind.offset))
    return out


def follower_axes(model: pin.Model) -> dict[int, Array]:
    """Subspaces (6,) of a model's followers by index, for `restore_followers`."""
    return {
        model.getJointId(name): axis_of(model, model.getJointId(name)).subspace
        for name in couplings_of(model)
    }


def restore_followers(model: pin.Model, axes: Mapping[int, Array]) -> None:
    """Replace the followers of an unpickled model, in place.

    Pinocchio 4.1 does not pickle the joint inside a `JointModelMimic`, and crashes when it is used.
    """
    leaders = {model.joints[j].idx_v: model.joints[j] for j in joint_indices(model)}
    for j, axis in axes.items():
        old, turns = model.joints[j], bool(axis[3:].any())
        leader, law = leaders[old.idx_v], old.extract()
        own = (
            pin.JointModelRevoluteUnaligned(axis[3:]) if turns else pin.JointModelPrismaticUnaligned(axis[:3])
        )
        own.setIndexes(leader.id, leader.idx_q, leader.idx_v, leader.idx_vExtended)
        new = pin.JointModelMimic(pin.JointModel(own), law.scaling, law.offset)
        new.setIndexes(j, old.idx_q, old.idx_v, old.idx_vExtended)
        model.joints[j] = pin.JointModel(new)


def resolved(couplings: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Couplings whose leaders are no followers: chains of couplings are composed.

    Raises
    ------
    InputError : joints that follow each other.
    """
    out = {}
    for name, (leader, ratio, offset) in couplings.items():
        chain = [name]
        while leader in couplings:
            if leader in chain:
                raise InputError(
                    f"joints {', '.join(map(repr, chain))} follow each other; one of them has to lead"
                )
            chain.append(leader)
            outer = couplings[leader]
            leader, ratio, offset = outer.leader, ratio * outer.ratio, ratio * outer.offset + offset
        out[name] = Coupling(leader, ratio, offset)
    return out


def unfit(model: pin.Model, name: str, coupling: Coupling) -> str:
    """Reason why a joint of a model cannot follow another one, with the fix; "" if it can."""
    follower, leader = (model.joints[model.getJointId(joint)] for joint in (name, coupling.leader))
    if not hasattr(pin, "transformJointIntoMimic"):
        return f"Pinocchio {pin.__version__} has no such joints: pip install -U pin"
    if not coupling.ratio or not np.isfinite(coupling[1:]).all():
        return f"its multiplier is {coupling.ratio:g}, its offset {coupling.offset:g}: correct them"
    for joint, each in ((name, follower), (coupling.leader, leader)):
        if each.nq != 1:
            return f"{joint!r} is continuous: give both of them position limits"
    if leader.id > follower.id:  # Pinocchio needs leaders before their followers
        ratio, offset = 1 / coupling.ratio, -coupling.offset / coupling.ratio
        return (
            f"{coupling.leader!r} comes after it in the tree: let {coupling.leader!r} follow {name!r}, with "
            f"multiplier {ratio:g} and offset {offset:g}"
        )
    return ""


def coupled(model: pin.Model, couplings: Mapping[str, Coupling]) -> pin.Model:
    """The model with these joints as followers, without coordinates of their own.

    A leader's position and velocity limits are intersected with those of its followers, and it gets their
    armature and friction in addition. As a follower moves `ratio` times as fast, its armature and viscous
    friction count ratio^2 times.

    Raises
    ------
    InputError : all couplings that a model cannot have; limits with an empty intersection.
    """
    found = Mistakes()
    couplings = resolved(couplings)
    for name, coupling in couplings.items():
        if reason := unfit(model, name, coupling):
            found.found.append(
                f"joint {name!r} cannot follow {coupling.leader!r}: {reason}, or lock it (`locked`)"
            )
    found.raise_if_any("the robot's couplings")
    model = model.copy()
    for name, coupling in couplings.items():
        _reflect_on_leader(model, name, coupling)
    # named configurations lose the entries of the followers
    postures = {str(entry.key()): np.array(entry.data()) for entry in model.referenceConfigurations}
    in_q = [model.joints[model.getJointId(name)].idx_q for name in couplings]
    for name, (leader, ratio, offset) in couplings.items():
        joints = (model.getJointId(joint) for joint in (leader, name))
        model = pin.transformJointIntoMimic(model, *joints, ratio, offset)
    for posture, q in postures.items():
        model.referenceConfigurations[posture] = np.delete(q, in_q)
    return model


def with_followers(
    springs: Mapping[str, tuple[float, float]], couplings: Mapping[str, Coupling]
) -> dict[str, tuple[float, float]]:
    """Stiffness and rest angle by joint, with the springs of followers reflected on their leaders.

    Two springs in parallel are one: stiffnesses add, and its rest angle is their weighted mean.
    """
    out = dict(springs)
    for name, (leader, ratio, offset) in couplings.items():
        if name in springs and springs[name][0]:
            stiffness, rest = ratio**2 * springs[name][0], (springs[name][1] - offset) / ratio
            own_stiffness, own_rest = out.get(leader, (0.0, 0.0))
            both = own_stiffness + stiffness
            out[leader] = both, (own_stiffness * own_rest + stiffness * rest) / both
    return out


def _reflect_on_leader(model: pin.Model, name: str, coupling: Coupling) -> None:
    """Add the armature and friction of a follower to its leader's, and intersect their limits, in place."""
    leader, ratio, offset = coupling
    own, other = (model.joints[model.getJointId(joint)] for joint in (leader, name))
    armature = np.array(model.armature)
    armature[own.idx_v] += ratio**2 * armature[other.idx_v]
    model.armature = armature
    viscous, dry = friction(model)
    viscous[own.idx_v] += ratio**2 * viscous[other.idx_v]
    dry[own.idx_v] += abs(ratio) * dry[other.idx_v]
    set_friction(model, viscous, dry)
    speed, low = velocity_limit(model), np.array(model.lowerPositionLimit)
    high = np.array(model.upperPositionLimit)
    with np.errstate(over="ignore"):  # Pinocchio has the largest double for a missing limit
        fastest = speed[other.idx_v] / abs(ratio)
        ends = sorted((bound[other.idx_q] - offset) / ratio for bound in (low, high))
    if fastest > 0:  # many files have no velocity limit, or 0, for a follower
        speed[own.idx_v] = min(speed[own.idx_v], fastest)
    set_velocity_limit(model, speed)
    low[own.idx_q], high[own.idx_q] = max(low[own.idx_q], ends[0]), min(high[own.idx_q], ends[1])
    if not low[own.idx_q] < high[own.idx_q]:
        raise InputError(
            f"joint {name!r} follows {leader!r}, and their position limits do not overlap: the follower's "
            f"are {ends[0]:.4g} to {ends[1]:.4g} rad of {leader!r}; correct their <limit>s or the offset"
        )
    model.lowerPositionLimit, model.upperPositionLimit = low, high


@dataclass(frozen=True, kw_only=True)
class Tendon:
    """Bounds on a weighted sum of joint angles: lower <= sum of coefficient x angle <= upper.

    name : of the tendon.  coefficients : by joint, without unit.  lower, upper [rad] : of the sum.
    """

    name: str
    coefficients: Mapping[str, float]
    lower: float
    upper: float

    def __str__(self) -> str:
        sum_of = " ".join(f"{factor:+g} {joint}" for joint, factor in self.coefficients.items())
        return f"{self.name}: {self.lower:g} <= {sum_of} <= {self.upper:g}"

    def without(self, locked: Mapping[str, float], couplings: Mapping[str, Coupling]) -> Tendon:
        """The same bounds on the remaining joints: locked ones, at an angle [rad], are moved to the bounds,
        followers are replaced by their leaders.
        """
        constant, left = 0.0, dict[str, float]()
        for joint, factor in self.coefficients.items():
            if joint in locked:
                constant += factor * locked[joint]
                continue
            leader, ratio, offset = couplings.get(joint, (joint, 1.0, 0.0))
            constant += factor * offset
            left[leader] = left.get(leader, 0.0) + factor * ratio
        left = {joint: factor for joint, factor in left.items() if factor}
        return replace(self, coefficients=left, lower=self.lower - constant, upper=self.upper - constant)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranges:
    """Ranges of a robot's n joints and, after them, of its tendons.

    names : of both.  lower, upper (n + tendons,) [rad].  matrix (tendons, n) : coefficients of the tendons.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    matrix: Array

    @classmethod
    def of(cls, joints: Sequence[str], lower: Array, upper: Array, tendons: Sequence[Tendon]) -> Ranges:
        """Ranges of joints (n,) and tendons."""
        return cls(
            names=(*joints, *(f"tendon {tendon.name}" for tendon in tendons)),
            lower=np.append(lower, [tendon.lower for tendon in tendons]),
            upper=np.append(upper, [tendon.upper for tendon in tendons]),
            matrix=np.array(
                [[tendon.coefficients.get(joint, 0.0) for joint in joints] for tendon in tendons]
            ).reshape(-1, len(joints)),
        )

    def positions(self, angles: Array) -> Array:
        """(..., n + tendons) [rad] of joint angles (..., n)."""
        return np.concatenate([angles, angles @ self.matrix.T], axis=-1)

    def excess(self, angles: Array) -> tuple[str, float]:
        """Name and excess [rad] of the joint or tendon farthest out of its range, at joint angles (k, n)."""
        at = self.positions(angles)
        most = np.maximum(at - self.upper, self.lower - at).max(axis=0)
        worst = int(np.argmax(most))
        return self.names[worst], float(most[worst])


def check_tendons(tendons: Sequence[Tendon], joints: Sequence[str]) -> None:
    """InputError for a tendon with unknown joints, an empty range, or no joints."""
    for tendon in tendons:
        what = f"tendon {tendon.name!r}"
        for joint in tendon.coefficients:
            joint_index(joints, joint, what)
        if not tendon.lower < tendon.upper:
            raise InputError(f"{what}: its range is {tendon.lower:g} to {tendon.upper:g}; give lower < upper")
        if not tendon.coefficients:
            raise InputError(f"{what} is out of its range at the angles of its locked joints; change those")
