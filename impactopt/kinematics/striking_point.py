"""The point of the robot that strikes: symbolic, and where it is at a configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

if TYPE_CHECKING:
    from impactopt.kinematics.coordinates import StanceCoordinates
    from impactopt.robots.robot import Robot

__all__ = ["striker_kinematics", "striking_point"]


def striker_kinematics(c: StanceCoordinates, striker: str) -> Any:
    """CasADi function (q, v, a) -> point [m], velocity [m/s], acceleration [m/s^2] of the striking point.

    World axes.
    """
    rb, frame = c.rb, f"striker:{striker}"
    _, point = rb.frame(frame)
    outs = [point, rb.frame_velocity(frame, rb.v)[:3], rb.frame_acceleration(frame, rb.v, rb.a)[:3]]
    return ca.Function("striker", [rb.q, rb.v, rb.a], outs)


def striking_point(robot: Robot, striker: str, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Its place (3,) [m] in the world, at a configuration (nq,)."""
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array(data.oMf[model.getFrameId(robot.striker(striker).model_frame)].translation)
