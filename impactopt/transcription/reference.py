"""References completed from independent coordinates: legs, torques and what the ground bears."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem

__all__ = ["complete_reference", "total_ground_wrench"]

Array = NDArray[np.float64]


def complete_reference(
    problem: ImpactProblem, y: Array, yd: Array, ydd: Array, wrench: Array, legs: Array
) -> tuple[Array, ...]:
    """Rows of q (nq), v (nv), a (nv), torque (n) [N m] and ground wrench (6).

    y, yd, ydd (k, ny) are independent coordinates, rates and second rates. wrench (k, 6 a sole) is corrected
    as little as it takes to balance the base and hinges of soles; legs (nl,) starts their inverse kinematics.
    """
    c, robot = problem.coordinates, problem.robot
    model, data = robot.model, robot.model.createData()
    n = len(y)
    q, v, a = np.zeros((n, model.nq)), np.zeros((n, model.nv)), np.zeros((n, model.nv))
    torque, ground = np.zeros((n, robot.n)), np.zeros((n, 6))
    # least correction of the interpolated wrenches, moments dear: the soles share the load as planned
    scale = np.array([1, 1, 1, 10, 10, 10] * len(c.legs))
    places = [leg.placement for leg in c.legs if leg.sole is not None]
    for k, leg in enumerate(c.closing.follow(y, legs)):
        q[k], v[k], a[k], jac = c.closing.motion(y[k], yd[k], ydd[k], leg)
        tau = np.array(pin.rnea(model, data, q[k], v[k], a[k]))
        if c.legs:
            base = jac[:, c.undriven].T / scale
            miss = tau[c.undriven] - jac[:, c.undriven].T @ wrench[k]
            w = wrench[k] + base.T @ np.linalg.solve(base @ base.T, miss) / scale
            tau = tau - jac.T @ w
            ground[k] = _about_origin(places, w)
        torque[k] = tau[c.base :]
    return q, v, a, torque, ground


def _about_origin(placements: list[pin.SE3], wrenches: Array) -> Array:
    """Sum of sole wrenches (each in its sole's frame) as one wrench about the world's origin, world axes."""
    total = np.zeros(6)
    for k, m in enumerate(placements):
        total += m.act(pin.Force(wrenches[6 * k : 6 * k + 6])).vector
    return total


def total_ground_wrench(coordinates: StanceCoordinates, wrenches: Array) -> Array:
    """(k, 6) ground wrenches about the world's origin of (k, 6 a sole) sole wrenches.

    The soles are where they are held. What hands hold on to is not the ground.
    """
    placements = [leg.placement for leg in coordinates.legs if leg.sole is not None]
    return np.array([_about_origin(placements, w) for w in wrenches])
