"""The collision in joint space: its state, and the forces in it, at one instant (paper, eqs. 9-12, 15-17).

With N freezes on the way, the freeze at contact only predicts. It says how long contact lasts, a trial with a
freeze in the middle of that says it better, T, and the course is cut into N segments of T / N (shorter ones
first are no better). Each goes by a freeze at its *middle*, which the freeze before it predicts. The
prediction's error is of second order in the segment's length, and so is that of a coefficient frozen in the
middle: the course converges to full dynamics with 1/N^2. What lasts
longer than T belongs to the last segment, which no N makes shorter: by the freeze at contact alone T can be a
fifth too short, and the error then stayed at half a per cent however many freezes there were.

A servo's reference whose joint velocities are not constant, as legs that stay closed have them, is known
before the blow. Its acceleration is frozen like all else, and the velocities u of the joint-space model are
then those relative to it: du/dt = A tau - s f + d - phiddot_ref.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.settings import Effects, Settings
from impactopt.contact import ContactLaw, Target
from impactopt.contact.friction import pushed_way

__all__ = ["GIVES_WAY", "Course", "JointSpaceModel", "Loop", "Segment", "cuts", "relative_to", "shape_of"]

_SOON = 1e-9  # [s] in which a target gains the speed that shows its acceleration


@dataclass(frozen=True, kw_only=True)
class JointSpaceModel:
    """Contact dynamics of hand and target with the robot's frozen dynamics.

    Its state y holds time integrals since the freeze, so that what is linear in them (momentum, work of
    constraints) is kept exactly by any Runge-Kutta or Taylor method:

        time [s]; penetration [m]; impulse [N s] = integral of f; target's state; and, where they are asked
        for or needed, peak force [N], what steps left out [N s], torque (n) [N m s] = integral of tau - F,
        deviation (n) [rad] = phi_ref - phi, sliding (3) [N s] = integral of the friction on the target,
        torque2 (n), impulse2, sliding2 (3): second integrals.

    Attributes
    ----------
    n : number of joints; 0 for a point mass.
    effects, law, target, settings : as in `SDC`.
    transition : [rad/s], of the joint friction.
    peak : keep the largest force in the state.
    error : keep in the state what the steps are estimated to leave out of the impulse, `left_out` [N s].
    second_integrals : keep torque2 and impulse2 in the state.
    slides : friction at the striking point is in the state and the data.
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
    slides: bool = False
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
        if self.slides:
            sizes["sliding"] = 3
        if self.second_integrals:
            sizes |= {"torque2": self.n, "impulse2": 1} | ({"sliding2": 3} if self.slides else {})
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
        if self.slides:
            names += ["s_point"] if self.n else []
            names += ["m_point", "point_velocity", *(["e_point"] if "e" in names else [])]
        return tuple(names)

    @cached_property
    def data(self) -> dict[str, tuple[int, int]]:
        """Names and shapes of what is constant during the collision."""
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
        those at contact, unless d is relative to another (`Freezes`)."""
        if not self.n:
            return ca.mtimes(ca.DM(0, 1), self.part(y, "impulse"))
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
        """A times a vector: as straight-line code of its own twice as fast as CasADi's loop."""
        lower, x = ca.SX.sym("A", self.n * (self.n + 1) // 2), ca.SX.sym("x", self.n)
        A = ca.tril2symm(ca.SX(ca.Sparsity.lower(self.n), lower))
        return ca.Function("product", [lower, x], [ca.mtimes(A, x)])

    def hand_speed_change(self, y: Any, data: dict[str, Any]) -> Any:
        """n.v_hand less what it was at the freeze [m/s]: integral of eqs. (15), (16). Linear in y."""
        w = -data["m"] * self.part(y, "impulse")
        if self.n:
            w = ca.mtimes(data["s"].T, self.part(y, "torque")) + w
        if self.slides:
            w -= ca.mtimes(ca.mtimes(data["normal"].T, data["m_point"]), self.part(y, "sliding"))
        return w + data["e"] * self.part(y, "time") if "e" in data else w

    def point_velocity(self, y: Any, data: dict[str, Any]) -> Any:
        """The striking point's velocity (3) [m/s]. Linear in y."""
        pushed = ca.mtimes(data["normal"], self.part(y, "impulse")) + self.part(y, "sliding")
        velocity = _spread(data["point_velocity"], pushed) - ca.mtimes(data["m_point"], pushed)
        if self.n:
            velocity += ca.mtimes(data["s_point"].T, self.part(y, "torque"))
        return velocity + ca.mtimes(data["e_point"], self.part(y, "time")) if "e_point" in data else velocity

    def friction_on_target(self, velocity: Any, force: Any, data: dict[str, Any]) -> Any:
        """(3) [N] at one instant, of a striking point with a velocity (3) [m/s] and a contact force [N]."""
        way = pushed_way(data["normal"], velocity, data["friction_coefficient"], data["friction_slip_speed"])
        return force * (way - data["normal"])

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
        if self.slides:
            friction = self.friction_on_target(self.point_velocity(y, data), force, data)
            hand -= ca.mtimes(ca.mtimes(data["normal"].T, data["m_point"]), friction)
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


# [1/kg] of a target that takes no impulse: drifts are frozen at the velocity given, see frozen.py
GIVES_WAY = 1e30

# (start, fraction of the horizon, data, whether states are wanted) -> (final state, states or None)
Loop = Callable[[Any, float, Sequence[Any], bool], tuple[Any, Any]]


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Result of the segment after one freeze, MX.

    Attributes
    ----------
    data : of the model, and the outputs of FrozenDynamics that were wanted.
    since : [s] from contact to the freeze's begin.
    final : the state at its end.
    states : (n_states, k) at all wanted instants, or None.
    v_after, q_after : velocity and configuration at its end; functions, as not all are asked for.
    """

    data: dict[str, Any]
    since: Any
    final: Any
    states: Any
    v_after: Callable[[], Any]
    q_after: Callable[[], Any]


def relative_to(settings: Mapping[str, Any], time: Any, data: dict[str, Any]) -> dict[str, Any]:
    """Frozen data with the drift d relative to the servo's reference, whose acceleration is frozen at a time
    [s] since contact; `settings` with `reference` (n, k) and `reference_until`, or without: it keeps its
    joint velocities."""
    if "reference" not in settings:
        return data
    bend, until = settings["reference"], settings["reference_until"]
    orders, bends = range(1, bend.shape[1] + 1), until > time
    acceleration = bends * sum(k * bend[:, k - 1] * time ** (k - 1) for k in orders)
    return data | {"d": data["d"] - acceleration, "reference_acceleration": acceleration}


def _gained(settings: Mapping[str, Any], time: Any) -> Any:
    """Gain of the reference's joint velocities (n) [rad/s] by a time [s] since contact."""
    bend, time = settings["reference"], ca.fmin(time, settings["reference_until"])
    return sum(bend[:, k] * time ** (k + 1) for k in range(bend.shape[1]))


def cuts(freezes: int) -> list[float]:
    """Ends of the segments, as fractions of the contact's duration (freezes + 1)."""
    return [i / freezes for i in range(freezes + 1)]


class Course:
    """Runs the time loop from contact to separation.

    Parameters
    ----------
    model, frozen : the collision in joint space, and what is frozen.
    loop : the time loop.
    horizon : [s] at which everything ends.
    freezes : on the way, besides the one at contact.
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
        """The segments, in order; `inputs` are q, v, feedforward and settings by name."""
        q, v = inputs["q"], inputs["v"]
        inputs = inputs | {"joint_velocity": v[-self.frozen.robot.n :]}
        data = relative_to(inputs, 0.0, inputs | self._frozen(q, v, inputs["normal"], target_start))
        if not self.freezes:
            return [self._segment(data, q, q, v, ca.MX(self.model.start()), 1.0, 0.0, record=True)]
        data |= {"velocity_before": ca.MX.zeros(self.model.n), "until": ca.MX(self.horizon)}
        guess = self._time(self._loop(data, ca.MX(self.model.start()), 1.0)[0])
        (trial,) = self._segments(inputs, data, guess, [0.0, 1.0], record=False)
        return self._segments(inputs, data, self._time(trial.final), cuts(self.freezes), record=True)

    def _segments(
        self, inputs: dict[str, Any], data: dict[str, Any], duration: Any, ends: list[float], *, record: bool
    ) -> list[Segment]:
        """The segments between these fractions of about that duration [s]; `data` of the freeze at
        contact."""
        n = self.model.n
        q, v = inputs["q"], inputs["v"]
        start = ca.MX(self.model.start())
        segments: list[Segment] = []
        reached, frozen_at, contact = start, q, ca.MX(1.0)
        for a, b in pairwise(ends):
            last = b == ends[-1]
            # what was frozen before goes on to the middle of this segment
            ahead = data | {"until": self._time(reached) + duration * (b - a) / 2}
            middle = self._loop(ahead, reached, (b - a) / 2)[0]
            q_middle, v_middle = self._moved(data, frozen_at, q, v, middle)
            if segments:
                q, v = segments[-1].q_after(), segments[-1].v_after()
            frozen_at = q_middle
            data = inputs | self._frozen(q_middle, v_middle, inputs["normal"], ca.DM([GIVES_WAY, 0.0]))
            data = relative_to(inputs, duration * (a + b) / 2, data)
            data["hand_speed"] = self.frozen.speed_of_hand(q, v, inputs["normal"])
            if self.model.slides:
                data["point_velocity"] = self.frozen.velocity_of_point(q, v, inputs["normal"])
            data["velocity_before"] = (v - inputs["v"])[-n:]
            if "reference" in inputs:
                data["reference_before"] = _gained(inputs, duration * a)
                data["velocity_before"] -= data["reference_before"]
            # no segment begins after separation
            length = self.horizon - duration * a if last else duration * (b - a)
            data["until"] = ca.if_else(contact, length, -1.0)
            share = 1.0 if last else b - a
            begin = (start, share, duration * a)
            segments.append(self._segment(data, frozen_at, q, v, *begin, record=record))
            reached = segments[-1].final
            start = self._handed_on(reached)
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
    ) -> Segment:
        final, states = self._loop(data, start, fraction, record=record)
        return Segment(
            data=data,
            since=since,
            final=final,
            states=states,
            v_after=lambda: v + self._change(data, frozen_at, final),
            q_after=lambda: self._moved(data, frozen_at, q, v, final)[0],
        )

    def _loop(
        self, data: dict[str, Any], start: Any, fraction: float, *, record: bool = False
    ) -> tuple[Any, Any]:
        return self.loop(start, fraction, [data[key] for key in self.model.data], record)

    def _time(self, y: Any) -> Any:
        return self.model.part(y, "time")

    def _handed_on(self, y: Any) -> Any:
        """The state at the begin of a segment, from that at the end of the one before."""
        kept = ("penetration", "target", "peak", "left_out", "deviation")
        parts = {name: self.model.part(y, name) for name in self.model.layout}
        return self.model.join({k: x if k in kept else ca.MX.zeros(*x.shape) for k, x in parts.items()})

    # ------------------------------------------------------------ whole motion
    def _moved(self, data: dict[str, Any], frozen_at: Any, q: Any, v: Any, y: Any) -> tuple[Any, Any]:
        """(configuration, velocity) at state y, from those at the begin of the segment."""
        time = self._time(y)
        way = v * time + self._change(data, frozen_at, y, second=True)
        return self.frozen.integrate(q, way), v + self._change(data, frozen_at, y)

    def _change(self, data: dict[str, Any], frozen_at: Any, y: Any, *, second: bool = False) -> Any:
        """Change of v since the begin, or its integral over time."""
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
