"""The effective ("virtual") mass of a robot at its striking point."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from impactopt.codegen.cache import cached, model_hash
from impactopt.collision.frozen import FrozenDynamics
from impactopt.errors import check_direction
from impactopt.kinematics.stance import Stance, usual_stance
from impactopt.robots.robot import Robot

__all__ = ["effective_mass"]


def effective_mass(robot: Robot, *, striker: str, normal: ArrayLike, stance: Stance | None = None) -> Any:
    """Compiled ca.Function q (nq) -> 1 / (n' J P J' n) [kg], the mass that the target meets at first.

    P is the inverse inertia of the robot as held by `stance` (None: all soles, or the fixed base); free
    joints, no servo. The paper calls it virtual mass (its section III, after Asada and Ogawa, and Khatib).

    Raises
    ------
    InputError : an unknown striker; a normal that is not a unit vector; a stance the robot cannot take.
    """
    frame = robot.striker(striker).model_frame
    n = check_direction("normal", normal)
    held_by = usual_stance(robot) if stance is None else stance

    def build() -> list[Any]:
        frozen = FrozenDynamics(robot, held_by, frame, bias=False, jdot=False)
        m = frozen.function("frozen", ("m",))(frozen.q, np.zeros(robot.nv), n, 0.0)
        return [ca.Function("effective_mass", [frozen.q], [1.0 / m], ["q"], ["mass"])]

    recipe = (model_hash(robot.model), frame, repr(held_by), held_by.constraint_frames(robot), tuple(n))
    return cached("effective_mass", recipe, build)["effective_mass"]
