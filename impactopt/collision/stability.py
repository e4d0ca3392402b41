"""How long a step of an explicit method may be, to be stable."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.checks import check_frozen
from impactopt.collision.graph import frozen_dynamics, joint_space_model
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.runge_kutta import rate_of_change
from impactopt.collision.stepped import SteppedModel

__all__ = ["Stability", "longest_stable_step", "slope_function"]

Array = NDArray[np.float64]

# the classical Runge-Kutta method is stable for decaying modes with |rate| h up to this
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


class Stability:
    """How long a model's steps may be, with what it takes to freeze it kept."""

    def __init__(self, collision: SteppedModel) -> None:
        self._collision, self._model = collision, joint_space_model(collision)

    @cached_property
    def _freeze(self) -> Any:
        names = ("A", "s", "m") if self._collision.n_servos else ("m",)
        return frozen_dynamics(self._collision).function("frozen", (*names, "pivots", "freedom"))

    @cached_property
    def _slope(self) -> Any:
        return slope_function(self._model)

    def frozen(self, q: Array, values: dict[str, Array]) -> dict[str, Array]:
        """What is frozen at q (nq), by name; InputError where rounding spoils it."""
        function = self._freeze
        at_rest = np.zeros(self._collision.robot.nv)
        found = function.call([ca.DM(x) for x in (q, at_rest, values["normal"], 0.0)])
        frozen = {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
        check_frozen(frozen)
        return frozen

    def longest(self, frozen: dict[str, Array], values: dict[str, Array]) -> float:
        """[s], of what is frozen and the settings' values."""
        data: dict[str, Any] = frozen | values
        if self._collision.terms.bias or self._collision.terms.jdot:
            data |= {"d": np.zeros(self._collision.robot.n), "e": 0.0}
        return longest_stable_step(self._model, self._slope, data)
