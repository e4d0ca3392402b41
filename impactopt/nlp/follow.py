"""From the state that the contact leaves behind to rest: variables and rows of a follow-through.

There is one after the expected blow and, where a problem asks for it, one for a blow that met nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.motion import CubicSpline
from impactopt.nlp.layout import Affine, Array, Group

if TYPE_CHECKING:
    from impactopt.nlp.transcription import Transcription


class FollowThrough:
    """A clamped cubic spline to rest, with legs and sole wrenches at its nodes.

    name : of its variables; place : what rows and messages call it.
    """

    def __init__(self, t: Transcription, name: str, place: str) -> None:
        self.t, self.place = t, place
        c, p, add = t.coordinates, t.problem, t.layout.add
        nodes = len(t.follow_nodes)
        y: dict[str, Any] = {"lower": t.y_lower, "upper": t.y_upper, "labels": c.labels}
        legs: dict[str, Any] = {"lower": t.legs_lower, "upper": t.legs_upper, "labels": c.leg_labels}
        self.c = add(f"{name} control point", p.follow.intervals + 1, t.ny, **y)
        self.legs = add(f"{name} legs", nodes, t.nl, **legs)
        self.w = add(f"{name} sole wrench", nodes, t.nw, scale=t.wrench_scale, labels=t.wrench_labels)
        self.T = t.duration(f"{name} duration", p.follow.duration, 0.1)

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2; the last three coincide: it ends at rest."""
        return self.c[min(j, self.c.count - 1)]

    @property
    def start(self) -> tuple[Affine, Affine]:
        """y and y' at its start."""
        y, y1, _ = self.t.at(self.control, self.t.follow_breaks, 0.0)
        return y, y1

    def nodes(self) -> tuple[list[list[Affine]], list[str]]:
        """Slots of the block ``node`` and the places of its instances."""
        instances, places = [], []
        for k, at in enumerate(self.t.follow_nodes):
            y, y1, y2 = self.t.at(self.control, self.t.follow_breaks, at)
            instances.append([y, y1, y2, self.legs[k], self.w[k], self.T[0]])
            places.append(f"{self.place}, {100 * at:.0f} %")
        return instances, places

    def coasting_node(self, wrench: Group) -> tuple[list[Affine], str]:
        """Slots of the block ``node`` where coasting ends and this begins: without acceleration, under a sole
        wrench of its own; and its place. Until then a robot that has hit nothing still coasts."""
        y, y1 = self.start
        slots = [y, y1, Affine.zeros(self.t.ny), self.legs[0], wrench[0], self.T[0]]
        return slots, "end of coasting, if nothing is hit"

    def add_rate_rows(self) -> None:
        # the last two velocity control points are zero by construction
        t = self.t
        t.rate_rows(self.place, self.control, range(t.problem.follow.intervals), t.follow_breaks, self.T)

    def decode(self, x: Array) -> tuple[CubicSpline, Array]:
        """The spline, and the sole wrenches at the nodes (k, 6 a sole)."""
        t = self.t
        control = np.array([self.control(j).evaluate(x) for j in range(len(t.follow_breaks) + 2)])
        duration = float(self.T.read(x)[0, 0])
        return CubicSpline(control=control, breaks=t.follow_breaks, duration=duration), self.w.read(x)

    def guess(self, x: Array, curve: CubicSpline, end: Array) -> None:
        """Write a spline that ends at ``end`` (ny,), and its duration."""
        self.c.write(x, np.vstack([curve.control[: self.c.count - 1], end]))
        self.T.write(x, curve.duration)

    def link_from_coasting(self, after: float) -> list[list[Affine]]:
        """Slots of the block ``link``: it starts where coasting for ``after`` [s] from contact ends."""
        t = self.t
        y, y1, _ = t.contact_state
        u0 = t.u0[0]
        position, rate = self.start
        times = [t.swing_T[0], Affine.constant(after), Affine.zeros(1)]
        out = []
        for k in range(t.ny):
            p, r, a, b, u = (e[k : k + 1] for e in (position, rate, y, y1, u0))
            out.append([p, r, self.T[0], a, b, *times, u, u, u, u])
        return out
