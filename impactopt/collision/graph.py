"""Expression graph of a collision, from configuration and velocity at contact to its outputs and gradient.

Effects and outputs are selected when the function is built; others cost nothing.

Steps are those of the classical Runge-Kutta method (paper, steps 3b to 7b and section III). Each of its four
stages evaluates the phase of contact by itself, so a step across an event is of second order only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import casadi as ca

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.model import JointSpaceModel, Loop, SegmentedCollision, shape_of
from impactopt.collision.outputs import HISTORIES, OF_SOLES, Outputs, frozen_for
from impactopt.collision.stepped import SteppedModel, number_of_steps
from impactopt.contact import Target
from impactopt.errors import counted
from impactopt.robots.rigid_body import RigidBody

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
    rate = ca.Function("rate", [y, *data.values(), u], [model.rate_of_change(y, u, data)])
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


# largest number of implicit steps, which choose their own length
MOST_STEPS = 5000


def joint_space_model(
    collision: SteppedModel, outputs: tuple[str, ...] = (), *, freezes: int = 0
) -> JointSpaceModel:
    """Model that the time loop integrates, with the states that these outputs need."""
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
        slides=collision.contact_friction is not None,
        moves_target=collision.moves_target,
        refrozen=freezes > 0,
        horizon=collision.horizon,
    )


def frozen_dynamics(collision: SteppedModel) -> FrozenDynamics:
    """Frozen dynamics of a collision model (paper, steps 1b and 2b)."""
    frame = collision.robot.striker(collision.striker).model_frame
    effects = collision.effects
    return FrozenDynamics(collision.robot, collision.held_by, frame, bias=effects.bias, jdot=effects.jdot)


def target_start(target: Target, numbers: dict[str, Any]) -> Any:
    """Inverse mass [1/kg] and normal speed [m/s] of the target's surface at first contact (2), MX.

    The inverse mass is the acceleration of the surface per contact force.
    """
    z, f = ca.SX.sym("z", target.n_states), ca.SX.sym("f")
    symbols = {name: ca.SX.sym(name) for name in numbers}
    states = [z[i] for i in range(target.n_states)]
    rates = ca.vertcat(ca.SX(0, 1), *target.derivative(states, f, symbols))
    acceleration = ca.mtimes(ca.jacobian(ca.SX(target.velocity(states, symbols)), z), rates)
    # d(dv/dt)/df = (dv/dz) d(dz/dt)/df, by the chain rule
    slope = ca.densify(ca.jacobian(acceleration, f))
    start = ca.vertcat(slope, ca.densify(ca.SX(target.velocity(states, symbols))))
    function = ca.Function("target_start", [z, f, *symbols.values()], [start])
    return function(ca.DM.zeros(target.n_states), 0.0, *numbers.values())


def columns_of(collision: SteppedModel, fraction: float, every: int) -> int:
    """Number of instants of the histories in a fraction of the horizon, with implicit steps."""
    # without the 1e-9, rounding of a whole quotient would add a column
    return ceil(fraction * collision.horizon / (every * collision.step_length) - 1e-9) + 1


def collision_graph(
    collision: SteppedModel, outputs: tuple[str, ...], *, every: int = 1, as_compiled: bool = False
) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> outputs, differentiable, not compiled.

    as_compiled : with implicit steps if the compiled function has them; then it has no derivatives.
    """
    implicit = as_compiled and collision.stepping == "implicit"
    inputs, out = _expressions(collision, outputs, every, implicit=implicit)
    return ca.Function("collision", list(inputs.values()), out, list(inputs), list(outputs))


def gradient_graph(collision: SteppedModel, output: str) -> Any:
    """ca.Function (q, v[, feedforward], *settings) -> (output, d/dq (nv), d/dv (nv)), in the basis of v."""
    inputs, (value,) = _expressions(collision, (output,), 1)
    rb = RigidBody(collision.robot.model)
    tangent = ca.Function("tangent", [rb.q], [rb.tangent_map()])
    # one adjoint sweep for both
    ((by_q, by_v),) = ca.reverse([value], [inputs["q"], inputs["v"]], [[ca.MX(1.0)]])
    by_q = ca.mtimes(tangent(inputs["q"]).T, by_q)
    names = [output, f"{output}_by_q", f"{output}_by_v"]
    return ca.Function("collision_gradient", list(inputs.values()), [value, by_q, by_v], list(inputs), names)


