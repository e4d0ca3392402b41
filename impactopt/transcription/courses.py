"""Torques from node to node of a phase, as terms and objectives take them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impactopt.kinematics.statics import static_wrenches
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.plan import complete_reference
from impactopt.transcription.rows import Place

if TYPE_CHECKING:
    from impactopt.transcription.transcription import Transcription


class TorqueCourse(NamedTuple):
    """The torques of a phase.

    nodes (k,) : in it, from 0 to 1.  torques : over limit (n,) at each node.  T (1,) : its duration [s].
    place_at : the place of a node, as rows have it.
    """

    nodes: Array
    torques: list[Affine]
    T: Affine
    place_at: Callable[[float], Place]


def torque_courses(t: Transcription) -> list[TorqueCourse]:
    """Of the swing from its start on, where the torque is given; of follow-through; of the brake if any."""
    swing, follow = len(t.swing_nodes), len(t.follow_nodes)
    start = Affine.constant(_start_torque(t))
    nodes = np.append(0.0, t.swing_nodes)
    out = [TorqueCourse(nodes, [start, *t.torques[:swing]], t.swing_T[0], t.swing_place)]
    for k, part in enumerate(t.follows):
        first = swing + k * follow
        torques = t.torques[first : first + follow]
        out.append(TorqueCourse(t.follow_nodes, torques, part.T[0], part.place_at))
    return out


def _start_torque(t: Transcription) -> Array:
    """Torque over limit (n,) at rest in the start posture."""
    c, rest = t.coordinates, np.zeros((1, t.ny))
    wrench = static_wrenches(c, t.y0, t.legs0)[None]
    torque = complete_reference(t.problem, t.y0[None], rest, rest, wrench, t.legs0)[3][0]
    return np.asarray(torque / t.robot.torque_limit)
