"""Torque profiles, from node to node of a phase, as terms and objectives take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from impactopt.kinematics.operational_space import static_wrenches
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Place
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.reference import complete_reference


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
    """Torque profiles of the swing, whose initial torque is given, and of each motion to rest.

    torques : over limit, at the nodes of all of these, one motion after the other.
    """
    start, first = Affine.constant(start_torque(b)), len(swing.nodes)
    nodes = np.append(0.0, swing.nodes)
    out = [TorqueCourse(nodes, [start, *torques[:first]], swing.T[0], swing.place_at)]
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
