"""How long a step of an explicit method may be, to be stable."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.model import JointSpaceModel
from impactopt.collision.runge_kutta import rate_of_change

__all__ = ["longest_stable_step", "slope_function", "unstable_rows"]

Array = NDArray[np.float64]

# the classical Runge-Kutta method and Taylor's of order six are both stable for decaying modes with |rate|
# h up to this
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
