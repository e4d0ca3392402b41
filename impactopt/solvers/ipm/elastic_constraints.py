"""Rows that may be violated at a price.

Row = p - n with p, n >= 0 under the barrier, and price (p + n) in the objective.

Source: Waechter and Biegler 2006, section 3.3.1, whose restoration phase does this without the objective.
"""

from __future__ import annotations

import numpy as np

from impactopt.solvers.ipm.barrier import longest
from impactopt.solvers.program import Vector

_LEAST = 1e-14  # of the price: no multiplier is nearer to it


class Elastic:
    """Excess p and lack n of all rows (k,), eliminated from the Newton system.

    Attributes
    ----------
    price : of a unit of violation; multipliers y stay below it.
    """

    def __init__(self, residual: Vector, price: float, mu: float):
        """residual (k,) of the rows."""
        self.price = price
        # on the central path for p - n = residual (eq. 33)
        half = (mu - self.price * residual) / (2.0 * self.price)
        root = np.sqrt(half**2 + mu * residual / (2.0 * self.price))
        with np.errstate(divide="ignore", invalid="ignore"):  # two forms, each where it does not cancel
            low = np.where(half > 0, half + root, -mu * residual / (2.0 * self.price) / (half - root))
        self._n = np.maximum(low, mu / (2e3 * self.price))
        self._p = np.maximum(residual + self._n, mu / (2e3 * self.price))

    def clip(self, y: Vector) -> Vector:
        """Multipliers moved strictly inside the price."""
        return np.clip(y, -0.9 * self.price, 0.9 * self.price)

    def residual(self, residual: Vector) -> Vector:
        """Part of a residual that is neither excess nor lack."""
        return residual - self._p + self._n

    def largest(self) -> float:
        """The largest violation of a row."""
        return float(np.abs(self._p - self._n).max(initial=0.0))

    def compliance(self, y: Vector, mu: float) -> tuple[Vector, Vector]:
        """Compliance of a row per unit of multiplier, and the offset that goes with it."""
        # p (price - y) = mu and n (price + y) = mu, linearized, give the steps of p and n as in `step`. Put
        # into J d + r = (p + dp) - (n + dn), they leave J d + (r - p + n) + offset = give y_new.
        zp, zn = self._below_price(y)
        give = self._p / zp + self._n / zn
        return give, give * y - (mu / zp - self._p) + (mu / zn - self._n)

    def _below_price(self, y: Vector) -> tuple[Vector, Vector]:
        """Distance of the multipliers below the price, and above its opposite: more than rounding."""
        least = _LEAST * self.price
        return np.maximum(self.price - y, least), np.maximum(self.price + y, least)

    def step(self, new: Vector, y: Vector, mu: float) -> None:
        """Find the steps of p and n for new multipliers."""
        dy, (zp, zn) = new - y, self._below_price(y)
        self._dp = (mu - self._p * zp + self._p * dy) / zp
        self._dn = (mu - self._n * zn - self._n * dy) / zn

    def longest(self, keep: float) -> float:
        """The longest part <= 1 of the steps of p and n that keeps them positive."""
        return min(longest(self._p, self._dp, keep), longest(self._n, self._dn, keep))

    def longest_dual(self, new: Vector, y: Vector, keep: float) -> float:
        """The longest part <= 1 of the multipliers' step that keeps them below the price."""
        return min(longest(self.price - y, y - new, keep), longest(self.price + y, new - y, keep))

    def moved(self, length: float) -> tuple[Vector, Vector]:
        """p and n after a part of their steps."""
        return self._p + length * self._dp, self._n + length * self._dn

    def cost(self, p: Vector, n: Vector, mu: float) -> float:
        """Part that p and n add to the barrier function."""
        return float(self.price * (p + n).sum() - mu * (np.log(p).sum() + np.log(n).sum()))

    def now(self, mu: float) -> float:
        """Part that they add now."""
        return self.cost(self._p, self._n, mu)

    def slope(self, mu: float) -> float:
        """Its slope along the steps."""
        return float((self.price - mu / self._p) @ self._dp + (self.price - mu / self._n) @ self._dn)

    def take(self, length: float, residual: Vector) -> None:
        """Move p and n; the larger of the two makes up for what is left of the residual there."""
        p, n = self.moved(length)
        left = residual - (p - n)
        least = 1e-3 * np.minimum(p, n)
        self._p = np.where(p >= n, np.maximum(p + left, least), p)
        self._n = np.where(p >= n, n, np.maximum(n - left, least))

    def off(self, y: Vector, mu: float) -> float:
        """Largest |multiplier x p - mu|, and likewise of n."""
        gaps = np.abs(self._p * (self.price - y) - mu), np.abs(self._n * (self.price + y) - mu)
        return max(float(g.max(initial=0.0)) for g in gaps)
