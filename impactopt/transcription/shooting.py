"""The collision of a strike by shooting: the SDC from contact to separation, with its tangents.

Its inputs are posture, rates and legs at contact and the feed-forward torque; its outputs what constraints
and objectives are about. The servo's reference coasts with the soles in place: the legs' part of that bends,
of which the first order is kept, sum of the joint velocities' gains by t.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from impactopt.codegen.cache import cached
from impactopt.codegen.hashing import model_hash
from impactopt.collision.effects import Effects
from impactopt.collision.sdc import SDC
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription.batched import Block
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.rows import Index

STEPS = 12  # of the horizon
INSTANTS = STEPS + 1  # at which constraints hold: from the first touch on, whose force may be the largest
FORCE = 100.0  # [N] unit of the peak force among the outputs
_BEND = 1e-3  # [rad/s^2] of differences by the reference's bend, in which the collision is all but linear
_HORIZONS = (2e-3, 5e-3, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.4)  # [s]: few, as one is compiled in


class _Called:
    """A compiled function with room for its inputs and outputs, by name."""

    def __init__(self, function: Any):
        self._buffer, self._run = function.buffer()  # which is freed where nobody keeps it
        names, out = function.name_in(), function.name_out()
        self.given = {name: np.zeros(function.nnz_in(i)) for i, name in enumerate(names)}
        self.found = {name: np.zeros(function.nnz_out(i)) for i, name in enumerate(out)}
        self._shapes = {name: function.size_out(i) for i, name in enumerate(out)}
        for numbers, tell in ((self.given, self._buffer.set_arg), (self.found, self._buffer.set_res)):
            for i, array in enumerate(numbers.values()):
                if array.size:
                    tell(i, array.data)

    def __call__(self, **inputs: Array) -> dict[str, Array]:
        for name, values in inputs.items():
            self.given[name][:] = values
        self._run()
        return self.found

    def matrix(self, name: str) -> Array:
        rows, columns = self._shapes[name]
        return self.found[name].reshape(columns, rows).T


class State(NamedTuple):
    """State at contact: v (nv), leg accelerations (nl) while coasting; slopes of both by y, ydot, legs."""

    v: Array
    bend: Array
    slopes: Array


class Shooting:
    """The collision with one target as a function of z = y, ydot (ny each), legs (nl), feed-forward over
    limit (n).

    horizon [s] : no less than the contact lasts.  cone (facets, 6 a sole) : rows of the soles' wrenches.

    Attributes
    ----------
    parts : name -> places among the outputs: impulse [N s], duration over the horizon, energy [J] of the
        target, peak force [100 N], torque over limit (n an instant), cone rows (facets an instant), and
        after contact y, ydot (ny) and legs (nl).
    """

    def __init__(
        self,
        problem: ImpactProblem,
        coordinates: StanceCoordinates,
        law: ContactLaw,
        target: Target,
        *,
        horizon: float,
        cone: Array,
    ):
        c, self.robot = coordinates, problem.robot
        self.coordinates, self.horizon = c, horizon
        self.ny, self.nl, self.n = c.ny, c.nl, problem.robot.n
        self.model = SDC(
            robot=problem.robot,
            striker=problem.striker,
            normal=problem.normal,
            law=law,
            target=target,
            stance=problem.stance if problem.robot.floating else None,
            horizon=horizon,
            step=horizon / STEPS,
            effects=Effects(saturation=False),  # constraints keep the torque below its limit
            accuracy=None,
        )
        turned = np.zeros((self.nl, self.nl))
        for k, leg in enumerate(c.legs):
            for at in (6 * k, 6 * k + 3):  # world axes to the sole's
                turned[at : at + 3, at : at + 3] = leg.placement.rotation.T
        self.to_sole, self._cone = turned, cone @ turned
        sizes = {"impulse": 1, "duration": 1, "energy": 1, "peak": 1, "torque": self.n * INSTANTS}
        sizes |= {"cone": len(cone) * INSTANTS, "y": self.ny, "rate": self.ny, "legs": self.nl}
        ends = np.cumsum([0, *sizes.values()])
        self.parts = {name: np.arange(a, b) for name, a, b in zip(sizes, ends, ends[1:], strict=False)}
        self.n_in, self.n_out = 2 * self.ny + self.nl + self.n, int(ends[-1])
        soles = ("sole_wrench",) if c.legs else ()
        self._carried = (
            "impulse",
            "duration",
            "energy",
            "peak_force",
            "time",
            "demand",
            "joint_velocity",
            *soles,
        )

    # ------------------------------------------------------------------ compiled
    @cached_property
    def _value(self) -> _Called:
        rest: tuple[str, ...] = ("separated", "force", "target_speed", "hand_speed")
        rest += ("target_result",) if self.model.target.results else ()
        return _Called(self.model.function((*self._carried, *rest), parameters=("reference",), by=()))

    @cached_property
    def _jacobian(self) -> _Called:
        by = ("q", "v", "feedforward")
        return _Called(self.model.jacobian_function(self._carried, parameters=("reference",), by=by))

    @cached_property
    def _state(self) -> _Called:
        c = self.coordinates
        held = tuple(
            (leg.frame, tuple(np.round(leg.placement.homogeneous.ravel(), 12)), *map(tuple, leg.order))
            for leg in c.legs
        )
        found = cached(
            f"{self.robot.name}-coasting", (model_hash(self.robot.model), held), lambda: [_coasting(c)]
        )
        return _Called(found["coasting_state"])

    def state(self, y: Array, rates: Array, legs: Array) -> State:
        """Velocity and bend of coordinates and rates, with their slopes (nv + nl, 2 ny + nl)."""
        found = self._state(y=y, rates=rates, legs=legs)["out"].copy()
        nv = self.coordinates.model.nv
        return State(found[:nv], found[nv:], self._state.matrix("slopes").copy())

    # ------------------------------------------------------------------ values
    def _split(self, z: Array) -> list[Array]:
        return np.split(z, [self.ny, 2 * self.ny, 2 * self.ny + self.nl])

    def _inputs(self, z: Array, state: State) -> dict[str, Array]:
        y, _, legs, feedforward = self._split(z)
        reference = np.zeros(self._value.given["reference"].size)
        reference[self.coordinates.dependent] = state.bend
        torque = feedforward * self.robot.torque_limit
        q = self.coordinates.join(y, legs)
        return {"q": q, "v": state.v, "feedforward": torque, "reference": reference}

    def collide(self, z: Array) -> dict[str, Array]:
        """Outputs of the SDC by name; of histories a row an instant."""
        state = self.state(*self._split(z)[:3])
        found = self._value(**self._inputs(z, state))
        columns = INSTANTS
        return {
            k: (v.reshape(columns, -1).copy() if v.size > columns else v.copy()) for k, v in found.items()
        }

    def value(self, z: Array) -> Array:
        """(n_out,)."""
        state = self.state(*self._split(z)[:3])
        return self._outputs(z, state, self._value(**self._inputs(z, state)))[0]

    def _outputs(self, z: Array, state: State, found: dict[str, Array]) -> tuple[Array, Array, Array]:
        """Outputs; the rates ydot after contact, and the way there, both of the coordinates (ny)."""
        y, _, legs, _ = self._split(z)
        out, at, c = np.empty(self.n_out), self.parts, self.coordinates
        out[at["impulse"]], out[at["duration"]] = found["impulse"], found["duration"] / self.horizon
        out[at["energy"]], out[at["peak"]] = found["energy"], found["peak_force"] / FORCE
        demand = found["demand"].reshape(INSTANTS, -1)
        out[at["torque"]] = (demand / self.robot.torque_limit).ravel()
        if len(self._cone):
            wrench = found["sole_wrench"].reshape(INSTANTS, -1)
            out[at["cone"]] = (wrench @ self._cone.T).ravel()
        speeds = found["joint_velocity"].reshape(INSTANTS, -1)
        way = _weights(found["time"]) @ speeds
        rates, moved = self._of_joints(speeds[-1], state), self._of_joints(way, state)
        out[at["y"]], out[at["rate"]], out[at["legs"]] = y + moved, rates, legs + way[c.dependent]
        return out, rates, moved

    def _of_joints(self, joints: Array, state: State) -> Array:
        """Rates of coordinates (ny, ...) of joint velocities (n, ...), with the soles' Jacobian."""
        c = self.coordinates
        out = np.empty((self.ny, *joints.shape[1:]))
        out[c.base :] = joints[c.independent]
        if c.base:
            out[: c.base] = np.linalg.solve(self._leg_map(state), joints[c.dependent[:6]])
        return out

    def _leg_map(self, state: State) -> Array:
        """(6, 6) rates of the first leg for the base's."""
        rows = self.coordinates.base + self.coordinates.dependent[:6]
        return state.slopes[rows, self.ny : self.ny + 6]

    # ------------------------------------------------------------------ slopes
    def jacobian(self, z: Array) -> Array:
        """(n_out, n_in)."""
        y, _, legs, _ = self._split(z)
        c, ny, nl, nv = self.coordinates, self.ny, self.nl, self.coordinates.model.nv
        state = self.state(*self._split(z)[:3])
        inputs = self._inputs(z, state)
        found = {k: v.copy() for k, v in self._value(**inputs).items()}
        self._jacobian(**inputs)
        by_bend = self._by_bend(inputs["reference"], found)
        ways = np.zeros((nv + nv + nl, self.n_in))  # of q in the basis of v, of v, of the bend
        ways[: c.base, : c.base] = state.slopes[: c.base, ny : ny + c.base]
        ways[c.base + c.independent, np.arange(c.base, ny)] = 1.0
        ways[c.base + c.dependent, 2 * ny + np.arange(nl)] = 1.0
        ways[nv:, : 2 * ny + nl] = state.slopes
        limit, at = self.robot.torque_limit, self.parts

        def by_inputs(name: str) -> Array:
            """(size, nv + nv + nl + n)"""
            parts = [self._jacobian.matrix(f"{name}_by_{by}") for by in ("q", "v", "feedforward")]
            parts[2] = parts[2] * limit
            return np.hstack([*parts[:2], by_bend[name], parts[2]])

        # what needs few of its rows is taken together before it meets the ways
        speeds = by_inputs("joint_velocity").reshape(INSTANTS, self.n, -1)
        known = found["joint_velocity"].reshape(INSTANTS, -1)
        way = np.tensordot(_weights(found["time"]), speeds, (0, 0))
        way += (0.5 * (known[1:] + known[:-1])).T @ np.diff(by_inputs("time"), axis=0)
        of_joints = [speeds[-1], way]
        own = {
            "impulse": by_inputs("impulse"),
            "duration": by_inputs("duration") / self.horizon,
            "energy": by_inputs("energy"),
            "peak": by_inputs("peak_force") / FORCE,
            "torque": by_inputs("demand") / np.tile(limit, INSTANTS)[:, None],
        }
        if len(self._cone):
            wrench = by_inputs("sole_wrench").reshape(INSTANTS, nl, -1)
            own["cone"] = (self._cone @ wrench).reshape(at["cone"].size, -1)
        every = np.vstack([*own.values(), *of_joints])
        made = every[:, : len(ways)] @ ways
        made[:, 2 * ny + nl :] += every[:, len(ways) :]
        out = np.zeros((self.n_out, self.n_in))
        out[np.concatenate([at[name] for name in own])] = made[: -2 * self.n]
        last, way = made[-2 * self.n : -self.n], made[-self.n :]
        _, rates, moved = self._outputs(z, state, found)
        for name, joints, turned in (("rate", last, rates), ("y", way, moved)):
            out[at[name]] = self._of_joints(joints - self._as_map_turns(y, legs, turned), state)
        out[at["y"][:, None], np.arange(ny)] += np.eye(ny)
        out[at["legs"]] = way[c.dependent]
        out[at["legs"][:, None], 2 * ny + np.arange(nl)] += np.eye(nl)
        return out

    def _as_map_turns(self, y: Array, legs: Array, rates: Array) -> Array:
        """(n, n_in) what the first leg's rates change by as it goes on with these ydot elsewhere."""
        out = np.zeros((self.n, self.n_in))
        if self.coordinates.base:
            first = self.coordinates.dependent[:6]
            slopes = self.state(y, rates, legs).slopes[self.coordinates.base + first]
            slopes[:, self.ny : 2 * self.ny] = 0.0
            out[first, : slopes.shape[1]] = slopes
        return out

    def _by_bend(self, reference: Array, found: dict[str, Array]) -> dict[str, Array]:
        """Differences by the bend of each leg joint: (size, nl) of each output, which are ``found`` there."""
        out = {name: np.zeros((self._value.found[name].size, self.nl)) for name in self._carried}
        for j, joint in enumerate(self.coordinates.dependent):
            bent = reference.copy()
            bent[joint] += _BEND
            other = self._value(reference=bent)
            for name, columns in out.items():
                columns[:, j] = (other[name] - found[name]) / _BEND
        return out


