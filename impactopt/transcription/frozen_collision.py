"""Contact with one target by a model with frozen dynamics: the SDC inside a program, or one impulse balance.

H, J and the bias are those of one freeze, or of several on the way, and are constant between them (paper,
steps 1b to 8b; `collision.frozen` has them in numbers, `collision.model` the freezes on the way). What is
frozen is a point of the contact: coordinates, rates and legs, at which the blocks of a collision evaluate the
rigid-body functions. Beside the robot's coordinates, the legs' rates and the hand's speed are integrated of
their own, as frozen Jacobians move them: servo, penetration and force are of these.

With one freeze it is at the state at contact, and the velocities that the bias and dJ/dt v depend on are
those with which hand and target have met (`v_meet`), by the constraints of an impact in which they stay
together. With N there is one in the middle of each of N segments of the contact's time. Phases share that
time as in the program's ``shares``; scenarios have the expected target's segments.

H (u+ - u-) = -J^T n I + J_c^T w, joints without torque: the generalized impulse balance. The impulse I comes
from Newton's restitution ("rigid"), or from the two-mass collision of the virtual mass with the contact law
("virtual-mass"; paper, sec. 2 and fig. 1), in closed form for the spring-damper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.collision.graph import target_start
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import coasted, effective_mass
from impactopt.transcription.contact_state import Contact, ContactEnd, still
from impactopt.transcription.layout import (
    DIRECTIONS,
    Affine,
    Array,
    Group,
    Measure,
    Place,
    Turn,
    along,
    by_leg,
    determined,
    percent,
    rates,
)
from impactopt.transcription.mesh import CollocationPoint, Shares, lagrange, place_of, segment_of
from impactopt.transcription.plan import PlannedCollision


class InstantImpact:
    """Variables and constraints of an impact in no time; no constraint of torque or wrench while it lasts.

    mass : of a target that hand and robot have met, when they move on together; None: the problem's, which
    parts as its model of the collision says.  named : begin of the variables' names.
    """

    def __init__(self, b: Builder, contact: Contact, *, mass: float | None = None, named: str = "") -> None:
        self._b, self.contact, self._meets = b, contact, mass is not None
        c = b.coordinates
        self.target = b.problem.target
        # a wall takes any impulse without moving
        self.mass = self.target.parameters.get("mass", np.inf) if mass is None else mass
        self.before = float(self.target.speed_before())

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(named + name, 1, size, **options)

        self.du = add("change of rate", b.ny, labels=c.labels)
        self.blow = add("impulse", 1, lower=1e-3, scale=10.0)
        scale = 0.05 * b.limits.wrench_scale
        self.w = add("impulsive sole wrench", b.nw, **{**b.limits.of_wrenches, "scale": scale})

    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self.blow[0]

    @property
    def target_state(self) -> Affine:
        """State of the target after the impact."""
        return self.blow[0] * (1 / self.mass)

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``impact``."""
        b, p, state = self._b, self._b.problem, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.du[0], self.w[0], self.blow[0]]
        rigid = float(self._meets or p.collision == "rigid")
        law = [p.law.parameters.get(name, 1.0) for name in ("stiffness", "damping")]
        numbers = [*p.normal, rigid, p.coefficient_of_restitution, *law, 1 / self.mass, self.before]
        return {"impact": ([slots], [np.concatenate([numbers, b.robot.torque_limit, b.limits.units])])}

    def determined(self) -> list[Determined]:
        """All of it, as of one element."""
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in (self.du, self.w, self.blow)]))]

    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        b, (start, _) = self._b, at["impact"]
        part = b.parts("impact")
        base, joints = start + part["base"], start + part["joints"]
        units = {"N": "N s", "N m": "N m s"}  # constraints are over a tenth of a second of the weight
        unbalanced = [Measure(units[m.unit], 0.1 * m.factor, "off") for m in b.limits.unbalanced]
        share = percent("off, of its limit for 0.1 s")
        b.equal("impulse balance", "impact", DIRECTIONS[: b.coordinates.base], base, unbalanced)
        b.equal("impulse balance", "impact", b.robot.joint_names, joints, share)
        off = Measure("m/s", 1.0, "off")
        b.equal("law of the impact", "impact", ["impulse"], start + part["blow"], off)

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Linking constraints (:meth:`impactopt.transcription.collision.Collision.link`); no time passes."""
        none, still = Affine.zeros(1), Affine.zeros(self._b.ny)
        return self.contact.link(start, (none, none), (still, still), self._rate)

    @property
    def state_after(self) -> list[Affine]:
        """State after contact (:meth:`impactopt.transcription.collision.Collision.state_after`)."""
        state = self.contact.state
        return [state.y, self._rate, state.legs, Affine.constant(1.0)]

    def contact_end(self) -> ContactEnd:
        state, none, one = self.contact.state, Affine.zeros(self._b.ny), Affine.constant(1.0)
        before = still(state.y, self.contact.u0[0], none, one, state.legs)
        after = still(state.y, self._rate, none, one, state.legs)
        return ContactEnd(Place.plain("after contact"), before, after, self.du[0])

    @property
    def _rate(self) -> Affine:
        """ydot after it."""
        return self.contact.u0[0] + self.du[0]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        self.du.write(x, -0.3 * rates)
        self.blow.write(x, 0.5 * self.mass if np.isfinite(self.mass) else 1.0)

    def durations(self, x: Array) -> tuple[float, float]:
        return 0.0, 0.0

    def decode(self, x: Array, outputs: dict[str, Array], approaches: Array) -> PlannedCollision:
        b = self._b
        gained = float(self.blow.read(x)[0, 0]) / self.mass
        outcome = self.target.outcome([gained] * self.target.n_states)
        return PlannedCollision(
            time=np.zeros(2),
            force=np.zeros(2),
            target_speed=self.before + np.array([0.0, gained]),
            outcome=outcome,
            torque=np.repeat(self.contact.feedforward.read(x), 2, axis=0) * b.robot.torque_limit,
            sole_wrench=np.zeros((0, b.nw)),
            ground=np.zeros((0, 6)),
        )


@dataclass(frozen=True)
class _Freeze:
    """Point at which the dynamics is frozen: phase, place in it; coordinates, rates, legs."""

    phase: int
    place: float
    y: Affine
    u: Affine
    legs: Affine


class FrozenCollision(Collision):
    """Variables and constraints of the contact with one target. shares : of the hit; the rest as of
    `Collision`.
    """

    def __init__(
        self,
        b: Builder,
        contact: Contact,
        stages: Sequence[CollocationPoint],
        *,
        shares: Shares,
        **common: Any,
    ) -> None:
        assert b.problem.frozen is not None
        self.effects, self.shares, self.freezes = b.problem.frozen, shares, b.problem.freezes
        super().__init__(b, contact, stages, **common)
        c, n, legs = b.coordinates, len(stages), {"labels": b.coordinates.leg_labels}

        def add(name: str, count: int, size: int, **options: Any) -> Group:
            return b.layout.add(self._named + name, count, size, **options)

        hand, joined = {"labels": ["hand"]}, self.joined.count
        self.leg_rates = add("collision leg rates", n, b.nl, **legs)
        self.lag = add("lag of the legs", n, b.nl, **legs)
        self.speed = add("hand speed", n, 1, **hand)
        self.travel = add("hand travel", n, 1, **hand)
        self.joined_travel = add("hand travel in compression", joined, 1, **hand)
        self.begins = [add(f"hand speed, segment {k}", 1, 1, **hand) for k in range(max(self.freezes, 1))]
        self.frozen_at = [add(f"freeze {k}", 1, b.ny, labels=c.labels) for k in range(self.freezes)]
        self.frozen_legs = [add(f"legs of freeze {k}", 1, b.nl, **legs) for k in range(self.freezes)]
        carried = int(not self.effects.bias and b.nw > 0)
        self.carried = add("sole wrench that carries", carried, b.nw, **b.limits.of_wrenches)
        self._meeting: InstantImpact | None = None
        if self.effects.jdot and not self.freezes:
            gives_way = float(target_start(b.problem.target, self.target)[0])
            mass = 1 / gives_way if gives_way > 0 else np.inf
            self._meeting = InstantImpact(b, contact, mass=mass, named=f"{self._named}meeting: ")
        self._segments = [self._segment(s) for s in stages]
        self._legs_at: list[Affine] = []
        self._frozen = [self._freeze(k) for k in range(max(self.freezes, 1))]

    def _add_reference(self, count: int) -> None:
        """Adds reference variables at the beginnings of segments, then at later freezes."""
        count, labels = max(2 * self.freezes, 1), self._b.coordinates.leg_labels
        super()._add_reference(count)
        name = f"{self._named}coasting leg accelerations"
        self.bends = self._b.layout.add(name, count, self._b.nl, labels=labels)

    # ------------------------------------------------------------------ where it is frozen
    def _segment(self, s: CollocationPoint) -> int:
        if not self.freezes:
            return 0
        begin, end = self._ends(s)
        return segment_of(s.phase, begin, end, self.shares, self.freezes)

    def _ends(self, s: CollocationPoint) -> tuple[float, float]:
        """Places of begin and end of a stage's element, in the phase."""
        return 0.0 if s.new_phase else self.stages[s.previous].place, self.stages[s.members[-1]].place

    def _freeze(self, k: int) -> _Freeze:
        state, u0 = self.contact.state, self.contact.u0[0]
        if not self.freezes:
            # v_meet of docs/notation.md: hand and target move at one speed, after the impulse that this takes
            met = u0 if self._meeting is None else u0 + self._meeting.du[0]
            return _Freeze(0, 0.0, state.y, met, state.legs)
        # in the middle of its segment: the midpoint rule, whose error falls with 1 / freezes^2
        phase, place = place_of((k + 0.5) / self.freezes, self.shares)
        s = self._element_at(phase, place)
        at = [self._ends(s)[0], *(self.stages[m].place for m in s.members)]
        weights = lagrange(at, place)

        def value(group: Group, start: Affine) -> Affine:
            out = (start if s.previous < 0 else group[s.previous]) * weights[0]
            for m, w in zip(s.members, weights[1:], strict=True):
                out = out + group[m] * w
            return out

        self._legs_at.append(value(self.legs, state.legs))
        return _Freeze(phase, place, self.frozen_at[k][0], value(self.u, u0), self.frozen_legs[k][0])

    def _element_at(self, phase: int, place: float) -> CollocationPoint:
        """A stage of the element that a place in a phase is in."""
        return next(
            s for s in self.stages if s.phase == phase and place <= self.stages[s.members[-1]].place + 1e-9
        )

    def _instants(self) -> list[tuple[int, float]]:
        """Phases and places at which the reference is known: where segments begin, and at freezes."""
        firsts = [self.stages[self._segments.index(k)].previous for k in range(len(self._frozen))]
        begins = [(0, 0.0) if i < 0 else (self.stages[i].phase, self.stages[i].place) for i in firsts]
        return [*begins, *((at.phase, at.place) for at in self._frozen[: self.freezes])]

    def _travel_to(self, k: int) -> list[Affine]:
        """Slots of the block ``moved``: to the freeze in the middle of a segment."""
        at = self._frozen[k]
        s = self._element_at(at.phase, at.place)
        T1, d1, _ = self._before(at.phase)
        d = Affine.zeros(self._b.ny) if s.new_phase else self.d[s.previous]
        places, begin = [self.stages[m].place for m in s.members], self._ends(s)[0]
        # the polynomial through the element's rates is integrated exactly by as many of its values
        x, w = np.polynomial.legendre.leggauss(len(places))
        inner = [lagrange(places, begin + (at.place - begin) * (z + 1) / 2) for z in x]
        for m, weight in zip(s.members, (at.place - begin) / 2 * (w @ np.array(inner)), strict=True):
            d = d + self.u[m] * weight
        return [self.contact.state.y, d1, T1, d, self.T[at.phase][0], at.u]

    def _travel_before(self, k: int) -> list[Affine]:
        """Slots of the block ``moved``: to the beginning of a segment."""
        i = self._segments.index(k)
        y, s = self.contact.state.y, self.stages[i]
        if s.previous < 0:
            none, still = Affine.zeros(1), Affine.zeros(self._b.ny)
            return [y, still, none, still, none, self.contact.u0[0]]
        return [y, *self._travel(s.previous), self.u[s.previous]]

    # ------------------------------------------------------------------ blocks
    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        b, state = self._b, self.contact.state
        out = super().instances()
        moved = [self._travel_before(k) for k in range(len(self.begins))]
        moved += [self._travel_to(k) for k in range(self.freezes)]
        out["moved"] = moved, [b.problem.normal] * len(moved)
        if self._meeting is not None:
            out |= self._meeting.instances()
        if self.carried.count:
            slots = [state.y, state.legs, self.contact.u0[0], self.carried[0]]
            out["carried"] = [slots], [b.limits.units]
        return out

    def _dynamics(self, i: int) -> list[Affine]:
        """Slots of the block ``collision``: steps 3b to 6b at one instant, with what step 1b has stored."""
        b, s, k = self._b, self.stages[i], self._segments[i]
        y, u0, at = self.contact.state.y, self.contact.u0[0], self._frozen[k]
        hit = [self.legs[i], self.f[i], self.w[i]]
        bends = self.bends[self.freezes + k] if self.effects.jdot else Affine.zeros(b.nl)
        since = self._time(s.phase, s.place) - self._time(*self._instants()[k])
        legs = [
            *self._slots(self.leg_rates, i, self.coast_rates[0]),
            *self._slots(self.lag, i, Affine.zeros(b.nl)),
        ]
        carried = [] if self.effects.bias else [self.carried[0] if self.carried.count else Affine.zeros(b.nw)]
        own = [y, u0, self._feedforward(), *self._travel(i), *self._slots(self.u, i, u0), *hit]
        reference = [self.coast_rates[k], bends]
        more = [*reference, *legs, since, self._hand_slope(i), *carried, self.contact.gains[0]]
        return [*own, at.y, at.u, at.legs, *more]

    def _hand_slope(self, i: int) -> Affine:
        """Slope of the hand's speed along the normal, which starts each segment at the robot's speed."""
        s, k = self.stages[i], self._segments[i]
        first = s.previous < 0 or self._segments[s.previous] != k
        slope = self.speed[s.members[0]] * 0.0
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + self.speed[m] * w
        return slope + (self.begins[k][0] if first else self.speed[s.previous]) * s.start

    def _of_hand(self, i: int) -> list[Affine]:
        """Step 7b: of the accelerations of the contact point, and not of the robot's geometry."""
        s = self.stages[i]
        before = self._so_far(self.travel, self.joined_travel, s.phase)
        return [before, self._before(s.phase)[0], self.travel[i], self.T[s.phase][0], self.speed[i]]

    def _reference(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        if not self._b.coordinates.legs:
            return {}
        start = [self.contact.state.y, self.contact.u0[0]]
        own = zip(
            self._instants(),
            *(map(group.__getitem__, range(group.count)) for group in self._of_reference()),
            strict=True,
        )
        slots = [[*start, self._before(phase)[0], self.T[phase][0], *legs] for (phase, _), *legs in own]
        return {"coasting": (slots, [[place, float(phase > 0)] for phase, place in self._instants()])}

    def _of_reference(self) -> tuple[Group, ...]:
        return self.coast_legs, self.coast_rates, self.bends

    def _feedforward(self) -> Affine:
        if self.effects.feedforward:
            return super()._feedforward()
        return Affine.zeros(self._b.robot.n)

    def _gains(self) -> tuple[Array, Array]:
        kp, kd = super()._gains()
        return (kp, kd) if self.effects.stiffness else (0 * kp, kd)

    # ------------------------------------------------------------------ groups
    def integrated(self) -> list[tuple[Group, Group]]:
        return [*super().integrated(), (self.travel, self.speed)]

    def _integrals(self) -> list[tuple[Group, Group]]:
        return [*super()._integrals(), (self.travel, self.joined_travel)]

    def _at_stage(self) -> tuple[Group, ...]:
        return (self.legs,)

    def loose(self) -> list[Group]:
        return [self.legs, self.f, self.w, self.leg_rates, self.lag, self.speed]

    def states(self) -> tuple[Group, ...]:
        return (*super().states(), self.leg_rates, self.lag)

    def held_over(self) -> list[Group]:
        met = [] if self._meeting is None else [self._meeting.du, self._meeting.w, self._meeting.blow]
        own = [*self._of_reference(), self.joined_travel, self.carried]
        return [*super().held_over(), *own, *self.begins, *self.frozen_at, *self.frozen_legs, *met]

    def determined(self) -> list[Determined]:
        out = [determined(Turn.LIFTED, group.index(0)) for group in self.frozen_legs if group.size]
        out += super().determined()
        for k in range(self.coast_legs.count):
            legs = [leg for g in self._of_reference() for leg in by_leg(g.index(k))]
            out += [determined(Turn.STAGE_LEGS, leg, j) for j, leg in enumerate(legs)]
        if self.carried.count:
            out.append(determined(Turn.ELEMENT, self.carried.index(0)))
        return [*([] if self._meeting is None else self._meeting.determined()), *out]

    # ------------------------------------------------------------------ constraints
    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        """Adds constraints; those of the freezes come first, as they determine variables that all others
        have.
        """
        if self._meeting is not None:
            self._meeting.add_rows(at)
        self._moved_rows(*at["moved"])
        if "coasting" in at:
            self._reference_rows(*at["coasting"])
        if "carried" in at:
            self._carried_rows(at["carried"][0])
        super().add_rows({name: found for name, found in at.items() if name != "coasting"})

    def _moved_rows(self, start: int, size: int) -> None:
        b, part = self._b, self._b.parts("moved")
        places = [(group, k, "speed") for k, group in enumerate(self.begins)]
        places += [(group, len(self.begins) + k, "y") for k, group in enumerate(self.frozen_at)]
        for group, instance, name in places:
            outputs = start + instance * size + part[name]
            measure = along(group.labels, "off") if name == "y" else Measure("m/s", 1.0, "off")
            b.rows.add(
                term="state to freeze at",
                place=group.name,
                components=group.labels,
                outputs=outputs,
                affine=-group[0],
                lower=0,
                upper=0,
                measure=measure,
            )
            b.lifted.append((group, np.asarray(outputs, dtype=np.intp)))
        for group, legs in zip(self.frozen_legs, self._legs_at, strict=True):
            b.rows.add(
                term="state to freeze at",
                place=group.name,
                components=group.labels,
                affine=legs - group[0],
                lower=0,
                upper=0,
                measure=along(group.labels, "off"),
            )

    def _reference_rows(self, start: int, size: int) -> None:
        b, part = self._b, self._b.parts("coasting")
        closure = [f"{leg.end} {d}" for leg in b.coordinates.legs for d in DIRECTIONS]
        for k in range(self.coast_legs.count):
            term, place = "legs of the coasting reference", f"freeze {k}{self.suffix}"
            outputs = start + k * size
            b.equal(term, place, closure, outputs + part["closure"], along(closure, "off"))
            labels = self.coast_rates.labels
            b.equal(term, place, labels, outputs + part["rate"], rates(labels))
            b.equal(term, place, labels, outputs + part["acceleration"], Measure("rad/s^2", 1.0, "off"))

    def _carried_rows(self, start: int) -> None:
        """They are what the soles bear at contact, and as much more each as makes them carry all."""
        b, term, place = self._b, "weight that soles carry", f"contact{self.suffix}"
        outputs = start + b.parts("carried")["base"]
        b.equal(term, place, DIRECTIONS[: b.coordinates.base], outputs, b.limits.unbalanced)
        more = self.carried[0] - self.contact.state.w
        for k in range(1, len(b.coordinates.legs)):
            b.rows.add(
                term=term,
                place=place,
                components=self.carried.labels[6 * k : 6 * k + 6],
                affine=more[6 * k : 6 * k + 6] - more[:6],
                lower=0,
                upper=0,
                measure=b.limits.unbalanced[:6],
            )

    def _dynamics_rows(self, i: int, place: Place, first: dict[str, int]) -> None:
        super()._dynamics_rows(i, place, first)
        b, part = self._b, self._b.parts("collision")
        for labels, name in (
            (self.lag.labels, "legs"),
            (self.lag.labels, "lag"),
            (self.travel.labels, "hand"),
        ):
            b.equal("collision kinematics", place, labels, first["collision"] + part[name], rates(labels))

    # ------------------------------------------------------------------ numbers
    def guess_model(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """The hand is slowed down as the coordinates are, all alike: as the fastest of them."""
        k = int(np.argmax(np.abs(rates)))
        if rates[k] != 0:
            speed = self._speed(y, rates, legs) / rates[k]
            for mine, its in ((self.speed, self.u), (self.travel, self.d), (self.joined_travel, self.joined)):
                mine.write(x, its.read(x)[:, k : k + 1] * speed)
        if self._meeting is not None:
            self._meeting.guess(x, y, rates, legs)
        if not legs.size:
            return
        self.carried.write(x, self.contact.state.w.evaluate(x))
        time = np.ravel([self._time(*at).evaluate(x) for at in self._instants()])
        for k, (there, motion) in enumerate(coasted(self._b.coordinates, time, y, rates, legs)):
            for group, value in zip(self._of_reference(), (there, *motion), strict=True):
                x[group.index(k)] = value
        self.leg_rates.write(x, self.coast_rates.read(x)[:1])
        for group in self.frozen_legs:
            group.write(x, legs)

    def _speed(self, y: Array, rates: Array, legs: Array) -> float:
        """Speed of the hand along the normal [m/s]."""
        p = self._b.problem
        return effective_mass(self._b.coordinates, p.strikers, p.normal, y, legs, rates)[1]
