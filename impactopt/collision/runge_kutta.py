"""Steps 3b to 7b of the paper as fixed steps of the classical Runge-Kutta method, as in its section III.

Phases are judged anew in each of the four stages, so a step across an event is of second order only.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from impactopt.collision.model import JointSpaceModel

__all__ = ["LEFT_OUT_BY_RK4", "rate_of_change", "rk4_step"]

# of |f_2 - f_3| h, of the force at both of a step's middles, summed over steps, what is left out of the
# impulse: where the force changes by x of itself within a step, half of x^2, as kinks cost
LEFT_OUT_BY_RK4 = 2.0


def rk4_step(model: JointSpaceModel, length: float) -> Any:
    """ca.Function step(y, *data) -> y `length` [s] later; y itself after separation."""
    y, data, u = ca.SX.sym("y", model.n_states), model.small_symbols(), ca.SX.sym("u", model.n)
    rate = ca.Function("rate", [y, *data.values(), u], [rate_of_change(model, y, u, data)])
    time = model.longest(y, data, length) * model.running(y, data)
    step_length = ca.Function("step_length", [y, *data.values()], [time])
    Y, D = ca.MX.sym("y", model.n_states), model.symbols(ca.MX)
    small = [D[name] for name in data]

    def slope(state: Any) -> Any:
        return rate(state, *small, model.velocity_change(state, D))

    h = step_length(Y, *small)
    k1 = slope(Y)
    k2 = slope(Y + h / 2 * k1)
    k3 = slope(Y + h / 2 * k2)
    k4 = slope(Y + h * k3)
    y_next = Y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    if model.peak:
        peak = model.layout["peak"]
        largest = ca.fmax(Y[peak], ca.if_else(h > 0, model.part(k1, "impulse"), 0.0))
        y_next = ca.vertcat(y_next[: peak.start], largest, y_next[peak.stop :])
    if model.error:
        more = LEFT_OUT_BY_RK4 * ca.fabs(model.part(k2, "impulse") - model.part(k3, "impulse")) * h
        y_next += ca.vertcat(
            *[more if i == model.layout["left_out"].start else 0.0 for i in range(model.n_states)]
        )
    return ca.Function("step", [Y, *D.values()], [y_next], ["y", *D], ["y_next"])


def rate_of_change(model: JointSpaceModel, y: Any, u: Any, data: dict[str, Any]) -> Any:
    """dy/dt, with every phase judged at y; u is the change of the joint velocities at y."""
    rate = model.rate(y, data)
    force = model.law.force(model.part(y, "penetration"), rate, model.law_numbers(data))
    tau = model.saturate(model.with_feedforward(model.servo(y, u, data), data), data)
    if model.effects.friction:
        tau = tau - model.friction(u, data)
    target = model.target.derivative(model.target_state(y), force, model.target_numbers(data))
    rates = {
        "time": 1.0,
        "penetration": rate,
        "impulse": force,
        "target": ca.vertcat(*target),
        "peak": 0.0,
        "left_out": 0.0,
        "torque": tau,
        "deviation": -u,
    }
    if model.second_integrals:
        rates |= {"torque2": model.part(y, "torque"), "impulse2": model.part(y, "impulse")}
    return model.join(rates)
