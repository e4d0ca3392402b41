"""Guesses of the drive parameters that a robot description lacks."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from impactopt.robots.build import (
    effort_limit,
    is_floating,
    joint_indices,
    joint_names,
    prismatic,
    velocity_limit,
)
from impactopt.robots.checks import MAX_SERVO_RATE
from impactopt.robots.couplings import Coupling, couplings_of
from impactopt.robots.gains import LIGHTEST_ROTOR, USUAL_ROTOR
from impactopt.robots.model import axis_of

# by joint type: True for a revolute joint, False for a prismatic one
SPEED = {True: 3.0, False: 0.3}  # guessed velocity limit [rad/s], [m/s]
RANGE = (-3.14, 3.14)  # [rad] guessed position limits
MIN_TORQUE = {True: 2.0, False: 50.0}  # [N m], [N]
# [N m], [N], or the robot's largest gravity torque times a factor, as an excavator's are large: higher limits
# are reported
PLAUSIBLE_TORQUE, PLAUSIBLE_FACTOR = {True: 500.0, False: 1e4}, 10.0
GRAVITY_FACTOR = 3.0  # guessed torque limit over the largest gravity torque
LEVER = 0.3  # [m]: weight x lever is the least torque limit of a leg's joints
PLAUSIBLE_SPEED = 60.0  # [rad/s], [m/s]: larger limits are reported
# Larger limits stand for none: no robot's motor reaches them, nor more than 25 times that gravity torque
LARGEST_TORQUE, LARGEST_FACTOR = {True: 5e3, False: 1e6}, 50.0  # [N m], [N]
UNLIMITED = 1e6  # [N m], [N]: the file itself means none
LARGEST_SPEED = 1e3  # [rad/s], [m/s]
SERVO_MARGIN = 2.0  # largest rate of a servo over that on a guessed rotor alone
DOUBT = "a GUESS"


@dataclass(frozen=True, kw_only=True)
class PublishedLimits:
    """A manufacturer's limits of the commands that its controller takes.

    joints : their names.  acceleration, jerk : limits of each [rad/s^2], [rad/s^3].  source : where they are
    published.
    """

    joints: tuple[str, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]
    source: str


_FRANKA = "Franka Control Interface documentation, robot and interface specifications"
PUBLISHED_LIMITS = (
    PublishedLimits(
        joints=tuple(f"panda_joint{k}" for k in range(1, 8)),
        acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
        jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
        source=_FRANKA,
    ),
    PublishedLimits(
        joints=tuple(f"fr3_joint{k}" for k in range(1, 8)),
        acceleration=(10.0,) * 7,
        jerk=(5000.0,) * 7,
        source=_FRANKA,
    ),
)


def published_limits(joints: Collection[str]) -> PublishedLimits | None:
    """Published limits of the robot with these joints; None if none are known."""
    return next((known for known in PUBLISHED_LIMITS if set(known.joints) <= set(joints)), None)


@dataclass(kw_only=True)
class Drives:
    """Guesses by joint: armature [kg m2], torque [N m], velocity [rad/s] and position [rad] limits that the
    file lacks, or that are too large to be meant. Of prismatic joints [kg], [N], [m/s] and [m].

    undriven : joints of which the file has no torque limit.
    said : messages about implausible numbers of the file.
    """

    armature: dict[str, float] = field(default_factory=dict)
    torque: dict[str, float] = field(default_factory=dict)
    velocity: dict[str, float] = field(default_factory=dict)
    position: dict[str, tuple[float, float]] = field(default_factory=dict)
    undriven: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)


def guess_drives(
    model: pin.Model,
    known: Mapping[str, float],
    carrying: Collection[str] = (),
    unranged: Collection[str] = (),
    kd: Mapping[str, float] | None = None,
) -> Drives:
    """Guesses of the missing drive parameters of each joint.

    known : torque limits that are not in the model.  carrying : joints of legs, which carry the robot.
    unranged : joints without position limits.  kd : servo damping of the file, which a guessed rotor bears.
    """
    out, joints = Drives(), joint_names(model)
    out.position = {joint: RANGE for joint in joints if joint in unranged}
    base, slides = model.nv - len(joints), prismatic(model)
    torque, speed = effort_limit(model)[base:], velocity_limit(model)[base:]
    gravity = _largest_gravity(model)
    heaviest = {
        kind: max([0.0, *(g for g, s in zip(gravity, slides, strict=True) if s != kind)]) for kind in SPEED
    }
    leg_torque = LEVER * 9.81 * sum(float(body.mass) for body in model.inertias)
    for k, joint in enumerate(joints):
        revolute = not slides[k]
        effort, rate, inertia = ("N m", "rad/s", "kg m2") if revolute else ("N", "m/s", "kg")
        limit = known.get(joint, float(torque[k]))
        given, heavy = limit, heaviest[revolute]
        if not 0 < limit < max(LARGEST_TORQUE[revolute], LARGEST_FACTOR * heavy):
            least = max(MIN_TORQUE[revolute], leg_torque * (joint in carrying))
            out.torque[joint] = limit = _rounded(max(GRAVITY_FACTOR * gravity[k], least))
            out.undriven += [] if 0 < given < UNLIMITED else [joint]
        if max(PLAUSIBLE_TORQUE[revolute], PLAUSIBLE_FACTOR * heavy) < given < UNLIMITED:
            guessed = ", and guessed" if joint in out.torque else ""
            out.said.append(f"torque limit of {joint}, {given:g} {effort}: hard to believe{guessed}")
        if not 0 < speed[k] < LARGEST_SPEED:
            out.velocity[joint] = SPEED[revolute]
        elif speed[k] > PLAUSIBLE_SPEED:
            out.said.append(f"velocity limit of {joint}, {speed[k]:g} {rate}: hard to believe")
        armature = float(model.armature[base + k])
        if armature < LIGHTEST_ROTOR * limit:  # as of a rotor whose gear ratio is left out
            if armature:
                out.said.append(
                    f"armature of {joint}, {armature:.2g} {inertia}: hard to believe, and guessed"
                )
            least = SERVO_MARGIN * (kd or {}).get(joint, 0.0) / MAX_SERVO_RATE
            out.armature[joint] = _rounded(max(USUAL_ROTOR * limit, least))
    return out


def _largest_gravity(model: pin.Model) -> list[float]:
    """Upper bound of the gravity torque [N m], [N] of each joint: its subtree stretched out horizontally."""
    first, couplings = 2 if is_floating(model) else 1, couplings_of(model)
    mass, moment, load = np.zeros((3, model.njoints))
    for j in range(model.njoints - 1, first - 1, -1):
        mass[j] += model.inertias[j].mass
        moment[j] += model.inertias[j].mass * float(np.linalg.norm(model.inertias[j].lever))
        # a joint of more degrees of freedom is refused later, when the robot is made
        slides = model.joints[j].nv <= 1 and axis_of(model, j).subspace[:3].any()
        load[j] = mass[j] if slides else moment[j]
        parent, length = int(model.parents[j]), float(np.linalg.norm(model.jointPlacements[j].translation))
        if slides:
            length += _travel(model, j, couplings.get(str(model.names[j])))
        mass[parent] += mass[j]
        moment[parent] += moment[j] + mass[j] * length
    for name, law in couplings.items():  # the leader's motor carries its followers, too
        follower, leader = (model.getJointId(joint) for joint in (name, law.leader))
        load[leader] += abs(law.ratio) * load[follower]
    return [9.81 * float(load[j]) for j in joint_indices(model)]


def _travel(model: pin.Model, joint: int, law: Coupling | None) -> float:
    """Largest distance [m] of a prismatic joint from its zero; 0 without limits.

    law : of a follower, whose limits are its leader's.
    """
    k = model.joints[joint].idx_q
    ends = np.array([model.lowerPositionLimit[k], model.upperPositionLimit[k]])
    if law is not None:
        ends = law.ratio * ends + law.offset
    return float(np.abs(ends).max()) if np.isfinite(ends).all() else 0.0


def _rounded(number: float) -> float:
    """Number rounded to two digits."""
    return float(f"{number:.2g}")
