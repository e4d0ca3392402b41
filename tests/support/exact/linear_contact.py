"""Contact laws and targets that are linear between events, as coefficients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt import Board, ContactLaw, InputError, Nail, Target

Array = NDArray[np.float64]
_INSTEAD = "the exact solution: {} is not linear between events; measure by SciPy"


def force_coefficients(law: ContactLaw, numbers: Mapping[str, float]) -> tuple[Array, Array]:
    """(f_0, k, d) of f = f_0 + k x + d dx/dt, in restitution and in compression.

    Raises
    ------
    InputError : the law is not of this form.
    """
    found = []
    for sign, compressing in ((-1.0, False), (1.0, True)):

        def force(x: float, rate: float, sign: float = sign, compressing: bool = compressing) -> float:
            return float(law.branch(x, sign * rate, compressing, numbers))

        zero = force(0.0, 0.0)
        c = np.array([zero, force(1.0, 0.0) - zero, sign * (force(0.0, 1.0) - zero)])
        for x, rate in ((1e-5, 0.01), (1e-4, 0.0), (1e-3, 1.0), (1e-2, 0.3), (0.0, 5.0), (0.1, 3.0)):
            terms = c * (1.0, x, sign * rate)
            if not abs(force(x, rate) - terms.sum()) <= 1e-9 * (np.abs(terms).sum() + abs(zero)):
                raise InputError(_INSTEAD.format(type(law).__name__))
        found.append(c)
    return found[0], found[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetMode:
    """A target's motion between two switches, linear in its state (k), the force and one.

    Attributes
    ----------
    derivative : (k, k + 2) of state, force, one.
    velocity : (k + 2) the same, without force.
    watched : (k + 2) what stays within `bounds` while the mode lasts; None where it lasts for good.
    bounds : of the form watched.
    following : number of the mode that comes next.
    stopped : the target stands still: its first state, the speed, is zero.
    """

    derivative: Array
    velocity: Array
    watched: Array | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)
    following: int = 0
    stopped: bool = False


def target_modes(target: Target, p: Mapping[str, float]) -> tuple[TargetMode, ...]:
    """A target's modes, the first being that at contact.

    Raises
    ------
    InputError : a target that is not linear between switches, or whose switches are not known here.
    """
    if isinstance(target, Nail):
        R, growth, m = p["resistance"] + p["hardening"] * p["depth"], p["hardening"], p["mass"]
        driven = np.array([[0.0, -growth / m, 1 / m, -R / m], [1.0, 0.0, 0.0, 0.0]])
        v, beyond = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, -growth, 1.0, -R])
        none = np.zeros((2, 4))
        below, above = (-np.inf, 0.0), (0.0, np.inf)
        return (
            TargetMode(
                derivative=none, velocity=none[0], watched=beyond, bounds=below, following=1, stopped=True
            ),
            TargetMode(derivative=driven, velocity=v, watched=v, bounds=above, following=0),
        )
    if isinstance(target, Board):
        k, d, m = p["stiffness"], p["damping"], p["mass"]
        surface = np.array([1.0, 0.0, 0.0, p["initial_velocity"]])
        v, w = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
        bent = np.array([[-d / m, -k / m, 1 / m, 0.0], v])
        free = np.array([[0.0, 0.0, 1 / m, 0.0], v])
        limit = (-np.inf, p["breaking_force"] / k)
        return (
            TargetMode(derivative=bent, velocity=surface, watched=w, bounds=limit, following=1),
            TargetMode(derivative=free, velocity=surface),
        )
    return (_smooth_target(target, p),)


def _smooth_target(target: Target, numbers: Mapping[str, float]) -> TargetMode:
    k = target.n_states

    def value(x: Array) -> Array:
        state, force = [float(s) for s in x[:k]], float(x[k])
        rates = target.derivative(state, force, numbers)
        return np.array([*rates, target.velocity(state, numbers)], dtype=float)

    zero = value(np.zeros(k + 1))
    slopes = [value(unit) - zero for unit in np.eye(k + 1)]
    matrix = np.column_stack([*slopes, zero])
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-2, 0.1, 1.0, 10.0):
        x = size * rng.uniform(-1.0, 1.0, k + 1)
        x[k] = 100.0 * abs(x[k])
        terms = matrix * np.append(x, 1.0)
        if not (np.abs(value(x) - terms.sum(axis=1)) <= 1e-9 * (np.abs(terms).sum(axis=1) + 1e-12)).all():
            raise InputError(_INSTEAD.format(type(target).__name__))
    if target.switches([0.0] * k, 0.0, numbers):
        raise InputError(_INSTEAD.format(f"{type(target).__name__} with switches of its own"))
    return TargetMode(derivative=matrix[:k], velocity=matrix[k])
