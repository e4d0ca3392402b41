"""Motion phases: swing, follow-through and abort motion, cubic splines in y with legs and wrenches at nodes.

There is one after the expected blow and, where a problem asks for it, one for a blow that met nothing. Where
soles lift off or touch down, there are more (`impactopt.transcription.stance_change`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.kinematics.splines import CubicSpline, basis, graded_breaks, knots, rate_weights
from impactopt.kinematics.support import contact_wrench_cone
from impactopt.problem.problem import Phase
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_state import Contact, ContactState
from impactopt.transcription.layout import (
    DIRECTIONS,
    GRAVITY,
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
    b: Builder,
    instances: list[list[Affine]],
    places: Sequence[Place | str],
    *,
    closed: int = 0,
    fading: Collection[str] = (),
) -> list[Index]:
    """Nodes of the block ``node`` with their constraints, but for those of torque; the torques' outputs.

    instances : y, y', y'', legs, sole wrench, T of each.  closed : so many of the last have the posture
    of another, whose constraints close their legs.  fading : names of soles that may bear nothing.
    """
    c, part = b.coordinates, b.parts("node")
    first, torques = b.add_block("node", instances, node_numbers(b)), []
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
        add_cone_rows(b, slots[4], place, b.limits.cone.margin, b.limits.cone.minimum_force, fading)
        torques.append(at + part["torque"])
    return torques


def node_numbers(b: Builder) -> Array:
    """Parameters of the block ``node``."""
    limits, rates = b.robot.torque_limit, b.robot.velocity_limit[b.coordinates.dependent]
    return np.concatenate([limits, rates, b.limits.units, b.coordinates.start_determinants])


def add_cone_rows(
    b: Builder,
    wrench: Affine,
    place: Place | str,
    margin: float,
    minimum_force: float,
    fading: Collection[str] = (),
) -> None:
    """Rows: each sole's wrench (6 a sole) is in its cone, its normal force [N] no less than the least, or
    than none if it is ``fading``; a wrench that is zero has no rows.
    """
    for k, leg in enumerate(b.coordinates.legs):
        if leg.sole is None:  # a hand: see `Grip`
            continue
        w = wrench[6 * k : 6 * k + 6]
        if leg.name in fading and not w.cols.size:
            continue
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
        if leg.name in fading:
            continue
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


REST, FREE, COASTING = "rest", "free", "coasting"  # how a spline may begin or end


def _control_points(end: str | Affine, known: dict[str, int]) -> int:
    """Number of control points at an end that are no variables of their own."""
    return known[end] if isinstance(end, str) else 1


class MotionPhase:
    """Takes a builder; hands back places, slots of blocks, and what constraints determine.

    Attributes
    ----------
    kind : first word of its variables' names.  name : what constraints and messages call it.
    phase : what the problem asks of it.
    breaks : of the spline, from 0 to 1.  nodes (k,) : where legs and sole wrenches are, and constraints hold.
    more : which of these are beside the ends and middles of the spline's intervals.
    c, legs, w, T : variables: control points, legs and sole wrenches at the nodes, duration [s].
    drift, bend : of a base that nothing holds: its part of the control points that an end at rest, or
        without acceleration, gives for joints; and its y'' at the nodes, which their forces determine.
    unloaded : components of the sole wrenches that are zero, by the number of the node.
    """

    c: Group
    legs: Group
    w: Group
    T: Group

    def __init__(
        self,
        b: Builder,
        names: tuple[str, str],
        phase: Phase,
        mesh: tuple[Array, Array, tuple[float, ...]],
        begins: str | Affine,
        ends: str | Affine,
    ) -> None:
        """names : first word of its variables' names, and `name`.  mesh : `breaks`, `nodes`, `more`.

        begins : `REST`, `FREE` or the coordinates (ny) that it begins at.  ends : likewise, or `COASTING`.
        """
        self.kind, self.name = names
        self.phase, (self.breaks, self.nodes, self.more) = phase, mesh
        self._begins, self._ends = begins, ends
        self._at: dict[float, tuple[Affine, Affine, Affine]] = {}
        self.unloaded: dict[int, Index] = {}
        self._last = len(self.breaks) + 1
        self._y0 = Affine.constant(b.y0)
        self.lead = _control_points(begins, {REST: 3, FREE: 0})
        points = self._last + 1 - self.lead - _control_points(ends, {REST: 2, FREE: 0, COASTING: 1})
        nodes, limits = len(self.nodes), b.limits
        self.c = b.layout.add(f"{self.kind} control point", points, b.ny, **limits.of_y)
        self.legs = b.layout.add(f"{self.kind} legs", nodes, b.nl, **limits.of_legs)
        self.w = b.layout.add(f"{self.kind} sole wrench", nodes, b.nw, **limits.of_wrenches)
        self.T = b.duration(f"{self.kind} duration", self.phase.duration, 0.1)
        self.drift: Group | None = None
        self.bend: Group | None = None
        self._drifting: tuple[int, ...] = ()
        if b.coordinates.drifts:
            self._drifting = ((2,) if begins == REST else ()) + {
                REST: (self._last - 1, self._last),
                COASTING: (self._last,),
            }[str(ends)]
            names, box = b.coordinates.labels[:6], {k: limits.of_y[k][:6] for k in ("lower", "upper")}
            count = len(self._drifting)
            self.drift = b.layout.add(f"{self.kind} base control point", count, 6, labels=names, **box)
            self.bend = b.layout.add(f"{self.kind} base acceleration", nodes, 6, labels=names)

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the spline.

        Three that are the same make a start or an end at rest. A last one on the line of those before it
        makes an end without acceleration: the reference coasts from contact on, so the torque that the swing
        ends with is the feed-forward of the collision: it does not jump, and a target that comes late meets
        the same motion.
        """
        point = self._control(j)
        if self.drift is None or j not in self._drifting:
            return point
        return stack([self.drift[self._drifting.index(j)], point[6:]])

    def _control(self, j: int) -> Affine:
        if j < self.lead:
            return self._y0 if isinstance(self._begins, str) else self._begins
        if j < self.lead + self.c.count:
            return self.c[j - self.lead]
        if self._ends == REST:
            return self.c[-1]
        if isinstance(self._ends, Affine):
            return self._ends
        factors = rate_weights(self.breaks)
        step = self.control(j - 1) - self.control(j - 2)
        return self.control(j - 1) + step * float(factors[-2] / factors[-1])

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
    def wrench(self, k: int) -> Affine:
        """Sole wrenches (6 a sole) at a node."""
        w = self.w[k]
        on = ~np.isin(w.rows, self.unloaded.get(k, ()))
        return w if on.all() else Affine(w.size, w.rows[on], w.cols[on], w.vals[on], w.const)

    def at_node(self, k: int) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at a node."""
        y, y1, y2 = self.at(float(self.nodes[k]))
        return y, y1, y2 if self.bend is None else stack([self.bend[k], y2[6:]])

    def place_at(self, s: float) -> Place:
        return Place(f"{self.name}, {percentage(s, self.more)}", f"{self.name} at {{s}}", self.T[0] * s)

    def instances(self) -> tuple[list[list[Affine]], list[Place]]:
        """Slots of the block ``node``, and the places of its instances."""
        slots = [[*self.at_node(k), self.legs[k], self.wrench(k), self.T[0]] for k in range(len(self.nodes))]
        return slots, [self.place_at(s) for s in self.nodes]

    def motion(self) -> list[tuple[Place, list[Affine]]]:
        """Places of its nodes with y, y', y'', legs and T [s], that y' and y'' are of."""
        return [(place, [*slots[:4], slots[5]]) for slots, place in zip(*self.instances(), strict=True)]

    def spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Places of its nodes with coordinates and legs, from a fraction of it on."""
        return [
            (self.place_at(s), [self.at(s)[0], self.legs[k]]) for k, s in enumerate(self.nodes) if s >= since
        ]

    def _bearing(self, k: int) -> Index:
        """Components of the first sole that bears load at a node, if any does."""
        soles = np.arange(self.w.size).reshape(-1, 6)
        return next((own for own in soles if not np.isin(own, self.unloaded.get(k, ())).any()), np.arange(0))

    def determined(self) -> list[Determined]:
        """Variables determined at each node: each leg, and the wrench of a sole that bears load."""
        found = [
            [*by_leg(self.legs.index(k)), self.w.index(k)[self._bearing(k)]] for k in range(self.w.count)
        ]
        if self.bend is not None:
            found = [[self.bend.index(k)] for k in range(self.bend.count)]
        return [each for parts in found for each in at_node(parts)]

    # ------------------------------------------------------------------ constraints
    def add_rate_rows(self, b: Builder) -> None:
        """Velocity control points within the limit; multiplied by T they are linear. Those that are zero by
        construction, at rest, have no rows.
        """
        js = range(max(self.lead - 1, 0), self._last - 2 * (self._ends == REST))
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

    def add_momentum_rows(self, b: Builder) -> None:
        """Rows: the momentum of a robot that nothing holds is what it was at the phase's start, and what
        gravity adds.

        They hold in the middles of the spline's intervals and at its end: as many places as the base has
        control points that are not known. A phase that begins at rest has none at first.
        """
        middles = (self.breaks[1:] + self.breaks[:-1]) / 2
        first = [0.0] if self._begins == FREE else []
        spots = [*first, *middles.tolist(), 1.0]
        at = b.add_block("momentum", [[*self.at(s)[:2], self.T[0]] for s in spots], b.limits.units)
        outputs = [at + 6 * i + np.arange(6) for i in range(len(spots))]
        measure = [replace(each, unit=f"{each.unit} s") for each in b.limits.unbalanced]
        before = Affine.zeros(6)
        if first:
            told: dict[str, Any] = {"term": "momentum", "place": self.place_at(0.0), "labels": DIRECTIONS}
            before = b.lift(f"{self.kind} momentum", outputs[0], **told)[0]
        pull = np.append(np.array(b.robot.model.gravity.linear) / GRAVITY, np.zeros(3))
        for s, out in list(zip(spots, outputs, strict=True))[len(first) :]:
            b.rows.add(
                term="momentum",
                place=self.place_at(s),
                components=DIRECTIONS,
                outputs=out,
                affine=-before - stack([self.T[0]] * 6) * (s * pull),
                lower=0,
                upper=0,
                measure=measure,
            )

    # ------------------------------------------------------------------ numbers
    def guess(self, x: Array, curve: CubicSpline) -> None:
        """Write a spline and its duration, as far as its control points are variables."""
        points = curve.control[self.lead : self.lead + self.c.count].copy()
        if self._ends == REST:
            points[-1] = curve.control[-1]
        if self.drift is not None and self.bend is not None:
            points[-1, :6] = curve.control[self.lead + self.c.count - 1, :6]
            self.drift.write(x, curve.control[list(self._drifting), :6])
            second = curve.sample(self.nodes * curve.duration)[2] * curve.duration**2
            self.bend.write(x, second[:, :6])
        self.c.write(x, points)
        self.T.write(x, curve.duration)

    def wrenches(self, x: Array) -> Array:
        """Sole wrenches (k, 6 a sole) at the nodes."""
        found = self.w.read(x)
        for k, zero in self.unloaded.items():
            found[k, zero] = 0.0
        return found

    def spline(self, x: Array) -> CubicSpline:
        """The spline that solver variables (n,) stand for."""
        points = np.array([self.control(j).evaluate(x) for j in range(len(self.breaks) + 2)])
        return CubicSpline(control=points, breaks=self.breaks, duration=float(self.T.read(x)[0, 0]))


