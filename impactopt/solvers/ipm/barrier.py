"""Values between bounds under a logarithmic barrier, with the multipliers of their bounds.

Source: Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, Mathematical Programming 106, 2006; equation numbers are that paper's.
"""

from __future__ import annotations

import numpy as np

from impactopt.solvers.program import Vector

_SAFEGUARD = 1e10  # multipliers stay within this factor of mu / distance (eq. 16)


class Bounded:
    """Values v (k,) strictly between bounds, which may be infinite.

    Attributes
    ----------
    values : v.
    below, above : multipliers of the lower and the upper bound, 0 where there is none.
    """

    def __init__(
        self,
        values: Vector,
        lower: Vector,
        upper: Vector,
        *,
        push: float,
        multipliers: Vector,
        mu: float,
        kept: bool = False,
    ):
        """values : moved inside by `push`, relative to the bound and to the room between both (section 3.6).

        multipliers (k,) : positive at the upper bound, negative at the lower; each gets mu / distance at
        least.  kept : only where it has none.
        """
        # 1 where there is a bound, else 0; and the bound, else 0
        self._has_lower, self._has_upper = np.isfinite(lower).astype(float), np.isfinite(upper).astype(float)
        self._lower = np.where(self._has_lower > 0, lower, 0.0)
        self._upper = np.where(self._has_upper > 0, upper, 0.0)
        self._take(self._inside(values, push))
        low, high = mu / self._to_lower, mu / self._to_upper
        if kept:
            low, high = np.where(multipliers < 0, 0.0, low), np.where(multipliers > 0, 0.0, high)
        self.below = self._has_lower * np.maximum(-multipliers, low)
        self.above = self._has_upper * np.maximum(multipliers, high)

    def _take(self, values: Vector) -> None:
        self.values = values
        self._to_lower, self._to_upper = self._distances(values)

    def _inside(self, values: Vector, push: float) -> Vector:
        has_lower, has_upper, low, high = self._has_lower > 0, self._has_upper > 0, self._lower, self._upper
        room = np.where(has_lower & has_upper, push * (high - low), np.inf)
        least = low + np.minimum(push * np.maximum(1.0, np.abs(low)), room)
        most = high - np.minimum(push * np.maximum(1.0, np.abs(high)), room)
        return np.clip(values, np.where(has_lower, least, -np.inf), np.where(has_upper, most, np.inf))

    def _distances(self, values: Vector) -> tuple[Vector, Vector]:
        """Distances to both bounds; 1 where there is none."""
        return (
            self._has_lower * (values - self._lower) + (1.0 - self._has_lower),
            self._has_upper * (self._upper - values) + (1.0 - self._has_upper),
        )

    @property
    def multiplier(self) -> Vector:
        """Multipliers of both bounds together: positive where the upper one holds."""
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
        out: Vector = mu * (self._has_upper / self._to_upper - self._has_lower / self._to_lower)
        return out

    def stiffness(self) -> Vector:
        """Part that the multipliers add to the Hessian's diagonal (eq. 13)."""
        return self.below / self._to_lower + self.above / self._to_upper

    def off(self, mu: float) -> float:
        """Largest |multiplier x distance - mu|."""
        gaps = (
            self.below * self._to_lower - mu * self._has_lower,
            self.above * self._to_upper - mu * self._has_upper,
        )
        return max(float(np.abs(g).max(initial=0.0)) for g in gaps)

    def longest(self, step: Vector, keep: float) -> float:
        """The longest part <= 1 of a step that leaves 1 - keep of every distance (eq. 15a)."""
        return min(
            longest(self._to_lower, self._has_lower * step, keep),
            longest(self._to_upper, -self._has_upper * step, keep),
        )

    def short_of_bounds(self, values: Vector, keep: float) -> Vector:
        """New values, each moved to where it takes no more than a part `keep` of its distance to a bound."""
        least = np.where(self._has_lower > 0, self.values - keep * self._to_lower, -np.inf)
        most = np.where(self._has_upper > 0, self.values + keep * self._to_upper, np.inf)
        return np.clip(values, least, most)

    def dual_step(self, step: Vector, mu: float, keep: float) -> tuple[Vector, Vector, float]:
        """Both multipliers' steps for a step of the values, eq. 12, and the longest part of them, eq. 15b."""
        below = (mu * self._has_lower - self.below * step) / self._to_lower - self.below
        above = (mu * self._has_upper + self.above * step) / self._to_upper - self.above
        return below, above, min(longest(self.below, below, keep), longest(self.above, above, keep))

    def move(self, values: Vector, below: Vector, above: Vector, mu: float) -> None:
        """Take new values, and multipliers kept near mu / distance."""
        self._take(values)
        low, high = mu / self._to_lower, mu / self._to_upper
        self.below = self._has_lower * np.clip(below, low / _SAFEGUARD, low * _SAFEGUARD)
        self.above = self._has_upper * np.clip(above, high / _SAFEGUARD, high * _SAFEGUARD)


def longest(room: Vector, step: Vector, keep: float) -> float:
    """The longest part <= 1 of a step that leaves 1 - keep of the room that it shrinks."""
    shrinks = step < 0.0
    return min(1.0, float((keep * room[shrinks] / -step[shrinks]).min(initial=1.0)))
