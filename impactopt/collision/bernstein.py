"""Polynomials on [0, 1] in Bernstein form, whose coefficients enclose them: no root hides between samples."""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

__all__ = ["bernstein_matrix", "first_negative", "largest"]

Array = NDArray[np.float64]

# parts of [0, 1] below this length are not told apart
_SHORTEST = 2.0**-50
# relative: halves of a polynomial are exact up to this
_ROUNDING = 1e-14


def bernstein_matrix(degree: int) -> Array:
    """(degree + 1, degree + 1): Bernstein coefficients are this times those of 1, s, s^2, ...

    No entry is negative, so that nothing is lost by rounding where the powers' coefficients fall off.
    """
    n = range(degree + 1)
    return np.array([[comb(i, k) / comb(degree, k) if k <= i else 0.0 for k in n] for i in n])


def first_negative(b: Array, start: float = 0.0, length: float = 1.0) -> float | None:
    """First place at which a polynomial, given by its Bernstein coefficients, falls below zero; None if
    nowhere.

    The polynomial lies in its coefficients' convex hull, and has no more roots than they have sign changes
    (Lane and Riesenfeld, BIT 21 (1981) 112-117): parts are halved until that decides.
    """
    if (b >= 0).all():
        return None
    if b[0] < 0 or (b <= 0).all():
        return start
    if length < _SHORTEST:
        return start if b[-1] < 0 else None
    signs = np.sign(b[b != 0])
    if b[0] > 0 and b[-1] < 0 and (np.diff(signs) != 0).sum() == 1:
        root = brentq(lambda s: _halves(b, s)[0][-1], 0.0, 1.0, xtol=1e-18, rtol=1e-15)
        return start + length * float(root)
    left, right = _halves(b, 0.5)
    found = first_negative(left, start, length / 2)
    return first_negative(right, start + length / 2, length / 2) if found is None else found


def largest(b: Array, end: float, least: float) -> float:
    """The greatest of `least` and a polynomial's values on [0, end], but for rounding.

    No value is above the greatest coefficient, which comes down to the values with the square of the length
    of the parts.
    """
    if b.max() <= least + _ROUNDING * np.abs(b).max():
        return least
    b = _halves(b, end)[0] if end < 1.0 else b
    least = max(least, float(b[0]), float(b[-1]))
    if b.max() <= least + _ROUNDING * np.abs(b).max():
        return least
    left, right = _halves(b, 0.5)
    return largest(right, 1.0, largest(left, 1.0, least))


def _halves(b: Array, s: float) -> tuple[Array, Array]:
    """Coefficients of the parts on [0, s] and [s, 1] (de Casteljau)."""
    left, right, row = np.empty_like(b), np.empty_like(b), b
    for k in range(b.size):
        left[k], right[-1 - k] = row[0], row[-1]
        row = (1.0 - s) * row[:-1] + s * row[1:]
    return left, right
