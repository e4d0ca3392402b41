"""Inverse dynamics of a robot by Pinocchio, with the springs of its joints, which a `pin.Model` has not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

__all__ = ["generalized_gravity", "inverse_dynamics", "nonlinear_effects"]

Array = NDArray[np.float64]


def inverse_dynamics(robot: Robot, data: Any, q: Array, v: Array, a: Array) -> Array:
    """Forces (nv,) [N, N m] of a motion q (nq), v, a (nv): `pin.rnea` and the springs' torques."""
    return _sprung(robot, q, pin.rnea(robot.model, data, q, v, a))


def nonlinear_effects(robot: Robot, data: Any, q: Array, v: Array) -> Array:
    """Forces (nv,) [N, N m] without acceleration: `pin.nonLinearEffects` and the springs' torques."""
    return _sprung(robot, q, pin.nonLinearEffects(robot.model, data, q, v))


def generalized_gravity(robot: Robot, data: Any, q: Array) -> Array:
    """Forces (nv,) [N, N m] at rest: `pin.computeGeneralizedGravity` and the springs' torques."""
    return _sprung(robot, q, pin.computeGeneralizedGravity(robot.model, data, q))


def _sprung(robot: Robot, q: Array, forces: Any) -> Array:
    out = np.array(forces)
    if robot.springs:
        out[robot.nv - robot.n :] += robot.spring_torque(q)
    return out
