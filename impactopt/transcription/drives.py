"""Points at which a program knows the state of joints and drives: nodes, contact and its ends."""

from __future__ import annotations

from typing import NamedTuple

from impactopt.transcription.layout import Affine
from impactopt.transcription.rows import Place


class DrivePoint(NamedTuple):
    """State of the drives at a node.

    torque (n,) : of the servos, over limit.  slots : z of `impactopt.problem.joint_motion.joint_motion`.
    """

    place: Place
    torque: Affine
    slots: list[Affine]


class ContactEnd(NamedTuple):
    """A contact's two ends.

    before, after : z of `impactopt.problem.joint_motion.joint_motion`.  change (ny,) : of ydot.
    """

    place: Place
    before: list[Affine]
    after: list[Affine]
    change: Affine


def still(y: Affine, rate: Affine, slope: Affine, T: Affine, legs: Affine) -> list[Affine]:
    """Slots of a motion at y, with ydot = rate/T and yddot = slope/T^2."""
    none = Affine.zeros(y.size)
    return [y, none, Affine.zeros(1), none, T, rate, slope, T, legs]
