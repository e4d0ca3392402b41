"""Expression graph of a collision, from configuration and velocity at contact to its outputs and gradient."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any

import casadi as ca

from impactopt.collision.course import Course, Loop
from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.implicit_numpy import implicit_loop
from impactopt.collision.loop import run
from impactopt.collision.model import JointSpaceModel, shape_of
from impactopt.collision.outputs import HISTORIES, Outputs, frozen_for
from impactopt.collision.runge_kutta import rk4_step
from impactopt.collision.stepped import SteppedModel, number_of_steps
from impactopt.contact import Target
from impactopt.robots.rigid_body import RigidBody

__all__ = [
    "MOST_STEPS",
    "collision_graph",
    "columns_of",
    "frozen_dynamics",
    "gradient_graph",
    "joint_space_model",
    "target_start",
]

# where steps find their own length
MOST_STEPS = 5000


def joint_space_model(
    collision: SteppedModel, outputs: tuple[str, ...] = (), *, freezes: int = 0
) -> JointSpaceModel:
    """Model that the time loop integrates for these outputs."""
    return JointSpaceModel(
        n=collision.n_servos,
        effects=collision.effects,
        law=collision.law,
        target=collision.target,
        settings=collision.settings,
        transition=collision.joint_friction.transition,
        peak="peak_force" in outputs,
        error="step_error" in outputs,
        second_integrals="configuration" in outputs or freezes > 0,
        refrozen=freezes > 0,
        horizon=collision.horizon,
    )


def frozen_dynamics(collision: SteppedModel) -> FrozenDynamics:
    """Steps 1b and 2b."""
    frame = collision.robot.striker(collision.striker).model_frame
    effects = collision.effects
    return FrozenDynamics(collision.robot, collision.held_by, frame, bias=effects.bias, jdot=effects.jdot)


def target_start(target: Target, numbers: dict[str, Any]) -> Any:
    """(2) of the target's surface where contact begins: acceleration per contact force [1/kg], which is one
    over a free mass; speed along the normal [m/s].
    """
    z, f = ca.SX.sym("z", target.n_states), ca.SX.sym("f")
    symbols = {name: ca.SX.sym(name) for name in numbers}
    states = [z[i] for i in range(target.n_states)]
    rates = ca.vertcat(ca.SX(0, 1), *target.derivative(states, f, symbols))
    acceleration = ca.mtimes(ca.jacobian(ca.SX(target.velocity(states, symbols)), z), rates)
    slope = ca.densify(ca.jacobian(acceleration, f))
    start = ca.vertcat(slope, ca.densify(ca.SX(target.velocity(states, symbols))))
    function = ca.Function("target_start", [z, f, *symbols.values()], [start])
    return function(ca.DM.zeros(target.n_states), 0.0, *numbers.values())


def columns_of(collision: SteppedModel, fraction: float, every: int) -> int:
    """Instants of the histories for a fraction of the horizon, where steps find their own length."""
    return ceil(fraction * collision.horizon / (every * collision.step_length) - 1e-9) + 1


def collision_graph(
    collision: SteppedModel, outputs: tuple[str, ...], *, every: int = 1, as_compiled: bool = False
) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> outputs, differentiable, not compiled.

    as_compiled : by implicit steps where the compiled function has them; then without derivatives.
    """
    implicit = as_compiled and collision.stepping == "implicit"
    inputs, out = _expressions(collision, outputs, every, implicit=implicit)
    return ca.Function("collision", list(inputs.values()), out, list(inputs), list(outputs))


def gradient_graph(collision: SteppedModel, output: str) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> (output, d/dq (nv), d/dv (nv)), both in v's basis."""
    inputs, (value,) = _expressions(collision, (output,), 1)
    rb = RigidBody(collision.robot.model)
    tangent = ca.Function("tangent", [rb.q], [rb.tangent_map()])
    # one sweep for both
    ((by_q, by_v),) = ca.reverse([value], [inputs["q"], inputs["v"]], [[ca.MX(1.0)]])
    by_q = ca.mtimes(tangent(inputs["q"]).T, by_q)
    names = [output, f"{output}_by_q", f"{output}_by_v"]
    return ca.Function("collision_gradient", list(inputs.values()), [value, by_q, by_v], list(inputs), names)


def _expressions(
    collision: SteppedModel, outputs: tuple[str, ...], every: int, *, implicit: bool = False
) -> tuple[dict[str, Any], list[Any]]:
    """Inputs by name, and the outputs, MX."""
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    frozen = frozen_dynamics(collision)
    inputs = {"q": frozen.q, "v": frozen.v}
    if collision.effects.feedforward:
        inputs["feedforward"] = ca.MX.sym("feedforward", collision.robot.n)
    inputs |= {key: ca.MX.sym(key, *shape_of(value)) for key, value in collision.settings.items()}
    inputs["normal"] = frozen.normal
    record = every if any(output in HISTORIES for output in outputs) else 0
    course = Course(
        model,
        frozen,
        loop=(_implicit if implicit else _explicit)(collision, model, record),
        horizon=collision.horizon,
        freezes=collision.n_freezes,
        wanted=frozen_for(outputs),
    )
    gives_way = target_start(model.target, model.target_numbers(inputs))
    segments = course.run(inputs, gives_way)
    made = Outputs(model, segments, len(frozen.soles), len(frozen.held), inputs["v"])
    return inputs, [ca.densify(getattr(made, output)) for output in outputs]


def _explicit(collision: SteppedModel, model: JointSpaceModel, every: int) -> Loop:
    """The time loop as a graph; `every`: keep every so many of the states, and the last; 0: none."""
    step = rk4_step(model, collision.step_of_graph)

    def loop(start: Any, fraction: float, data: Sequence[Any], record: bool) -> tuple[Any, Any]:
        steps = number_of_steps(collision, fraction)
        final, states = run(model, step, start, steps, data, record=record and every > 0)
        if states is not None and every > 1:
            last = states.size2() - 1
            states = states[:, [*range(0, last, every), last]]
        return final, states

    return loop


def _implicit(collision: SteppedModel, model: JointSpaceModel, every: int) -> Loop:
    """The time loop as a call of NumPy."""

    def loop(start: Any, fraction: float, data: Sequence[Any], record: bool) -> tuple[Any, Any]:
        wanted = record and every > 0
        function = implicit_loop(
            model,
            tolerance=collision.tolerance,
            most_steps=MOST_STEPS,
            spacing=max(every, 1) * collision.step_length,
            columns=columns_of(collision, fraction, every) if wanted else 1,
        )
        final, states = function(start, *data)
        return final, states if wanted else None

    return loop
