"""Torque that holds a robot at rest: the least share of its limits, whatever its constraints bear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import linprog

from impactopt.kinematics.held import frame_jacobians
from impactopt.robots.robot import Robot

__all__ = ["Holding", "least_holding_share"]

Array = NDArray[np.float64]


class Holding(NamedTuple):
    """Share of the limits, the joint (index) that is at it, and its torque [N m]."""

    share: float
    joint: int
    torque: float


def least_holding_share(robot: Robot, q: Array, frames: Sequence[str], limit: Array) -> Holding | None:
    """The least largest share of torque limits (n,) [N m] with which a robot is at rest in q (nq,).

    frames : of the model, held in all six directions. Their wrenches are free, also to pull: no stance needs
    less. Joints without motor are at rest by their springs. A linear program: min s with
    |tau_i| <= s limit_i and S' tau + J_c' lambda = g. None: it has no solution.
    """
    model, n = robot.model, robot.n
    gravity = np.array(pin.computeGeneralizedGravity(model, model.createData(), q))
    held = frame_jacobians(model, q, frames)
    scale = np.where(robot.passive, 1.0, limit)
    select = np.vstack([np.zeros((model.nv - n, n)), np.diag(scale)])
    equal = np.hstack([select, held.T, np.zeros((model.nv, 1))])
    driven = np.flatnonzero(~robot.passive)
    rows = np.zeros((2 * len(driven), equal.shape[1]))
    for k, joint in enumerate(driven):
        rows[2 * k, joint], rows[2 * k + 1, joint] = 1.0, -1.0
    rows[:, -1] = -1.0
    cost = np.zeros(equal.shape[1])
    cost[-1] = 1.0
    found = linprog(cost, rows, np.zeros(len(rows)), equal, gravity, bounds=(None, None), method="highs")
    if found.status != 0:
        return None
    shares = np.where(robot.passive, 0.0, np.abs(found.x[:n]))
    worst = int(np.argmax(shares))
    return Holding(float(found.fun), worst, float(shares[worst] * scale[worst]))
