"""From configuration and velocity at contact to a collision's outputs: the whole graph, and its gradient."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING, Any

import casadi as ca

from ..rigid_body import RigidBody
from .frozen import FrozenDynamics
from .loop import run
from .model import JointSpaceModel
from .outputs import HISTORIES, Outputs, frozen_for
from .runge_kutta import rk4_step
from .taylor import taylor_step

if TYPE_CHECKING:
    from .sdc import SDC

__all__ = [
    "METHODS",
    "collision_graph",
    "frozen_dynamics",
    "gradient_graph",
    "joint_space_model",
    "number_of_steps",
]

METHODS = {"events": taylor_step, "rk4": rk4_step}


def joint_space_model(sdc: SDC, outputs: tuple[str, ...] = ()) -> JointSpaceModel:
    """The collision in joint space, with what the outputs need in its state."""
    return JointSpaceModel(
        n=sdc.robot.n,
        terms=sdc.terms,
        law=sdc.law,
        target=sdc.target,
        settings=sdc.settings,
        transition=sdc.joint_friction.transition,
        peak="peak_force" in outputs,
        second_integrals="displacement" in outputs,
    )


def frozen_dynamics(sdc: SDC) -> FrozenDynamics:
    """Steps 1b and 2b."""
    frame = sdc.robot.striker(sdc.striker).model_frame
    return FrozenDynamics(sdc.robot, sdc.held_by, frame, bias=sdc.terms.bias, jdot=sdc.terms.jdot)


def number_of_steps(sdc: SDC) -> int:
    """Steps that reach the horizon; where they end on events, with two events a joint on the way."""
    steps = ceil(sdc.horizon / sdc.step - 1e-9)
    return steps + (2 * sdc.robot.n + 4 if sdc.method == "events" else 0)


def collision_graph(sdc: SDC, outputs: tuple[str, ...], *, every: int = 1) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> outputs, differentiable, not compiled."""
    inputs, out = _expressions(sdc, outputs, every)
    return ca.Function("collision", list(inputs.values()), out, list(inputs), list(outputs))


def gradient_graph(sdc: SDC, output: str) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> (output, d/dq (nv), d/dv (nv)), both in v's basis."""
    inputs, (value,) = _expressions(sdc, (output,), 1)
    rb = RigidBody(sdc.robot.model)
    tangent = ca.Function("tangent", [rb.q], [rb.tangent_map()])
    # one sweep for both
    ((by_q, by_v),) = ca.reverse([value], [inputs["q"], inputs["v"]], [[ca.MX(1.0)]])
    by_q = ca.mtimes(tangent(inputs["q"]).T, by_q)
    names = [output, f"{output}_by_q", f"{output}_by_v"]
    return ca.Function("collision_gradient", list(inputs.values()), [value, by_q, by_v], list(inputs), names)


def _expressions(sdc: SDC, outputs: tuple[str, ...], every: int) -> tuple[dict[str, Any], list[Any]]:
    """Inputs by name, and the outputs, MX."""
    model, frozen = joint_space_model(sdc, outputs), frozen_dynamics(sdc)
    inputs = {"q": frozen.q, "v": frozen.v}
    if sdc.terms.feedforward:
        inputs["feedforward"] = ca.MX.sym("feedforward", sdc.robot.n)
    inputs |= {key: ca.MX.sym(key, max(1, value.size)) for key, value in sdc.settings.items()}
    inputs["normal"] = frozen.normal
    wanted = tuple(dict.fromkeys((*model.frozen, *frozen_for(outputs))))
    values = frozen.function("frozen", wanted).call([frozen.q, frozen.v, frozen.normal])
    data = dict(zip(wanted, values, strict=True)) | inputs
    step = METHODS[sdc.method](model, sdc.step)
    record = any(output in HISTORIES for output in outputs)
    constants = [data[key] for key in model.data]
    final, states = run(model, step, number_of_steps(sdc), constants, record=record)
    if record and every > 1:
        last = states.size2() - 1
        states = states[:, [*range(0, last, every), last]]
    made = Outputs(model, data, final, states, len(frozen.soles), frozen.velocity_change, frozen.v)
    return inputs, [getattr(made, output) for output in outputs]
