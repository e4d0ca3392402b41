"""Classification of joints as legs, arms, fingers and wheels, by the tree, the links' shapes and names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.convex_hulls import Piece
from impactopt.robots.build import effort_limit, friction, is_floating, neutral
from impactopt.robots.checks import LEG

_FINGERS = re.compile(r"finger|thumb|gripper|jaw|claw|knuckle|(?<![a-z])eyes?(?![a-z])", re.IGNORECASE)
_WHEELS = re.compile(r"wheel|caster|roller", re.IGNORECASE)
_ARMS = re.compile(r"shoulder|elbow|wrist", re.IGNORECASE)
_WRISTS = re.compile(r"wrist", re.IGNORECASE)
_HEADS = re.compile(r"head|neck|eye|camera|face", re.IGNORECASE)
# largest mass of a finger, with all beyond it, over the robot's; its largest length [m]
FINGER_MASS, FINGER_LENGTH = 0.03, 0.25
# Fractions of the robot's height: largest height of a foot's lowest point above the lowest of all, and least
# height of the root link's.
FOOT_HEIGHT, ROOT_HEIGHT = 0.05, 0.1
# ranges [m] of a prismatic, and [rad] of a revolute joint: such ones, or larger, drive a mobile base, the
# latter if it is on the former
TRAVEL, TURN = 20.0, 4 * np.pi
CREEP = 1e-3  # [m/s], [rad/s] at which the damping of a joint that is held exceeds the robot's weight, at 1 m
NO_RANGE, HELD = "no range", "held by its damping"  # reasons for which a joint is locked
TOE = 0.03  # [m] from an ankle to a toe's joint, at least; half of it: largest height of foot over toe


@dataclass(frozen=True, kw_only=True)
class Limb:
    """A chain of joints to a tip: `path`, their indices in the model from the root on, whose end `own` is in
    no other limb.
    """

    path: tuple[int, ...]
    own: tuple[int, ...]

    @property
    def tip(self) -> int:
        """The last joint."""
        return self.path[-1]


def limbs_of(model: pin.Model) -> tuple[Limb, ...]:
    """All limbs, in the order of their tips."""
    children = _children(model)
    first = 2 if is_floating(model) else 1
    out = []
    for tip in range(first, model.njoints):
        if children[tip]:
            continue
        path = tuple(int(j) for j in model.supports[tip] if j >= first)
        fork = max((k + 1 for k, j in enumerate(path) if len(children[j]) > 1), default=0)
        out.append(Limb(path=path, own=path[fork:]))
    return tuple(out)


def range_of(model: pin.Model, j: int) -> tuple[float, float]:
    """Range [rad], [m] of a joint; infinite of those that have none, such as continuous ones."""
    k = model.joints[j].idx_q
    if model.joints[j].nq != 1:
        return -np.inf, np.inf
    return float(model.lowerPositionLimit[k]), float(model.upperPositionLimit[k])


def to_lock(model: pin.Model) -> dict[str, str]:
    """Joints that a plan should not move, with reasons: fingers, wheels, joints without range or mass,
    prismatic joints too weak for their load, drives of a mobile base, joints held by their damping.
    """
    children, out = _children(model), dict[str, str]()
    first = 2 if is_floating(model) else 1
    data = model.createData()
    pin.computeSubtreeMasses(model, data)
    # the base, too, which Pinocchio's sums leave out if it is bolted
    mass, total = list(data.mass), sum(float(body.mass) for body in model.inertias)
    reach = _reach(model, children)
    effort = np.where(effort_limit(model) > 0, effort_limit(model), np.inf)  # zero: the file has none
    viscous = friction(model)[0]
    weight = np.abs(pin.computeGeneralizedGravity(model, data, neutral(model)))
    for j in range(model.njoints - 1, first - 1, -1):
        joint, name, (low, high) = model.joints[j], str(model.names[j]), range_of(model, j)
        if low > high:
            continue  # crossed limits are a mistake of the file, which the robot's checks report
        if not low < high:
            out[name] = NO_RANGE
        elif _WHEELS.search(name) or (joint.nq == 2 and model.parents[j] < first and not children[j]):
            out[name] = "a wheel"
        elif _FINGERS.search(name):
            out[name] = "a finger"
        elif mass[j] <= 0:
            out[name] = "no mass"
        elif "JointModelP" in joint.shortname() and effort[joint.idx_v] < weight[joint.idx_v]:
            out[name] = "too weak for what it carries"
        elif "JointModelP" in joint.shortname() and high - low >= TRAVEL:
            # what turns such a slide, or turns on it without a limit, steers the base
            steering = [i for i in model.supports[j] if i >= first]
            steering += [i for i in children[j] if np.ptp(range_of(model, i)) > TURN]
            out |= {str(model.names[i]): "drives a base" for i in steering}
        elif joint.nv == 1 and CREEP * viscous[joint.idx_v] > 9.81 * total:
            out[name] = HELD
    for j in range(first, model.njoints):  # a hand: several short and light chains on one link
        small = [c for c in children[j] if mass[c] < FINGER_MASS * total and reach[c] < FINGER_LENGTH]
        if len(small) > 1 and len(small) == len(children[j]):
            out |= {str(model.names[i]): "a finger" for c in small for i in _subtree(c, children)}
    if len(out) == model.njoints - first:  # a robot that is a finger
        out = {name: why for name, why in out.items() if not _FINGERS.search(name)}
    return out


def legs_of(model: pin.Model, pieces: Mapping[int, tuple[Piece, ...]]) -> tuple[Limb, ...]:
    """Limbs on which the robot stands in its zero posture: those that end lowest, well below the root link.

    pieces : convex hulls of the links, by the joint that moves them.
    """
    data = model.createData()
    pin.forwardKinematics(model, data, neutral(model))

    def heights(joint: int) -> Array:
        found = _heights(data, pieces, joint)
        return found if found.size else data.oMi[joint].translation[2:]

    everywhere = np.concatenate([heights(j) for j in range(1, model.njoints)])
    lowest, robot_height = float(everywhere.min()), float(np.ptp(everywhere))
    root = float(heights(1).min())
    if root < lowest + ROOT_HEIGHT * robot_height:
        return ()
    feet = (
        limb
        for limb in limbs_of(model)
        # limbs on a common trunk are no legs if their joints' names are those of arms; on the root, legs of
        # four-legged robots have shoulders and elbows, too
        if len(limb.own) > 1
        and not _is_head(model, limb)
        and not _named(model, limb, _WRISTS if limb.own == limb.path else _ARMS)
    )
    highest = lowest + FOOT_HEIGHT * robot_height
    found = tuple(limb for limb in feet if heights(limb.tip).min() < highest)
    return found if len(found) > 1 else ()  # one limb is a hanging arm


def arms_of(model: pin.Model, legs: tuple[Limb, ...]) -> tuple[Limb, ...]:
    """Limbs that may strike: those that are neither legs nor heads."""
    feet = {leg.tip for leg in legs}
    long = [limb for limb in limbs_of(model) if limb.tip not in feet and not _is_head(model, limb)]
    return tuple(limb for limb in long if len(limb.own) > 1) or tuple(long)


def toes(model: pin.Model, legs: tuple[Limb, ...], pieces: Mapping[int, tuple[Piece, ...]]) -> list[str]:
    """Names of toe joints: at the end of a leg with more than six joints, where the foot is on the ground."""
    data = model.createData()
    pin.forwardKinematics(model, data, neutral(model))

    def low(joint: int) -> float:
        return float(_heights(data, pieces, joint).min(initial=np.inf))

    out = []
    for own in map(list, unshared(model, legs)):
        while len(own) > LEG:
            foot, toe = own[-2:]
            distance = float(np.linalg.norm((data.oMi[toe].translation - data.oMi[foot].translation)[:2]))
            if distance < TOE or low(foot) > low(toe) + TOE / 2:
                break
            out.append(str(model.names[own.pop()]))
    return out


def unshared(model: pin.Model, legs: Sequence[Limb]) -> list[tuple[int, ...]]:
    """Driven joints of each leg that are not in the paths of other legs."""
    others = [{j for other in legs if other is not leg for j in other.path} for leg in legs]
    return [
        tuple(j for j in leg.path if j not in of and model.joints[j].nv)
        for leg, of in zip(legs, others, strict=True)
    ]


def renumbered(limb: Limb, old: pin.Model, new: pin.Model) -> Limb:
    """The same joints, by name, in another model that has them."""

    def at(joints: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(int(new.getJointId(old.names[j])) for j in joints)

    return Limb(path=at(limb.path), own=at(limb.own))


def _heights(data: Any, pieces: Mapping[int, tuple[Piece, ...]], joint: int) -> Array:
    """Heights [m] of the vertices of a joint's shapes, (0,) without shapes; data : pin.Data."""
    found = [p.vertices @ data.oMi[joint].rotation[2] for p in pieces.get(joint, ())]
    return np.concatenate([np.zeros(0), *found]) + data.oMi[joint].translation[2]


def _is_head(model: pin.Model, limb: Limb) -> bool:
    return _named(model, limb, _HEADS)


def _named(model: pin.Model, limb: Limb, names: re.Pattern[str]) -> bool:
    return any(names.search(str(model.names[j])) for j in limb.own)


def _children(model: pin.Model) -> dict[int, list[int]]:
    out: dict[int, list[int]] = {j: [] for j in range(model.njoints)}
    for j in range(1, model.njoints):
        out[int(model.parents[j])].append(j)
    return out


def _subtree(joint: int, children: Mapping[int, list[int]]) -> list[int]:
    return [joint, *(i for c in children[joint] for i in _subtree(c, children))]


def _reach(model: pin.Model, children: Mapping[int, list[int]]) -> dict[int, float]:
    """Length [m] of the longest chain beyond each joint, to the centre of mass of its last link."""
    out: dict[int, float] = {}
    for j in range(model.njoints - 1, -1, -1):
        lengths = [float(np.linalg.norm(model.jointPlacements[c].translation)) + out[c] for c in children[j]]
        out[j] = max([float(np.linalg.norm(model.inertias[j].lever)), *lengths])
    return out
