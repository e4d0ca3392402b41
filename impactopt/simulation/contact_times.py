"""Times of contact of striker and target, and the reference of a robot that has felt it or has not."""

from __future__ import annotations

from typing import Any

import numpy as np


def parts_from(reference: Any, missed: Any) -> float:
    """Time [s] from which a robot that has felt no contact follows ``missed``, and not ``reference``.

    Both coast from the planned contact on. The one goes on to the follow-through at its ``contact_end``; the
    other goes on coasting, until the robot notices at its own ``contact_end``, and is the abort motion then.
    """
    return min(float(reference.contact_end), float(missed.contact_end))


class FollowedReference:
    """Choice of the servo's reference, by whether the robot has felt a contact.

    A robot knows that it has hit something when it feels it, but that it has hit nothing only at
    ``missed.contact_end``: until then it goes over to ``reference`` when it is late.

    reference, missed : as of :class:`impactopt.transcription.plan.Trajectory`.  missed None: it does not
        notice, and ``reference`` is all that it has.
    """

    def __init__(self, reference: Any, missed: Any = None) -> None:
        self._reference, self._missed = reference, missed
        self._parts = np.inf if missed is None else parts_from(reference, missed)
        self._aborts = False

    def at(self, t: float, felt: bool) -> Any:
        """The reference from a time [s] on; felt : whether there has been a contact yet."""
        if t < self._parts:
            return self._reference
        self._aborts = self._aborts or (not felt and t >= self._missed.contact_end)
        return self._reference if felt and not self._aborts else self._missed


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
