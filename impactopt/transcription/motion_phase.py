"""Motion phases of the NLP: swing, follow-through and abort motion.

Each is a cubic spline in the independent coordinates y. Legs and sole wrenches are variables of its nodes.
The optional abort motion follows if nothing is hit. If soles lift off or touch down, there are phases before
and after these (`impactopt.transcription.stance_change`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.kinematics.splines import CubicSpline, basis, graded_breaks, knots, rate_weights
from impactopt.kinematics.stance import contact_wrench_cone
from impactopt.problem.phases import Phase
from impactopt.problem.violation import Measure, Place, percent
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_state import Contact, ContactState
from impactopt.transcription.layout import (
    DIRECTIONS,
    GRAVITY,
    Affine,
    Group,
    Turn,
    add,
    along,
    by_leg,
    determined,
    stack,
)
from impactopt.transcription.mesh import digits_of, percentage, with_middles


def add_nodes(
    b: Builder,
    instances: list[list[Affine]],
    places: Sequence[Place | str],
    *,
    closed: int = 0,
    fading: Collection[str] = (),
) -> list[Index]:
    """Adds the block ``node`` and its constraints except torque limits; returns outputs (n,) of torques.

    instances : y, y', y'', legs, sole wrench, T of each node.
    closed : number of nodes at the end of ``instances`` that share the posture of another one. They get no
        constraints that close their legs, as these would be redundant.
    fading : names of soles whose normal force may go to zero.
    """
    c, part = b.coordinates, b.parts("node")
    first, torques = b.add_block("node", instances, node_numbers(b)), []
    closure = [f"{leg.end} {d}" for leg in c.legs for d in DIRECTIONS]
    fast = percent("over its limit", of=b.limits.velocity.fraction)
    for i, (place, slots) in enumerate(zip(places, instances, strict=True)):
        at = first + i * b.blocks[-1].n_out
        # equal bounds, of zero, make these equality constraints, except that of the rates of leg joints
        for term, name, components, bound, measure in (
            ("closed legs", "closure", closure, 0.0, along(closure, "open")),
            (b.limits.velocity.name, "leg_rate", c.leg_labels, b.limits.velocity.fraction, fast),
            ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0, b.limits.unbalanced),
        ):
            if name == "closure" and i >= len(instances) - closed:
                continue
            b.constraints.add(
                term=term,
                place=place,
                components=components,
                outputs=at + part[name],
                lower=-bound,
                upper=bound,
                measure=measure,
            )
        b.constraints.add(
            term=b.limits.extension.name,
            place=place,
            components=[leg.limb for leg in c.legs],
            outputs=at + part["extension"],
            lower=b.limits.extension.minimum,
            measure=percent("too near to straight", of=b.limits.extension.minimum),
        )
        add_cone_constraints(b, slots[4], place, b.limits.cone.margin, b.limits.cone.minimum_force, fading)
        torques.append(at + part["torque"])
    return torques


def node_numbers(b: Builder) -> Array:
    """Parameters p of the block ``node``."""
    limits, rates = b.robot.torque_limit, b.robot.velocity_limit[b.coordinates.dependent]
    return np.concatenate([limits, rates, b.limits.units, b.coordinates.start_determinants])


def add_cone_constraints(
    b: Builder,
    wrench: Affine,
    place: Place | str,
    margin: float,
    minimum_force: float,
    fading: Collection[str] = (),
) -> None:
    """Constrains each sole's wrench (6 a sole) to its contact wrench cone, and its normal force from below.

    margin : of the cone [m].  minimum_force : normal force [N], except of ``fading`` soles.
    """
    for k, leg in enumerate(b.coordinates.legs):
        if leg.sole is None:  # a hand: see `Grip`
            continue
        w = wrench[6 * k : 6 * k + 6]
        if leg.name in fading and not w.cols.size:  # the wrench is identically zero
            continue
        facets = contact_wrench_cone(leg.sole.polygon, b.limits.cone.friction, margin=margin)
        # facets are of order one at unit normal force, so over the weight they are of order one here
        facets = facets / b.limits.weight
        normal, sole = w[2:3] * (1 / b.limits.weight), leg.end
        b.constraints.add(
            term=b.limits.cone.name,
            place=place,
            components=[f"{sole}, facet {i}" for i in range(len(facets))],
            affine=w.apply(facets),
            lower=0,
            measure=[_outside_cone(f * b.limits.weight, normal, b.limits.cone.friction) for f in facets],
            whole=sole,
        )
        if leg.name in fading:
            continue
        b.constraints.add(
            term="normal force",
            place=place,
            components=[sole],
            affine=normal,
            lower=minimum_force / b.limits.weight,
            measure=Measure("N", b.limits.weight, "too light"),
        )


def _outside_cone(facet: Array, normal: Affine, friction: float) -> Measure:
    """Measure of the violation of a facet f (6,) of the cone, f.w >= 0.  normal : normal force over weight.

    A facet without shear and torsion bounds the centre of pressure, one without moments of tilting and
    torsion the friction; the others combine these.
    """
    x, y, z, roll, pitch, yaw = facet.tolist()
    shear, tilting = math.hypot(x, y), math.hypot(roll, pitch)
    if shear < 1e-9 and abs(yaw) < 1e-9:
        return Measure("mm", 1e3 / tilting, "outside", normal, 0.05)  # moment over normal force
    if tilting < 1e-9 and abs(yaw) < 1e-9:
        return Measure("%", 100 / shear / friction, "beyond its friction", normal, 0.05)
    return Measure("%", 100 / max(z, 1e-3), "beyond its friction and torsion", normal, 0.05)


# End conditions of a spline: zero velocity and acceleration; none; zero acceleration.
REST, FREE, COASTING = "rest", "free", "coasting"


def _control_points(end: str | Affine, fixed: dict[str, int]) -> int:
    """Number of control points at an end that its condition determines; one if it is given coordinates."""
    return fixed[end] if isinstance(end, str) else 1


class MotionPhase:
    """Variables and constraints of one motion phase of the NLP.

    Attributes
    ----------
    kind : first word of its variables' names.  name : its name in constraints and messages.
    phase : the problem's settings of it.
    breaks : of the spline, from 0 to 1.  nodes (k,) : fractions at which constraints hold, and at which legs
        and sole wrenches are variables.
    more : nodes that are neither ends nor middles of the spline's intervals.
    lead : number of control points at the start that are no variables.
    c, legs, w, T : variables: control points, legs and sole wrenches at the nodes, duration [s].
    drift, bend : variables of a free-floating base, else None. Its motion follows from its dynamics, so a
        resting or coasting end determines control points of the joints only; ``drift`` has the base's
        components of those. ``bend`` is the base's y'' at the nodes.
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
        more: tuple[float, ...],
        begins: str | Affine,
        ends: str | Affine,
        *,
        fine_end: bool,
    ) -> None:
        """names : `kind` and `name`.  fine_end : the shortest interval is the last one, not the first.

        begins : `REST`, `FREE`, or coordinates (ny) of its first point.  ends : likewise, or `COASTING`.
        """
        self.kind, self.name = names
        self.phase, self.more = phase, more
        self.breaks = graded_breaks(phase.intervals, phase.grading, fine_end=fine_end)
        regular = with_middles(self.breaks)
        # Messages, warm starts and clearance constraints know a node by its name. Additional nodes do not
        # change those of others, so that a refined mesh has the same ones.
        self._digits = digits_of(regular)
        # a start at rest has no node: the posture there is given
        self.nodes = np.union1d(regular[1:] if begins == REST else regular, more)
        self._begins, self._ends = begins, ends
        self._at: dict[float, tuple[Affine, Affine, Affine]] = {}
        self._controls: dict[int, Affine] = {}
        self.unloaded: dict[int, Index] = {}
        self._last = len(self.breaks) + 1
        self._y0 = Affine.constant(b.y0)
        self.lead = _control_points(begins, {REST: 3, FREE: 0})
        # at rest three equal control points are given at a start, and one variable stands for three at an end
        points = self._last + 1 - self.lead - _control_points(ends, {REST: 2, FREE: 0, COASTING: 1})
        nodes, limits = len(self.nodes), b.limits
        self.c = b.layout.add(f"{self.kind} control point", points, b.ny, **limits.of_y)
        self.legs = b.layout.add(f"{self.kind} legs", nodes, b.nl, **limits.of_legs)
        self.w = b.layout.add(f"{self.kind} sole wrench", nodes, b.nw, **limits.of_wrenches)
        self.T = b.duration(f"{self.kind} duration", self.phase.duration, 0.1)
        self.drift: Group | None = None
        self.bend: Group | None = None
        self._drifting: tuple[int, ...] = ()  # control points whose base part is in `drift`
        if b.coordinates.drifts:
            # At rest the first two points give position and speed, also of a base that drifts; from the third
            # on its acceleration, which gravity causes, is free. At the end nothing of it is given.
            self._drifting = ((2,) if begins == REST else ()) + {
                REST: (self._last - 1, self._last),
                COASTING: (self._last,),
            }[str(ends)]
            of_base = {name: values[:6] for name, values in limits.of_y.items()}
            self.drift = b.layout.add(f"{self.kind} base control point", len(self._drifting), 6, **of_base)
            self.bend = b.layout.add(f"{self.kind} base acceleration", nodes, 6, labels=of_base["labels"])

    def control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the spline.

        At rest the first or last three are equal. At a coasting end the last one continues the line of those
        before it, which makes the acceleration zero there. The reference then coasts from contact on with the
        torque that the swing ends with as feed-forward. So the torque does not jump at contact, and a target
        that comes late meets the same motion.
        """
        if j not in self._controls:
            point = self._control(j)
            if self.drift is not None and j in self._drifting:
                point = stack([self.drift[self._drifting.index(j)], point[6:]])
            self._controls[j] = point
        return self._controls[j]

    def _control(self, j: int) -> Affine:
        if j < self.lead:
            return self._y0 if isinstance(self._begins, str) else self._begins
        if j < self.lead + self.c.count:
            return self.c[j - self.lead]
        if self._ends == REST:
            return self.c[-1]
        if isinstance(self._ends, Affine):
            return self._ends
        # equal last control points of the velocity: factors[k] (c_(k+1) - c_k) are these
        factors = rate_weights(self.breaks)
        step = self.control(j - 1) - self.control(j - 2)
        return self.control(j - 1) + step * float(factors[-2] / factors[-1])

    def at(self, s: float) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at s in [0, 1]."""
        if s not in self._at:  # many constraints and terms use the same nodes
            y, yd, ydd = (
                add([self.control(int(j)) * weights[0, j] for j in np.flatnonzero(weights[0])])
                for weights in basis(self.breaks, s)
            )
            self._at[s] = y, yd, ydd
        return self._at[s]

    # ------------------------------------------------------------------ nodes
    def wrench(self, k: int) -> Affine:
        """Sole wrenches (6 a sole) at a node, without their unloaded components."""
        w = self.w[k]
        loaded = ~np.isin(w.rows, self.unloaded.get(k, ()))
        return w if loaded.all() else Affine(w.size, w.rows[loaded], w.cols[loaded], w.vals[loaded], w.const)

    def at_node(self, k: int) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at a node; y'' of a free-floating base is the variable `bend`."""
        y, y1, y2 = self.at(float(self.nodes[k]))
        return y, y1, y2 if self.bend is None else stack([self.bend[k], y2[6:]])

    def place_at(self, s: float) -> Place:
        # an additional node has others near it
        name = percentage(s, self._digits + 2 * (s in self.more))
        return Place(f"{self.name}, {name}", f"{self.name} at {{s}}", self.T[0] * s)

    def instances(self) -> tuple[list[list[Affine]], list[Place]]:
        """Slots of the block ``node`` at each node, and the nodes' places."""
        slots = [[*self.at_node(k), self.legs[k], self.wrench(k), self.T[0]] for k in range(len(self.nodes))]
        return slots, [self.place_at(s) for s in self.nodes]

    def motion(self) -> list[tuple[Place, list[Affine]]]:
        """Places of the nodes with y, y', y'', legs and T [s], by which ydot = y'/T and yddot = y''/T^2."""
        return [(place, [*slots[:4], slots[5]]) for slots, place in zip(*self.instances(), strict=True)]

    def third_derivatives(self) -> list[tuple[Place, list[Affine]]]:
        """Places of the spline's intervals with y''' (ny), which is constant there, and T [s]."""
        out = []
        for a, b in pairwise(self.breaks.tolist()):
            third = (self.at(b)[2] - self.at(a)[2]) * (1 / (b - a))
            out.append((self.place_at((a + b) / 2), [third, self.T[0]]))
        return out

    def spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Places of the nodes with coordinates and legs, from fraction ``since`` of the phase on."""
        return [
            (self.place_at(s), [self.at(s)[0], self.legs[k]]) for k, s in enumerate(self.nodes) if s >= since
        ]

    def _loaded_sole(self, k: int) -> Index:
        """Components (6,) of the first loaded sole's wrench at a node; (0,) if all are unloaded."""
        soles = np.arange(self.w.size).reshape(-1, 6)
        return next((own for own in soles if not np.isin(own, self.unloaded.get(k, ())).any()), np.arange(0))

    def determined(self) -> list[Determined]:
        """Variables that can be eliminated at each node.

        Closure determines a leg, and the base's equations of motion the wrench of one loaded sole, or the
        acceleration of a free-floating base.
        """
        found = [
            [*by_leg(self.legs.index(k)), self.w.index(k)[self._loaded_sole(k)]] for k in range(self.w.count)
        ]
        if self.bend is not None:
            found = [[self.bend.index(k)] for k in range(self.bend.count)]
        return [each for parts in found for each in at_node(parts)]

    # ------------------------------------------------------------------ constraints
    def add_rate_limits(self, b: Builder) -> None:
        """Bounds the velocity spline's control points, and so the velocity everywhere between them.

        Multiplied by T, |c'_j| / T <= limit is linear in the variables.
        """
        # at rest, control points of the velocity are zero by construction: no constraints
        js = range(max(self.lead - 1, 0), self._last - 2 * (self._ends == REST))
        c, velocity = b.coordinates, b.limits.velocity
        joints = np.arange(c.base, c.ny)
        limit = b.limits.rate_limit[c.independent]
        names = c.labels[c.base :]
        factors = rate_weights(self.breaks)
        shortest, longest = b.layout.bounds(self.T)
        for j in js:
            step = (self.control(j + 1) - self.control(j))[joints] * (factors[j] / limit)
            # for messages: the Greville abscissa, the mean of the knots, where this control point weighs most
            s = float(knots(self.breaks)[j + 2 : j + 4].mean())
            name = f"{self.name}, control point {j}"
            place = Place(name, f"{self.name} at about {{s}}", self.T[0] * s)
            if shortest == longest:  # T is a number: one two-sided constraint instead of two
                constraints = [(name, step, -longest, longest)]
            else:
                time = stack([self.T[0]] * len(joints))
                constraints = [
                    (f"{name}, forward", step - time, -np.inf, 0.0),
                    (f"{name}, backward", -step - time, -np.inf, 0.0),
                ]
            for own_name, affine, lower, upper in constraints:
                b.constraints.add(
                    term=velocity.name,
                    place=replace(place, name=own_name),
                    components=names,
                    affine=affine,
                    lower=lower,
                    upper=upper,
                    measure=Measure("%", 100.0, "over its limit", self.T[0]),
                )

    def add_momentum_conservation(self, b: Builder) -> None:
        """Constrains the momentum of a free-floating robot: h(s) = h(0) + s T m g.

        It is collocated in the middles of the spline's intervals and at its end: as many points as the base
        has unknown control points.
        """
        middles = (self.breaks[1:] + self.breaks[:-1]) / 2
        start = [0.0] if self._begins == FREE else []  # from rest, h(0) = 0
        fractions = [*start, *middles.tolist(), 1.0]
        at = b.add_block("momentum", [[*self.at(s)[:2], self.T[0]] for s in fractions], b.limits.units)
        outputs = [at + 6 * i + np.arange(6) for i in range(len(fractions))]
        measure = [replace(each, unit=f"{each.unit} s") for each in b.limits.unbalanced]
        initial = Affine.zeros(6)
        if start:  # a variable, since each of the constraints below needs it
            origin: dict[str, Any] = {"term": "momentum", "place": self.place_at(0.0), "labels": DIRECTIONS}
            initial = b.lift(f"{self.kind} momentum", outputs[0], **origin)[0]
        # the block divides by the weight, m * GRAVITY
        gravity = np.append(np.array(b.robot.model.gravity.linear) / GRAVITY, np.zeros(3))
        for s, out in list(zip(fractions, outputs, strict=True))[len(start) :]:
            b.equal(
                "momentum",
                self.place_at(s),
                DIRECTIONS,
                out,
                measure,
                affine=-initial - stack([self.T[0]] * 6) * (s * gravity),
            )

    # ------------------------------------------------------------------ numbers
    def guess(self, x: Array, curve: CubicSpline) -> None:
        """Write a spline and its duration into solver variables x (n,)."""
        points = curve.control[self.lead : self.lead + self.c.count].copy()
        if self._ends == REST:  # the last variable stands for the last three control points: take the end
            points[-1] = curve.control[-1]
        if self.drift is not None and self.bend is not None:  # it does not for the base, which drifts
            points[-1, :6] = curve.control[self.lead + self.c.count - 1, :6]
            self.drift.write(x, curve.control[list(self._drifting), :6])
            second = curve.sample(self.nodes * curve.duration)[2] * curve.duration**2
            self.bend.write(x, second[:, :6])
        self.c.write(x, points)
        self.T.write(x, curve.duration)

    def wrenches(self, x: Array) -> Array:
        """Sole wrenches (k, 6 a sole) at the nodes, of solver variables x (n,)."""
        found = self.w.read(x)
        for k, zero in self.unloaded.items():
            found[k, zero] = 0.0
        return found

    def spline(self, x: Array) -> CubicSpline:
        """The spline of solver variables x (n,)."""
        points = np.array([self.control(j).evaluate(x) for j in range(len(self.breaks) + 2)])
        return CubicSpline(control=points, breaks=self.breaks, duration=float(self.T.read(x)[0, 0]))


