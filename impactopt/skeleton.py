"""Capsules along a robot's bones, for robots whose shapes nobody has given."""

from __future__ import annotations

import numpy as np

from impactopt.errors import InputError
from impactopt.robot import Robot
from impactopt.shapes import Capsule, Vector

HAND, THIGH, TORSO = 0.06, 0.08, 0.12  # [m] radii, of a robot as large as a person
BONE = 0.15  # [m] what is shorter is within a joint of several axes
SIDEWAYS = 0.05  # [m] from the spine


def skeleton_pairs(robot: Robot, striker: str) -> tuple[tuple[Capsule, Capsule], ...]:
    """The hand that strikes, against the torso and against each thigh.

    A thigh is the first long bone of a leg. The torso goes up, along z of its frame, to the height of the
    shoulder: where the first bone to the hand that goes sideways, along y, ends.

    Raises
    ------
    InputError : a robot without legs and torso, or none that its bones tell of.
    """
    hand = Capsule(frame=robot.striker(striker).frame, radius=HAND)
    parts = [
        *_torso(robot, hand.frame),
        *(part for sole in robot.soles for part in _thigh(robot, sole.frame)),
    ]
    if not parts:
        raise InputError(
            f"{robot.name} has no torso and no thighs that its bones tell of: give SelfCollision its pairs"
        )
    return tuple((hand, part) for part in parts)


def _bones(robot: Robot, frame: str) -> list[tuple[str, Vector]]:
    """Of the limb to a frame: each joint from the root on, and where the next one is in its frame [m]."""
    model = robot.model
    names = [model.names[1]] * robot.floating + [robot.joint_names[j] for j in robot.limb(frame)]
    ends = [model.jointPlacements[model.getJointId(name)].translation.tolist() for name in names[1:]]
    return list(zip(names, ends, strict=False))


def _torso(robot: Robot, frame: str) -> list[Capsule]:
    for name, end in _bones(robot, frame):
        if abs(end[1]) > SIDEWAYS:
            return [Capsule(frame=name, radius=TORSO, end=(0.0, 0.0, end[2]))] if end[2] > BONE else []
    return []


def _thigh(robot: Robot, frame: str) -> list[Capsule]:
    for name, end in _bones(robot, frame)[1:]:  # the first is to the hip
        if np.linalg.norm(end) > BONE:
            return [Capsule(frame=name, radius=THIGH, end=end)]
    return []
