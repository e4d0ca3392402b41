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
    guesses: Sequence[Array],
    *,
    joint_margin: float = 0.02,
) -> Reach:
    """The best posture near some guesses (nq,) with the striking point at `point` (3,) [m].

    held : soles, each a frame and its pin.SE3 in the world.  polygon : (k, 2) that the centre of mass is to
    be above, (0, 2): none is asked for.  joint_margin [rad] : inside the limits.
    """
    model, data = robot.model, robot.model.createData()
    fid = model.getFrameId(f"striker:{striker}")
    frames = [(model.getFrameId(frame), placement) for frame, placement in held]
    base = robot.nv - robot.n
    inward, offset = inward_edges(polygon) if len(polygon) else (np.zeros((0, 2)), np.zeros(0))
    best: Reach | None = None

    for guess in guesses:
        angles = robot.joint_positions(guess)
        slack = np.minimum(joint_margin, (robot.upper - robot.lower) / 4)
        low = np.maximum(robot.lower + slack - angles, -FARAWAY)
        high = np.minimum(robot.upper - slack - angles, FARAWAY)
        lower, upper = np.full(robot.nv, -FARAWAY), np.full(robot.nv, FARAWAY)
        lower[base:], upper[base:] = np.minimum(low, high - 1e-9), high

        def errors(step: Array, guess: Array = guess) -> Array:
            q = pin.integrate(model, guess, step)
            pin.forwardKinematics(model, data, q)
            pin.updateFramePlacements(model, data)
            rows = [pin.log6(data.oMf[f].actInv(placement)).vector for f, placement in frames]
            centre = np.array(pin.centerOfMass(model, data, q))[:2]
            rows += [point - data.oMf[fid].translation, np.maximum(offset - inward @ centre, 0.0)]
            return np.concatenate([*rows, 1e-4 * step])

        start = np.clip(np.zeros(robot.nv), lower, upper)
        found = least_squares(errors, start, bounds=(lower, upper), xtol=1e-10, ftol=1e-12, max_nfev=80)
        q, rest = pin.integrate(model, guess, found.x), errors(found.x)
        holds = 6 * len(frames) + 3
        outside = -np.inf
        if len(polygon):
            pin.centerOfMass(model, data, q)
            outside = -float(margin(polygon, np.array(data.com[0])[None, :2])[0])
        this = Reach(q, float(np.abs(rest[:holds]).max()), outside)
        if best is None or _badness(this) < _badness(best):
            best = this
    assert best is not None
    return best


def _badness(reach: Reach) -> float:
    return reach.off + max(reach.outside, 0.0)
