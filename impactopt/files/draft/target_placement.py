"""Placement of a drafted problem's target: in front of an arm, within its reach, with room to swing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb
from impactopt.files.draft.postures import arm_length, bend_arm, shoulder
from impactopt.kinematics.operational_space import striking_point
from impactopt.robots.robot import Robot

# horizontal
STRIKE_DIRECTIONS = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))
# Positions relative to the shoulder, over the arm's length, in the order tried:
STARTS = ((0.4, 0.3), (0.45, 0.0), (0.35, 0.5), (0.5, -0.3))  # (ahead, below) of the arm's end at the start
RAISED = ((0.45, 0.0), (0.4, -0.2), (0.5, 0.2))  # the same before a strike from above
HITS = (0.75, 0.65, 0.85, 0.55)  # ahead, of the hit point
HITS_BELOW = (0.45, 0.35, 0.55)  # below, of the hit point of a strike from above
FARTHER = 0.2  # largest distance of that hit point ahead of the start, over the arm's length
LOW_SHOULDER = 0.6  # [m]: an arm with a lower shoulder is on the ground; it starts level with it, if it can
AHEAD = np.array(STRIKE_DIRECTIONS[0])
LOWEST = 0.25  # [m] above the ground
NEAR = 0.03  # [m] tolerance of the arm's end, as bent postures are preferred to exact ones


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A limb that may strike, and the name of its striker; axis (3,) : direction of its last link."""

    limb: Limb
    name: str
    axis: Array


def _level(direction: Array) -> Array:
    """A horizontal direction (3,): the direction itself, or ahead for one from above."""
    return AHEAD if direction[2] else direction


def ready(
    robot: Robot, arms: Sequence[Arm], q: Array, *, directions: Sequence[Sequence[float]]
) -> tuple[Array, Array]:
    """The configuration (nq,) with all arms bent, and the strike direction (3,) of the first one.

    arms : the first one strikes.  directions : directions in which it may strike, the best first.

    Raises
    ------
    InputError : the striking arm reaches none of its start positions.
    """
    direction, nearest = np.array(directions[0]), np.inf
    for k, arm in enumerate(arms):
        length = arm_length(robot, arm.limb, arm.name)
        root = shoulder(robot, arm.limb, q)
        best, off = q, np.inf
        starts = STARTS if root[2] > LOW_SHOULDER else STARTS[1:]
        tries = directions if k == 0 else [_level(direction)]
        for to, ahead, below in ((one, *start) for one in tries for start in (RAISED if one[2] else starts)):
            place = root + length * (ahead * _level(np.array(to)) - [0.0, 0.0, below])
            place[2] = max(place[2], LOWEST)
            tried, gap = bend_arm(robot, arm.limb, arm.name, arm.axis, q, place, np.array(to))
            if gap < off - NEAR:
                best, off, found = tried, gap, np.array(to)
            if off < NEAR:
                break
        if k == 0:
            direction, nearest = found, off
        q = best
    if nearest > 5 * NEAR:
        raise InputError(
            f"no posture is found with {arms[0].name!r} in front: the best one is {1e3 * nearest:.0f} mm "
            "off; write the problem file by hand (docs/howto/robot.md)"
        )
    return q, direction


def aims(robot: Robot, arm: Arm, q: Array, direction: Array) -> Iterator[Array]:
    """Hit points (3,) [m] within the arm's reach from a configuration (nq,), the most promising first."""
    start = striking_point(robot, arm.name, q)
    root, length = shoulder(robot, arm.limb, q), arm_length(robot, arm.limb, arm.name)
    for part, hit in product((0.0, 0.5, 1.0), HITS_BELOW if direction[2] else HITS):
        point = start + direction * ((root - start) @ direction + hit * length)
        if direction[2]:
            point += FARTHER * part * length * AHEAD
        else:  # from the height of the start to that of the shoulder
            point[2] += part * (max(root[2], LOWEST) - start[2])
        gap = bend_arm(robot, arm.limb, arm.name, arm.axis, q, point, direction)[1]
        if gap < NEAR and (point - start) @ direction > 0.1 * length:
            yield rounded_point(robot, arm.name, point)


def rounded_point(robot: Robot, striker: str, point: Array) -> Array:
    """A hit point (3,) [m] to the millimetre, where the striker has joints enough to reach that."""
    # fewer than three joints reach a curve or a surface only, from which rounding would move the point
    joints = len(robot.limb(robot.striker(striker).model_frame))
    return np.round(point, 3 if joints > 2 else 9) + 0.0
