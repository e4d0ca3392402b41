"""Whether a step is progress: the l1 merit function, and a filter for the steps it refuses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from impactopt.solvers.sqp.point import Point


@dataclass
class Merit:
    """phi = sigma f + price * sum of violations (Nocedal and Wright 2006, eq. 18.27 and section 18.5).

    Attributes
    ----------
    price : of a unit of violation; exact once it exceeds the multipliers.
    price_max : it never rises above this.
    sigma : 1, or 0 while only the violation counts (restoration).
    """

    price: float
    price_max: float
    sigma: float = 1.0

    def value(self, point: Point) -> float:
        """phi at the point; inf where f or g is not finite."""
        return self.sigma * point.objective + self.price * point.violation if point.finite else np.inf

    def pay_for(self, change: float, relief: float) -> None:
        """Raise the price so that a step is predicted to be progress (eq. 18.36).

        Parameters
        ----------
        change : predicted change of the objective.
        relief : predicted decrease of the sum of violations.
        """
        if relief > 0.0 and change > 0.7 * self.price * relief:
            self.price = min(1.5 * change / relief, self.price_max)

    def settle(self, largest: float, least: float, *, lower: bool) -> None:
        """Bring the price near the largest multiplier: up where below; down, if wanted, where far above."""
        if self.price < 1.2 * largest:
            self.price = min(1.5 * largest, self.price_max)
        elif lower:
            self.price = min(self.price, max(10.0 * largest, least))


@dataclass
class Filter:
    """Pairs of violation and objective (Fletcher, Leyffer 2002); who beats each in one of the two passes."""

    pairs: list[tuple[float, float]] = field(default_factory=list)

    def passes(self, point: Point) -> bool:
        """Whether the point would be taken."""
        v, f = point.violation, point.objective
        return point.finite and all(v < 0.9 * w or f < h - 0.1 * v for w, h in self.pairs)

    def add(self, point: Point) -> None:
        """Remember a point that was taken."""
        v, f = point.violation, point.objective
        self.pairs = [(w, h) for w, h in self.pairs if w < v or h < f]
        self.pairs.append((v, f))
