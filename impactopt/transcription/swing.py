"""Variables and constraints of the swing, from rest to contact."""

from __future__ import annotations

import numpy as np

from impactopt.kinematics.splines import graded_breaks, rate_weights
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_state import ContactState
from impactopt.transcription.layout import Affine
from impactopt.transcription.mesh import with_middles
from impactopt.transcription.motion_phase import MotionPhase


class Swing(MotionPhase):
    """A cubic spline from rest that ends without acceleration; it hands back the state at contact.

    more : nodes beside the ends and middles of its intervals.
    """

    def __init__(self, b: Builder, more: tuple[float, ...] = ()) -> None:
        phase = b.problem.swing
        breaks = graded_breaks(phase.intervals, phase.grading, fine_end=True)
        nodes = np.union1d(with_middles(breaks)[1:], more)  # the start is given
        super().__init__("swing", phase, breaks, nodes, more)
        self._start = Affine.constant(b.y0)
        self._add_variables(b, "swing", phase.intervals - 1)

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2.

        The first three make a start at rest, the last one an end without acceleration.
        The reference coasts from contact on, so the torque that the swing ends with is the feed-forward of
        the collision: it does not jump, and a target that comes late meets the same motion.
        """
        if j <= 2:
            return self._start
        if j < self.phase.intervals + 2:
            return self.c[j - 3]
        factors = rate_weights(self.breaks)
        step = self.control(j - 1) - self.control(j - 2)
        return self.control(j - 1) + step * float(factors[-2] / factors[-1])

    @property
    def end(self) -> ContactState:
        """The state at contact."""
        return ContactState(*self.at(1.0), T=self.T[0], legs=self.legs[-1], w=self.w[-1])

    def add_rate_rows(self, b: Builder) -> None:
        """Velocities within their limit; the first two control points of them are zero by construction."""
        self._add_rate_rows(b, range(2, self.phase.intervals + 2))
