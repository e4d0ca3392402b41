"""How long a step of an explicit method may be, to be stable."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.model import JointSpaceModel
from impactopt.collision.runge_kutta import rate_of_change

__all__ = ["longest_stable_step", "slope_function"]

Array = NDArray[np.float64]

# the classical Runge-Kutta method and Taylor's of order six are both stable for decaying modes with |rate|
# h up to this
_LIMIT = 2.6


def slope_function(model: JointSpaceModel) -> Any:
    """ca.Function (y, *data) -> the Jacobian of dy/dt."""
    y, data = ca.SX.sym("y", model.n_states), model.symbols()
    rate = rate_of_change(model, y, model.velocity_change(y, data), data)
    return ca.Function("slope", [y, *data.values()], [ca.jacobian(rate, y)])


def longest_stable_step(model: JointSpaceModel, slope: Any, data: dict[str, Any]) -> float:
    """[s] beyond which a step is unstable, with no joint saturated and friction in its transition band."""
    worst = dict(data)
    for name in {"feedforward", "joint_velocity"} & {*model.data}:
        worst[name] = np.zeros(model.n)
    y, rates = model.start(), [1e-12]
    y[model.layout["penetration"]] = 1e-3
    for worst["hand_speed"] in (1.0, -1.0):  # compression, restitution
        for y[model.layout["target"]] in (0.0, 1e-3):  # a target that sticks hides how fast it can move
            matrix = np.array(slope(y, *[worst[name] for name in model.data]))
            rates.append(float(np.abs(np.linalg.eigvals(matrix)).max()))
    return _LIMIT / max(rates)
