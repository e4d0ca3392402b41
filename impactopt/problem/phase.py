"""A phase of the motion: how long it may last, and how fine its spline is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from impactopt.errors import InputError, check_array, check_number, raw_array, shortened

__all__ = ["FINEST", "LONGEST", "SHORTEST", "STEEPEST", "Phase"]

SHORTEST, LONGEST = 1e-3, 1e3  # [s] of a phase: no servo is faster, and no blow is prepared for longer
FINEST = 2000  # intervals of a phase: nodes of a swing of 1 s come as often as a servo of 4 kHz samples
STEEPEST = 1e3  # grading


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A phase of the motion: its duration and its spline.

    ``duration`` [s] : (shortest, longest), or one number.  ``intervals`` : how many the spline has.
    ``grading`` : longest over shortest interval; the short ones are at the contact. The program's nodes are
    the ends and the middles of the intervals.
    """

    duration: tuple[float, float]
    intervals: int = 12
    grading: float = 3.0

    def __post_init__(self) -> None:
        one = raw_array("a phase's duration [s]", self.duration).ndim == 0
        given: Any = (self.duration,) * 2 if one else self.duration
        duration = check_array("a phase's duration [s]", given, (None,)).tolist()
        if len(duration) != 2 or not SHORTEST <= duration[0] <= duration[1] <= LONGEST:
            raise InputError(
                f"a phase's duration [s] is a number of {SHORTEST:g} to {LONGEST:g} or (shortest, longest), "
                f"not {shortened(str(self.duration))}"
            )
        object.__setattr__(self, "duration", tuple(duration))
        object.__setattr__(self, "grading", check_number("a phase's grading", self.grading))
        if not 1 <= self.grading <= STEEPEST:
            raise InputError(f"a phase's grading must be 1 to {STEEPEST:g}, not {self.grading:g}")
        intervals = check_number("a phase's intervals", self.intervals)
        if not 6 <= intervals <= FINEST or intervals != round(intervals):
            raise InputError(
                f"a phase needs 6 to {FINEST} spline intervals, a whole number, not "
                f"{shortened(str(self.intervals))}"
            )
        object.__setattr__(self, "intervals", round(intervals))
