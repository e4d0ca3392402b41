"""Fixed steps of the classical Runge-Kutta method (paper, steps 3b to 7b and section III).

Each of the four stages evaluates the phase of contact by itself, so a step across an event is of second order
only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from impactopt.collision.model import JointSpaceModel

# steps in a block; a block is skipped if the contact is over before it begins
BLOCK = 16


def run(
    model: JointSpaceModel, step: Any, start: Any, steps: int, data: Sequence[Any], *, record: bool
) -> tuple[Any, Any]:
    """Final state, and with `record` the states at all steps (n_states, steps + 1), else None, MX.

    The number of steps is rounded up to whole blocks. After the end of contact the states repeat the last
    one.
    """
    advance = _skippable_block(model, step, record)
    symbol, symbols = ca.SX.sym("y", model.n_states), model.small_symbols()
    running = ca.Function("running", [symbol, *symbols.values()], [model.running(symbol, symbols)])
    small = [x for x, name in zip(data, model.data, strict=True) if name != "A"]
    y = ca.MX(start)
    history = [y]
    for _ in range(-(-steps // BLOCK)):
        out = advance.call([running(y, *small), y, *data])
        y = out[0]
        history += out[1:]
    return y, ca.horzcat(*history) if record else None


def _skippable_block(model: JointSpaceModel, step: Any, record: bool) -> Any:
    """ca.Function (flag, y, *data) -> state after `BLOCK` steps[, all states]; y[, copies] if flag is 0."""
    y, data = ca.MX.sym("y", model.n_states), list(model.symbols(ca.MX).values())
    states = [y]
    for _ in range(BLOCK):
        states.append(step(states[-1], *data))
    steps, copies = [states[-1], ca.horzcat(*states[1:])], [y, ca.repmat(y, 1, BLOCK)]
    block = ca.Function("block", [y, *data], steps[: 1 + record])
    return ca.Function.if_else("advance", block, ca.Function("still", [y, *data], copies[: 1 + record]))


# Error estimate of the impulse: this times |f_2 - f_3| h, summed over steps, of the forces f_2 and f_3 at the
# two midpoint stages. If the force changes by the fraction x within a step, it is half of x^2, as much as a
# kink costs. Friction is included: it oscillates from stage to stage if steps are too long for a sticking
# point.
LEFT_OUT_BY_RK4 = 2.0


def rk4_step(model: JointSpaceModel, length: float) -> Any:
    """ca.Function (y, *data) -> state `length` [s] later; after separation y itself."""
    y, data, u = ca.SX.sym("y", model.n_states), model.small_symbols(), ca.SX.sym("u", model.n)
    rate = ca.Function("rate", [y, *data.values(), u], [rate_of_change(model, y, u, data)])
    # A step of length zero leaves the state as it is: so the number of steps can be constant.
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
        # the force at the step's start is the slope of the impulse there
        largest = ca.fmax(Y[peak], ca.if_else(h > 0, model.part(k1, "impulse"), 0.0))
        y_next = ca.vertcat(y_next[: peak.start], largest, y_next[peak.stop :])
    if model.error:
        names = ("impulse", *(("sliding",) if model.slides else ()))
        apart = ca.vertcat(*[model.part(k2, name) - model.part(k3, name) for name in names])
        more = LEFT_OUT_BY_RK4 * ca.norm_1(apart) * h
        y_next += ca.vertcat(
            *[more if i == model.layout["left_out"].start else 0.0 for i in range(model.n_states)]
        )
    return ca.Function("step", [Y, *D.values()], [y_next], ["y", *D], ["y_next"])


def rate_of_change(model: JointSpaceModel, y: Any, u: Any, data: dict[str, Any]) -> Any:
    """Time derivative dy/dt in the phase at y; u is the change of the joint velocities at y."""
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
        # `rk4_step` updates these two, which are no integrals
        "peak": 0.0,
        "left_out": 0.0,
        "torque": tau,
        "deviation": -u,
    }
    if model.slides:
        velocity, deflection = model.point_velocity(y, data), model.deflection(y)
        rates["sliding"], rates["bristles"] = model.friction_on_target(velocity, force, deflection, data)
    if model.second_integrals:
        once = ("torque", "impulse", *(("sliding",) if model.slides else ()))
        rates |= {f"{name}2": model.part(y, name) for name in once}
    return model.join(rates)