def _expressions(
    collision: SteppedModel, outputs: tuple[str, ...], every: int, *, implicit: bool = False
) -> tuple[dict[str, Any], list[Any]]:
    """Inputs by name, and outputs, MX."""
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    frozen = frozen_dynamics(collision)
    inputs = {"q": frozen.q, "v": frozen.v}
    if collision.effects.feedforward:
        inputs["feedforward"] = ca.MX.sym("feedforward", collision.robot.n)
    inputs |= {key: ca.MX.sym(key, *shape_of(value)) for key, value in collision.settings.items()}
    inputs["normal"] = frozen.normal
    record = every if any(output in HISTORIES for output in outputs) else 0
    segmented = SegmentedCollision(
        model,
        frozen,
        loop=(_adaptive if implicit else _explicit)(collision, model, record),
        horizon=collision.horizon,
        freezes=collision.n_freezes,
        names=_frozen_names(collision, model, outputs),
    )
    segments = segmented.run(inputs, target_start(model.target, model.target_numbers(inputs)))
    made = Outputs(model, segments, len(frozen.soles), len(frozen.held), inputs["v"])
    return inputs, [ca.densify(getattr(made, output)) for output in outputs]


def _explicit(collision: SteppedModel, model: JointSpaceModel, every: int) -> Loop:
    """Time loop of Runge-Kutta steps as a graph. It records every `every`-th state and the last; 0: none."""
    step = rk4_step(model, collision.step_of_graph)

    def loop(start: Any, fraction: float, data: Sequence[Any], record: bool) -> tuple[Any, Any]:
        steps = number_of_steps(collision, fraction)
        final, states = run(model, step, start, steps, data, record=record and every > 0)
        if states is not None and every > 1:
            last = states.size2() - 1
            states = states[:, [*range(0, last, every), last]]
        return final, states

    return loop


def _adaptive(collision: SteppedModel, model: JointSpaceModel, every: int) -> Loop:
    """Time loop without a compiler in the place of implicit steps."""
    # SciPy's integrators take a while to import, and are needed without a compiler only
    from impactopt.collision.adaptive import AdaptiveLoop

    def loop(start: Any, fraction: float, data: Sequence[Any], record: bool) -> tuple[Any, Any]:
        recorded = record and every > 0
        function = AdaptiveLoop(
            model,
            tolerance=collision.tolerance,
            spacing=max(every, 1) * collision.step_length,
            columns=columns_of(collision, fraction, every) if recorded else 1,
        )
        final, states = function(start, *data)
        return final, states if recorded else None

    return loop


