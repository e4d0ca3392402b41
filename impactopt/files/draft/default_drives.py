"""Default drive parameters that a robot description lacks, each marked as a guess."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from impactopt.robots.build import effort_limit, is_floating, joint_indices, joint_names, velocity_limit
from impactopt.robots.couplings import couplings_of
from impactopt.robots.gains import USUAL_ROTOR

__all__ = ["Drives", "guess_drives"]

LEAST = {True: 1e-3, False: 0.05}  # armature: [kg m2] of a hinge, [kg] of a slide
SPEED = {True: 3.0, False: 0.3}  # [rad/s], [m/s]
WEIGHT = 3.0  # torque limit over the largest that gravity asks for
THIGH = 0.3  # [m] times the robot's weight: what a leg's joint can bear at least
WEAKEST = {True: 2.0, False: 50.0}  # [N m], [N]
BELIEVED = {True: 500.0, False: 1e4}  # more than that [N m], [N] is reported
FAST = 60.0  # [rad/s], [m/s]: likewise
DOUBT = "a GUESS"


@dataclass(kw_only=True)
class Drives:
    """Numbers by joint, and what is said of them: armature [kg m2], torque [N m] and velocity [rad/s] limits
    that the file lacks; said : sentences about what it has and is hard to believe.
    """

    armature: dict[str, float] = field(default_factory=dict)
    torque: dict[str, float] = field(default_factory=dict)
    velocity: dict[str, float] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)


def guess_drives(model: pin.Model, known: Mapping[str, float], carrying: Collection[str] = ()) -> Drives:
    """Guesses the missing drive parameters of each joint.

    known : torque limits that the model itself has not got.  carrying : joints of legs, with the robot above.
    """
    out, joints = Drives(), joint_names(model)
    base, indices = model.nv - len(joints), joint_indices(model)
    torque, speed = effort_limit(model)[base:], velocity_limit(model)[base:]
    lifting = _gravity(model)
    weight = THIGH * 9.81 * sum(float(body.mass) for body in model.inertias)
    for k, joint in enumerate(joints):
        turns = "JointModelP" not in model.joints[indices[k]].shortname()
        limit = known.get(joint, float(torque[k]))
        if not 0 < limit < 1e15:
            limit = _rounded(max(WEIGHT * lifting[k], WEAKEST[turns], weight * (joint in carrying)))
            out.torque[joint] = limit
        elif limit > BELIEVED[turns]:
            unit = "N m" if turns else "N"
            out.said.append(f"torque limit of {joint}, {limit:g} {unit}: hard to believe")
        if not 0 < speed[k] < 1e15:
            out.velocity[joint] = SPEED[turns]
        elif speed[k] > FAST:
            out.said.append(f"velocity limit of {joint}, {speed[k]:g} rad/s: hard to believe")
        if model.armature[base + k] == 0:
            out.armature[joint] = _rounded(max(USUAL_ROTOR * limit, LEAST[turns]))
    return out


def _gravity(model: pin.Model) -> list[float]:
    """The most that gravity can ask of each joint [N m], [N]: all that it moves, stretched out level."""
    first = 2 if is_floating(model) else 1
    mass = np.zeros(model.njoints)
    moment = np.zeros(model.njoints)
    for j in range(model.njoints - 1, first - 1, -1):
        mass[j] += model.inertias[j].mass
        moment[j] += model.inertias[j].mass * float(np.linalg.norm(model.inertias[j].lever))
        parent, length = int(model.parents[j]), float(np.linalg.norm(model.jointPlacements[j].translation))
        mass[parent] += mass[j]
        moment[parent] += moment[j] + mass[j] * length
    for name, law in couplings_of(model).items():  # the leader's motor moves both
        follower, leader = (model.getJointId(joint) for joint in (name, law.leader))
        mass[leader] += abs(law.ratio) * mass[follower]
        moment[leader] += abs(law.ratio) * moment[follower]
    slides = [(j, "JointModelP" in model.joints[j].shortname()) for j in joint_indices(model)]
    return [9.81 * float(mass[j] if slide else moment[j]) for j, slide in slides]


def _rounded(number: float) -> float:
    """Number rounded to two digits."""
    return float(f"{number:.2g}")
