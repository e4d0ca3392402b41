"""Torque constraints of unactuated joints, and torque profiles of motions.

An unactuated joint has the torque of its spring and damper; the hinge of a sole has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from impactopt.arrays import Array
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.problem.violation import Place, percent
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, add
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.plan import complete_reference


class TorqueProfile(NamedTuple):
    """Torques of a motion phase at its nodes.

    nodes (k,) : fractions of the phase.  torques : over limit (n,) at each node.  T (1,) : duration [s].
    place_at : function that gives a node's place for messages.
    """

    nodes: Array
    torques: list[Affine]
    T: Affine
    place_at: Callable[[float], Place]


def torque_profiles(
    b: Builder, swing: MotionPhase, follows: Sequence[MotionPhase], torques: Sequence[Affine]
) -> list[TorqueProfile]:
    """Torque profiles of the swing and of each motion to rest.

    torques : over limit, at the nodes of these motions, concatenated.
    """
    first, nodes, own = len(swing.nodes), swing.nodes, list(torques[: len(swing.nodes)])
    if nodes[0]:  # a swing from rest has no node at its start, where the torque is known
        nodes, own = np.append(0.0, nodes), [Affine.constant(start_torque(b)), *own]
    out = [TorqueProfile(nodes, own, swing.T[0], swing.place_at)]
    for motion in follows:
        last = first + len(motion.nodes)
        out.append(TorqueProfile(motion.nodes, list(torques[first:last]), motion.T[0], motion.place_at))
        first = last
    return out


def start_torque(b: Builder) -> Array:
    """Torque over limit (n,) at rest in the start posture."""
    c, rest = b.coordinates, np.zeros((1, b.ny))
    wrench = static_wrenches(c, b.y0, b.legs0)[None]
    torque = complete_reference(b.problem, b.y0[None], rest, rest, wrench, b.legs0)[3][0]
    return np.asarray(torque / b.robot.torque_limit)


# weights of an interval's begin, middle and end: Simpson's rule, exact for cubics such as the splines'
SIMPSON = (1 / 6, 4 / 6, 1 / 6)


class SpringPoint(NamedTuple):
    """Torques over limit (n,), y and y' (ny,), and duration T [s]: at a node, or means over an interval."""

    place: Place
    torque: Affine
    y: Affine
    y1: Affine
    T: Affine


def swing_springs(b: Builder, motion: MotionPhase, torques: Sequence[Affine]) -> list[SpringPoint]:
    """Points of spring constraints of a motion to contact: means over the spline's intervals, and its end.

    Accelerations of the spline are linear in an interval, those of a spring are not. With the right means,
    the speeds at the intervals' ends are right, and so is the speed at contact.

    torques : over limit, at the motion's nodes.
    """
    out = []
    for one, other in pairwise(motion.breaks):
        samples = []
        for s in (one, (one + other) / 2, other):
            # none at the start of a swing from rest, where the torque is known
            near = np.flatnonzero(np.isclose(motion.nodes, s))
            torque = torques[near[0]] if near.size else Affine.constant(start_torque(b))
            samples.append((torque, *motion.at(s)[:2]))
        torque, y, y1 = (
            add([part * w for part, w in zip(parts, SIMPSON, strict=True)])
            for parts in zip(*samples, strict=True)
        )
        out.append(SpringPoint(motion.place_at((one + other) / 2), torque, y, y1, motion.T[0]))
    return [*out, *follow_springs(motion, torques)[-1:]]


def follow_springs(motion: MotionPhase, torques: Sequence[Affine]) -> list[SpringPoint]:
    """Points of spring constraints of a motion to rest: the ends of the spline's intervals.

    With means over intervals the motion would oscillate.
    """
    return [
        SpringPoint(motion.place_at(s), torque, *motion.at(s)[:2], motion.T[0])
        for s, torque in zip(motion.nodes, torques, strict=True)
        if np.isclose(s, motion.breaks).any()
    ]


def add_springs(b: Builder, points: Sequence[SpringPoint], gains: Affine) -> None:
    """Adds spring constraints: torque = torque at rest - stiffness x deflection - damping x rate.

    None are needed in contact: a spring is modelled as a servo with its stiffness and damping as gains, and
    the contact's equations have the servo's law.

    gains : logarithms of factors on stiffness and damping, if these are variables.
    """
    robot, c = b.robot, b.coordinates
    passive, own = np.flatnonzero(robot.sprung), c.independent
    stiffness, damping = ((gain / robot.torque_limit)[own] for gain in (robot.kp, robot.kd))
    slots: list[list[Any]] = [[point.y, point.y1, point.T, gains] for point in points]
    at = b.add_block("spring", slots, np.concatenate([b.y0[c.base :], stiffness, damping]))
    # The block's torque is zero in the start posture, where the springs carry what the robot's weight needs.
    rest, m = start_torque(b)[passive], b.ny - c.base
    position = np.array([int(np.flatnonzero(own == k)[0]) for k in passive])  # in the block's outputs (m,)
    names = [robot.joint_names[k] for k in passive]
    for k, point in enumerate(points):
        b.constraints.add(
            term="spring of a joint",
            place=point.place,
            components=names,
            outputs=at + m * k + position,
            affine=point.torque[passive] * -1.0,
            lower=-rest,
            upper=-rest,
            measure=percent("of its limit off"),
        )


def add_hinges(b: Builder, points: Sequence[tuple[Place, Affine]]) -> None:
    """Constrains the torques of soles' hinges to zero, at places with torques over limit (n,).

    None are needed in contact, where the servo's law gives zero: feed-forward and gains of hinges are zero.
    """
    free = np.flatnonzero(b.robot.hinges)
    for place, torque in points:
        b.constraints.add(
            term="hinge of a sole",
            place=place,
            components=[b.robot.joint_names[k] for k in free],
            affine=torque[free],
            lower=0.0,
            upper=0.0,
            measure=percent("of its limit off"),
        )
