"""What one collision should give, independent of the steps that are judged."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from support.exact import ExactCollision

from benchmarks.stability_cases import Case
from impactopt.collision.graph import frozen_dynamics, joint_space_model, target_start
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact import Board, FreeMass
from impactopt.errors import InputError

Array = NDArray[np.float64]

# some seconds of work
_MOST_STEPS, _MOST_SLOPES = 1e4, 50_000
_TOLERANCES, _CLOSE = (1e-9, 1e-12), 5e-6  # of SciPy's methods; of the impulse, by which two agree


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What a reference says."""

    impulse: float
    duration: float
    separated: bool


def reference(model: SymbolicModel, case: Case) -> tuple[Expected, float, str]:
    """(what should come out, [N s] of a plastic blow of two masses, which reference says so).

    Where both references would take minutes, as with fast modes in a long contact, it is the model itself
    with a millionth of its tolerance, or a hundredth, whose steps are others.
    """
    values = model.settings.override({k: np.asarray(x, dtype=float) for k, x in case.overrides.items()})
    q, v, torque = (np.asarray(x, dtype=float) for x in (case.q, case.v, case.torque))
    given = torque if model.effects.feedforward else None
    frozen = frozen_numbers(model, q, v, values)
    m, speed = float(frozen["m"].item()), float(frozen["hand_speed"].item())
    free = isinstance(model.target, (FreeMass, Board))
    scale = abs(speed) / max(m + (1.0 / float(values["target_mass"]) if free else 0.0), 1e-12)
    try:
        # an exact solution has no longer steps than an explicit method; of a board it may have many pieces
        if isinstance(model.target, Board) or model.horizon > _MOST_STEPS * model.stable_step(q, **values):
            raise InputError("left to LSODA")
        found = _exact(model)(q, v, given, values)
        made = Expected(impulse=found.impulse, duration=found.duration, separated=found.separated)
        return made, scale, "exact solution"
    except (InputError, RuntimeError, FloatingPointError):
        pass
    try:
        return _agreed(functools.partial(by_scipy, model, frozen, v, given, values), scale), scale, "LSODA"
    except TakesTooLong:
        if model.stepping != "implicit":
            raise
    options: dict[str, Any] = {"require_separation": False, **case.overrides}
    for factor in (1e-6, 1e-2):  # there are only so many steps
        try:
            found = _finer(model, factor).collide(case.q, case.v, case.torque, **options)
        except InputError:
            continue
        break
    else:
        raise TakesTooLong
    made = Expected(impulse=found.impulse, duration=found.duration, separated=found.separated)
    return made, scale, "itself, finer"


class TakesTooLong(Exception):
    """A reference is given up."""


@functools.lru_cache(maxsize=2)
def _finer(model: SymbolicModel, factor: float) -> SymbolicModel:
    return replace(model, tolerance=factor * model.tolerance)


@functools.lru_cache(maxsize=2)
def _exact(model: SymbolicModel) -> ExactCollision:
    return ExactCollision(model)


@functools.lru_cache(maxsize=2)
def _freeze(model: SymbolicModel) -> Any:
    return frozen_dynamics(model).function("frozen", joint_space_model(model).frozen)


def frozen_numbers(model: SymbolicModel, q: Array, v: Array, values: dict[str, Array]) -> dict[str, Array]:
    """What is frozen at contact, by name."""
    function = _freeze(model)
    numbers = {name: float(values[f"target_{name}"]) for name in model.target.parameters}
    found = function(q, v, values["normal"], target_start(model.target, numbers))
    return {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}


