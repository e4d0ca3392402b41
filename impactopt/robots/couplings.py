"""Couplings: joints that follow others, as `<mimic>` and MuJoCo's joint equalities have it.

A follower's angle is a multiple of its leader's and an offset. It is a `JointModelMimic` of the `pin.Model`,
which has no coordinate of its own: with v_all = S v, inertias are S'HS, forces S'tau and Jacobians J S.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError, Mistakes
from impactopt.robots.build import (
    friction,
    joint_indices,
    set_friction,
    set_velocity_limit,
    velocity_limit,
)

__all__ = [
    "Axis",
    "Coupling",
    "axis_of",
    "coupled",
    "couplings_of",
    "follower_axes",
    "resolved",
    "restore_followers",
    "unfit",
    "with_followers",
]

Array = NDArray[np.float64]
_MIMIC = "JointModelMimic"


class Coupling(NamedTuple):
    """Law of a follower: its angle is `ratio` times the leader's, plus `offset` [rad]."""

    leader: str
    ratio: float
    offset: float


class Axis(NamedTuple):
    """A joint at zero of its coordinate.

    placement : pin.SE3 in the parent's frame.  subspace (6,) : unit twist [linear; angular] about or along
    its axis.  ratio : of its angle to its coordinate.
    """

    placement: Any
    subspace: Array
    ratio: float


def axis_of(model: pin.Model, joint: int) -> Axis:
    """Axis of a joint with one degree of freedom, or of a follower."""
    kind = model.joints[joint]
    data, ratio = kind.createData(), 1.0
    kind.calc(data, pin.neutral(model))
    if kind.shortname() == _MIMIC:
        ratio = float(kind.extract().scaling)
    subspace = np.asarray(data.S, dtype=float).reshape(6) / ratio
    return Axis(model.jointPlacements[joint] * data.M, subspace, ratio)


def couplings_of(model: pin.Model) -> dict[str, Coupling]:
    """Couplings of a model, by the follower's name."""
    leaders = {int(model.joints[j].idx_v): str(model.names[j]) for j in joint_indices(model)}
    out = {}
    for j in range(1, model.njoints):
        if model.joints[j].shortname() == _MIMIC:
            kind = model.joints[j].extract()
            leader = leaders[int(model.joints[j].idx_v)]
            out[str(model.names[j])] = Coupling(leader, float(kind.scaling), float(kind.offset))
    return out


def follower_axes(model: pin.Model) -> dict[int, Array]:
    """Subspaces (6,) of a model's followers by index, which `restore_followers` needs."""
    return {
        model.getJointId(name): axis_of(model, model.getJointId(name)).subspace
        for name in couplings_of(model)
    }


def restore_followers(model: pin.Model, axes: Mapping[int, Array]) -> None:
    """Make followers anew, in place, in a model that was pickled: Pinocchio 4.1 loses how they move, and
    crashes where they do.
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
    """Couplings to leaders that follow none: a follower's follower is one of the first leader.

    Raises
    ------
    InputError : joints that follow each other.
    """
    out = {}
    for name, (leader, ratio, offset) in couplings.items():
        seen = [name]
        while leader in couplings:
            if leader in seen:
                raise InputError(
                    f"joints {', '.join(map(repr, seen))} follow each other; one of them has to lead"
                )
            seen.append(leader)
            above = couplings[leader]
            leader, ratio, offset = above.leader, ratio * above.ratio, ratio * above.offset + offset
        out[name] = Coupling(leader, ratio, offset)
    return out


def unfit(model: pin.Model, name: str, coupling: Coupling) -> str:
    """Reason why a joint of a model cannot follow another one, and the fix; "" if it can."""
    follower, leader = (model.joints[model.getJointId(joint)] for joint in (name, coupling.leader))
    if not hasattr(pin, "transformJointIntoMimic"):
        return f"Pinocchio {pin.__version__} has no such joints: pip install -U pin"
    if not coupling.ratio or not np.isfinite(coupling[1:]).all():
        return f"its multiplier is {coupling.ratio:g}, its offset {coupling.offset:g}: correct them"
    for joint, each in ((name, follower), (coupling.leader, leader)):
        if each.nq != 1:
            return f"{joint!r} turns without end: give both of them position limits"
    if leader.id > follower.id:
        ratio, offset = 1 / coupling.ratio, -coupling.offset / coupling.ratio
        return (
            f"{coupling.leader!r} comes after it in the tree: let {coupling.leader!r} follow {name!r}, with "
            f"multiplier {ratio:g} and offset {offset:g}"
        )
    return ""


def coupled(model: pin.Model, couplings: Mapping[str, Coupling]) -> pin.Model:
    """The model whose followers have no coordinates of their own.

    Leaders get the followers' position and velocity limits too, and their armature and friction: at a speed
    `ratio` times its own, they resist with ratio^2 times their inertia and damping.

    Raises
    ------
    InputError : all couplings that a model cannot have; limits that leave a leader no room.
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
        _hand_over(model, name, coupling)
    postures = {str(entry.key()): np.array(entry.data()) for entry in model.referenceConfigurations}
    places = [model.joints[model.getJointId(name)].idx_q for name in couplings]
    for name, (leader, ratio, offset) in couplings.items():
        joints = (model.getJointId(joint) for joint in (leader, name))
        model = pin.transformJointIntoMimic(model, *joints, ratio, offset)
    for posture, q in postures.items():
        model.referenceConfigurations[posture] = np.delete(q, places)
    return model


def with_followers(
    springs: Mapping[str, tuple[float, float]], couplings: Mapping[str, Coupling]
) -> dict[str, tuple[float, float]]:
    """Stiffness and angle at rest by joint, with those of followers as their leaders feel them."""
    out = dict(springs)
    for name, (leader, ratio, offset) in couplings.items():
        if name in springs and springs[name][0]:
            stiffness, rest = ratio**2 * springs[name][0], (springs[name][1] - offset) / ratio
            own, at = out.get(leader, (0.0, 0.0))
            out[leader] = own + stiffness, (own * at + stiffness * rest) / (own + stiffness)
    return out


def _hand_over(model: pin.Model, name: str, coupling: Coupling) -> None:
    """Give a leader, in place, what its follower has by joint."""
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
    with np.errstate(over="ignore"):  # Pinocchio's largest double stands for a limit that is missing
        fastest = speed[other.idx_v] / abs(ratio)
        ends = sorted((bound[other.idx_q] - offset) / ratio for bound in (low, high))
    if fastest > 0:  # many files give a follower none
        speed[own.idx_v] = min(speed[own.idx_v], fastest)
    set_velocity_limit(model, speed)
    low[own.idx_q], high[own.idx_q] = max(low[own.idx_q], ends[0]), min(high[own.idx_q], ends[1])
    if not low[own.idx_q] < high[own.idx_q]:
        raise InputError(
            f"joint {name!r} follows {leader!r}, whose position limits lie outside the follower's, which are "
            f"{ends[0]:.4g} to {ends[1]:.4g} rad of {leader!r}; correct their <limit>s or the offset"
        )
    model.lowerPositionLimit, model.upperPositionLimit = low, high
