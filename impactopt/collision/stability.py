"""Longest stable step of an explicit method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.checks import check_frozen, spoiled
from impactopt.collision.graph import frozen_dynamics, joint_space_model
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.runge_kutta import rate_of_change
from impactopt.collision.stepped import SteppedModel

__all__ = ["Stability", "longest_stable_step", "slope_function", "unstable_rows"]

Array = NDArray[np.float64]

# the classical Runge-Kutta method is stable for decaying modes with |rate| h up to this
_LIMIT = 2.6
_BALANCED = 4  # times, before a matrix has its norm taken


def slope_function(model: JointSpaceModel) -> Any:
    """ca.Function (y, *data) -> the Jacobian of dy/dt."""
    y, data = ca.SX.sym("y", model.n_states), model.symbols()
    rate = rate_of_change(model, y, model.velocity_change(y, data), data)
    return ca.Function("slope", [y, *data.values()], [ca.jacobian(rate, y)])


def longest_stable_step(model: JointSpaceModel, slope: Any, data: dict[str, Any]) -> float:
    """[s] beyond which a step is unstable, with no joint saturated and friction in its transition band."""
    rates = [1e-12]
    for y, worst in _worst(model, data):
        matrix = np.array(slope(y, *[worst[name] for name in model.data]))
        rates.append(float(np.abs(np.linalg.eigvals(matrix)).max()))
    return _LIMIT / max(rates)


def _worst(model: JointSpaceModel, data: dict[str, Any]) -> Iterator[tuple[Array, dict[str, Any]]]:
    """States that bound the rates, with the data there."""
    worst = dict(data)
    for name in {"feedforward", "joint_velocity"} & {*model.data}:
        worst[name] = np.zeros(model.n)
    y = model.start()
    y[model.layout["penetration"]] = 1e-3
    for worst["hand_speed"] in (1.0, -1.0):  # compression, restitution
        for y[model.layout["target"]] in (0.0, 1e-3):  # a target that sticks hides how fast it can move
            yield y, worst


def unstable_rows(model: JointSpaceModel, slope: Any, data: dict[str, Array], step: float) -> Any:
    """(N) whether a step [s] is unstable, of data with a first axis of N or 1, else as of
    `longest_stable_step`.

    Eigenvalues take longer than a collision, and most rows are far from their limit: those get a bound, the
    norm of the balanced matrix.
    """
    count, limit = max(len(x) for x in data.values()), _LIMIT / step
    many, size = slope.map(count), model.n_states
    found = np.zeros(count, dtype=bool)

    def wide(name: str, x: Any) -> Array:
        """Rows' matrices side by side, as CasADi has them; one for all, or a number, as often."""
        shape, given = model.data[name], np.asarray(x, dtype=float)
        own = x is data.get(name)  # what is not is one for all, a number or a vector
        rows = given.reshape(len(given) if own else 1, *(shape if given.size > 1 or own else (1, 1)))
        rows = np.broadcast_to(rows, (count, *shape))
        return np.moveaxis(rows, 0, 1).reshape(shape[0], -1)

    for y, worst in _worst(model, data):
        slopes = np.array(many(y, *[wide(name, worst[name]) for name in model.data]))
        slopes = slopes.reshape(size, count, size).swapaxes(0, 1)
        close = np.flatnonzero(~(_bound(slopes) < limit))
        known = np.isfinite(slopes[close]).all(axis=(1, 2))
        found[close[~known]] = True
        rates = np.abs(np.linalg.eigvals(slopes[close[known]])).max(axis=-1)
        found[close[known]] |= rates >= limit
    return found


def _bound(matrices: Array) -> Array:
    """(N) that no eigenvalue of matrices (N, k, k) is above."""
    a = np.abs(matrices)
    scale = np.ones(a.shape[:2])
    for _ in range(_BALANCED):
        scaled = a * scale[:, :, None] / scale[:, None, :]
        rows, columns = scaled.sum(axis=2), scaled.sum(axis=1)
        both = (rows > 0) & (columns > 0)
        scale *= np.sqrt(np.where(both, columns, 1.0) / np.where(both, rows, 1.0))
    scaled = a * scale[:, :, None] / scale[:, None, :]
    bound: Array = np.minimum(scaled.sum(axis=2).max(axis=1), scaled.sum(axis=1).max(axis=1))
    return bound


class Stability:
    """Stable step lengths of a model, with its freezing functions cached."""

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
        """Frozen quantities at q (nq), by name; InputError if rounding spoils them."""
        function = self._freeze
        at_rest = np.zeros(self._collision.robot.nv)
        found = function.call([ca.DM(x) for x in (q, at_rest, values["normal"], np.zeros(2))])
        frozen = {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
        check_frozen(frozen)
        return frozen

    def longest(self, frozen: dict[str, Array], values: dict[str, Array]) -> float:
        """[s], of what is frozen and the settings' values."""
        data: dict[str, Any] = frozen | values
        if self._collision.effects.bias or self._collision.effects.jdot:
            data |= {"d": np.zeros(self._collision.robot.n), "e": 0.0}
        return longest_stable_step(self._model, self._slope, data)

    def unstable(self, given: Mapping[str, Array]) -> NDArray[np.bool_]:
        """(N) rows of a batch that the model's steps are unstable of, or that rounding spoils; inputs by name
        have a first axis of N or 1."""
        collision, count = self._collision, len(given["q"])
        inputs = (given["q"], np.zeros((1, collision.robot.nv)), given["normal"], np.zeros((1, 2)))
        columns = [np.broadcast_to(x, (count, x.shape[1])).T for x in inputs]
        found = self._freeze.map(count).call([ca.DM(x) for x in columns])
        frozen = {name: np.array(x).T for name, x in zip(self._freeze.name_out(), found, strict=True)}
        data: dict[str, Any] = frozen | {name: given[name] for name in collision.settings}
        if collision.effects.bias or collision.effects.jdot:
            data |= {"d": np.zeros((1, collision.robot.n)), "e": np.zeros((1, 1))}
        own = {name: x for name, x in data.items() if name in self._model.data}
        step = collision.step_length
        return np.asarray(unstable_rows(self._model, self._slope, own, step) | spoiled(frozen))
