"""Values between bounds under a logarithmic barrier, with the multipliers of their bounds.

Source: Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, Mathematical Programming 106, 2006; equation numbers are that paper's.
"""

from __future__ import annotations

import numpy as np

from impactopt.program import Vector

_SAFEGUARD = 1e10  # multipliers stay within this factor of mu / distance (eq. 16)


class Bounded:
    """Values v (k,) strictly between bounds, which may be infinite.

    Attributes
    ----------
    values : v.
    below, above : multipliers of the lower and the upper bound, 0 where there is none.
    """

    def __init__(
        self, values: Vector, lower: Vector, upper: Vector, *, push: float, multipliers: Vector, mu: float
    ):
        """values : moved inside by `push`, relative to the bound and to the room between both (section 3.6).

        multipliers (k,) : positive at the upper bound, negative at the lower; each gets mu / distance at
        least.
        """
        self._lower, self._upper = lower, upper
        self._has_lower, self._has_upper = np.isfinite(lower), np.isfinite(upper)
        self.values = self._inside(values, push)
        low, high = self._distances()
        self.below = np.where(self._has_lower, np.maximum(-multipliers, mu / low), 0.0)
        self.above = np.where(self._has_upper, np.maximum(multipliers, mu / high), 0.0)

    def _inside(self, values: Vector, push: float) -> Vector:
        lower, upper = self._lower, self._upper
        room = np.where(self._has_lower & self._has_upper, push * (upper - lower), np.inf)
        low = np.where(self._has_lower, lower, 0.0)
        high = np.where(self._has_upper, upper, 0.0)
        least = np.where(
            self._has_lower, low + np.minimum(push * np.maximum(1.0, np.abs(low)), room), -np.inf
        )
        most = np.where(
            self._has_upper, high - np.minimum(push * np.maximum(1.0, np.abs(high)), room), np.inf
        )
        return np.clip(values, least, most)

    def _distances(self, values: Vector | None = None) -> tuple[Vector, Vector]:
        """To both bounds; 1 where there is none."""
        v = self.values if values is None else values
        low = np.where(self._has_lower, v - np.where(self._has_lower, self._lower, 0.0), 1.0)
        high = np.where(self._has_upper, np.where(self._has_upper, self._upper, 0.0) - v, 1.0)
        return low, high

    @property
    def multiplier(self) -> Vector:
        """Of both bounds together: positive where the upper one holds."""
        return self.above - self.below

    @property
    def bounds(self) -> int:
        """Number of finite bounds."""
        return int(self._has_lower.sum() + self._has_upper.sum())

    def total(self) -> float:
        """Sum of the multipliers."""
        return float(self.below.sum() + self.above.sum())

    def barrier(self, values: Vector) -> float:
        """- sum of the logarithms of the distances to the bounds."""
        low, high = self._distances(values)
        if low.min(initial=1.0) <= 0.0 or high.min(initial=1.0) <= 0.0:
            return np.inf
        return -float(np.log(low).sum() + np.log(high).sum())

    def slope(self, mu: float) -> Vector:
        """Gradient of mu times the barrier."""
        low, high = self._distances()
        return np.where(self._has_upper, mu / high, 0.0) - np.where(self._has_lower, mu / low, 0.0)

    def stiffness(self) -> Vector:
        """What the multipliers add to the Hessian's diagonal (eq. 13)."""
        low, high = self._distances()
        return self.below / low + self.above / high

    def off(self, mu: float) -> float:
        """Largest |multiplier x distance - mu|."""
        low, high = self._distances()
        gaps = (
            np.where(self._has_lower, self.below * low - mu, 0.0),
            np.where(self._has_upper, self.above * high - mu, 0.0),
        )
        return max(float(np.abs(g).max(initial=0.0)) for g in gaps)

    def longest(self, step: Vector, keep: float) -> float:
        """The longest part <= 1 of a step that leaves 1 - keep of every distance (eq. 15a)."""
        low, high = self._distances()
        return min(
            longest(low, np.where(self._has_lower, step, 0.0), keep),
            longest(high, np.where(self._has_upper, -step, 0.0), keep),
        )

    def short_of_bounds(self, values: Vector, keep: float) -> Vector:
        """New values, each moved to where it takes no more than a part `keep` of its distance to a bound."""
        low, high = self._distances()
        least = np.where(self._has_lower, self.values - keep * low, -np.inf)
        most = np.where(self._has_upper, self.values + keep * high, np.inf)
        return np.clip(values, least, most)

    def dual_step(self, step: Vector, mu: float, keep: float) -> tuple[Vector, Vector, float]:
        """Both multipliers' steps for a step of the values, eq. 12, and the longest part of them, eq. 15b."""
        low, high = self._distances()
        below = np.where(self._has_lower, mu / low - self.below - self.below / low * step, 0.0)
        above = np.where(self._has_upper, mu / high - self.above + self.above / high * step, 0.0)
        return below, above, min(longest(self.below, below, keep), longest(self.above, above, keep))

    def move(self, values: Vector, below: Vector, above: Vector, mu: float) -> None:
        """Take new values, and multipliers kept near mu / distance."""
        self.values = values
        low, high = self._distances()
        self.below = np.where(
            self._has_lower, np.clip(below, mu / low / _SAFEGUARD, mu / low * _SAFEGUARD), 0.0
        )
        self.above = np.where(
            self._has_upper, np.clip(above, mu / high / _SAFEGUARD, mu / high * _SAFEGUARD), 0.0
        )


def longest(room: Vector, step: Vector, keep: float) -> float:
    """The longest part <= 1 of a step that leaves 1 - keep of the room that it shrinks."""
    shrinks = step < 0.0
    return min(1.0, float((keep * room[shrinks] / -step[shrinks]).min(initial=1.0)))
