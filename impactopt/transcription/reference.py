"""References completed from independent coordinates: legs, torques and what the ground bears."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.sole_margins import BEARS, weight_of

__all__ = ["Completed", "complete_reference", "total_ground_wrench"]

Array = NDArray[np.float64]
MOMENT_COST = 10.0  # [1/m] of a correction of moments against one of forces


class Completed(NamedTuple):
    """Rows of q (k, nq), v and a (k, nv), torque (k, n) [N m], ground wrench (k, 6) about the world's origin,
    and wrenches (k, 6 a sole, 6 a hand) in the soles' and hands' own frames [N, N m].
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    ground: Array
    sole_wrench: Array


def complete_reference(
    problem: ImpactProblem, y: Array, yd: Array, ydd: Array, wrench: Array, legs: Array
) -> Completed:
    """Full motion, torques and wrenches of a motion in independent coordinates.

    y, yd, ydd (k, ny) are independent coordinates, rates and second rates. wrench (k, 6 a sole) is corrected
    to balance the base and hinges of soles, by as little as it takes: each sole takes its part of what is
    lacking by the load that it bears, so that one that bears little keeps its centre of pressure. legs (nl,)
    starts their inverse kinematics.
    """
    c, robot = problem.coordinates, problem.robot
    model, data = robot.model, robot.model.createData()
    n = len(y)
    q, v, a = np.zeros((n, model.nq)), np.zeros((n, model.nv)), np.zeros((n, model.nv))
    torque, corrected = np.zeros((n, robot.n)), np.zeros((n, 6 * len(c.legs)))
    cost = _correction_costs(c, wrench, BEARS * weight_of(robot))
    for k, leg in enumerate(c.closing.follow(y, legs)):
        q[k], v[k], a[k], jac = c.closing.motion(y[k], yd[k], ydd[k], leg)
        tau = np.array(pin.rnea(model, data, q[k], v[k], a[k]))
        if c.legs:
            # least |cost dw|^2 with B' dw = miss: dw = C^-2 B (B' C^-2 B)^-1 miss, base = B' C^-1
            base = jac[:, c.undriven].T / cost[k]
            miss = tau[c.undriven] - jac[:, c.undriven].T @ wrench[k]
            corrected[k] = wrench[k] + base.T @ np.linalg.solve(base @ base.T, miss) / cost[k]
            tau = tau - jac.T @ corrected[k]
        torque[k] = tau[c.base :]
    return Completed(q, v, a, torque, total_ground_wrench(c, corrected), corrected)


def _correction_costs(c: StanceCoordinates, wrench: Array, least: float) -> Array:
    """(k, 6 a sole, 6 a hand) Weights of a correction's components, whose squares are minimized.

    A correction is shared as the load is: what minimizes the sum of d_i^2 / load_i. ``least`` [N] is the load
    that a sole counts for at least. A hand that holds on counts for a sole of mean load.
    """
    standing = np.array([leg.sole is not None for leg in c.legs], dtype=bool)
    load = np.maximum(wrench[:, 2::6], least)
    load[:, ~standing] = load[:, standing].mean(axis=1, keepdims=True) if standing.any() else least
    six = np.array([1.0, 1.0, 1.0, MOMENT_COST, MOMENT_COST, MOMENT_COST])
    return np.asarray((six / np.sqrt(load)[:, :, None]).reshape(len(wrench), -1))


def total_ground_wrench(coordinates: StanceCoordinates, wrenches: Array) -> Array:
    """(k, 6) ground wrenches about the world's origin of (k, 6 a sole) sole wrenches.

    The soles are where they are held. What hands hold on to is not the ground.
    """
    placements = [leg.placement for leg in coordinates.legs if leg.sole is not None]
    total = np.zeros((len(wrenches), 6))
    for k, place in enumerate(placements):
        # the dual action: wrenches to the world's axes and origin
        total += wrenches[:, 6 * k : 6 * k + 6] @ place.toDualActionMatrix().T
    return total
