"""Margins of the soles in a replay: distances of their centres of pressure from their own edges."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.loads import cop_margin
from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene

Array = NDArray[np.float64]


def sole_names(robot: Robot, scene: Scene) -> tuple[str, ...]:
    """The robot's names of the scene's soles, in the scene's order."""
    names = {sole.frame: sole.name for sole in robot.soles}
    return tuple(names.get(frame, frame) for frame in scene.soles)


def cop_margins(robot: Robot, scene: Scene, q: Array, sole_ground: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from its own edges, as of `cop_margin`.

    q (k, nq); sole_ground (k, soles, 6) about the world's origin [N, N m].
    """
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in scene.soles]
    wrenches = np.empty_like(sole_ground)
    for k, posture in enumerate(q if frames else ()):
        pin.forwardKinematics(model, data, posture)
        for i, frame in enumerate(frames):
            place = pin.updateFramePlacement(model, data, frame)
            # in the sole's own frame, so that a tilted sole's edges are its edges
            wrenches[k, i] = place.actInv(pin.Force(sole_ground[k, i])).vector
    return cop_margin(robot, scene.corners, wrenches)