# description of each effect, and when it may be left out
_EFFECTS = {
    "stiffness": "the servo's stiffness (eq. 10): it matters little in contacts of a few milliseconds",
    "feedforward": "the feed-forward torque: it is zero, or no saturation depends on it",
    "saturation": "the torque limits (eq. 12): no joint reaches its limit, or the plan's constraints exclude "
    "it",
    "friction": "joint friction (eq. 5): its parameters are unknown, or small",
    "bias": "Coriolis, centrifugal and gravity terms (eq. 6): small beside the impact",
    "jdot": "the Jacobians' rates (eq. 14): small beside the impact",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Description:
    """Contents of a collision function, as text by str(), and as data by `as_dict`.

    Attributes
    ----------
    contents : what the function includes, by name: plain numbers, text, lists and mappings.
    left_out : what it omits, and why.
    """

    contents: Mapping[str, Any]
    left_out: Mapping[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Contents and omissions, for JSON."""
        return {**self.contents, "left_out": dict(self.left_out)}

    def __str__(self) -> str:
        lines = [f"{name.replace('_', ' ')}: {_words(value)}" for name, value in self.contents.items()]
        return "\n".join([*lines, "left out:", *(f"  {what}: {why}" for what, why in self.left_out.items())])


def describe(
    collision: SteppedModel, outputs: tuple[str, ...], parameters: tuple[str, ...] = ()
) -> Description:
    """Description of `SteppedModel.function` for these outputs; see `SteppedModel.describe`."""
    robot, held_by, settings = collision.robot, collision.held_by, collision.settings
    by = f"{max(held_by.compliance):g} per kg" if any(held_by.compliance) else "exactly"
    effects = [name for name in _EFFECTS if getattr(collision.effects, name)]
    effects = ["damping", *effects] if collision.n_servos else []
    effects += ["friction at the hit"] if collision.contact_friction is not None else []
    contents: dict[str, Any] = {
        "robot": robot.name,
        "joints": robot.n,
        "velocities": robot.nv,
        "striker": collision.striker,
        "held": list(held_by.constraint_frames(robot)),
        "held_how": by if held_by.constraint_frames(robot) else "fixed base",
        "effects": effects,
        "law": type(collision.law).__name__,
        "target": type(collision.target).__name__,
        "outputs": list(outputs),
        "method": collision.stepping,
        **_steps(collision),
        "horizon_s": collision.horizon,
        "freezes": 1 + collision.n_freezes,
        "inputs": ["q", "v", *(["feedforward"] if collision.effects.feedforward else []), *parameters],
        "fixed_numbers": [name for name in settings if name not in parameters],
        "instructions": instructions(collision, outputs),
    }
    return Description(contents=contents, left_out=_left_out(collision, outputs))


def _frozen_names(
    collision: SteppedModel, model: JointSpaceModel, outputs: tuple[str, ...]
) -> tuple[str, ...]:
    """Attributes of FrozenDynamics that a collision with these outputs needs."""
    # each freeze is at a configuration and velocity of the whole robot, which that output needs
    wanted = (*outputs, "velocity") if collision.n_freezes else outputs
    return tuple(dict.fromkeys((*model.frozen, *frozen_for(wanted, slides=model.slides))))


def instructions(collision: SteppedModel, outputs: tuple[str, ...]) -> dict[str, int]:
    """Scalar instructions, counted by CasADi, of one freeze and of one Runge-Kutta step of the graph.

    The handwritten C has the same freeze. Its implicit step costs twice as much as the Runge-Kutta step, or
    six times as much with a nonlinear law or target.
    """
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    freeze = frozen_dynamics(collision).function("frozen", _frozen_names(collision, model, outputs))
    step = rk4_step(model, collision.step_of_graph)
    return {"freeze": int(freeze.expand().n_instructions()), "step": int(step.expand().n_instructions())}


def _steps(collision: SteppedModel) -> dict[str, float]:
    if collision.stepping == "implicit":
        return {"tolerance": collision.tolerance, "histories_every_s": collision.step_length}
    return {"step_s": collision.step_length, "most_steps": number_of_steps(collision)}


def independent_joints(collision: SteppedModel) -> list[str]:
    """Joints that can be locked without any effect on the collision.

    On a fixed base without couplings, these are the joints of limbs that share no joint with the striking
    point's. H has no entries between the two, nor have gains that are one number a joint.
    """
    robot = collision.robot
    gains = [value for name, value in collision.settings.items() if name in ("kp", "kd")]
    if robot.floating or robot.couplings or any(gain.ndim == 2 for gain in gains):
        return []
    model = robot.model
    frame = model.getFrameId(robot.striker(collision.striker).model_frame)
    striking = {int(j) for j in model.supports[model.frames[frame].parentJoint]} - {0}
    independent = (j for j in range(1, model.njoints) if not striking & {int(i) for i in model.supports[j]})
    return [str(model.names[j]) for j in independent]


def _left_out(collision: SteppedModel, outputs: tuple[str, ...]) -> dict[str, str]:
    robot, held_by = collision.robot, collision.held_by
    out: dict[str, str] = {}
    if not collision.n_servos:
        out["servo"] = "a point mass has none"
    else:
        out |= {
            name: f"{what} (effects.{name} is off)"
            for name, what in _EFFECTS.items()
            if not getattr(collision.effects, name)
        }
    wanted = {*outputs}
    if not held_by.soles(robot):
        out["wrenches and ZMP"] = "nothing holds the robot" if robot.floating else "the base is fixed"
    elif not wanted & {*OF_SOLES}:
        out["wrenches and ZMP"] = "not requested"
    elif not wanted & {"ground_wrench", "zmp"}:
        out["ZMP"] = "not requested"
    free = [sole.name for sole in robot.soles if sole not in held_by.soles(robot)] if robot.floating else []
    if free:
        out["fixed soles"] = f"{', '.join(free)}: not fixed by the stance"
    if not wanted & {*HISTORIES}:
        out["histories"] = "not requested"
    if "peak_force" not in wanted:
        out["peak force"] = "not requested"
    if "configuration" not in wanted and not collision.n_freezes:
        out["second integrals"] = "no configuration requested, no further freezes"
    if not wanted & {"configuration", "velocity"}:
        out["motion of the whole robot"] = "not requested"
    if collision.contact_friction is None:
        out["friction at the hit"] = "not given (contact_friction)"
    out["derivatives"] = "in `gradient_function`, and in `graph`"
    if independent := independent_joints(collision):
        out["nothing yet"] = (
            f"{counted(len(independent), 'joint shares', 'joints share')} none with the striking point's "
            f"limb, and could be locked without any change: {', '.join(independent)}"
        )
    return out


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {x}" for name, x in value.items())
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)