def at_node(parts: list[Index]) -> list[Determined]:
    """Variables that a node's constraints determine, in the order of their elimination.

    Steps count up to -1, so that the last part of every node is eliminated in the same step.
    """
    return [determined(Turn.NODE, part, k) for k, part in enumerate(parts, -len(parts))]


class Swing(MotionPhase):
    """Motion to contact, usually from rest; it ends without acceleration.

    more : nodes in addition to the ends and middles of the intervals.  begins : as of `MotionPhase`.
    """

    def __init__(self, b: Builder, more: tuple[float, ...] = (), begins: str | Affine = REST) -> None:
        super().__init__(b, ("swing", "swing"), b.problem.swing, more, begins, COASTING, fine_end=True)

    @property
    def end(self) -> ContactState:
        """The state at contact."""
        return ContactState(*self.at_node(-1), T=self.T[0], legs=self.legs[-1], w=self.w[-1])


class FollowThrough(MotionPhase):
    """Motion from the state after contact to rest.

    more : nodes in addition to the ends and middles of the intervals.  ends : as of `MotionPhase`.
    kind, name : as of `MotionPhase`.
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
        super().__init__(b, (kind, name), b.problem.follow, more, FREE, ends, fine_end=False)

    @property
    def start(self) -> tuple[Affine, Affine, Affine]:
        """y and y' at the start, and the duration T [s]: ydot = y'/T."""
        y, y1, _ = self.at(0.0)
        return y, y1, self.T[0]

    def determined(self) -> list[Determined]:
        """Variables as of `MotionPhase`, and two control points: position and rate after contact."""
        first = np.concatenate([self.c.index(0), self.c.index(1)])
        return [*super().determined(), determined(Turn.AFTER, first)]


class AbortMotion(FollowThrough):
    """Motion to rest if nothing is hit, which the robot detects ``after`` [s] past the planned contact.

    Until then it coasts. The end of coasting is one more node, with its own sole wrench.
    """

    def __init__(
        self, b: Builder, more: tuple[float, ...] = (), *, after: float, ends: str | Affine = REST
    ) -> None:
        super().__init__(b, more, kind="abort", name="abort", ends=ends)
        self.after = after
        self.coast_w = b.layout.add("coasting sole wrench", 1, b.nw, **b.limits.of_wrenches)

    def coasting_node(self) -> tuple[list[Affine], Place]:
        """Slots of the block ``node`` at the end of coasting, where y'' = 0, and the node's place."""
        y, y1, T = self.start
        slots = [y, y1, Affine.zeros(y.size), self.legs[0], self.coast_w[0], T]
        return slots, Place.plain("end of coasting, if nothing is hit")

    def link(self, contact: Contact) -> list[list[Affine]]:
        """Slots of the block ``link``: the motion starts at the end of coasting."""
        u0 = contact.u0[0]
        return contact.link(self.start, (Affine.constant(self.after), Affine.zeros(1)), (u0, u0), u0)

    def determined(self) -> list[Determined]:
        return [*super().determined(), *at_node([self.coast_w.index(0)[:6]])]
