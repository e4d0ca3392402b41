"""Filter and switching rule of the interior-point method: acceptance of its steps.

Source: Waechter and Biegler 2006, section 2.3; equation numbers are that paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_VIOLATION, _OBJECTIVE = 1e-5, 1e-8  # gamma_theta, gamma_phi of eq. 18
_ARMIJO, _SWITCH, _VIOLATION_POWER, _SLOPE_POWER = 1e-8, 1.0, 1.1, 2.3  # eta, delta, s_theta, s_phi
_SHORTEST = 0.05  # gamma_alpha of eq. 23


@dataclass(frozen=True, kw_only=True)
class SearchStart:
    """Start of a line search: violation theta, barrier function phi and its slope along the step."""

    theta: float
    phi: float
    slope: float

    def switches(self, length: float) -> bool:
        """True if a step of that length is to lessen phi rather than theta (eq. 19)."""
        return (
            self.slope < 0.0
            and length * (-self.slope) ** _SLOPE_POWER > _SWITCH * self.theta**_VIOLATION_POWER
        )

    def falls(self, length: float, phi: float) -> bool:
        """True if phi falls as its slope lets expect: Armijo's condition, eq. 20, but for rounding."""
        return phi <= self.phi + _ARMIJO * length * self.slope + 1e-13 * abs(self.phi)


@dataclass
class Filter:
    """Pairs (theta, phi) that no later point may be worse than in both."""

    least: float
    most: float
    pairs: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def around(cls, theta: float) -> Filter:
        """A filter for a run that starts with this violation (section 3.3)."""
        return cls(least=1e-4 * max(1.0, theta), most=1e4 * max(1.0, theta))

    def shortest(self, at: SearchStart) -> float:
        """The length below which no step will do (eq. 23)."""
        length = _VIOLATION
        if at.slope < 0.0:
            length = min(length, _OBJECTIVE * at.theta / -at.slope)
            if at.theta <= self.least:
                length = min(length, _SWITCH * at.theta**_VIOLATION_POWER / (-at.slope) ** _SLOPE_POWER)
        return max(_SHORTEST * length, 1e-14)

    def accepts(self, at: SearchStart, length: float, theta: float, phi: float) -> bool:
        """True if a trial point is taken (steps A-5.3 and A-5.4)."""
        if not (np.isfinite(theta) and np.isfinite(phi)) or theta > self.most:
            return False
        if any(theta >= t and phi >= p for t, p in self.pairs):
            return False
        # Where a step is to lessen phi, a little less violation is not enough: the iterates would go to a
        # feasible point that is no optimum.
        if at.theta <= self.least and at.switches(length):
            return at.falls(length, phi)
        return theta <= (1.0 - _VIOLATION) * at.theta or phi <= at.phi - _OBJECTIVE * at.theta

    def remember(self, at: SearchStart, length: float, phi: float) -> None:
        """Augment the filter, but after a step for phi's sake (eq. 22)."""
        if at.switches(length) and at.falls(length, phi):
            return
        pair = (1.0 - _VIOLATION) * at.theta, at.phi - _OBJECTIVE * at.theta
        self.pairs = [(t, p) for t, p in self.pairs if t < pair[0] or p < pair[1]] + [pair]
