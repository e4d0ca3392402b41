"""What a collision model can give, each built only when asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca

from ..errors import InputError, did_you_mean
from .model import JointSpaceModel

__all__ = ["HISTORIES", "OF_SOLES", "OUTPUTS", "SCALARS", "Outputs", "check_outputs", "frozen_for"]

# name: what it is
OUTPUTS = {
    "impulse": "[N s] delivered to the target",
    "peak_force": "[N] largest contact force at the steps",
    "duration": "[s] from contact to separation",
    "energy": "[J] given to the target",
    "separated": "1 where the contact ended within the horizon, else 0",
    "velocity": "(nv) after the collision, Pinocchio's v",
    "displacement": "(nv) integral of v over the collision: q after it is pin.integrate(q, displacement)",
    "time": "(k) [s] since contact",
    "force": "(k) [N] on the target along the normal",
    "penetration": "(k) [m] of the contact law",
    "hand_speed": "(k) [m/s] of the striking point along the normal",
    "target_speed": "(k) [m/s] of the target along the normal",
    "joint_velocity": "(n, k) [rad/s]",
    "torque": "(n, k) [N m] of the servo",
    "demand": "(n, k) [N m] of the servo before saturation",
    "sole_wrench": "(6 a held sole, k) [N, N m] of the ground on each sole, world axes, at the sole's frame",
    "ground_wrench": "(6, k) [N, N m] of the ground on the robot, world axes, about the world's origin",
    "zmp": "(2, k) [m] x and y of the zero-moment point on the ground z = 0",
}
SCALARS = ("impulse", "peak_force", "duration", "energy", "separated")
HISTORIES = tuple(OUTPUTS)[tuple(OUTPUTS).index("time") :]
OF_SOLES = ("sole_wrench", "ground_wrench", "zmp")


def check_outputs(names: tuple[str, ...]) -> None:
    """InputError for an output that there is not."""
    for name in names:
        if name not in OUTPUTS:
            raise InputError(
                f"no output {name!r}{did_you_mean(name, OUTPUTS)}; there are {', '.join(OUTPUTS)}"
            )


def frozen_for(names: tuple[str, ...]) -> tuple[str, ...]:
    """Attributes of FrozenDynamics that these outputs need besides what the model does."""
    wrench = {*OF_SOLES, "velocity", "displacement"} & {*names}
    whole = {"ground_wrench", "zmp"} & {*names}
    return (("L_tau", "L_f", "L_0") if wrench else ()) + (
        ("sole_positions", "unmodelled_wrench") if whole else ()
    )


class Outputs:
    """Expressions (MX) of a collision's outputs.

    Parameters
    ----------
    model : the collision in joint space.
    data : its data by name, and the outputs of FrozenDynamics that `frozen_for` asks for.
    final, states : last state (n_states), and states at all wanted instants (n_states, k) or None.
    soles : number of held soles.
    velocity_change : function (torque, force, sole wrenches, time) -> change of v or position.
    v : velocity at contact (nv).
    """

    def __init__(
        self,
        model: JointSpaceModel,
        data: dict[str, Any],
        final: Any,
        states: Any,
        soles: int,
        velocity_change: Callable[..., Any],
        v: Any,
    ) -> None:
        self._model, self._data, self._final, self._states = model, data, final, states
        self._n_soles, self._velocity_change, self._v = soles, velocity_change, v

    # ------------------------------------------------------------ over the collision
    @cached_property
    def impulse(self) -> Any:
        return self._model.part(self._final, "impulse")

    @cached_property
    def peak_force(self) -> Any:
        return self._model.part(self._final, "peak")

    @cached_property
    def duration(self) -> Any:
        return self._model.part(self._final, "time")

    @cached_property
    def energy(self) -> Any:
        numbers = self._model.target_numbers(self._data)
        energies = [
            self._model.target.energy(self._model.target_state(y), numbers)
            for y in (self._final, ca.DM(self._model.start()))
        ]
        return energies[0] - energies[1]

    @cached_property
    def separated(self) -> Any:
        return 1 - self._model.phase(self._final, self._data)[1]

    @cached_property
    def velocity(self) -> Any:
        return self._v + self._change("torque", "impulse", self.duration)

    @cached_property
    def displacement(self) -> Any:
        return self._v * self.duration + self._change("torque2", "impulse2", self.duration**2 / 2)

    def _change(self, torque: str, impulse: str, time: Any) -> Any:
        tau, f = self._model.part(self._final, torque), self._model.part(self._final, impulse)
        return self._velocity_change(tau, f, self._wrench(tau, f, time), time)

    # ------------------------------------------------------------ at the steps
    def _row(self, name: str) -> Any:
        return self._model.part(self._states, name)

    @cached_property
    def time(self) -> Any:
        return self._row("time").T

    @cached_property
    def penetration(self) -> Any:
        return self._row("penetration").T

    @cached_property
    def _force(self) -> Any:
        model = self._model
        x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
        numbers = {name: ca.SX.sym(name) for name in model.law.parameters}
        law = ca.Function("force", [x, rate, *numbers.values()], [model.law.force(x, rate, numbers)])
        rates = model.rate(self._states, self._data)
        columns = self._states.size2()
        values = [ca.repmat(value, 1, columns) for value in model.law_numbers(self._data).values()]
        return law.map(columns)(self._row("penetration"), rates, *values)

    @cached_property
    def force(self) -> Any:
        return self._force.T

    @cached_property
    def hand_speed(self) -> Any:
        return (self._model.hand_speed_change(self._states, self._data) + self._data["hand_speed"]).T

    @cached_property
    def target_speed(self) -> Any:
        model = self._model
        return model.target.velocity(model.target_state(self._states), model.target_numbers(self._data)).T

    @cached_property
    def _joint_change(self) -> Any:
        return self._model.velocity_change(self._states, self._data)

    @cached_property
    def joint_velocity(self) -> Any:
        change = self._joint_change
        return ca.repmat(self._v[-self._model.n :], 1, change.size2()) + change

    @cached_property
    def demand(self) -> Any:
        servo = self._model.servo(self._states, self._joint_change, self._data)
        return self._model.with_feedforward(servo, self._data)

    @cached_property
    def torque(self) -> Any:
        return self._model.saturate(self.demand, self._data)

    # ------------------------------------------------------------ ground
    def _wrench(self, torque: Any, force: Any, time: Any) -> Any:
        """Sole wrenches for torques (n, k), forces (1, k) and drift's weight (1, k); or their integrals."""
        data = self._data
        return ca.mtimes(data["L_tau"], torque) - ca.mtimes(data["L_f"], force) + ca.mtimes(data["L_0"], time)

    @cached_property
    def sole_wrench(self) -> Any:
        torque = self.torque
        if self._model.terms.friction:
            torque = torque - self._model.friction(self._joint_change, self._data)
        return self._wrench(torque, self._force, ca.DM.ones(1, torque.size2()))

    @cached_property
    def ground_wrench(self) -> Any:
        total = ca.repmat(self._data["unmodelled_wrench"], 1, self._states.size2())
        for i in range(self._n_soles):
            wrench = self.sole_wrench[6 * i : 6 * i + 6, :]
            arm = ca.skew(self._data["sole_positions"][:, i])
            total = total + ca.vertcat(wrench[:3, :], wrench[3:, :] + ca.mtimes(arm, wrench[:3, :]))
        return total

    @cached_property
    def zmp(self) -> Any:
        w = self.ground_wrench
        return ca.vertcat(-w[4, :] / w[2, :], w[3, :] / w[2, :])
