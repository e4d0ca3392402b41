"""Postures that reach a point at rest: soles in place, joints inside limits, the weight over the soles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import least_squares

from impactopt.kinematics.support import margin
from impactopt.kinematics.wrench_cone import inward_edges
from impactopt.robots.robot import Robot

__all__ = ["Reach", "reach"]

Array = NDArray[np.float64]
FARAWAY = 50.0  # [rad], [m] bound of what has none


class Reach(NamedTuple):
    """The posture (nq,) found; how far [m] its striking point is off, soles and all; how far [m] its centre
    of mass is outside the support polygon, < 0 inside."""

    q: Array
    off: float
    outside: float


def reach(
    robot: Robot,
    held: Sequence[tuple[str, object]],
    polygon: Array,
    striker: str,
    point: Array,
    guess: Array,
    *,
    lean: float = 0.0,
    joint_margin: float = 0.02,
) -> Reach:
    """The best posture near a guess (nq,) with the striking point at `point` (3,) [m].

    held : soles, each a frame and its pin.SE3 in the world.  polygon : (k, 2) that the centre of mass is to
    be above, (0, 2): none is asked for.  lean [m] : how far outside it may be.  joint_margin [rad] : inside
    the limits.
    """
    model, data = robot.model, robot.model.createData()
    fid = model.getFrameId(f"striker:{striker}")
    frames = [(model.getFrameId(frame), placement) for frame, placement in held]
    base = robot.nv - robot.n
    inward, offset = inward_edges(polygon) if len(polygon) else (np.zeros((0, 2)), np.zeros(0))

    def errors(step: Array) -> Array:
        q = pin.integrate(model, guess, step)
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacements(model, data)
        rows = [pin.log6(data.oMf[f].actInv(placement)).vector for f, placement in frames]
        centre = np.array(pin.centerOfMass(model, data, q))[:2]
        rows += [point - data.oMf[fid].translation, np.maximum(offset - lean - inward @ centre, 0.0)]
        return np.concatenate([*rows, 1e-4 * step])

    angles = robot.joint_positions(guess)
    slack = np.minimum(joint_margin, (robot.upper - robot.lower) / 4)
    lower, upper = np.full(robot.nv, -FARAWAY), np.full(robot.nv, FARAWAY)
    upper[base:] = np.minimum(robot.upper - slack - angles, FARAWAY)
    lower[base:] = np.minimum(np.maximum(robot.lower + slack - angles, -FARAWAY), upper[base:] - 1e-9)
    start = np.clip(np.zeros(robot.nv), lower, upper)
    found = least_squares(errors, start, bounds=(lower, upper), xtol=1e-10, ftol=1e-12, max_nfev=80)
    q, off = pin.integrate(model, guess, found.x), np.abs(errors(found.x)[: 6 * len(frames) + 3]).max()
    outside = -np.inf
    if len(polygon):
        centre = np.array(pin.centerOfMass(model, data, q))
        outside = -float(margin(polygon, centre[None, :2])[0])
    return Reach(q, float(off), outside)