def _weights(time: Array) -> Array:
    """Weights of the trapezoidal rule at these times."""
    steps = np.diff(time) / 2
    return np.append(steps, 0.0) + np.append(0.0, steps)


def _coasting(c: StanceCoordinates) -> Any:
    """ca.Function of y, rates, legs -> v and the legs' accelerations without y'', and their Jacobian."""
    y, rates, legs = ca.SX.sym("y", c.ny), ca.SX.sym("rates", c.ny), ca.SX.sym("legs", c.nl)
    v, a = c.motion(y, legs, rates, ca.SX.zeros(c.ny))
    out = ca.vertcat(v, *[a[c.base + int(j)] for j in c.dependent])
    slopes = ca.densify(ca.jacobian(out, ca.vertcat(y, rates, legs)))
    names = ["y", "rates", "legs"], ["out", "slopes"]
    return ca.Function("coasting_state", [y, rates, legs], [ca.densify(out), slopes], *names, {"cse": True})


def horizon_of(duration: float) -> float:
    """The horizon [s], out of few, for contacts that may last so long [s]."""
    return next((h for h in _HORIZONS if h >= duration), _HORIZONS[-1])


class _Dense:
    """A function of z as a block's: dense, of one instance, not compiled as a whole."""

    def __init__(self, function: Any, shape: tuple[int, int]):
        self._function, self._shape, self.size = function, shape, shape[0] * shape[1]
        self.write_to(np.zeros(self.size))

    def copy(self) -> _Dense:
        return _Dense(self._function, self._shape)

    def write_to(self, numbers: Array) -> None:
        self._numbers, self.output = numbers, numbers.reshape(1, -1)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        if self.size:
            self._numbers[:] = self._function(z[0]).ravel(order="F")
        return self.output

    @property
    def pattern(self) -> tuple[Index, Index]:
        rows, columns = self._shape
        return np.tile(np.arange(rows), columns), np.repeat(np.arange(columns), rows)


def shot_block(shooting: Shooting, lift: Affine) -> Block:
    """The block of a shooting at these z; its second derivatives are not known, and left out."""
    value = _Dense(shooting.value, (shooting.n_out, 1))
    jacobian = _Dense(shooting.jacobian, (shooting.n_out, shooting.n_in))
    hessian: Any = _Dense(None, (0, 0))
    functions: Any = {"value": value, "jacobian": jacobian, "hessian": hessian}
    return Block(
        name="shot",
        **functions,
        n_in=shooting.n_in,
        n_out=shooting.n_out,
        count=1,
        lift=lift,
        jac_pattern=jacobian.pattern,
        hess_pattern=hessian.pattern,
    )