def _agreed(solve: Callable[..., Expected], scale: float) -> Expected:
    """What LSODA says at two tolerances; where these are apart, that of the two which Radau's method says.

    A target's switches lead LSODA astray at either of them, now and then.

    Raises
    ------
    TakesTooLong : no two of them agree, or Radau's method breaks down.
    """
    found = [solve(rtol=rtol) for rtol in _TOLERANCES]
    close = _CLOSE * max(abs(found[-1].impulse), scale)
    if abs(found[0].impulse - found[1].impulse) <= close:
        return found[-1]
    try:
        third = solve(method="Radau", rtol=_TOLERANCES[0])
    except ValueError as error:  # its slopes are no numbers any more
        raise TakesTooLong from error
    nearest = min(found, key=lambda one: abs(one.impulse - third.impulse))
    if abs(nearest.impulse - third.impulse) > close:
        raise TakesTooLong
    return nearest


def by_scipy(
    model: SymbolicModel,
    frozen: dict[str, Array],
    v: Array,
    torque: Array | None,
    values: dict[str, Array],
    *,
    method: str = "LSODA",
    rtol: float = 1e-9,
) -> Expected:
    """The same frozen dynamics by one of SciPy's methods, from the numbers alone."""
    n, effects, target = model.n_servos, model.effects, model.target
    law = type(model.law)(**{k: float(values[f"contact_{k}"]) for k in model.law.parameters})
    hit = type(target)(**{k: float(values[f"target_{k}"]) for k in target.parameters})
    A = np.zeros((n, n))
    if n:
        A[np.triu_indices(n)] = frozen["A"].ravel()
        A = A + np.triu(A, 1).T
    s, d = (frozen.get(k, np.zeros(n)).ravel() for k in ("s", "d"))
    s = s if n else np.zeros(0)
    d = d if n else np.zeros(0)
    m, speed, e = (float(frozen[k].item()) if k in frozen else 0.0 for k in ("m", "hand_speed", "e"))
    k = target.n_states

    def rate(t: float, y: Array) -> float:
        hand = speed + s @ y[2 + k : 2 + k + n] - m * y[1] + e * t
        return float(hand - hit.velocity(list(y[2 : 2 + k])))

    slopes = 0

    def flow(t: float, y: Array) -> Array:
        nonlocal slopes
        slopes += 1
        if slopes > _MOST_SLOPES:
            raise TakesTooLong
        r, T = rate(t, y), y[2 + k : 2 + k + n]
        f = float(law.force(float(y[0]), r))
        u = A @ T - s * y[1] + d * t
        tau = np.zeros(n)
        if n:
            tau = -values["kd"] * u
            if effects.stiffness:
                tau = tau + values["kp"] * y[2 + k + n :]
            if torque is not None:
                tau = tau + torque
            if effects.saturation:
                tau = np.clip(tau, -values["torque_limit"], values["torque_limit"])
            if effects.friction:
                rates = v[v.size - n :] + u
                slipping = np.clip(rates / model.joint_friction.transition, -1.0, 1.0)
                tau = tau - values["viscous"] * rates - values["coulomb"] * slipping
        return np.concatenate([[r, f], hit.derivative(list(y[2 : 2 + k]), f), tau, -u])

    def over(t: float, y: Array) -> float:
        r = rate(t, y)
        return 1.0 if r > 0 else float(law.branch(float(y[0]), r, False))

    over.terminal, over.direction = True, -1  # type: ignore[attr-defined]
    start = np.zeros(2 + k + 2 * n)
    pace = rate(0.0, start)
    if pace == 0:  # neither approaches nor parts: the next derivative decides
        soon = 1e-9
        pace = rate(soon, start + soon * flow(0.0, start)) / soon * model.horizon
    if not pace > 0:
        return Expected(impulse=0.0, duration=0.0, separated=True)
    size = np.full(start.size, 1e-9)
    size[0], size[1] = 1e-9 * pace * 1e-3, 1e-9 * pace / max(m, 1e-9)
    way = solve_ivp(
        flow, (0.0, model.horizon), start, method=method, rtol=rtol, atol=np.minimum(size, 1e-9) * 1e-3,
        events=over, max_step=model.horizon / 50, first_step=min(1e-9, model.step_length * 1e-3),
    )  # fmt: skip
    return Expected(impulse=float(way.y[1, -1]), duration=float(way.t[-1]), separated=way.status == 1)
