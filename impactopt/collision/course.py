"""The course of a collision: one freeze from contact to separation, or several, one after the other.

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
from itertools import pairwise
from typing import Any

import casadi as ca

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.model import JointSpaceModel

__all__ = ["GIVES_WAY", "Course", "Loop", "Segment", "cuts", "relative_to"]

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
    wanted : outputs of FrozenDynamics that are wanted besides what the model needs.
    """

    def __init__(
        self,
        model: JointSpaceModel,
        frozen: FrozenDynamics,
        *,
        loop: Loop,
        horizon: float,
        freezes: int,
        wanted: tuple[str, ...],
    ) -> None:
        self.model, self.frozen, self.loop = model, frozen, loop
        self.horizon, self.freezes = horizon, freezes
        whole = ("L_tau", "L_f", "L_0", "drift_velocity") if freezes else ()
        self._names = tuple(dict.fromkeys((*model.frozen, *wanted, *whole)))
        self._freeze = frozen.function("frozen", self._names)

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
        at = (frozen_at, data["drift_velocity"], data["normal"])
        return self.frozen.velocity_change(*at, torque, impulse, wrench, time)
