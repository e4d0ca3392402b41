"""Motion styles: prices on motion, which keep plans smooth and near the start posture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from impactopt.arrays import Mask
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class MotionPrices:
    """Prices of a whole motion. All but ``end`` are on the integral of a square over swing and
    follow-through.

    acceleration [N s per (rad/s^2)^2 s], jerk [N s per (rad/s^3)^2 s] : of all independent coordinates.
    speed, idle_speed [N s per (rad/s)^2 s] : of all independent coordinates, and of idle joints in addition.
    end [N s per rad^2] : on the squared distance of the end posture from the start posture.
    """

    acceleration: float = 0.0
    jerk: float = 0.0
    speed: float = 0.0
    idle_speed: float = 0.0
    end: float = 0.0

    def scaled(self, factor: float) -> MotionPrices:
        """All prices multiplied by a factor."""
        return replace(self, **{name: factor * value for name, value in vars(self).items()})


# Chosen for `punch` (figures: docs/howto/natural.md). The price on jerk removes reversals and peaks, that on
# idle speed the motion of limbs that do not contribute, that on speed the detours of all others.
STYLES: dict[str, MotionPrices] = {
    "natural": MotionPrices(jerk=7e-7, speed=7.5e-3, idle_speed=8e-2, end=2.0),
    "strongest": MotionPrices(),
}


def joints_to(robot: Robot, frames: Iterable[str]) -> set[int]:
    """Joints of the model that move any of these frames, and 0, the world."""
    model = robot.model
    joints = (model.frames[model.getFrameId(name)].parentJoint for name in frames)
    return {int(j) for joint in joints for j in model.supports[joint]}


def idle_joints(robot: Robot, frames: Iterable[str]) -> Mask:
    """Mask (n,) of the joints that move none of these frames, such as those of an idle arm or the head."""
    model = robot.model
    first = model.nv - robot.n
    idle = np.ones(robot.n, dtype=bool)
    for j in joints_to(robot, frames):
        column = int(model.joints[j].idx_v) - first if j else -1
        if column >= 0:
            idle[column] = False
    return idle
