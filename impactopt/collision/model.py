"""The collision in joint space: its state, and the forces in it, at one instant (paper, eqs. 9-12, 15-17)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.effects import Effects
from impactopt.collision.settings import Settings
from impactopt.contact import ContactLaw, Target

__all__ = ["JointSpaceModel", "shape_of"]

_SOON = 1e-9  # [s] in which a target gains the speed that shows its acceleration


@dataclass(frozen=True, kw_only=True)
class JointSpaceModel:
    """Contact dynamics of hand and target with the robot's frozen dynamics.

    Its state y holds time integrals since the freeze, so that what is linear in them (momentum, work of
    constraints) is kept exactly by any Runge-Kutta or Taylor method:

        time [s]; penetration [m]; impulse [N s] = integral of f; target's state; and, where they are asked
        for or needed, peak force [N], what steps left out [N s], torque (n) [N m s] = integral of tau - F,
        deviation (n) [rad] = phi_ref - phi, torque2 (n), impulse2: second integrals.

    Attributes
    ----------
    n : number of joints; 0 for a point mass.
    effects, law, target, settings : as in `SDC`.
    transition : [rad/s], of the joint friction.
    peak : keep the largest force in the state.
    error : keep in the state what the steps are estimated to leave out of the impulse, `left_out` [N s].
    second_integrals : keep torque2 and impulse2 in the state.
    refrozen : whether there are several freezes. Then `velocity_before` (n), the change of the joint velocity
        from contact to the freeze, and `until` [s], when the freeze ends, are among the data.
    horizon : [s] at which everything ends; several freezes have it in `until`.
    """

    n: int
    effects: Effects
    law: ContactLaw
    target: Target
    settings: Settings
    transition: float
    peak: bool = False
    error: bool = False
    second_integrals: bool = False
    refrozen: bool = False
    horizon: float = np.inf

    # ------------------------------------------------------------ layout of state and data
    @cached_property
    def layout(self) -> dict[str, slice]:
        """Slice of each part of the state."""
        sizes = {"time": 1, "penetration": 1, "impulse": 1, "target": self.target.n_states}
        if self.peak:
            sizes["peak"] = 1
        if self.error:
            sizes["left_out"] = 1
        sizes["torque"] = self.n
        if self.effects.stiffness:
            sizes["deviation"] = self.n
        if self.second_integrals:
            sizes |= {"torque2": self.n, "impulse2": 1}
        ends = np.cumsum(list(sizes.values()))
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @property
    def n_states(self) -> int:
        return max(part.stop for part in self.layout.values())

    @property
    def frozen(self) -> tuple[str, ...]:
        """Attributes of FrozenDynamics that the model needs."""
        names = ["A", "s"] if self.n else []
        names += ["m", "hand_speed"]
        if self.effects.bias or self.effects.jdot:
            names += ["d", "e"]
        return tuple(names)

    @cached_property
    def data(self) -> dict[str, tuple[int, int]]:
        """Names and shapes of what is constant during the collision."""
        n = self.n
        shapes = {"A": (n * (n + 1) // 2, 1), "m": (1, 1), "hand_speed": (1, 1), "e": (1, 1)}
        out = {name: shapes.get(name, (n, 1)) for name in self.frozen}
        if self.refrozen:
            out |= {"velocity_before": (n, 1), "until": (1, 1)}
        if self.effects.friction:
            out["joint_velocity"] = (n, 1)
        if self.effects.feedforward:
            out["feedforward"] = (n, 1)
        no_data = ("normal", "reference", "reference_until")
        return out | {name: shape_of(v) for name, v in self.settings.items() if name not in no_data}

    def symbols(self, kind: Any = ca.SX) -> dict[str, Any]:
        """A symbol for each of the data."""
        return {name: kind.sym(name, *shape) for name, shape in self.data.items()}

    def small_symbols(self) -> dict[str, Any]:
        """An SX symbol for each of the data but A."""
        return {name: ca.SX.sym(name, *shape) for name, shape in self.data.items() if name != "A"}

    def start(self) -> NDArray[np.float64]:
        """The state at contact."""
        return np.zeros(self.n_states)

    def part(self, y: Any, name: str) -> Any:
        """One part of the state; columns of y are different instants."""
        return y[self.layout[name], :]

    def join(self, parts: dict[str, Any]) -> Any:
        """The state (or a derivative of it) from its parts."""
        return ca.vertcat(*[parts[name] for name in self.layout])

    # ------------------------------------------------------------ numbers of law and target
    def law_numbers(self, data: dict[str, Any]) -> dict[str, Any]:
        return {name: data[f"contact_{name}"] for name in self.law.parameters}

    def target_numbers(self, data: dict[str, Any]) -> dict[str, Any]:
        return {name: data[f"target_{name}"] for name in self.target.parameters}

    # ------------------------------------------------------------ one instant, or several: one a column of y
    def velocity_change(self, y: Any, data: dict[str, Any]) -> Any:
        """Joint velocities less those of the servo's reference (n) [rad/s]: integral of eq. (9). It keeps
        those at contact, unless d is relative to another (course.py)."""
        u = self.velocity_from(self.part(y, "torque"), self.part(y, "impulse"), self.part(y, "time"), data)
        return u + _spread(data["velocity_before"], u) if self.refrozen else u

    def velocity_from(self, torque: Any, impulse: Any, time: Any, data: dict[str, Any]) -> Any:
        """Joint velocities less those at the freeze, from the state's parts that they depend on. Linear."""
        if not self.n:
            return ca.mtimes(ca.DM(0, 1), impulse)
        u = self._product(data["A"], torque) - ca.mtimes(data["s"], impulse)
        return u + ca.mtimes(data["d"], time) if "d" in data else u

    def _product(self, lower: Any, columns: Any) -> Any:
        """A times columns, from A's lower triangle."""
        if columns.size2() > 1:
            A = ca.tril2symm(type(lower)(ca.Sparsity.lower(self.n), lower))
            return ca.mtimes(A, columns)
        return self._product_function(lower, columns)

    @cached_property
    def _product_function(self) -> Any:
        """A times a vector: as straight-line code of its own twice as fast as CasADi's loop."""
        lower, x = ca.SX.sym("A", self.n * (self.n + 1) // 2), ca.SX.sym("x", self.n)
        A = ca.tril2symm(ca.SX(ca.Sparsity.lower(self.n), lower))
        return ca.Function("product", [lower, x], [ca.mtimes(A, x)])

    def hand_speed_change(self, y: Any, data: dict[str, Any]) -> Any:
        """n.v_hand less what it was at the freeze [m/s]: integral of eqs. (15), (16). Linear in y."""
        w = -data["m"] * self.part(y, "impulse")
        if self.n:
            w = ca.mtimes(data["s"].T, self.part(y, "torque")) + w
        return w + data["e"] * self.part(y, "time") if "e" in data else w

    def target_state(self, y: Any) -> list[Any]:
        states = self.part(y, "target")
        return [states[i, :] for i in range(self.target.n_states)]

    def rate(self, y: Any, data: dict[str, Any]) -> Any:
        """Rate of penetration [m/s]."""
        hand = self.hand_speed_change(y, data) + data["hand_speed"]
        return hand - self.target.velocity(self.target_state(y), self.target_numbers(data))

    def phase(self, y: Any, data: dict[str, Any]) -> tuple[Any, Any]:
        """(compressing, in contact), 0 or 1. Contact is over when, in restitution, no force is left."""
        rate = self.rate(y, data)
        force = self.law.branch(self.part(y, "penetration"), rate, False, self.law_numbers(data))
        at_rest = ca.logic_and(rate == 0, self.part(y, "time") == 0)
        compressing = ca.logic_or(rate > 0, ca.logic_and(at_rest, self._closing(y, data) > 0))
        return compressing, ca.logic_or(compressing, force > 0)

    def _closing(self, y: Any, data: dict[str, Any]) -> Any:
        """Acceleration [m/s2] at which hand and target approach at a freeze's begin, where they neither
        approach nor part: it decides what their speeds leave open."""
        u = data["velocity_before"] if self.refrozen else ca.DM.zeros(self.n, 1)
        force = self.law.force(self.part(y, "penetration"), 0.0, self.law_numbers(data))
        hand = -data["m"] * force
        if self.n:
            tau = self.saturate(self.with_feedforward(self.servo(y, u, data), data), data)
            hand += ca.mtimes(data["s"].T, tau - self.friction(u, data) if self.effects.friction else tau)
        if "e" in data:
            hand += data["e"]
        state, numbers = self.target_state(y), self.target_numbers(data)
        rates = self.target.derivative(state, force, numbers)
        soon = [x + _SOON * slope for x, slope in zip(state, rates, strict=True)]
        return hand - (self.target.velocity(soon, numbers) - self.target.velocity(state, numbers)) / _SOON

    def running(self, y: Any, data: dict[str, Any]) -> Any:
        """Flag, 0 or 1, that integration goes on: in contact, and before the end."""
        return ca.logic_and(self.phase(y, data)[1], self.part(y, "time") < self._end(data))

    def longest(self, y: Any, data: dict[str, Any], length: float) -> Any:
        """[s] a step of at most `length` may take, so that it ends with the freeze, or at the horizon."""
        return ca.fmin(length, self._end(data) - self.part(y, "time"))

    def _end(self, data: dict[str, Any]) -> Any:
        return data["until"] if self.refrozen else self.horizon

    def servo(self, y: Any, u: Any, data: dict[str, Any]) -> Any:
        """The servo's feedback torque (n) [N m] at velocity change u (eqs. 10, 11). Linear in y and u."""
        if not self.n:
            return u
        tau = -_gain(data["kd"], u)
        return tau + _gain(data["kp"], self.part(y, "deviation")) if self.effects.stiffness else tau

    def with_feedforward(self, tau: Any, data: dict[str, Any]) -> Any:
        return tau + _spread(data["feedforward"], tau) if self.effects.feedforward else tau

    def saturate(self, tau: Any, data: dict[str, Any]) -> Any:
        """The servo's torque (n) [N m] (eq. 12)."""
        if not self.effects.saturation:
            return tau
        limit = _spread(data["torque_limit"], tau)
        return ca.fmax(ca.fmin(tau, limit), -limit)

    def friction(self, u: Any, data: dict[str, Any]) -> Any:
        """F (n) [N m] (eq. 5) at velocity change u."""
        rate = _spread(data["joint_velocity"], u) + u
        sign = ca.fmax(ca.fmin(rate / self.transition, 1.0), -1.0)
        return _spread(data["viscous"], u) * rate + _spread(data["coulomb"], u) * sign


def shape_of(value: NDArray[np.float64]) -> tuple[int, int]:
    """Shape of a setting as a matrix."""
    return (value.shape[0], value.shape[1]) if value.ndim == 2 else (max(1, value.size), 1)


def _gain(gain: Any, x: Any) -> Any:
    """Gain times x, the gain a matrix or one number a joint."""
    return _spread(gain, x) * x if gain.size2() == 1 else ca.mtimes(gain, x)


def _spread(column: Any, like: Any) -> Any:
    """A column for each of the columns of `like`."""
    return ca.repmat(column, 1, like.size2())
