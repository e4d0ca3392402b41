"""The trust region, and the Levenberg term that makes hard QPs easier."""

from __future__ import annotations

from dataclasses import dataclass

_SMALLEST = 1e-9


@dataclass
class TrustRegion:
    """|d|_inf <= radius, and levenberg * I added to the Hessian.

    Attributes
    ----------
    radius, radius_max : now, and at most.
    levenberg, levenberg_min : now, and at least.
    """

    radius: float
    radius_max: float
    levenberg: float
    levenberg_min: float

    @property
    def exhausted(self) -> bool:
        """Whether smaller steps, or stiffer QPs, make no sense any more."""
        return self.radius < _SMALLEST or self.levenberg > 1e8

    def after_step(self, ratio: float, length: float, *, accepted: bool, hard: bool) -> None:
        """Adapt to a step (Nocedal and Wright 2006, algorithm 4.1).

        Parameters
        ----------
        ratio : actual over predicted decrease of the merit function.
        length : |d|_inf of the step.
        accepted : whether it was taken.
        hard : whether its QP could be solved inaccurately only.
        """
        if not accepted:
            self.radius = 0.35 * min(self.radius, length)
        elif ratio > 0.7 and length > 0.7 * self.radius:
            self.radius = min(2.0 * self.radius, self.radius_max)
        elif ratio < 0.1:
            self.radius = 0.5 * min(self.radius, length)
        if hard:
            self.levenberg = min(max(4.0 * self.levenberg, 0.1), 10.0)
        elif ratio > 0.4:
            relaxed = 0.25 * self.levenberg
            self.levenberg = max(relaxed if relaxed > 1e-4 else 0.0, self.levenberg_min)

    def after_failure(self) -> None:
        """Make the next QP easier than the one that could not be solved."""
        self.radius *= 0.5
        self.levenberg = max(10.0 * self.levenberg, 0.1)

    def widen(self, radius: float) -> None:
        """Start anew from at least this radius."""
        self.radius = max(self.radius, min(radius, self.radius_max))
