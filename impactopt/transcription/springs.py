"""Rows of joints that a spring and a damper move: the torque that the motion needs is that of the two."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.transcription.courses import start_torque
from impactopt.transcription.rows import percent

if TYPE_CHECKING:
    from impactopt.transcription.at_contact import ContactProgram

__all__ = ["add_springs"]


def add_springs(program: ContactProgram) -> None:
    """At a program's `spring_nodes`: torque = torque at rest - stiffness x turn - damping x rate.

    In contact the servo's own law is that of the spring.
    """
    robot, c, b = program.robot, program.coordinates, program.builder
    passive = np.flatnonzero(robot.passive)
    if not passive.size:
        return
    nodes = program.spring_nodes()
    slots: list[list[Any]] = [[y, y1, T] for _, _, (y, y1, _, _, _, T) in nodes]
    own = c.independent
    gains = [(gain / robot.torque_limit)[own] for gain in (robot.kp, robot.kd)]
    at = program.add_block("spring", slots, np.concatenate([program.y0[c.base :], *gains]))
    rest, m = start_torque(b)[passive], b.ny - c.base
    which = np.array([int(np.flatnonzero(own == k)[0]) for k in passive])
    names = [robot.joint_names[k] for k in passive]
    for k, (place, torque, _) in enumerate(nodes):
        program.rows.add(
            term="spring of a joint",
            place=place,
            components=names,
            outputs=at + m * k + which,
            affine=torque[passive] * -1.0,
            lower=-rest,
            upper=-rest,
            measure=percent("of its limit off"),
        )
