"""How long a step of an explicit method may be, to be stable and to be accurate."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .model import JointSpaceModel
from .runge_kutta import rate_of_change

__all__ = ["contact_rate", "longest_stable_step", "servo_modes", "slope_function", "step_error"]

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


def contact_rate(model: JointSpaceModel, slope: Any, data: dict[str, Any], x: Array, rate: Array) -> float:
    """[1/s] the fastest mode of hand and target alone, at the penetrations and rates that were reached.

    model, slope, data : of the point mass; other joints' servos only make the hand heavier.
    """
    fastest, y, worst = 0.0, model.start(), dict(data)
    for place in {*np.linspace(0, x.size - 1, 9).astype(int), int(np.argmax(x))}:
        y[model.layout["penetration"]] = max(x[place], 0.0)
        for y[model.layout["target"]] in (0.0, 1e-3):
            worst["hand_speed"] = rate[place] + float(
                np.asarray(
                    model.target.velocity(model.target_state(y[:, None]), model.target.parameters)
                ).sum()
            )
            matrix = np.array(slope(y, *[worst[name] for name in model.data]))
            fastest = max(fastest, float(np.abs(np.linalg.eigvals(matrix)).max()))
    return fastest


def servo_modes(data: dict[str, Array], step: float) -> tuple[Array, Array]:
    """(rates [1/s], shares) of the servo's modes; a share is what of the hand's mobility goes with its mode.

    A mode that cannot be followed within the step spoils no more than its share of the hand's motion.
    """
    n = data["s"].size
    A = np.zeros((n, n))
    A[np.triu_indices(n)] = data["A"].ravel()  # its lower triangle by columns is its upper one by rows
    A = A + np.triu(A, 1).T
    gains = [np.diag(data[k]) if k in data and data[k].ndim == 2 else data.get(k, 0.0) for k in ("kd", "kp")]
    # what the spring adds within one step acts as a damper
    root = np.sqrt(np.maximum(gains[0] + step * gains[1], 0.0))
    rates, vectors = np.linalg.eigh(root[:, None] * A * root)
    rates = np.maximum(rates, 1e-12)
    shares = (vectors.T @ (root * data["s"].ravel())) ** 2 / rates / data["m"].item()
    return rates, shares


def step_error(method: str, step: float, contact: float, rates: Array, shares: Array) -> float:
    """Relative error of the impulse that steps of this length [s] may make, as an estimate from above.

    contact : [1/s], see `contact_rate`; rates, shares : see `servo_modes`.

    With x the contact's rate times the step, "events" leave the first term that Taylor's polynomials lack,
    x^7 / 7!, in each of the some pi / x steps of a contact; and of each servo mode the same, where it counts:
    within one step the contact force changes by x of what it becomes, and so does the hand's speed. "rk4"
    meets events within its steps, whose kinks cost x^2 / 2.
    """
    x = contact * step
    if method == "rk4":
        return 0.5 * x**2
    servo = float((np.minimum(shares, 1.0) * (rates * step) ** 7).sum())
    return (np.pi * x**6 + x**2 * servo) / 5040.0
