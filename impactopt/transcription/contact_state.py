"""State at contact that all collisions of a program start from, and the servo reference that continues.

Also the points at which a program knows the state of joints and drives: nodes, contact and its ends.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Place
from impactopt.transcription.layout import Affine, Group

GAINS = "logarithms of factors on gains"


class ContactState(NamedTuple):
    """The state at contact, as a swing or a posture hands it over.

    y, y1, y2 : coordinates, y' and y''.  T : the duration [s] of the phase that they are of: ydot = y'/T.
    legs, w : legs and sole wrenches.
    """

    y: Affine
    y1: Affine
    y2: Affine
    T: Affine
    legs: Affine
    w: Affine


class Coasting(NamedTuple):
    """Reference during contact: the feed-forward torques over limit (n), the rate (ny) ydot, and the
    logarithms of the factors on the servo's gains, one for each of the problem's `gains`.
    """

    feedforward: Group
    u0: Group
    gains: Group


def add_coasting(b: Builder, rates: dict[str, Any] | None = None) -> Coasting:
    """Its variables.  rates : bounds of the rates at contact."""
    limit, names = b.limits.torque.fraction, b.robot.joint_names
    return Coasting(
        b.layout.add("feed-forward at contact", 1, b.robot.n, lower=-limit, upper=limit, labels=names),
        b.layout.add("rate at contact", 1, b.ny, labels=b.coordinates.labels, **(rates or {})),
        _add_gains(b),
    )


def _add_gains(b: Builder) -> Group:
    chosen = b.problem.gains
    if not chosen:
        return Group(GAINS, 0, 1, 0, np.zeros(0), ())
    least, largest = np.log([gain.factor for gain in chosen]).T
    labels = [", ".join(gain.joints) for gain in chosen]
    return b.layout.add(GAINS, 1, len(chosen), lower=least, upper=largest, labels=labels)


class Contact(NamedTuple):
    """State at contact and what coasts from there."""

    state: ContactState
    feedforward: Group
    u0: Group
    gains: Group

    def link(
        self,
        start: tuple[Affine, Affine, Affine],
        times: tuple[Affine, Affine],
        travel: tuple[Affine, Affine],
        rate: Affine,
    ) -> list[list[Affine]]:
        """Slots of the block ``link``, coordinate by coordinate: from the state at contact to a later start.

        start : y and d y/ds of what starts, and its duration [s].  times [s], travel : of two phases between,
        whose ways are time x travel.  rate : ydot after them.
        """
        y, y1, *_ = self.state
        out = []
        for k in range(self.u0.size):
            yk, rk, a, b, one, two, u0, u = (
                e[k : k + 1] for e in (*start[:2], y, y1, *travel, self.u0[0], rate)
            )
            out.append([yk, rk, start[2], a, b, self.state.T, *times, one, two, u0, u])
        return out


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