def at_node(parts: list[Index]) -> list[Determined]:
    """Variables that a node's constraints determine, in order; the last of all nodes in one step."""
    return [determined(Turn.NODE, part, k) for k, part in enumerate(parts, -len(parts))]


class Swing(MotionPhase):
    """A cubic spline from rest that ends without acceleration; it hands back the state at contact.

    more : nodes beside the ends and middles of its intervals.  begins : as of `MotionPhase`.
    """

    def __init__(self, b: Builder, more: tuple[float, ...] = (), begins: str | Affine = REST) -> None:
        phase = b.problem.swing
        breaks = graded_breaks(phase.intervals, phase.grading, fine_end=True)
        places = with_middles(breaks)
        places = places[1:] if begins == REST else places  # the start is given
        mesh = breaks, np.union1d(places, more), more
        super().__init__(b, ("swing", "swing"), phase, mesh, begins, COASTING)

    @property
    def end(self) -> ContactState:
        """The state at contact."""
        return ContactState(*self.at_node(-1), T=self.T[0], legs=self.legs[-1], w=self.w[-1])


class FollowThrough(MotionPhase):
    """A clamped cubic spline to rest; it hands back where it starts.

    more : nodes beside the ends and middles of its intervals.  ends : as of `MotionPhase`.
    kind : first word of its variables' names; name : what constraints and messages call it.
    """

    def __init__(
        self,
        b: Builder,
        more: tuple[float, ...] = (),
        *,
        kind: str = "follow",
        name: str = "follow-through",
        ends: str | Affine = REST,
    ) -> None:
        phase = b.problem.follow
        breaks = graded_breaks(phase.intervals, phase.grading, fine_end=False)
        mesh = breaks, np.union1d(with_middles(breaks), more), more
        super().__init__(b, (kind, name), phase, mesh, FREE, ends)

    @property
    def start(self) -> tuple[Affine, Affine, Affine]:
        """y and y' at its start, and the duration [s] that y' is of."""
        y, y1, _ = self.at(0.0)
        return y, y1, self.T[0]

    def determined(self) -> list[Determined]:
        """And the control points that the state at its start determines: position and rate."""
        first = np.concatenate([self.c.index(0), self.c.index(1)])
        return [*super().determined(), determined(Turn.AFTER, first)]


class AbortMotion(FollowThrough):
    """Motion to rest of a robot that has hit nothing, and coasts for ``after`` [s] from contact on until it
    detects that. It has one more node, at the end of coasting, with a sole wrench of its own.
    """

    def __init__(
        self, b: Builder, more: tuple[float, ...] = (), *, after: float, ends: str | Affine = REST
    ) -> None:
        super().__init__(b, more, kind="abort", name="abort", ends=ends)
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
