"""Outputs of a collision model, each built only on request."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi as ca

from impactopt.collision.model import JointSpaceModel, Segment
from impactopt.errors import InputError, check_choice

# description of each output
OUTPUTS = {
    "impulse": "[N s] delivered to the target",
    "peak_force": "[N] largest contact force; of 'rk4' at the steps",
    "duration": "[s] from contact to separation",
    "energy": "[J] given to the target",
    "step_error": "estimated relative error of the impulse by the steps of 'rk4'",
    "separated": "1 if the contact ended within the horizon, else 0",
    "velocity": "(nv) after the collision, Pinocchio's v",
    "configuration": "(nq) after the collision, Pinocchio's q",
    "target_result": "the target's `results` at separation",
    "tangential_velocity": "(3) [m/s] across the normal after the collision, of a target that friction moves",
    "time": "(k) [s] since contact",
    "force": "(k) [N] on the target along the normal",
    "penetration": "(k) [m] of the contact law",
    "hand_speed": "(k) [m/s] of the striking point along the normal",
    "target_speed": "(k) [m/s] of the target along the normal",
    "joint_velocity": "(n, k) [rad/s]",
    "torque": "(n, k) [N m] of the servo",
    "demand": "(n, k) [N m] of the servo before saturation",
    "sole_wrench": "(6 a held sole, k) [N, N m] of the ground on each sole, world axes, at the sole's frame",
    "hand_wrench": "(6 a held hand, k) [N, N m] of the world on each, world axes, at its striking point",
    "ground_wrench": "(6, k) [N, N m] of the ground on the robot, world axes, about the world's origin",
    "zmp": "(2, k) [m] x and y of the zero-moment point on the ground z = 0",
}
SCALARS = ("impulse", "peak_force", "duration", "energy", "step_error", "separated")
HISTORIES = tuple(OUTPUTS)[tuple(OUTPUTS).index("time") :]
OF_SOLES = ("sole_wrench", "ground_wrench", "zmp")
# outputs that a point mass and a rigid impact do not have
OF_SERVO = ("joint_velocity", "torque", "demand", "hand_wrench", *OF_SOLES)


def check_outputs(names: Sequence[str]) -> None:
    """InputError for an unknown output, or for a name in place of a tuple of names."""
    if isinstance(names, str):
        raise InputError(f"outputs: give a tuple of names, ({names!r},), not {names!r}")
    for name in names:
        check_choice("no output", name, OUTPUTS)


def check_jacobian(names: tuple[str, ...], method: str, freezes: int) -> None:
    """InputError for outputs or models without compiled Jacobians."""
    for name in names:
        if name not in (*SCALARS, *HISTORIES):
            raise InputError(f"Jacobian of {name!r}: only of {', '.join((*SCALARS, *HISTORIES))}")
    instead = "differentiate what `graph` gives by ca.jacobian instead"
    if method != "implicit":
        raise InputError(f"jacobian_function: only of method 'implicit', not of {method!r}; or {instead}")
    if freezes:
        raise InputError(f"jacobian_function: only without further freezes; give freezes=0, or {instead}")


def frozen_for(names: tuple[str, ...], *, slides: bool = False) -> tuple[str, ...]:
    """Attributes of FrozenDynamics that these outputs need, besides those of the model.

    With further freezes a collision also needs those of "velocity". slides : with friction at the striking
    point.
    """
    motion = {"velocity", "configuration"} & {*names}
    wrench = {*OF_SOLES, "hand_wrench"} & {*names}
    whole = {"ground_wrench", "zmp"} & {*names}
    return (
        (("L_tau", "L_f", "L_0", *(("L_point",) if slides else ())) if motion or wrench else ())
        + (("drift_velocity",) if motion else ())
        + (("sole_positions", "unmodelled_wrench") if whole else ())
    )


class Outputs:
    """Expressions (MX) of a collision's outputs.

    Parameters
    ----------
    model : collision in joint space.
    segments : results of the integration, one a freeze.
    soles, held : number of fixed soles, and of all constrained frames, of which the soles are first.
    v : velocity at contact (nv).
    """

    def __init__(
        self,
        model: JointSpaceModel,
        segments: list[Segment],
        soles: int,
        held: int,
        v: Any,
    ) -> None:
        self._model, self._segments, self._last = model, segments, segments[-1]
        self._instants = [Instants(model, segment, soles, held, v) for segment in segments]

    def __getattr__(self, name: str) -> Any:
        # called for attributes that this class does not have: histories are those of all segments, side by
        # side
        if name not in HISTORIES:
            raise AttributeError(name)
        parts: list[Any] = []
        for segment, instants in zip(self._segments, self._instants, strict=True):
            own = getattr(instants, name)
            if parts:  # after separation, with another freeze, repeat the instant of separation
                own = ca.if_else(segment.contact, own, ca.repmat(parts[-1][:, -1], 1, own.size2()))
            parts.append(own)
        history = ca.horzcat(*parts)
        return history.T if history.size1() == 1 else history

    def _sum(self, part: str) -> Any:
        return sum(self._model.part(segment.final, part) for segment in self._segments)

    @cached_property
    def impulse(self) -> Any:
        return self._sum("impulse")

    @cached_property
    def peak_force(self) -> Any:
        return self._model.part(self._last.final, "peak")

    @cached_property
    def step_error(self) -> Any:
        left_out = self._model.part(self._last.final, "left_out")
        # without an impulse there is no error either: 0 / 1e-300
        return left_out / ca.fmax(self.impulse, 1e-300)

    @cached_property
    def duration(self) -> Any:
        return self._sum("time")

    def _target(self, y: Any) -> tuple[list[Any], dict[str, Any]]:
        return self._model.target_state(y), self._model.target_numbers(self._last.data)

    @cached_property
    def energy(self) -> Any:
        ends = (self._last.final, ca.DM(self._model.start()))
        energies = [self._model.target.energy(*self._target(y)) for y in ends]
        gained = ca.MX(energies[0] - energies[1])
        if not self._model.moves_target:
            return gained
        _, numbers = self._target(self._last.final)
        mass = self._model.target.tangential_mass(numbers)
        return gained + mass / 2 * ca.sumsqr(self.tangential_velocity)

    @property
    def tangential_velocity(self) -> Any:
        return self._last.tangential

    @cached_property
    def target_result(self) -> Any:
        return ca.vertcat(*self._model.target.result(*self._target(self._last.final)))

    @cached_property
    def separated(self) -> Any:
        # contact has ended at the end of some segment
        contact = ca.MX(1.0)
        for segment in self._segments:
            contact *= self._model.phase(segment.final, segment.data)[1]
        return 1 - contact

    @cached_property
    def velocity(self) -> Any:
        return self._last.v_after()

    @cached_property
    def configuration(self) -> Any:
        return self._last.q_after()


class Instants:
    """Histories within one segment, one instant a column."""

    def __init__(self, model: JointSpaceModel, segment: Segment, soles: int, held: int, v: Any) -> None:
        self._model, self._data, self._states = model, segment.data, segment.states
        self._since = segment.since
        self._n_soles, self._n_held, self._v = soles, held, v

    def _part(self, name: str) -> Any:
        return self._model.part(self._states, name)

    @cached_property
    def time(self) -> Any:
        return self._since + self._part("time")

    @cached_property
    def penetration(self) -> Any:
        return self._part("penetration")

    @cached_property
    def force(self) -> Any:
        model = self._model
        x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
        numbers = {name: ca.SX.sym(name) for name in model.law.parameters}
        # in SX and mapped, as laws are written for one instant
        law = ca.Function("force", [x, rate, *numbers.values()], [model.law.force(x, rate, numbers)])
        rates = model.rate(self._states, self._data)
        columns = self._states.size2()
        values = [ca.repmat(value, 1, columns) for value in model.law_numbers(self._data).values()]
        return law.map(columns)(self._part("penetration"), rates, *values)

    @cached_property
    def friction_on_target(self) -> Any:
        """Friction on the target (3, k) [N]."""
        model, velocity, force = self._model, ca.SX.sym("velocity", 3), ca.SX.sym("force")
        names = [name for name in model.data if name == "normal" or name.startswith("friction_")]
        data = {name: ca.SX.sym(name, *model.data[name]) for name in names}
        deflection = ca.SX.sym("deflection", 3 * model.bristles)
        found, _ = model.friction_on_target(velocity, force, deflection, data)
        function = ca.Function("friction", [velocity, force, deflection, *data.values()], [found])
        columns = self._states.size2()
        values = [ca.repmat(self._data[name], 1, columns) for name in names]
        velocities = model.point_velocity(self._states, self._data)
        return function.map(columns)(velocities, self.force, model.deflection(self._states), *values)

    @cached_property
    def hand_speed(self) -> Any:
        return self._model.hand_speed_change(self._states, self._data) + self._data["hand_speed"]

    @cached_property
    def target_speed(self) -> Any:
        model = self._model
        speed = model.target.velocity(model.target_state(self._states), model.target_numbers(self._data))
        return speed + ca.MX.zeros(1, self._states.size2())

    @cached_property
    def _joint_change(self) -> Any:
        return self._model.velocity_change(self._states, self._data)

    @cached_property
    def joint_velocity(self) -> Any:
        change = self._joint_change
        start = self._v[-self._model.n :] + self._data.get("reference_before", 0.0)
        velocity = ca.repmat(start, 1, change.size2()) + change
        if "reference_acceleration" not in self._data:
            return velocity
        return velocity + ca.mtimes(self._data["reference_acceleration"], self._part("time"))

    @cached_property
    def demand(self) -> Any:
        servo = self._model.servo(self._states, self._joint_change, self._data)
        return self._model.with_feedforward(servo, self._data)

    @cached_property
    def torque(self) -> Any:
        return self._model.saturate(self.demand, self._data)

    # ------------------------------------------------------------ ground
    @cached_property
    def _held_wrench(self) -> Any:
        """Wrenches on all constrained frames (c, k), L_tau (tau - F) - L_f f + L_0."""
        torque, data = self.torque, self._data
        if self._model.effects.friction:
            torque = torque - self._model.friction(self._joint_change, data)
        wrench = ca.mtimes(data["L_tau"], torque) - ca.mtimes(data["L_f"], self.force)
        wrench += ca.mtimes(data["L_0"], ca.DM.ones(1, torque.size2()))
        if not self._model.slides:
            return wrench
        return wrench - ca.mtimes(data["L_point"], self.friction_on_target)

    @cached_property
    def sole_wrench(self) -> Any:
        return self._held_wrench[: 6 * self._n_soles, :]

    @cached_property
    def hand_wrench(self) -> Any:
        return self._held_wrench[6 * self._n_soles :, :]

    @cached_property
    def ground_wrench(self) -> Any:
        total = ca.repmat(self._data["unmodelled_wrench"], 1, self._states.size2())
        for i in range(self._n_soles):
            wrench = self.sole_wrench[6 * i : 6 * i + 6, :]
            # moment about the world's origin: m + p x f
            arm = ca.skew(self._data["sole_positions"][:, i])
            total = total + ca.vertcat(wrench[:3, :], wrench[3:, :] + ca.mtimes(arm, wrench[:3, :]))
        return total

    @cached_property
    def zmp(self) -> Any:
        w = self.ground_wrench  # ZMP (-M_y, M_x) / F_z: paper, end of section II-B
        return ca.vertcat(-w[4, :] / w[2, :], w[3, :] / w[2, :])
