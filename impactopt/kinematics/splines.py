"""Cubic B-splines of motions, and Radau IIA collocation.

Reasons for cubic splines: At a break a spline depends on three control points only, so a node of the program
has few variables. Accelerations are piecewise linear, so a torque within its limit at the nodes is nearly so
between them. Control points bound the curve, so limits of position and velocity hold everywhere. Breaks are
graded, with short intervals near the contact, where motions are fastest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline

from impactopt.arrays import Array


def graded_breaks(intervals: int, ratio: float, *, fine_end: bool) -> Array:
    """Breaks (intervals + 1,) on [0, 1] with geometrically growing lengths.

    ratio : of the longest interval to the shortest, which is at the end if ``fine_end``, else at the start.
    """
    lengths = ratio ** np.linspace(0.0, 1.0, intervals)
    lengths /= lengths.sum()
    breaks = np.concatenate([[0.0], np.cumsum(lengths)])
    # Rounding of the sum.
    breaks[-1] = 1.0
    return np.asarray(1.0 - breaks[::-1] if fine_end else breaks)


def knots(breaks: Array) -> Array:
    """Clamped knot vector (N + 7,) of cubic splines with N + 1 breaks."""
    # End knots four times (degree + 1): the curve begins and ends at a control point.
    return np.concatenate([[breaks[0]] * 3, breaks, [breaks[-1]] * 3])


def basis(breaks: Array, s: ArrayLike) -> tuple[Array, Array, Array]:
    """Weights (k, N + 3) of the control points in value, first and second derivative by s, at s (k,)."""
    curve = BSpline(knots(breaks), np.eye(len(breaks) + 2), 3)
    at = np.atleast_1d(np.asarray(s, dtype=float))
    return curve(at), curve(at, 1), curve(at, 2)


def rate_weights(breaks: Array) -> Array:
    """Factors (N + 2,) of the derivative's control points  factor_j (c_{j+1} - c_j),  which bound it."""
    t = knots(breaks)
    # Derivative of a B-spline of degree p: control points p (c_{j+1} - c_j) / (t_{j+p+1} - t_{j+1}); p = 3.
    return np.asarray(3.0 / (t[4:-1] - t[1:-4]))


@dataclass(frozen=True, kw_only=True)
class CubicSpline:
    """C2 curve over s in [0, 1]; time is t = duration * s.

    control : (N + 3, d) control points; the first and the last are the curve's ends.
    breaks : (N + 1,) from 0 to 1.
    duration : [s].
    """

    control: Array
    breaks: Array
    duration: float

    def sample(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Positions, velocities, accelerations (each (k, d)) at times [s], clipped to [0, duration]."""
        s = np.clip(np.atleast_1d(np.asarray(times, dtype=float)) / self.duration, 0.0, 1.0)
        curve = BSpline(knots(self.breaks), self.control, 3)
        return curve(s), curve(s, 1) / self.duration, curve(s, 2) / self.duration**2

    @classmethod
    def fit(
        cls, values: Array, breaks: Array, start_rate: Array, end_rate: Array, duration: float
    ) -> CubicSpline:
        """Interpolant of ``values`` (N + 1, d) at the breaks with given end velocities (d,) [1/s]."""
        value, rate, _ = basis(breaks, breaks)
        # N + 1 values and two rates for N + 3 control points.
        a = np.vstack([value, rate[:1] / duration, rate[-1:] / duration])
        b = np.vstack([values, start_rate, end_rate])
        return cls(control=np.linalg.solve(a, b).astype(np.float64), breaks=breaks, duration=duration)


def quintic(
    start: Array, start_rate: Array, end: Array, end_rate: Array, duration: float, s: ArrayLike
) -> Array:
    """Positions (k, d) at s (k,) in [0, 1] of the quintic with zero accelerations at both ends.

    start, end (d,); start_rate, end_rate (d,) [1/s]. Without rates it is the minimum-jerk curve.
    """
    s = np.atleast_1d(np.asarray(s, dtype=float))[:, None]
    v0, v1, gap = start_rate * duration, end_rate * duration, end - start
    # c2 = 0, as the acceleration at s = 0 is zero; the other three meet position, rate
    # and acceleration at s = 1.
    c3 = 10 * gap - 6 * v0 - 4 * v1
    c4 = -15 * gap + 8 * v0 + 7 * v1
    c5 = 6 * gap - 3 * (v0 + v1)
    return np.asarray(start + v0 * s + c3 * s**3 + c4 * s**4 + c5 * s**5)


@dataclass(frozen=True)
class Radau:
    """Radau IIA collocation: stage times c (s,) and matrix A (s, s).

    It is stiffly accurate, so a stiff mode of the servo is damped instead of oscillating.

    Source: Hairer & Wanner, Solving ODEs II, tables IV.5.5 and IV.5.6.
    """

    c: Array
    a: Array

    @classmethod
    def of_stages(cls, stages: int) -> Radau:
        if stages == 2:
            return cls(np.array([1 / 3, 1.0]), np.array([[5 / 12, -1 / 12], [3 / 4, 1 / 4]]))
        if stages == 3:
            r = np.sqrt(6.0)
            c = np.array([(4 - r) / 10, (4 + r) / 10, 1.0])
            a = np.array(
                [
                    [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
                    [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
                    [(16 - r) / 36, (16 + r) / 36, 1 / 9],
                ]
            )
            return cls(c, a)
        raise ValueError(f"Radau IIA with 2 or 3 stages, not {stages}")
