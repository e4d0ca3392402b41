"""First zero and maximum of a polynomial, from its Bernstein coefficients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]

# subintervals of [0, 1] shorter than this are not subdivided further
_SHORTEST_INTERVAL = 2.0**-50
# relative rounding error of the coefficients of a subdivided polynomial
_SUBDIVISION_ROUNDING = 1e-14


def first_negative(b: Array, start: float = 0.0, length: float = 1.0) -> float | None:
    """First point at which a polynomial becomes negative, or None, from its Bernstein coefficients.

    The interval is [start, start + length]. The polynomial lies in the convex hull of its coefficients and
    has at most as many roots as they have sign changes (Lane and Riesenfeld, BIT 21 (1981) 112-117). The
    interval is halved until this decides.
    """
    if (b >= 0).all():
        return None
    if b[0] < 0 or (b <= 0).all():
        return start
    if length < _SHORTEST_INTERVAL:
        return start if b[-1] < 0 else None
    signs = np.sign(b[b != 0])
    if b[0] > 0 and b[-1] < 0 and (np.diff(signs) != 0).sum() == 1:
        # one sign change: exactly one root
        root = brentq(lambda s: _halves(b, s)[0][-1], 0.0, 1.0, xtol=1e-18, rtol=1e-15)
        return start + length * float(root)
    left, right = _halves(b, 0.5)
    found = first_negative(left, start, length / 2)
    return first_negative(right, start + length / 2, length / 2) if found is None else found


def largest(b: Array, end: float, least: float) -> float:
    """Maximum of `least` and of a polynomial on [0, end], up to rounding, from its Bernstein coefficients.

    The largest coefficient is an upper bound of the values. It converges to their maximum with the square of
    the subintervals' length.
    """
    if b.max() <= least + _SUBDIVISION_ROUNDING * np.abs(b).max():
        return least
    b = _halves(b, end)[0] if end < 1.0 else b
    # the end coefficients are values of the polynomial
    least = max(least, float(b[0]), float(b[-1]))
    if b.max() <= least + _SUBDIVISION_ROUNDING * np.abs(b).max():
        return least
    left, right = _halves(b, 0.5)
    return largest(right, 1.0, largest(left, 1.0, least))


def _halves(b: Array, s: float) -> tuple[Array, Array]:
    """Bernstein coefficients of a polynomial on [0, s] and on [s, 1] (de Casteljau)."""
    left, right, row = np.empty_like(b), np.empty_like(b), b
    for k in range(b.size):
        left[k], right[-1 - k] = row[0], row[-1]
        row = (1.0 - s) * row[:-1] + s * row[1:]
    return left, right
