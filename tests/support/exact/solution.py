"""The frozen collision solved exactly, mode by mode, where law and target are linear between events.

Between events (end of compression, separation, a joint entering or leaving saturation or its friction's
transition band, a switch of the target) the frozen equations are linear with constant coefficients, so that
z(t + h) = exp(M h) z(t). Within h, one over the fastest mode's rate, Taylor's polynomials of degree 20 are
exact to rounding; their Bernstein coefficients enclose what is watched, so no event goes unseen, however
soon it is undone. What is left are rounding errors: this is what other methods are measured against.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from impactopt import InputError
from impactopt.collision.graph import frozen_dynamics, joint_space_model, target_start
from impactopt.collision.implicit import bernstein_matrix
from impactopt.collision.interface import Collision
from impactopt.collision.model import Segment, relative_to
from impactopt.collision.outputs import Outputs, frozen_for
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import check_array
from support.exact.bernstein import first_negative, largest
from support.exact.linear_contact import force_coefficients, target_modes
from support.exact.modes import Modes, Phase

Array = NDArray[np.float64]

_DEGREE = 20
_TO_BERNSTEIN = bernstein_matrix(_DEGREE)
# of the terms that a watched form sums up: below this its value is rounding
_ROUNDING = 64 * np.finfo(float).eps
_MOST_PHASES = 10_000
_SPACING = 2.5e-4  # [s]
_MOST_HALVINGS = 16


class ExactCollision:
    """The collisions of a model, exact but for rounding; of one freeze.

    Parameters
    ----------
    collision : the model; how it is stepped is not used.
    spacing : [s] of the histories; None: the model's `step`, or 0.25 ms.

    Raises
    ------
    InputError : law or target that are not linear between events; a model with freezes on the way.
    """

    def __init__(self, collision: SteppedModel, *, spacing: float | None = None) -> None:
        if collision.n_freezes:
            raise InputError("the exact solution: only without further freezes; give freezes=0")
        own = collision.step or min(_SPACING, collision.horizon)
        self.collision, self.spacing = collision, own if spacing is None else spacing
        self.model = joint_space_model(collision, ("configuration",))
        force_coefficients(collision.law, collision.law.parameters)
        target_modes(collision.target, collision.target.parameters)

    @cached_property
    def _frozen(self) -> Any:
        return frozen_dynamics(self.collision)

    @cached_property
    def _freeze(self) -> Any:
        names = (*self.model.frozen, *frozen_for(self.collision.available))
        return self._frozen.function("frozen", tuple(dict.fromkeys(names)))

    def collide(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> Collision:
        """One collision, as of `CollisionModel.collide`."""
        robot, values = self.collision.robot, self.collision.settings.override(overrides)
        given = None if torque is None else check_array("torque [N m]", torque, (robot.n,))
        result = self(robot.check_configuration(q), robot.check_velocity(v), given, values)
        if require_separation:
            self.collision.check_separation(result)
        return result

    def __call__(self, q: Array, v: Array, torque: Array | None, values: dict[str, Array]) -> Collision:
        """Of all of the model's settings, by name."""
        model, collision = self.model, self.collision
        gives_way = target_start(model.target, model.target_numbers(values))
        found = self._freeze.call([ca.DM(x) for x in (q, v, values["normal"], gives_way)])
        data: dict[str, Any] = dict(zip(self._freeze.name_out(), found, strict=True))
        data |= {"q": q, "v": v, "joint_velocity": v[-collision.robot.n :], **values}
        if collision.effects.feedforward:
            data["feedforward"] = torque
        data = relative_to({name: ca.DM(x) for name, x in values.items()}, 0.0, data)
        numbers = {name: _array(data[name]) for name in model.data}
        path = exact_path(Modes(model, numbers), collision.horizon, self.spacing)
        return self._result({name: ca.DM(x) for name, x in data.items()}, path)

    def _result(self, data: dict[str, Any], path: Path) -> Collision:
        """By the same formulas as other methods' results, but for what is known exactly here."""
        frozen, collision = self._frozen, self.collision
        states = ca.DM(path.states.T)
        final = states[:, -1]

        def change(*, second: bool) -> Any:
            """Of v since contact, or its integral over time."""
            names = ("torque2", "impulse2") if second else ("torque", "impulse")
            joints, impulse = (self.model.part(final, name) for name in names)
            time = self.model.part(final, "time")
            weight = time**2 / 2 if second else time
            joints = joints if self.model.n else ca.DM.zeros(collision.robot.n)
            wrench = data["L_tau"] @ joints - data["L_f"] * impulse + data["L_0"] * weight
            at = (data["q"], data["drift_velocity"], data["normal"])
            return frozen.velocity_change(*at, joints, impulse, np.zeros(3), wrench, weight)

        way = data["v"] * path.time[-1] + change(second=True)
        segment = Segment(
            data=data,
            since=0.0,
            final=final,
            states=states,
            v_after=lambda: data["v"] + change(second=False),
            q_after=lambda: frozen.integrate(data["q"], way),
        )
        made = Outputs(self.model, [segment], len(frozen.soles), len(frozen.held), data["v"])
        known = {"peak_force": path.peak_force, "separated": float(path.separated)}
        out = {name: np.array([[x]]) for name, x in known.items()}
        for name in collision.available:
            if name not in out and name != "step_error":
                out[name] = np.array(ca.evalf(ca.densify(ca.MX(getattr(made, name)))))
        if path.separated:  # there the force is zero, and not what rounding has left of it
            out["force"].ravel()[-1] = 0.0
        return Collision.from_outputs(out, collision.target)


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """States from contact to separation.

    Attributes
    ----------
    time : (k) [s], at phases' ends and on a uniform grid.
    states : (k, n_states) of the joint-space model.
    peak_force : [N] largest force at any time.
    separated : whether the contact ended within the horizon.
    phases : that were gone through, in order.
    """

    time: Array
    states: Array
    peak_force: float
    separated: bool
    phases: list[Phase]


