"""A way before or after contact: a cubic spline in y, with legs and sole wrenches at its nodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from impactopt.kinematics.splines import CubicSpline, basis, knots, rate_weights
from impactopt.problem.problem import Phase
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Index, Measure, Place, by_leg
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.layout import Affine, Array, Group, add, stack
from impactopt.transcription.mesh import percentage


class MotionPhase(ABC):
    """Takes a builder; hands back places, slots of blocks, and what constraints determine.

    Attributes
    ----------
    name : what constraints and messages call it.  phase : what the problem asks of it.
    breaks : of the spline, from 0 to 1.  nodes (k,) : where legs and sole wrenches are, and constraints hold.
    more : which of these are beside the ends and middles of the spline's intervals.
    c, legs, w, T : variables: control points, legs and sole wrenches at the nodes, duration [s].
    """

    c: Group
    legs: Group
    w: Group
    T: Group

    def __init__(self, name: str, phase: Phase, breaks: Array, nodes: Array, more: tuple[float, ...]) -> None:
        self.name, self.phase = name, phase
        self.breaks, self.nodes, self.more = breaks, nodes, more
        self._at: dict[float, tuple[Affine, Affine, Affine]] = {}

    def _add_variables(self, b: Builder, kind: str, points: int) -> None:
        """``points`` control points, and all else; ``kind``: their names' first word."""
        nodes, limits = len(self.nodes), b.limits
        self.c = b.layout.add(f"{kind} control point", points, b.ny, **limits.of_y)
        self.legs = b.layout.add(f"{kind} legs", nodes, b.nl, **limits.of_legs)
        self.w = b.layout.add(f"{kind} sole wrench", nodes, b.nw, **limits.of_wrenches)
        self.T = b.duration(f"{kind} duration", self.phase.duration, 0.1)

    @abstractmethod
    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the spline."""

    def at(self, s: float) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at s."""
        if s not in self._at:  # constraints, prices and places ask for the same few
            y, yd, ydd = (
                add([self.control(int(j)) * row[0, j] for j in np.flatnonzero(row[0])])
                for row in basis(self.breaks, s)
            )
            self._at[s] = y, yd, ydd
        return self._at[s]

    # ------------------------------------------------------------------ nodes
    def place_at(self, s: float) -> Place:
        return Place(f"{self.name}, {percentage(s, self.more)}", f"{self.name} at {{s}}", self.T[0] * s)

    def instances(self) -> tuple[list[list[Affine]], list[Place]]:
        """Slots of the block ``node``, and the places of its instances."""
        slots = [[*self.at(s), self.legs[k], self.w[k], self.T[0]] for k, s in enumerate(self.nodes)]
        return slots, [self.place_at(s) for s in self.nodes]

    def motion(self) -> list[tuple[Place, list[Affine]]]:
        """Places of its nodes with y, y', y'', legs and T [s], that y' and y'' are of."""
        return [(place, [*slots[:4], slots[5]]) for slots, place in zip(*self.instances(), strict=True)]

    def spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Places of its nodes with coordinates and legs, from a fraction of it on."""
        return [
            (self.place_at(s), [self.at(s)[0], self.legs[k]]) for k, s in enumerate(self.nodes) if s >= since
        ]

    def determined(self) -> list[Determined]:
        """Variables determined at each node: each leg, and the first sole's wrench."""
        found = [[*by_leg(self.legs.index(k)), self.w.index(k)[:6]] for k in range(self.w.count)]
        return [each for parts in found for each in at_node(parts)]

    # ------------------------------------------------------------------ constraints
    def _add_rate_rows(self, b: Builder, js: range) -> None:
        """Velocity control points within the limit; multiplied by T they are linear."""
        c, velocity = b.coordinates, b.limits.velocity
        joints = np.arange(c.base, c.ny)
        limit = b.limits.rate_limit[c.independent]
        names = c.labels[c.base :]
        factors = rate_weights(self.breaks)
        shortest, longest = b.layout.bounds(self.T)
        fixed = shortest == longest
        for j in js:
            step = (self.control(j + 1) - self.control(j))[joints] * (factors[j] / limit)
            # where the velocity's control point pulls most: the mean of its knots
            s = float(knots(self.breaks)[j + 2 : j + 4].mean())
            name = f"{self.name}, control point {j}"
            place = Place(name, f"{self.name} at about {{s}}", self.T[0] * s)
            fast = Measure("%", 100.0, "over its limit", self.T[0])
            if fixed:
                bound = float(longest)
                b.rows.add(
                    term=velocity.name,
                    place=place,
                    components=names,
                    affine=step,
                    lower=-bound,
                    upper=bound,
                    measure=fast,
                )
                continue
            time = stack([self.T[0]] * len(joints))
            for sign, way in ((1.0, "forward"), (-1.0, "backward")):
                b.rows.add(
                    term=velocity.name,
                    place=replace(place, name=f"{name}, {way}"),
                    components=names,
                    affine=step * sign - time,
                    upper=0,
                    measure=fast,
                )

    # ------------------------------------------------------------------ numbers
    def spline(self, x: Array) -> CubicSpline:
        """The spline that solver variables (n,) stand for."""
        points = np.array([self.control(j).evaluate(x) for j in range(len(self.breaks) + 2)])
        return CubicSpline(control=points, breaks=self.breaks, duration=float(self.T.read(x)[0, 0]))


def at_node(parts: list[Index]) -> list[Determined]:
    """Variables that a node's constraints determine, in order; the last of all nodes in one step."""
    return [determined(Turn.NODE, part, k) for k, part in enumerate(parts, -len(parts))]
