"""Variables and constraints of a follow-through, from the state after contact to rest.

There is one after the expected blow and, where a problem asks for it, one for a blow that met nothing.
"""

from __future__ import annotations

import numpy as np

from impactopt.kinematics.splines import CubicSpline, graded_breaks
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Place
from impactopt.transcription.contact_state import Contact
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.mesh import with_middles
from impactopt.transcription.motion_phase import MotionPhase, at_node


class FollowThrough(MotionPhase):
    """A clamped cubic spline to rest; it hands back where it starts.

    more : nodes beside the ends and middles of its intervals.
    kind : first word of its variables' names; name : what constraints and messages call it.
    """

    def __init__(
        self,
        b: Builder,
        more: tuple[float, ...] = (),
        *,
        kind: str = "follow",
        name: str = "follow-through",
    ) -> None:
        phase = b.problem.follow
        breaks = graded_breaks(phase.intervals, phase.grading, fine_end=False)
        super().__init__(name, phase, breaks, np.union1d(with_middles(breaks), more), more)
        self._add_variables(b, kind, phase.intervals + 1)

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2; the last three coincide: it ends at rest."""
        return self.c[min(j, self.c.count - 1)]

    @property
    def start(self) -> tuple[Affine, Affine, Affine]:
        """y and y' at its start, and the duration [s] that y' is of."""
        y, y1, _ = self.at(0.0)
        return y, y1, self.T[0]

    def determined(self) -> list[Determined]:
        """And the control points that the state at its start determines: position and rate."""
        first = np.concatenate([self.c.index(0), self.c.index(1)])
        return [*super().determined(), determined(Turn.AFTER, first)]

    def add_rate_rows(self, b: Builder) -> None:
        """Velocities within their limit; the last two control points of them are zero by construction."""
        self._add_rate_rows(b, range(self.phase.intervals))

    def guess(self, x: Array, curve: CubicSpline, end: Array) -> None:
        """Write a spline that ends at ``end`` (ny,), and its duration."""
        self.c.write(x, np.vstack([curve.control[: self.c.count - 1], end]))
        self.T.write(x, curve.duration)


class AbortMotion(FollowThrough):
    """Motion to rest of a robot that has hit nothing, and coasts for ``after`` [s] from contact on until it
    detects that. It has one more node, at the end of coasting, with a sole wrench of its own.
    """

    def __init__(self, b: Builder, more: tuple[float, ...] = (), *, after: float) -> None:
        super().__init__(b, more, kind="abort", name="abort")
        self.after = after
        self.coast_w = b.layout.add("coasting sole wrench", 1, b.nw, **b.limits.of_wrenches)

    def coasting_node(self) -> tuple[list[Affine], Place]:
        """Slots of the block ``node`` where coasting ends, without acceleration; and its place."""
        y, y1, T = self.start
        slots = [y, y1, Affine.zeros(y.size), self.legs[0], self.coast_w[0], T]
        return slots, Place.plain("end of coasting, if nothing is hit")

    def link(self, contact: Contact) -> list[list[Affine]]:
        """Slots of the block ``link``: it starts where coasting ends."""
        u0 = contact.u0[0]
        return contact.link(self.start, (Affine.constant(self.after), Affine.zeros(1)), (u0, u0), u0)

    def determined(self) -> list[Determined]:
        return [*super().determined(), *at_node([self.coast_w.index(0)[:6]])]