def exact_path(modes: Modes, horizon: float, spacing: float) -> Path:
    """From contact to separation, or to the horizon [s]; states are kept every `spacing` [s].

    Raises
    ------
    RuntimeError : phases that end as soon as they begin, one after the other; numbers too far apart for
        floating point.
    """
    z, phase = modes.start()
    phases, kept, peak = [], [z], 0.0
    time, step = modes.model.layout["time"].start, min(1.0 / modes.fastest(), horizon)
    touching = phase.compressing or modes.force(phase) @ z > 0
    following: Phase | None = phase if touching else None
    while following is not None and z[time] < horizon:
        phase, found = following, None
        phases.append(phase)
        if len(phases) > _MOST_PHASES:
            raise RuntimeError(f"more than {_MOST_PHASES} phases by {z[time]:.3g} s")
        flow = _Flow(modes, phase, step)
        while found is None and z[time] < horizon:
            flow, terms = flow.fitting(z)
            begin, left = z[time], min(1.0, (horizon - z[time]) / flow.step)
            found = flow.first_exit(terms, left)
            s = left if found is None else found[0]
            peak = largest(_TO_BERNSTEIN @ (terms @ flow.force), s, peak)
            ends = (begin / spacing, (begin + s * flow.step) / spacing)
            for grid in spacing * np.arange(np.floor(ends[0]) + 1, np.ceil(ends[1])):
                kept.append(_value(terms, (grid - begin) / flow.step))
            z = flow.exponential @ z if s == 1.0 else _value(terms, s)
            if found is None and left < 1.0:
                z[time] = horizon
        kept.append(z)
        if found is not None:
            following = modes.after(phase, flow.watch.of[found[1]], above=found[2])
            z = z if following is None else modes.entering(following, z)
    states = np.array(kept)
    return Path(
        time=states[:, time],
        states=states[:, :-1],
        peak_force=peak,
        separated=following is None,
        phases=phases,
    )


class _Flow:
    """Steps of one length [s] within one phase."""

    def __init__(self, modes: Modes, phase: Phase, step: float) -> None:
        self.modes, self.phase, self.step = modes, phase, step
        self.scaled = modes.matrix(phase) * step
        self.exponential = expm(self.scaled)
        self.watch, self.force = modes.watch(phase), modes.force(phase)

    def fitting(self, z: Array) -> tuple[_Flow, Array]:
        """This flow, or one of shorter steps, and its terms: they have to sum up to what the exponential
        gives."""
        flow = self
        for _ in range(_MOST_HALVINGS):
            terms, ends = flow.terms(z), flow.exponential @ z
            off = np.abs(flow.watch.rows @ (_value(terms, 1.0) - ends))
            if (off <= 1e-12 * flow.sizes(terms)).all():
                return flow, terms
            flow = _Flow(flow.modes, flow.phase, flow.step / 2)
        raise RuntimeError(f"Taylor's polynomials differ from the exponential in steps of {flow.step:.2g} s")

    def terms(self, z: Array) -> Array:
        """(degree + 1, N): z(s step) = sum of s^k times row k."""
        out = np.empty((_DEGREE + 1, z.size))
        out[0] = z
        for k in range(_DEGREE):
            out[k + 1] = self.scaled @ out[k] / (k + 1)
        return out

    def sizes(self, terms: Array) -> Array:
        """Of what the watched forms are sums of, over a step: rounding errors go with these.

        The state's terms, and what these are sums of in their turn: where a nail's force and resistance all
        but cancel, so do the terms of its speed.
        """
        state = np.abs(terms).sum(axis=0)
        found: Array = np.abs(self.watch.rows) @ (state + np.abs(self.scaled) @ state)
        return found

    def first_exit(self, terms: Array, end: float) -> tuple[float, int, bool] | None:
        """(place in the step, up to `end`; number of the form; whether above) of the first out of bounds.

        Bounds are widened by rounding errors, so that a form that has just come in is not thrown out.
        """
        watch = self.watch
        b = _TO_BERNSTEIN @ (terms @ watch.rows.T)
        sizes = self.sizes(terms)
        first: tuple[float, int, bool] | None = None
        for bound, sign in ((watch.lower, 1.0), (watch.upper, -1.0)):
            there = np.isfinite(bound)
            edge = np.where(there, bound, 0.0)
            margin = sign * (b - edge) + _ROUNDING * (sizes + np.abs(edge))
            for i in np.flatnonzero(there & (margin < 0).any(axis=0)):
                place = first_negative(margin[:, i])
                if place is not None and place <= (end if first is None else first[0]):
                    first = (place, int(i), sign < 0)
        return first


def _value(terms: Array, s: float) -> Array:
    z: Array = s ** np.arange(_DEGREE + 1) @ terms
    return z


def _array(value: Any) -> Array:
    """As the settings have it: matrices as they are, columns as vectors."""
    found = np.array(value, dtype=float)
    return found.ravel() if found.ndim < 2 or 1 in found.shape else found
