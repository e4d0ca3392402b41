"""Where each sole is pressed: the distance of its centre of pressure from its own edges."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene, centre_of_pressure, distance_inside

Array = NDArray[np.float64]
BEARS = 0.02  # of the weight: a sole with less on it bears no load


def sole_names(robot: Robot, scene: Scene) -> tuple[str, ...]:
    """The robot's names of the scene's soles, in the scene's order."""
    names = {sole.frame: sole.name for sole in robot.soles}
    return tuple(names.get(frame, frame) for frame in scene.soles)


def weight_of(robot: Robot) -> float:
    """Weight [N]."""
    mass = float(sum(inertia.mass for inertia in robot.model.inertias))
    return mass * float(np.linalg.norm(robot.model.gravity.linear))


def cop_margin(robot: Robot, scene: Scene, q: Array, sole_ground: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from the nearest of its own edges.

    q (k, nq); sole_ground (k, soles, 6) about the world's origin [N, N m]. Negative outside, which only a
    sole that is held can be; nan where the sole bears no load.
    """
    model, data = robot.model, robot.model.createData()
    out = np.full(sole_ground.shape[:2], np.nan)
    frames = [model.getFrameId(name) for name in scene.soles]
    wrenches = np.empty_like(sole_ground)
    for k, posture in enumerate(q if frames else ()):
        pin.forwardKinematics(model, data, posture)
        for i, frame in enumerate(frames):
            place = pin.updateFramePlacement(model, data, frame)
            # in the sole's own frame, so that a tilted sole's edges are its edges
            wrenches[k, i] = place.actInv(pin.Force(sole_ground[k, i])).vector
    for i, corners in enumerate(scene.corners):
        out[:, i] = distance_inside(corners, centre_of_pressure(wrenches[:, i]))
    out[sole_ground[:, :, 2] < BEARS * weight_of(robot)] = np.nan
    return out
