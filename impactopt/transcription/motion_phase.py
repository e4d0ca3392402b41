"""Motion phases: swing, follow-through and abort motion, cubic splines in y with legs and wrenches at nodes.

There is one after the expected blow and, where a problem asks for it, one for a blow that met nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impactopt.kinematics.splines import CubicSpline, basis, graded_breaks, knots, rate_weights
from impactopt.kinematics.support import contact_wrench_cone
from impactopt.problem.problem import Phase
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_state import Contact, ContactState
from impactopt.transcription.layout import (
    DIRECTIONS,
    Affine,
    Array,
    Group,
    Index,
    Measure,
    Place,
    Turn,
    add,
    along,
    by_leg,
    determined,
    percent,
    stack,
)
from impactopt.transcription.mesh import percentage, with_middles


def add_nodes(
    b: Builder, instances: list[list[Affine]], places: Sequence[Place | str], *, closed: int = 0
) -> list[Index]:
    """Nodes of the block ``node`` with their constraints, but for those of torque; the torques' outputs.

    instances : y, y', y'', legs, sole wrench, T of each.  closed : so many of the last have the posture
    of another, whose constraints close their legs.
    """
    c, part = b.coordinates, b.parts("node")
    limits, rates = b.robot.torque_limit, b.robot.velocity_limit[c.dependent]
    numbers = np.concatenate([limits, rates, b.limits.units, c.start_determinants])
    first, torques = b.add_block("node", instances, numbers), []
    closure = [f"{leg.end} {d}" for leg in c.legs for d in DIRECTIONS]
    fast = percent("over its limit", of=b.limits.velocity.fraction)
    for i, (place, slots) in enumerate(zip(places, instances, strict=True)):
        at = first + i * b.blocks[-1].n_out
        for term, name, components, bound, measure in (
            ("closed legs", "closure", closure, 0.0, along(closure, "open")),
            (b.limits.velocity.name, "leg_rate", c.leg_labels, b.limits.velocity.fraction, fast),
            ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0, b.limits.unbalanced),
        ):
            if name == "closure" and i >= len(instances) - closed:
                continue
            b.rows.add(
                term=term,
                place=place,
                components=components,
                outputs=at + part[name],
                lower=-bound,
                upper=bound,
                measure=measure,
            )
        b.rows.add(
            term=b.limits.extension.name,
            place=place,
            components=[leg.limb for leg in c.legs],
            outputs=at + part["extension"],
            lower=b.limits.extension.minimum,
            measure=percent("too near to straight", of=b.limits.extension.minimum),
        )
        add_cone_rows(b, slots[4], place, b.limits.cone.margin, b.limits.cone.minimum_force)
        torques.append(at + part["torque"])
    return torques


def add_cone_rows(
    b: Builder, wrench: Affine, place: Place | str, margin: float, minimum_force: float
) -> None:
    """Rows: each sole's wrench (6 a sole) is in its cone, its normal force [N] no less than the least."""
    for k, leg in enumerate(b.coordinates.legs):
        if leg.sole is None:  # a hand: see `Grip`
            continue
        w = wrench[6 * k : 6 * k + 6]
        rows = contact_wrench_cone(leg.sole.polygon, b.limits.cone.friction, margin=margin) / b.limits.weight
        normal, sole = w[2:3] * (1 / b.limits.weight), leg.end
        b.rows.add(
            term=b.limits.cone.name,
            place=place,
            components=[f"{sole}, facet {i}" for i in range(len(rows))],
            affine=w.apply(rows),
            lower=0,
            measure=[_outside_cone(row * b.limits.weight, normal, b.limits.cone.friction) for row in rows],
            whole=sole,
        )
        b.rows.add(
            term="normal force",
            place=place,
            components=[sole],
            affine=normal,
            lower=minimum_force / b.limits.weight,
            measure=Measure("N", b.limits.weight, "too light"),
        )


def _outside_cone(facet: Array, normal: Affine, friction: float) -> Measure:
    """Measure of a facet (6,) of the cone of corners' forces; ``normal``: normal force over weight."""
    along_sole, tilting = np.hypot(*facet[:2]), np.hypot(*facet[3:5])
    if along_sole < 1e-9 and abs(facet[5]) < 1e-9:
        return Measure("mm", 1e3 / tilting, "outside", normal, 0.05)  # moment over force: the CoP
    if tilting < 1e-9 and abs(facet[5]) < 1e-9:
        return Measure("%", 100 / along_sole / friction, "beyond its friction", normal, 0.05)
    return Measure("%", 100 / max(facet[2], 1e-3), "beyond its friction and torsion", normal, 0.05)


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
