"""The feed-forward torque that lets a held robot move on as it does."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError
from impactopt.kinematics.stance import Stance, usual_stance
from impactopt.robots.robot import Robot

__all__ = ["holding_torque"]


def holding_torque(
    robot: Robot, q: ArrayLike, v: ArrayLike | None = None, *, stance: Stance | None = None
) -> NDArray[np.float64]:
    """Torque (n) [N m] that keeps all velocities as they are, on a stance.

    The least-norm solution (tau, lambda) of S' tau + J_c' lambda = c + g at q (nq), v (nv; None: at rest).

    Raises
    ------
    InputError : wrong shapes or NaN; a stance the robot cannot take.
    """
    q = robot.check_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.check_velocity(v)
    held_by = usual_stance(robot) if stance is None else stance
    model, data = robot.model, robot.model.createData()
    bias = pin.nonLinearEffects(model, data, q, v)
    if not np.all(np.isfinite(bias)):
        raise InputError("q, v: the forces of this motion are no finite numbers; give smaller ones")
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    columns = [np.eye(robot.nv)[:, -robot.n :]]
    for frame in held_by.constraint_frames(robot):
        J = pin.getFrameJacobian(model, data, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)
        columns.append(J.T)
    found = np.linalg.lstsq(np.hstack(columns), bias, rcond=None)[0]
    return np.array(found[: robot.n])
