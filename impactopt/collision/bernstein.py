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
# next to an extremum the polynomial is flat: so far from it nothing changes
_NEXT = 1e-9


def bernstein_matrix(degree: int) -> Array:
    """(degree + 1, degree + 1): Bernstein coefficients are this times those of 1, s, s^2, ...

    No entry is negative, so that nothing is lost by rounding where the powers' coefficients fall off.
    """
    n = range(degree + 1)
    return np.array([[comb(i, k) / comb(degree, k) if k <= i else 0.0 for k in n] for i in n])


def first_negative(b: Array, start: float = 0.0, length: float = 1.0) -> float | None:
    """Where a polynomial, given by its Bernstein coefficients, falls below zero first; None: nowhere.

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
    """The greatest of `least` and a polynomial's values on [0, end]."""
    if b.max() <= least:
        return least
    b = _halves(b, end)[0]
    least = max(least, float(b[0]), float(b[-1]))
    slope = np.diff(b)
    if b.max() <= least or (slope >= 0).all() or (slope <= 0).all():
        return least
    # up to the next extremum, and on from just beyond it
    place = first_negative(slope if slope[0] >= 0 else -slope)
    if place is None:
        return least
    least = max(least, float(_halves(b, place)[0][-1]))
    place = max(place, _NEXT)
    return least if place >= 1.0 else largest(_halves(b, place)[1], 1.0, least)


def _halves(b: Array, s: float) -> tuple[Array, Array]:
    """Coefficients of the parts on [0, s] and [s, 1] (de Casteljau)."""
    left, right, row = np.empty_like(b), np.empty_like(b), b
    for k in range(b.size):
        left[k], right[-1 - k] = row[0], row[-1]
        row = (1.0 - s) * row[:-1] + s * row[1:]
    return left, right
