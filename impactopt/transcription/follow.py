"""From the state that the contact leaves behind to rest: variables and rows of a follow-through.

There is one after the expected blow and, where a problem asks for it, one for a blow that met nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impactopt.kinematics.splines import CubicSpline
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.mesh import percentage
from impactopt.transcription.rows import Index, Place

if TYPE_CHECKING:
    from impactopt.transcription.transcription import Transcription


class FollowThrough:
    """A clamped cubic spline to rest, with legs and sole wrenches at its nodes.

    name : of its variables; place : what rows and messages call it.
    """

    def __init__(self, t: Transcription, name: str, place: str) -> None:
        self.t, self.place = t, place
        p, add = t.problem, t.layout.add
        nodes = len(t.follow_nodes)
        self.c = add(f"{name} control point", p.follow.intervals + 1, t.ny, **t.of_y)
        self.legs = add(f"{name} legs", nodes, t.nl, **t.of_legs)
        self.w = add(f"{name} sole wrench", nodes, t.nw, **t.of_wrenches)
        self.T = t.duration(f"{name} duration", p.follow.duration, 0.1)

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2; the last three coincide: it ends at rest."""
        return self.c[min(j, self.c.count - 1)]

    @property
    def start(self) -> tuple[Affine, Affine]:
        """y and y' at its start."""
        y, y1, _ = self.t.at(self.control, self.t.follow_breaks, 0.0)
        return y, y1

    def determined(self) -> Index:
        """Control points that the state at its start determines: position and rate."""
        return np.concatenate([self.c.index(0), self.c.index(1)])

    def place_at(self, s: float) -> Place:
        name = f"{self.place}, {percentage(s, self.t.nodes.follow)}"
        return Place(name, f"{self.place} at {{s}}", self.T[0] * s)

    def nodes(self) -> tuple[list[list[Affine]], list[Place]]:
        """Slots of the block ``node`` and the places of its instances."""
        instances, places = [], []
        for k, at in enumerate(self.t.follow_nodes):
            y, y1, y2 = self.t.at(self.control, self.t.follow_breaks, at)
            instances.append([y, y1, y2, self.legs[k], self.w[k], self.T[0]])
            places.append(self.place_at(at))
        return instances, places

    def spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places of its nodes with coordinates and legs."""
        instances, places = self.nodes()
        return [(place, [slots[0], slots[3]]) for place, slots in zip(places, instances, strict=True)]

    def coasting_node(self, wrench: Group) -> tuple[list[Affine], Place]:
        """Slots of the block ``node`` where coasting ends and this begins: without acceleration, under a sole
        wrench of its own; and its place. Until then a robot that has hit nothing still coasts."""
        y, y1 = self.start
        slots = [y, y1, Affine.zeros(self.t.ny), self.legs[0], wrench[0], self.T[0]]
        return slots, Place.plain("end of coasting, if nothing is hit")

    def add_rate_rows(self) -> None:
        # the last two velocity control points are zero by construction
        t = self.t
        t.rate_rows(self.place, self.control, range(t.problem.follow.intervals), t.follow_breaks, self.T)

    def decode(self, x: Array) -> tuple[CubicSpline, Array]:
        """The spline, and the sole wrenches at the nodes (k, 6 a sole)."""
        t = self.t
        return t.spline(x, self.control, t.follow_breaks, self.T), self.w.read(x)

    def guess(self, x: Array, curve: CubicSpline, end: Array) -> None:
        """Write a spline that ends at ``end`` (ny,), and its duration."""
        self.c.write(x, np.vstack([curve.control[: self.c.count - 1], end]))
        self.T.write(x, curve.duration)

    def link_from_coasting(self, after: float) -> list[list[Affine]]:
        """Slots of the block ``link``: it starts where coasting for ``after`` [s] from contact ends."""
        u0 = self.t.u0[0]
        times = Affine.constant(after), Affine.zeros(1)
        return self.t.link_slots((*self.start, self.T[0]), times, (u0, u0), u0)
