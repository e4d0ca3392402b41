"""Placement of a drafted problem's target: ahead of an arm, within its reach, with room to swing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb
from impactopt.files.draft.postures import arm_length, bend_arm, shoulder
from impactopt.kinematics.operational_space import striking_point
from impactopt.robots.robot import Robot

__all__ = ["AHEAD", "WAYS", "Arm", "aims", "ready"]

Array = NDArray[np.float64]
WAYS = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))
# of the arm's length, from the shoulder: where its end waits (ahead, below), and where it may hit (ahead)
WAITS = ((0.4, 0.3), (0.45, 0.0), (0.35, 0.5), (0.5, -0.3))
RAISED = ((0.45, 0.0), (0.4, -0.2), (0.5, 0.2))  # the same before a blow from above
BENCH = 0.6  # [m] a shoulder as low as that belongs to an arm on the ground, whose end waits level with it
HITS = (0.75, 0.65, 0.85, 0.55)
FALLS = (0.45, 0.35, 0.55)  # of the arm's length, below the shoulder: where it may hit from above
FARTHER = 0.2  # of the arm's length, at most, than where it waits
AHEAD = np.array(WAYS[0])
LOWEST = 0.25  # [m] above the ground
NEAR = 0.03  # [m] off its place, as bent postures are preferred


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A limb that may strike, by its striker's name; axis (3,) : of its last link, to the striking point."""

    limb: Limb
    name: str
    axis: Array


def _level(way: Array) -> Array:
    """The way (3,) itself, or ahead where it is down."""
    return AHEAD if way[2] else way


def ready(
    robot: Robot, arms: Sequence[Arm], q: Array, *, ways: Sequence[Sequence[float]]
) -> tuple[Array, Array]:
    """The configuration (nq,) with all arms bent, and the way (3,) in which the first one strikes.

    arms : the first one strikes, and has to find a place.  ways : that may be struck in, the best first.

    Raises
    ------
    InputError : the striking arm reaches none of the places where it could wait.
    """
    way, nearest = np.array(ways[0]), np.inf
    for k, arm in enumerate(arms):
        length = arm_length(robot, arm.limb, arm.name)
        root = shoulder(robot, arm.limb, q)
        best, off = q, np.inf
        low = WAITS if root[2] > BENCH else WAITS[1:]
        tries = ways if k == 0 else [_level(way)]
        for to, ahead, below in ((one, *wait) for one in tries for wait in (RAISED if one[2] else low)):
            place = root + length * (ahead * _level(np.array(to)) - [0.0, 0.0, below])
            place[2] = max(place[2], LOWEST)
            tried, gap = bend_arm(robot, arm.limb, arm.name, arm.axis, q, place, np.array(to))
            if gap < off - NEAR:
                best, off, found = tried, gap, np.array(to)
            if off < NEAR:
                break
        if k == 0:
            way, nearest = found, off
        q = best
    if nearest > 5 * NEAR:
        raise InputError(
            f"no posture is found with {arms[0].name!r} in front: the best one is {1e3 * nearest:.0f} mm "
            "off; write the problem file by hand (docs/howto/robot.md)"
        )
    return q, way


def aims(robot: Robot, arm: Arm, q: Array, way: Array) -> Iterator[Array]:
    """Points (3,) [m] that the arm can hit from a configuration (nq,), the likeliest first."""
    start = striking_point(robot, arm.name, q)
    root, length = shoulder(robot, arm.limb, q), arm_length(robot, arm.limb, arm.name)
    for other, hit in product((0.0, 0.5, 1.0), FALLS if way[2] else HITS):
        point = start + way * ((root - start) @ way + hit * length)
        if way[2]:
            point += FARTHER * other * length * AHEAD
        else:
            point[2] += other * (max(root[2], LOWEST) - start[2])
        gap = bend_arm(robot, arm.limb, arm.name, arm.axis, q, point, way)[1]
        if gap < NEAR and (point - start) @ way > 0.1 * length:
            yield np.round(point, 3) + 0.0
