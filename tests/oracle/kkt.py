"""The KKT residual of a program in pieces, with gradients by differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
STEP, SMALLEST = 1e-3, 1e-6  # of a variable of order one
ENOUGH = 1e-8  # a difference is fine enough that changes by less when its step is halved


@dataclass(frozen=True, kw_only=True)
class Residual:
    """What is left of the KKT conditions.

    stationarity : largest entry of grad f + J'y + z, over the multipliers' scale.  variable : its number.
    complementarity : largest product of a multiplier and the distance to the bound it pushes at.
    doubt : how far differences with steps h and h/2 are apart at most, over that scale: what stationarity is
    known to.
    """

    stationarity: float
    complementarity: float
    variable: int
    doubt: float

    @property
    def kkt(self) -> float:
        return max(self.stationarity, self.complementarity)


def lagrangian_gradient(
    pieces: Sequence[Piece], weights: Sequence[Array], v: Variables
) -> tuple[Array, Array]:
    """Gradient (n,) of the sum of weights . value over pieces, and what it is known to.

    Each piece touches a few variables. Central differences with steps h and h/2 are extrapolated to h = 0; h
    is made smaller while the two are not alike.
    """
    gradient, doubt = np.zeros(v.n), np.zeros(v.n)
    for piece, weight in zip(pieces, weights, strict=True):
        used = np.flatnonzero(weight)
        if not used.size:
            continue
        touched = v.read = set()
        piece.value(v)
        v.read = None
        for j in sorted(touched):
            slope, unsure = _slope(piece, weight, v, j)
            gradient[j] += slope
            doubt[j] += unsure
    return gradient, doubt


def _slope(piece: Piece, weight: Array, v: Variables, j: int) -> tuple[float, float]:
    """d(weight . value)/dx_j, and how far the differences that it is made of are apart."""
    x = float(v.x[j])
    step, best, least = STEP * (min(abs(x), 1.0) or 1.0), 0.0, np.inf
    if abs(x) < 1e-6:
        step = STEP
    while True:
        slopes = []
        for h in (step, step / 2):
            v.x[j] = x + h
            above = float(weight @ piece.value(v))
            v.x[j] = x - h
            slopes.append((above - float(weight @ piece.value(v))) / (2 * h))
        v.x[j] = x
        unsure = abs(slopes[1] - slopes[0]) / 3
        if unsure < least:
            best, least = (4 * slopes[1] - slopes[0]) / 3, unsure
        if least <= ENOUGH * max(1.0, abs(best)) or step < SMALLEST:
            return best, least
        step /= 10


def residual(
    gradient: Array,
    doubt: Array,
    of_variables: tuple[Array, Array, Array, Array],
    of_rows: tuple[Array, Array, Array, Array],
) -> Residual:
    """Of grad f + J'y (n,) and what it is known to.

    of_variables : x, lower, upper and the bounds' multipliers (n,).  of_rows : values, lower, upper and
    multipliers (m,). Multipliers are positive at upper bounds. The scale is IPOPT's (Waechter and Biegler
    2006, eq. 6).
    """
    x, lower, upper, z = of_variables
    left = np.where(lower == upper, 0.0, np.abs(gradient + z))  # what is given is no variable
    y = of_rows[3]
    scale = max(100.0, float(np.abs(y).sum() + np.abs(z).sum()) / max(y.size + z.size, 1)) / 100
    slack = [_slack(*of_rows), _slack(x, lower, upper, z)]
    return Residual(
        stationarity=float(left.max(initial=0.0)) / scale,
        complementarity=float(np.concatenate(slack).max(initial=0.0)),
        variable=int(np.argmax(left)) if left.size else 0,
        doubt=float(doubt.max(initial=0.0)) / scale,
    )


def _slack(values: Array, lower: Array, upper: Array, multipliers: Array) -> Array:
    """|multiplier| x distance to the bound that it pushes at; inf where there is none."""
    out, pushes = np.zeros(len(values)), multipliers != 0
    gap = np.abs(np.where(multipliers > 0, upper - values, values - lower))
    out[pushes] = np.abs(multipliers[pushes]) * gap[pushes]
    return out
