"""When striker and target touched."""

from __future__ import annotations

import numpy as np


class Touches:
    """Intervals of contact, told step by step. A graze before or after the blow is an interval of its own."""

    def __init__(self) -> None:
        self.intervals: list[list[float]] = []  # start [s], end [s], impulse [N s]
        self.touching = False

    def add(self, t: float, force: float, step: float, since: float = 0.0) -> None:
        """The contact's mean force [N] in the step that begins at time t [s]; since [s]: when in it there was
        one first."""
        if force > 0:
            if not self.touching:
                self.intervals.append([t + since, t + since, 0.0])
            self.intervals[-1][2] += force * step
        if self.touching or force > 0:
            self.intervals[-1][1] = max(t, self.intervals[-1][0])
        self.touching = force > 0

    def blow(self) -> tuple[float, float]:
        """Start and end [s] of the contact with the largest impulse; nan if there was none."""
        if not self.intervals:
            return np.nan, np.nan
        start, end, _ = max(self.intervals, key=lambda interval: interval[2])
        return start, end
