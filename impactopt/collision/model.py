"""Collision in joint space: state and forces (paper, eqs. 9-12, 15-17), and integration in segments.

With N further freezes, the freeze at contact serves for predictions only. It predicts the duration of
contact. A trial with one freeze in the middle of that gives a better estimate T, and the contact is divided
into N segments of T / N (shorter first segments do not improve the result). Each segment uses a freeze at its
*middle*, at a state predicted with the freeze before. The error of the prediction is of second order in the
segment's length, and so is that of coefficients frozen in the middle: the motion converges to full dynamics
with 1/N^2. The last segment also has the time beyond T, and no N makes that shorter. Hence the trial: from
the freeze at contact alone T can be a fifth too short, and an error of half a per cent then remained for all
N.

The servo's reference may have joint velocities that change, as closed legs need them; they are known before
the impact. Its acceleration is frozen like all else, and the velocities u of the joint-space model are
relative to it: du/dt = A tau - s f + d - phiddot_ref.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.settings import Effects, Settings
from impactopt.contact import ContactLaw, Target
from impactopt.contact.friction import deflection_rate, lean, pushed_way

_DIFFERENCE_STEP = 1e-9  # [s] for the target's acceleration, by a difference of velocities


@dataclass(frozen=True, kw_only=True)
class JointSpaceModel:
    """Contact dynamics of hand and target with the robot's frozen dynamics.

    The state y holds time integrals since the freeze. Integration methods conserve linear functions of the
    state exactly: so momentum, and the work of constraints. Its parts are

        time [s], penetration [m], impulse [N s] = integral of f, target's state; and if requested or needed
        peak force [N], left_out [N s] = estimated error of the impulse,
        torque (n) [N m s] = integral of tau - F, deviation (n) [rad] = phi_ref - phi,
        sliding (3) [N s] = integral of the friction on the target, bristles (3) [m] = their deflection,
        torque2 (n), impulse2, sliding2 (3) = second integrals.

    Attributes
    ----------
    n : number of joints; 0 for a point mass.
    effects, law, target, settings : as in `SDC`.
    transition : [rad/s] transition velocity of the joint friction.
    peak : the state has the peak force.
    error : the state has `left_out`.
    second_integrals : the state has torque2 and impulse2.
    slides : state and data have friction at the striking point.
    moves_target : the friction moves the target across the normal. Its velocity there is that at the freeze,
        and the integral of the friction over its mass.
    refrozen : there are several freezes. Then the data have `velocity_before` (n), the change of the joint
        velocity from contact to the freeze, and `until` [s], the end of the freeze.
    horizon : [s] end of the integration; with several freezes it is in `until`.
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
    slides: bool = False
    moves_target: bool = False
    refrozen: bool = False
    horizon: float = np.inf

    # ------------------------------------------------------------ layout of state and data
    @cached_property
    def layout(self) -> dict[str, slice]:
        """Slices of the parts in the state, by name."""
        sizes = {"time": 1, "penetration": 1, "impulse": 1, "target": self.target.n_states}
        if self.peak:
            sizes["peak"] = 1
        if self.error:
            sizes["left_out"] = 1
        sizes["torque"] = self.n
        if self.effects.stiffness:
            sizes["deviation"] = self.n
        if self.slides:
            sizes |= {"sliding": 3} | ({"bristles": 3} if self.bristles else {})
        if self.second_integrals:
            sizes |= {"torque2": self.n, "impulse2": 1} | ({"sliding2": 3} if self.slides else {})
        ends = np.cumsum(list(sizes.values()))
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }

    @property
    def bristles(self) -> bool:
        """True if the friction at the striking point has bristles."""
        return "friction_stiffness" in self.settings

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
        if self.slides:
            names += ["s_point"] if self.n else []
            names += ["m_point", "point_velocity", *(["e_point"] if "e" in names else [])]
        return tuple(names)

    @cached_property
    def data(self) -> dict[str, tuple[int, int]]:
        """Names and shapes of the quantities that are constant during a freeze."""
        n = self.n
        shapes = {"A": (n * (n + 1) // 2, 1), "m": (1, 1), "hand_speed": (1, 1), "e": (1, 1)}
        shapes |= {"s_point": (n, 3), "m_point": (3, 3), "point_velocity": (3, 1), "e_point": (3, 1)}
        out = {name: shapes.get(name, (n, 1)) for name in self.frozen}
        if self.refrozen:
            out |= {"velocity_before": (n, 1), "until": (1, 1)}
        if self.effects.friction:
            out["joint_velocity"] = (n, 1)
        if self.effects.feedforward:
            out["feedforward"] = (n, 1)
        no_data = ("reference", "reference_until", *(() if self.slides else ("normal",)))
        return out | {name: shape_of(v) for name, v in self.settings.items() if name not in no_data}

    def symbols(self, kind: Any = ca.SX) -> dict[str, Any]:
        """A symbol for each of the data."""
        return {name: kind.sym(name, *shape) for name, shape in self.data.items()}

    def small_symbols(self) -> dict[str, Any]:
        """An SX symbol for each of the data except A, the largest, which only `velocity_change` needs."""
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

    # ------------------------------------------------------------ parameters of law and target
    def law_numbers(self, data: dict[str, Any]) -> dict[str, Any]:
        return {name: data[f"contact_{name}"] for name in self.law.parameters}

    def target_numbers(self, data: dict[str, Any]) -> dict[str, Any]:
        return {name: data[f"target_{name}"] for name in self.target.parameters}

    def tangential_change(self, y: Any, data: dict[str, Any]) -> Any:
        """Change (3) of the target's velocity across the normal since the freeze [m/s]."""
        return self.part(y, "sliding") / self.target.tangential_mass(self.target_numbers(data))

    # ------------------------------------------------------------ quantities at the instants of y's columns
    def velocity_change(self, y: Any, data: dict[str, Any]) -> Any:
        """Joint velocities relative to the servo's reference (n) [rad/s]: integral of eq. (9).

        The reference keeps the joint velocities at contact, unless d is relative to another one
        (`relative_to`).
        """
        if not self.n:
            return ca.mtimes(ca.DM(0, 1), self.part(y, "impulse"))
        # not an integral of its own: A, s and d are constant, so integrals of torque, force and time give it
        u = self._product(data["A"], self.part(y, "torque")) - ca.mtimes(data["s"], self.part(y, "impulse"))
        if self.slides:
            u -= ca.mtimes(data["s_point"], self.part(y, "sliding"))
        if "d" in data:
            u += ca.mtimes(data["d"], self.part(y, "time"))
        return u + _spread(data["velocity_before"], u) if self.refrozen else u

    def _product(self, lower: Any, columns: Any) -> Any:
        """A times columns, from A's lower triangle."""
        if columns.size2() > 1:
            A = ca.tril2symm(type(lower)(ca.Sparsity.lower(self.n), lower))
            return ca.mtimes(A, columns)
        return self._product_function(lower, columns)

    @cached_property
    def _product_function(self) -> Any:
        """ca.Function (A, x) -> A x; as straight-line code twice as fast as CasADi's loop."""
        lower, x = ca.SX.sym("A", self.n * (self.n + 1) // 2), ca.SX.sym("x", self.n)
        A = ca.tril2symm(ca.SX(ca.Sparsity.lower(self.n), lower))
        return ca.Function("product", [lower, x], [ca.mtimes(A, x)])

    def hand_speed_change(self, y: Any, data: dict[str, Any]) -> Any:
        """Change of n.v_hand since the freeze [m/s]: integral of eqs. (15), (16). Linear in y."""
        w = -data["m"] * self.part(y, "impulse")
        if self.n:
            w = ca.mtimes(data["s"].T, self.part(y, "torque")) + w
        if self.slides:
            w -= ca.mtimes(ca.mtimes(data["normal"].T, data["m_point"]), self.part(y, "sliding"))
        return w + data["e"] * self.part(y, "time") if "e" in data else w

    def point_velocity(self, y: Any, data: dict[str, Any]) -> Any:
        """Velocity of the striking point (3) [m/s], across the normal against the target. Linear in y."""
        pushed = ca.mtimes(data["normal"], self.part(y, "impulse")) + self.part(y, "sliding")
        velocity = _spread(data["point_velocity"], pushed) - ca.mtimes(data["m_point"], pushed)
        if self.n:
            velocity += ca.mtimes(data["s_point"].T, self.part(y, "torque"))
        if self.moves_target:
            velocity -= self.tangential_change(y, data)
        return velocity + ca.mtimes(data["e_point"], self.part(y, "time")) if "e_point" in data else velocity

    def friction_on_target(
        self, velocity: Any, force: Any, deflection: Any, data: dict[str, Any]
    ) -> tuple[Any, Any]:
        """Friction (3) [N] at one instant, and rate (3) [m/s] of the bristles' deflection.

        velocity (3) [m/s] : of the striking point.  deflection (3) [m] : of bristles, if there are any.
        """
        normal, coefficient = data["normal"], data["friction_coefficient"]
        slip_speed = data["friction_slip_speed"]
        if not self.bristles:
            return force * (pushed_way(normal, velocity, coefficient, slip_speed) - normal), ca.SX(0, 1)
        leaning = lean(deflection, force, coefficient, data["friction_stiffness"])
        rate = deflection_rate(normal, velocity, leaning, slip_speed)
        return force * coefficient * leaning, rate

    def deflection(self, y: Any) -> Any:
        """Deflection of the bristles (3) [m], if there are any, else (0)."""
        return self.part(y, "bristles") if self.bristles else y[:0, :]

    def target_state(self, y: Any) -> list[Any]:
        states = self.part(y, "target")
        return [states[i, :] for i in range(self.target.n_states)]

    def rate(self, y: Any, data: dict[str, Any]) -> Any:
        """Rate of penetration [m/s]."""
        hand = self.hand_speed_change(y, data) + data["hand_speed"]
        return hand - self.target.velocity(self.target_state(y), self.target_numbers(data))

    def phase(self, y: Any, data: dict[str, Any]) -> tuple[Any, Any]:
        """Flags (compressing, in contact), 0 or 1. Contact ends when the force of restitution is zero."""
        rate = self.rate(y, data)
        force = self.law.branch(self.part(y, "penetration"), rate, False, self.law_numbers(data))
        # at equal speeds, the accelerations at the start of a freeze decide
        at_rest = ca.logic_and(rate == 0, self.part(y, "time") == 0)
        compressing = ca.logic_or(rate > 0, ca.logic_and(at_rest, self.closing(y, data) > 0))
        return compressing, ca.logic_or(compressing, force > 0)

    def closing(self, y: Any, data: dict[str, Any]) -> Any:
        """Acceleration [m/s2] of hand towards target, at the start of a freeze and at equal speeds.

        It decides between compression and restitution if the rate of penetration is zero.
        """
        u = data["velocity_before"] if self.refrozen else ca.DM.zeros(self.n, 1)
        force = self.law.force(self.part(y, "penetration"), 0.0, self.law_numbers(data))
        hand = -data["m"] * force
        if self.slides:
            velocity, deflection = self.point_velocity(y, data), self.deflection(y)
            friction, _ = self.friction_on_target(velocity, force, deflection, data)
            hand -= ca.mtimes(ca.mtimes(data["normal"].T, data["m_point"]), friction)
        if self.n:
            tau = self.saturate(self.with_feedforward(self.servo(y, u, data), data), data)
            hand += ca.mtimes(data["s"].T, tau - self.friction(u, data) if self.effects.friction else tau)
        if "e" in data:
            hand += data["e"]
        state, numbers = self.target_state(y), self.target_numbers(data)
        rates = self.target.derivative(state, force, numbers)
        soon = [x + _DIFFERENCE_STEP * slope for x, slope in zip(state, rates, strict=True)]
        gained = self.target.velocity(soon, numbers) - self.target.velocity(state, numbers)
        return hand - gained / _DIFFERENCE_STEP

    def running(self, y: Any, data: dict[str, Any]) -> Any:
        """Flag, 0 or 1, that integration continues: in contact, and before the end."""
        return ca.logic_and(self.phase(y, data)[1], self.part(y, "time") < self._end(data))

    def longest(self, y: Any, data: dict[str, Any], length: float) -> Any:
        """Step [s], at most `length`, and so that it does not pass the end of the freeze or the horizon."""
        return ca.fmin(length, self._end(data) - self.part(y, "time"))

    def _end(self, data: dict[str, Any]) -> Any:
        return data["until"] if self.refrozen else self.horizon

    def servo(self, y: Any, u: Any, data: dict[str, Any]) -> Any:
        """Feedback torque of the servo (n) [N m] at velocity change u (eqs. 10, 11). Linear in y and u."""
        if not self.n:
            return u
        tau = -_gain(data["kd"], u)
        return tau + _gain(data["kp"], self.part(y, "deviation")) if self.effects.stiffness else tau

    def with_feedforward(self, tau: Any, data: dict[str, Any]) -> Any:
        return tau + _spread(data["feedforward"], tau) if self.effects.feedforward else tau

    def saturate(self, tau: Any, data: dict[str, Any]) -> Any:
        """Torque of the servo within its limits (n) [N m] (eq. 12)."""
        if not self.effects.saturation:
            return tau
        limit = _spread(data["torque_limit"], tau)
        return ca.fmax(ca.fmin(tau, limit), -limit)

    def friction(self, u: Any, data: dict[str, Any]) -> Any:
        """Joint friction F (n) [N m] (eq. 5) at velocity change u."""
        rate = _spread(data["joint_velocity"], u) + u
        sign = ca.fmax(ca.fmin(rate / self.transition, 1.0), -1.0)
        return _spread(data["viscous"], u) * rate + _spread(data["coulomb"], u) * sign

    def rate_of_change(self, y: Any, u: Any, data: dict[str, Any], force: Any = None) -> Any:
        """Time derivative dy/dt at y; u is the change of the joint velocities at y.

        force [N] : of the contact; None: the law's in the phase at y.
        """
        rate = self.rate(y, data)
        if force is None:
            force = self.law.force(self.part(y, "penetration"), rate, self.law_numbers(data))
        tau = self.saturate(self.with_feedforward(self.servo(y, u, data), data), data)
        if self.effects.friction:
            tau = tau - self.friction(u, data)
        target = self.target.derivative(self.target_state(y), force, self.target_numbers(data))
        rates = {
            "time": 1.0,
            "penetration": rate,
            "impulse": force,
            "target": ca.vertcat(*target),
            # no integrals: the steps update these two
            "peak": 0.0,
            "left_out": 0.0,
            "torque": tau,
            "deviation": -u,
        }
        if self.slides:
            velocity, deflection = self.point_velocity(y, data), self.deflection(y)
            rates["sliding"], rates["bristles"] = self.friction_on_target(velocity, force, deflection, data)
        if self.second_integrals:
            once = ("torque", "impulse", *(("sliding",) if self.slides else ()))
            rates |= {f"{name}2": self.part(y, name) for name in once}
        return self.join(rates)


def shape_of(value: NDArray[np.float64]) -> tuple[int, int]:
    """Shape of a setting as a matrix."""
    return (value.shape[0], value.shape[1]) if value.ndim == 2 else (max(1, value.size), 1)


def _gain(gain: Any, x: Any) -> Any:
    """Product of a gain, a matrix or one number a joint, and x."""
    return _spread(gain, x) * x if gain.size2() == 1 else ca.mtimes(gain, x)


def _spread(column: Any, like: Any) -> Any:
    """The column, repeated for each column of `like`."""
    return ca.repmat(column, 1, like.size2())


# Inverse mass [1/kg] of a target that takes no impulse: drifts are then frozen at the velocity given
# (frozen.py).
GIVES_WAY = 1e30

# Time loop: (start, fraction of the horizon, data, whether to record) -> (final state, recorded states or
# None)
Loop = Callable[[Any, float, Sequence[Any], bool], tuple[Any, Any]]


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Result of the integration with one freeze, MX.

    Attributes
    ----------
    tangential : (3) [m/s] velocity across the normal, at its end, of a target that friction moves.
    data : of the model, and the requested outputs of FrozenDynamics.
    since : [s] from contact to the segment's start.
    final : state at its end.
    states : (n_states, k) recorded states, or None.
    v_after, q_after : velocity and configuration at its end; functions, as not all segments need them.
    contact : 1 if it begins in contact, else 0.
    """

    data: dict[str, Any]
    since: Any
    final: Any
    states: Any
    v_after: Callable[[], Any]
    q_after: Callable[[], Any]
    tangential: Any = None
    contact: Any = 1.0


def relative_to(settings: Mapping[str, Any], time: Any, data: dict[str, Any]) -> dict[str, Any]:
    """Frozen data with the drift d relative to the servo's reference.

    The acceleration of the reference is frozen at a time [s] since contact. It is zero if `settings` lack
    `reference` (n, k), see `Settings`.
    """
    if "reference" not in settings:
        return data
    # joint velocities of the reference: sum of coefficients[:, k - 1] t^k, up to `until`
    coefficients, until = settings["reference"], settings["reference_until"]
    orders, accelerates = range(1, coefficients.shape[1] + 1), until > time
    acceleration = accelerates * sum(k * coefficients[:, k - 1] * time ** (k - 1) for k in orders)
    return data | {"d": data["d"] - acceleration, "reference_acceleration": acceleration}


def _gained(settings: Mapping[str, Any], time: Any) -> Any:
    """Change of the reference's joint velocities (n) [rad/s] from contact to a time [s]."""
    coefficients, time = settings["reference"], ca.fmin(time, settings["reference_until"])
    return sum(coefficients[:, k] * time ** (k + 1) for k in range(coefficients.shape[1]))


def cuts(freezes: int) -> list[float]:
    """Bounds of the segments, as fractions of the contact's duration (freezes + 1)."""
    return [i / freezes for i in range(freezes + 1)]


class SegmentedCollision:
    """Integrates a collision from contact to separation, segment by segment.

    Parameters
    ----------
    model, frozen : collision in joint space, and the robot's frozen dynamics.
    loop : time loop.
    horizon : [s] end of the integration.
    freezes : besides the one at contact.
    names : attributes of FrozenDynamics that are needed.
    """

    def __init__(
        self,
        model: JointSpaceModel,
        frozen: FrozenDynamics,
        *,
        loop: Loop,
        horizon: float,
        freezes: int,
        names: tuple[str, ...],
    ) -> None:
        self.model, self.frozen, self.loop = model, frozen, loop
        self.horizon, self.freezes = horizon, freezes
        self._names, self._freeze = names, frozen.function("frozen", names)

    def run(self, inputs: dict[str, Any], target_start: Any) -> list[Segment]:
        """Segments in order, from `inputs` by name: q, v, feedforward and settings."""
        q, v = inputs["q"], inputs["v"]
        inputs = inputs | {"joint_velocity": v[-self.frozen.robot.n :]}
        data = relative_to(inputs, 0.0, inputs | self._frozen(q, v, inputs["normal"], target_start))
        if not self.freezes:
            return [self._segment(data, q, q, v, ca.MX(self.model.start()), 1.0, 0.0, record=True)]
        data |= {"velocity_before": ca.MX.zeros(self.model.n), "until": ca.MX(self.horizon)}
        # contact's duration by the freeze at contact, then by one in its middle: see above
        predicted = self._time(self._loop(data, ca.MX(self.model.start()), 1.0)[0])
        (trial,) = self._segments(inputs, data, predicted, [0.0, 1.0], record=False)
        return self._segments(inputs, data, self._time(trial.final), cuts(self.freezes), record=True)

    def _segments(
        self, inputs: dict[str, Any], data: dict[str, Any], duration: Any, ends: list[float], *, record: bool
    ) -> list[Segment]:
        """Segments between fractions `ends` of the duration [s]; `data` are of the freeze at contact."""
        n = self.model.n
        q, v = inputs["q"], inputs["v"]
        start = ca.MX(self.model.start())
        segments: list[Segment] = []
        reached, frozen_at, contact = start, q, ca.MX(1.0)
        for a, b in pairwise(ends):
            last = b == ends[-1]
            # predict the middle of this segment with the freeze before it
            # `reached` counts its time since the segment before began, as its data do
            ahead = data | {"until": self._time(reached) + duration * (b - a) / 2}
            # A fraction of the horizon, as the number of Runge-Kutta steps has to be constant; `until` ends
            # it earlier.
            middle = self._loop(ahead, reached, (b - a) / 2)[0]
            q_middle, v_middle = self._moved(data, frozen_at, q, v, middle)
            if segments:
                q, v = segments[-1].q_after(), segments[-1].v_after()
            frozen_at = q_middle
            # v_middle is the velocity to freeze the drifts at, so nothing is to be estimated (`GIVES_WAY`)
            data = inputs | self._frozen(q_middle, v_middle, inputs["normal"], ca.DM([GIVES_WAY, 0.0]))
            data = relative_to(inputs, duration * (a + b) / 2, data)
            # Coefficients are of the middle, but the segment begins at q and v: so its speeds are by J of q.
            data["hand_speed"] = self.frozen.speed_of_hand(q, v, inputs["normal"])
            if self.model.slides:
                data["point_velocity"] = self.frozen.velocity_of_point(q, v, inputs["normal"])
            before = segments[-1].tangential if segments else 0.0
            if self.model.moves_target:
                data["point_velocity"] -= before
            data["velocity_before"] = (v - inputs["v"])[-n:]
            if "reference" in inputs:
                data["reference_before"] = _gained(inputs, duration * a)
                data["velocity_before"] -= data["reference_before"]
            # a segment after separation has no steps
            length = self.horizon - duration * a if last else duration * (b - a)
            data["until"] = ca.if_else(contact, length, -1.0)
            begin = (start, 1.0 if last else b - a, duration * a)
            segment = self._segment(data, frozen_at, q, v, *begin, record=record, tangential=before)
            segments.append(replace(segment, contact=contact))
            reached = segments[-1].final
            start = self._next_start(reached)
            # once separated, always: bodies that meet again are not in this model
            contact *= self.model.phase(reached, data)[1]
        return segments

    def _frozen(self, q: Any, v: Any, normal: Any, target_start: Any) -> dict[str, Any]:
        return dict(zip(self._names, self._freeze.call([q, v, normal, target_start]), strict=True))

    def _segment(
        self,
        data: dict[str, Any],
        frozen_at: Any,
        q: Any,
        v: Any,
        start: Any,
        fraction: float,
        since: Any,
        *,
        record: bool,
        tangential: Any = 0.0,
    ) -> Segment:
        final, states = self._loop(data, start, fraction, record=record)
        moves = self.model.moves_target
        return Segment(
            data=data,
            since=since,
            final=final,
            states=states,
            v_after=lambda: v + self._change(data, frozen_at, final),
            q_after=lambda: self._moved(data, frozen_at, q, v, final)[0],
            tangential=tangential + self.model.tangential_change(final, data) if moves else None,
        )

    def _loop(
        self, data: dict[str, Any], start: Any, fraction: float, *, record: bool = False
    ) -> tuple[Any, Any]:
        return self.loop(start, fraction, [data[key] for key in self.model.data], record)

    def _time(self, y: Any) -> Any:
        return self.model.part(y, "time")

    def _next_start(self, y: Any) -> Any:
        """State at the start of a segment, from the end of the one before; integrals restart at zero."""
        kept = ("penetration", "target", "peak", "left_out", "deviation", "bristles")
        parts = {name: self.model.part(y, name) for name in self.model.layout}
        return self.model.join({k: x if k in kept else ca.MX.zeros(*x.shape) for k, x in parts.items()})

    # ------------------------------------------------------------ whole motion
    def _moved(self, data: dict[str, Any], frozen_at: Any, q: Any, v: Any, y: Any) -> tuple[Any, Any]:
        """Configuration and velocity at state y, from those at the start of the segment."""
        time = self._time(y)
        # The integral of v_0 + change(t). Changes are linear in the integrals of the state, so their integral
        # has the second integrals in their place.
        displacement = v * time + self._change(data, frozen_at, y, second=True)
        return self.frozen.integrate(q, displacement), v + self._change(data, frozen_at, y)

    def _change(self, data: dict[str, Any], frozen_at: Any, y: Any, *, second: bool = False) -> Any:
        """Change of v (nv) since the start of the segment; with `second` its time integral."""
        model = self.model
        names = ("torque2", "impulse2") if second else ("torque", "impulse")
        torque, impulse = (model.part(y, name) for name in names)
        time = self._time(y) ** 2 / 2 if second else self._time(y)
        if not model.n:
            torque = ca.MX.zeros(self.frozen.robot.n)
        wrench = ca.mtimes(data["L_tau"], torque) - data["L_f"] * impulse + data["L_0"] * time
        sliding = ca.MX.zeros(3)
        if model.slides:
            sliding = model.part(y, "sliding2" if second else "sliding")
            wrench -= ca.mtimes(data["L_point"], sliding)
        at = (frozen_at, data["drift_velocity"], data["normal"])
        return self.frozen.velocity_change(*at, torque, impulse, sliding, wrench, time)
