"""Joints that no motor moves, and the torque profiles of the others.

Of a spring and a damper, the torque that the motion needs is that of the two; of a sole's hinge it is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from impactopt.kinematics.operational_space import static_wrenches
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Array, Place, add, percent
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.plan import complete_reference

__all__ = [
    "SpringPoint",
    "TorqueCourse",
    "add_hinges",
    "add_springs",
    "follow_springs",
    "swing_springs",
    "torque_courses",
]


class TorqueCourse(NamedTuple):
    """The torques of a phase.

    nodes (k,) : in it, from 0 to 1.  torques : over limit (n,) at each node.  T (1,) : its duration [s].
    place_at : the place of a node, as constraints have it.
    """

    nodes: Array
    torques: list[Affine]
    T: Affine
    place_at: Callable[[float], Place]


def torque_courses(
    b: Builder, swing: MotionPhase, follows: Sequence[MotionPhase], torques: Sequence[Affine]
) -> list[TorqueCourse]:
    """Torque profiles of the swing, whose initial torque is given where it starts at rest, and of each motion
    to rest.

    torques : over limit, at the nodes of all of these, one motion after the other.
    """
    first, nodes, own = len(swing.nodes), swing.nodes, list(torques[: len(swing.nodes)])
    if nodes[0]:  # at rest before it
        nodes, own = np.append(0.0, nodes), [Affine.constant(start_torque(b)), *own]
    out = [TorqueCourse(nodes, own, swing.T[0], swing.place_at)]
    for motion in follows:
        last = first + len(motion.nodes)
        out.append(TorqueCourse(motion.nodes, list(torques[first:last]), motion.T[0], motion.place_at))
        first = last
    return out


def start_torque(b: Builder) -> Array:
    """Torque over limit (n,) at rest in the start posture."""
    c, rest = b.coordinates, np.zeros((1, b.ny))
    wrench = static_wrenches(c, b.y0, b.legs0)[None]
    torque = complete_reference(b.problem, b.y0[None], rest, rest, wrench, b.legs0)[3][0]
    return np.asarray(torque / b.robot.torque_limit)


# weights of an interval's begin, middle and end: Simpson's rule, exact for the splines' cubics
SIMPSON = (1 / 6, 4 / 6, 1 / 6)


class SpringPoint(NamedTuple):
    """Torques over limit (n,), and the motion that they are of: at a place, or means over an interval.

    y, y1 (ny,), T : the coordinates, and their rate y'/T.
    """

    place: Place
    torque: Affine
    y: Affine
    y1: Affine
    T: Affine


def swing_springs(b: Builder, motion: MotionPhase, torques: Sequence[Affine]) -> list[SpringPoint]:
    """Spring constraints of a motion to contact: means over the spline's intervals, and its end.

    Accelerations of a spline are linear in an interval, those of a spring are not. Where their means are
    right, so are the speeds at the intervals' ends, and with them the blow.

    torques : over limit, at the motion's nodes.
    """
    out = []
    for one, other in pairwise(motion.breaks):
        three = []
        for s in (one, (one + other) / 2, other):
            near = np.flatnonzero(np.isclose(motion.nodes, s))
            torque = torques[near[0]] if near.size else Affine.constant(start_torque(b))
            three.append((torque, *motion.at(s)[:2]))
        torque, y, y1 = (
            add([part * w for part, w in zip(parts, SIMPSON, strict=True)])
            for parts in zip(*three, strict=True)
        )
        out.append(SpringPoint(motion.place_at((one + other) / 2), torque, y, y1, motion.T[0]))
    return [*out, *follow_springs(motion, torques)[-1:]]


def follow_springs(motion: MotionPhase, torques: Sequence[Affine]) -> list[SpringPoint]:
    """Spring constraints of a motion to rest: the ends of the spline's intervals. With means it would
    oscillate.
    """
    return [
        SpringPoint(motion.place_at(s), torque, *motion.at(s)[:2], motion.T[0])
        for s, torque in zip(motion.nodes, torques, strict=True)
        if np.isclose(s, motion.breaks).any()
    ]


def add_springs(b: Builder, points: Sequence[SpringPoint], gains: Affine) -> None:
    """Adds spring constraints at some points: torque = torque at rest - stiffness x turn - damping x rate.

    In contact the servo's own law is that of the spring.

    gains : logarithms of the factors on them that are chosen.
    """
    robot, c = b.robot, b.coordinates
    passive = np.flatnonzero(robot.sprung)
    if not passive.size:
        return
    own = c.independent
    given = [(gain / robot.torque_limit)[own] for gain in (robot.kp, robot.kd)]
    slots: list[list[Any]] = [[point.y, point.y1, point.T, gains] for point in points]
    at = b.add_block("spring", slots, np.concatenate([b.y0[c.base :], *given]))
    rest, m = start_torque(b)[passive], b.ny - c.base
    which = np.array([int(np.flatnonzero(own == k)[0]) for k in passive])
    names = [robot.joint_names[k] for k in passive]
    for k, point in enumerate(points):
        b.rows.add(
            term="spring of a joint",
            place=point.place,
            components=names,
            outputs=at + m * k + which,
            affine=point.torque[passive] * -1.0,
            lower=-rest,
            upper=-rest,
            measure=percent("of its limit off"),
        )


def add_hinges(b: Builder, points: Sequence[tuple[Place, Affine]]) -> None:
    """Adds constraints at places with these torques over limit (n,): those of soles' hinges are zero.

    In contact the servo's own law is that: feed-forward and gains are zero.
    """
    free = np.flatnonzero(b.robot.hinges)
    for place, torque in points:
        b.rows.add(
            term="hinge of a sole",
            place=place,
            components=[b.robot.joint_names[k] for k in free],
            affine=torque[free],
            lower=0.0,
            upper=0.0,
            measure=percent("of its limit off"),
        )
