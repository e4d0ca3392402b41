"""Collision with one target by a model with frozen dynamics (SDC), or by one impulse balance.

`FrozenCollision` has H, J and the bias of one freeze, or of several during the contact, constant between
them: steps 1b to 8b of the paper. `collision.frozen` and `collision.model` do the same outside a program.
A freeze is a state of the contact: coordinates, rates and legs, at which the blocks of a collision evaluate
the rigid-body functions. Beside the robot's coordinates, the legs' rates and the hand's speed are integrated,
as the frozen Jacobians move them. Servo, penetration and contact force depend on these.

A single freeze is at the state at contact. The bias and dJ/dt v depend on the velocity there; they are
evaluated at the velocity with which hand and target have met (`v_meet` in `collision.frozen`), which the
constraints of an impact without rebound determine. Of N freezes, one is in the middle of each of N segments
of the contact's time. The phases' fractions of that time are the program's ``shares``; scenarios have the
segments of the expected target.

`InstantImpact` is the generalized impulse balance H (u+ - u-) = -J^T n I + J_c^T w, joints without torque.
The impulse I comes from Newton's restitution ("rigid"), or from the two-mass collision of the effective mass
with the contact law ("virtual-mass"; paper, sec. 2 and fig. 1), in closed form for the spring-damper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.collision.graph import target_start
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ReferenceRange
from impactopt.problem.violation import Measure, Place, percent
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import coasted, effective_mass
from impactopt.transcription.contact_state import Contact, ContactEnd, joint_motion_slots
from impactopt.transcription.layout import DIRECTIONS, Affine, Group, Turn, along, by_leg, determined, rates
from impactopt.transcription.mesh import CollocationPoint, Shares, lagrange, place_of, segment_of
from impactopt.transcription.plan import PlannedCollision


class InstantImpact:
    """Variables and constraints of an impact without duration; torques and wrenches are not bounded in it.

    mass : of a target [kg] that moves on together with the hand. None: the problem's target, with the
        restitution of its collision model.
    prefix : of the variables' names.

    Attributes
    ----------
    du : change of the rate ydot.
    impulse : to the target [N s].
    w : impulsive sole wrenches [N s, N m s].
    phases : of a contact with a duration; none.
    """

    phases = ()

    def __init__(self, b: Builder, contact: Contact, *, mass: float | None = None, prefix: str = "") -> None:
        self._b, self.contact, self._without_rebound = b, contact, mass is not None
        c = b.coordinates
        self.target = b.problem.target
        # a target without a mass is a wall
        self.mass = self.target.parameters.get("mass", np.inf) if mass is None else mass
        self.speed_before = float(self.target.speed_before())

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(prefix + name, 1, size, **options)

        self.du = add("change of rate", b.ny, labels=c.labels)
        of_impulse = Measure("N s", 1.0, "off")
        # > 0, as the block divides by it; a target or a robot of grams has less
        robot_mass = sum(inertia.mass for inertia in b.robot.model.inertias)
        least = 1e-3 * min(self.mass, robot_mass, 1.0)
        self.impulse_group = add("impulse", 1, lower=least, scale=10.0, measure=of_impulse)
        # [N s, N m s]: the weight for 0.05 s
        scale = 0.05 * b.limits.wrench_scale
        self.w = add("impulsive sole wrench", b.nw, **{**b.limits.of_wrenches, "scale": scale})

    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self.impulse_group[0]

    @property
    def target_velocity(self) -> Affine:
        """Velocity of the target along the normal after the impact [m/s]."""
        return self.impulse_group[0] * (1 / self.mass) + self.speed_before

    @property
    def target_state(self) -> Affine:
        """State (n_states,) of the target after the impact: a mass's speed that it gained; of a wall none."""
        return self.impulse_group[0] * (1 / self.mass) if self.target.n_states else Affine.zeros(0)

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``impact``."""
        b, p, state = self._b, self._b.problem, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.du[0], self.w[0], self.impulse_group[0]]
        rigid = float(self._without_rebound or p.collision == "rigid")
        # Where these are not the law's, they are unused (rigid = 1), but the block divides by the stiffness.
        # The restitution is 0 unless the collision is "rigid": hand and target then go on at one speed.
        law = [p.law.parameters.get(name, 1.0) for name in ("stiffness", "damping")]
        parameters = [*p.normal, rigid, p.coefficient_of_restitution, *law, 1 / self.mass, self.speed_before]
        return {"impact": ([slots], [np.concatenate([parameters, b.robot.torque_limit, b.limits.units])])}

    def determined(self) -> list[Determined]:
        """All variables: their constraints determine them together, as those of a collocation element."""
        groups = (self.du, self.w, self.impulse_group)
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in groups]))]

    def add_constraints(self, at: dict[str, tuple[int, int]]) -> None:
        b, (start, _) = self._b, at["impact"]
        part = b.parts("impact")
        base, joints = start + part["base"], start + part["joints"]
        units = {"N": "N s", "N m": "N m s"}  # the block's scale is 0.1 s times the weight
        unbalanced = [Measure(units[m.unit], 0.1 * m.factor, "off") for m in b.limits.unbalanced]
        of_limit = percent("off, of its limit for 0.1 s")
        b.equal("impulse balance", "impact", DIRECTIONS[: b.coordinates.base], base, unbalanced)
        b.equal("impulse balance", "impact", b.robot.joint_names, joints, of_limit)
        off = Measure("m/s", 1.0, "off")
        b.equal("law of the impact", "impact", ["impulse"], start + part["blow"], off)

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link``, as of `impactopt.transcription.collision.Collision.link`."""
        zero, no_travel = Affine.zeros(1), Affine.zeros(self._b.ny)
        return self.contact.link(start, (zero, zero), (no_travel, no_travel), self._rate_after)

    @property
    def state_after(self) -> list[Affine]:
        """y, ydot, legs and T (1 s) after contact."""
        state = self.contact.state
        return [state.y, self._rate_after, state.legs, Affine.constant(1.0)]

    def contact_end(self) -> ContactEnd:
        state, zero, one = self.contact.state, Affine.zeros(self._b.ny), Affine.constant(1.0)
        before = joint_motion_slots(state.y, self.contact.u0[0], zero, one, state.legs)
        after = joint_motion_slots(state.y, self._rate_after, zero, one, state.legs)
        return ContactEnd(Place.plain("after contact"), before, after, self.du[0])

    @property
    def _rate_after(self) -> Affine:
        """ydot (ny,) after the impact."""
        return self.contact.u0[0] + self.du[0]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess to x (n,): the robot loses 30 % of its rates."""
        self.du.write(x, -0.3 * rates)
        # what gives the target 0.5 m/s; 1 N s to a wall
        self.impulse_group.write(x, 0.5 * self.mass if np.isfinite(self.mass) else 1.0)

    def durations(self, x: Array) -> tuple[float, float]:
        """Durations of compression and restitution [s]: none."""
        return 0.0, 0.0

    def decode(self, x: Array, outputs: dict[str, Array], approaches: Array) -> PlannedCollision:
        """Collision of a plan, from solver variables (n,): two instants without a force."""
        b = self._b
        gained = float(self.impulse_group.read(x)[0, 0]) / self.mass  # [m/s]
        outcome = self.target.outcome([gained] * self.target.n_states)
        return PlannedCollision(
            time=np.zeros(2),
            force=np.zeros(2),
            target_speed=self.speed_before + np.array([0.0, gained]),
            outcome=outcome,
            torque=np.repeat(self.contact.feedforward.read(x), 2, axis=0) * b.robot.torque_limit,
            sole_wrench=np.zeros((0, b.nw)),
            ground=np.zeros((0, 6)),
        )


@dataclass(frozen=True)
class _Freeze:
    """State at which the dynamics are frozen: phase and place in it; coordinates, rates and legs there."""

    phase: int
    place: float
    y: Affine
    u: Affine
    legs: Affine


def bounds_reference(problem: ImpactProblem) -> bool:
    """True if `ReferenceRange` is among the problem's own terms, and bounds the coasting reference."""
    term = problem.extra(ReferenceRange)
    return term is not None and term.active


class FrozenCollision(Collision):
    """Variables and constraints of the collision with one target, with frozen dynamics.

    shares : fractions of the contact's time that the phases last. The other arguments are `Collision`'s.

    Attributes
    ----------
    leg_rates, lag : rates of the constrained legs' joints by the frozen Jacobians, and their angles behind
        the reference.
    speed, travel, joined_travel : of the hand along the normal; its integrals, as `d` and `joined`.
    begin_speeds : speed of the hand at the beginning of each segment.
    frozen_at, frozen_legs : coordinates and legs of each freeze during the contact.
    carried : sole wrenches that carry the weight, in a model without bias.
    coast_accelerations : of the legs of the coasting reference.
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
            return b.layout.add(self._prefix + name, count, size, **options)

        hand, joined = {"labels": ["hand"]}, self.joined.count
        self.leg_rates = add("collision leg rates", n, b.nl, **legs)
        self.lag = add("lag of the legs", n, b.nl, **legs)
        self.speed = add("hand speed", n, 1, **hand)
        self.travel = add("hand travel", n, 1, **hand)
        self.joined_travel = add("hand travel in compression", joined, 1, **hand)
        self.begin_speeds = [
            add(f"hand speed, segment {k}", 1, 1, **hand) for k in range(max(self.freezes, 1))
        ]
        self.frozen_at = [add(f"freeze {k}", 1, b.ny, labels=c.labels) for k in range(self.freezes)]
        self.frozen_legs = [add(f"legs of freeze {k}", 1, b.nl, **legs) for k in range(self.freezes)]
        count = int(not self.effects.bias and b.nw > 0)
        self.carried = add("sole wrench that carries", count, b.nw, **b.limits.of_wrenches)
        self._meeting: InstantImpact | None = None
        if self.effects.jdot and not self.freezes:
            # a surface that a force does not move at once, as a wall, stops the hand
            inverse_mass = float(target_start(b.problem.target, self.target)[0])
            mass = 1 / inverse_mass if inverse_mass > 0 else np.inf
            self._meeting = InstantImpact(b, contact, mass=mass, prefix=f"{self._prefix}meeting: ")
        self._segments = [self._segment(s) for s in stages]
        self._legs_at: list[Affine] = []
        self._frozen = [self._freeze(k) for k in range(max(self.freezes, 1))]

    def _add_reference(self, count: int) -> None:
        """Add variables of the reference, at `_instants`."""
        self._with_end = self.scenario is None and bounds_reference(self._b.problem)
        # without freezes the only segment begins at contact, where the freeze is, too
        count, labels = max(2 * self.freezes, 1) + self._with_end, self._b.coordinates.leg_labels
        super()._add_reference(count)
        name = f"{self._prefix}coasting leg accelerations"
        self.coast_accelerations = self._b.layout.add(name, count, self._b.nl, labels=labels)

    # ------------------------------------------------------------------ freezes
    def _segment(self, s: CollocationPoint) -> int:
        """Index of the segment that a stage's element belongs to."""
        if not self.freezes:
            return 0
        begin, end = self._ends(s)
        return segment_of(s.phase, begin, end, self.shares, self.freezes)

    def _ends(self, s: CollocationPoint) -> tuple[float, float]:
        """Places in the phase where a stage's element begins and ends."""
        return 0.0 if s.new_phase else self.stages[s.previous].place, self.stages[s.members[-1]].place

    def _freeze(self, k: int) -> _Freeze:
        """State of freeze k; appends the legs that the contact has there to ``_legs_at``."""
        state, u0 = self.contact.state, self.contact.u0[0]
        if not self.freezes:
            # v_meet of `collision.frozen`: the velocity at which hand and target have one speed
            v_meet = u0 if self._meeting is None else u0 + self._meeting.du[0]
            return _Freeze(0, 0.0, state.y, v_meet, state.legs)
        # In the middle of its segment: the midpoint rule, whose error falls with 1 / freezes^2.
        phase, place = place_of((k + 0.5) / self.freezes, self.shares)
        s = self._element_at(phase, place)
        # the freeze's rates and legs are values of its element's collocation polynomials, which are affine
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
        """First stage of the element that contains a place in a phase."""
        return next(
            s for s in self.stages if s.phase == phase and place <= self.stages[s.members[-1]].place + 1e-9
        )

    def _instants(self) -> list[tuple[int, float]]:
        """Phase and place of each instant of the reference's variables: beginnings of segments, freezes, and
        the end of contact if the reference is bounded there.
        """
        # a segment begins where the stage before its first one is
        firsts = [self.stages[self._segments.index(k)].previous for k in range(len(self._frozen))]
        begins = [(0, 0.0) if i < 0 else (self.stages[i].phase, self.stages[i].place) for i in firsts]
        freezes = [(at.phase, at.place) for at in self._frozen[: self.freezes]]
        return [*begins, *freezes, *([(len(self.phases) - 1, 1.0)] if self._with_end else [])]

    def _travel_to(self, k: int) -> list[Affine]:
        """Slots of the block ``moved`` at the freeze in the middle of segment k."""
        at = self._frozen[k]
        s = self._element_at(at.phase, at.place)
        T1, d1, _ = self._before(at.phase)
        # integral over the phase up to the element, to which that over the element's part is added
        d = Affine.zeros(self._b.ny) if s.new_phase else self.d[s.previous]
        places, begin = [self.stages[m].place for m in s.members], self._ends(s)[0]
        # Integral of the polynomial through the element's rates, from its beginning to the freeze: Gauss's
        # quadrature with one point a stage is exact.
        x, w = np.polynomial.legendre.leggauss(len(places))
        inner = [lagrange(places, begin + (at.place - begin) * (z + 1) / 2) for z in x]
        for m, weight in zip(s.members, (at.place - begin) / 2 * (w @ np.array(inner)), strict=True):
            d = d + self.u[m] * weight
        return [self.contact.state.y, d1, T1, d, self.T[at.phase][0], at.u]

    def _travel_before(self, k: int) -> list[Affine]:
        """Slots of the block ``moved`` at the beginning of segment k."""
        i = self._segments.index(k)
        y, s = self.contact.state.y, self.stages[i]
        if s.previous < 0:
            zero, no_travel = Affine.zeros(1), Affine.zeros(self._b.ny)
            return [y, no_travel, zero, no_travel, zero, self.contact.u0[0]]
        return [y, *self._travel(s.previous), self.u[s.previous]]

    # ------------------------------------------------------------------ blocks
    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        b, state = self._b, self.contact.state
        out = super().instances()
        moved = [self._travel_before(k) for k in range(len(self.begin_speeds))]
        moved += [self._travel_to(k) for k in range(self.freezes)]
        out["moved"] = moved, [b.problem.normal] * len(moved)
        if self._meeting is not None:
            out |= self._meeting.instances()
        if self.carried.count:
            slots = [state.y, state.legs, self.contact.u0[0], self.carried[0]]
            out["carried"] = [slots], [b.limits.units]
        return out

    def _dynamics(self, i: int) -> list[Affine]:
        """Slots of the block ``collision``: steps 3b to 6b at stage i, with the freeze of step 1b."""
        b, s, k = self._b, self.stages[i], self._segments[i]
        y, u0, at = self.contact.state.y, self.contact.u0[0], self._frozen[k]
        # In a segment the reference's rates go on from those at its beginning, with the acceleration at its
        # freeze. Without dJ/dt v there is none.
        acceleration = self.coast_accelerations[self.freezes + k] if self.effects.jdot else Affine.zeros(b.nl)
        since = self._time(s.phase, s.place) - self._time(*self._instants()[k])
        legs = [
            *self._slots(self.leg_rates, i, self.coast_rates[0]),
            *self._slots(self.lag, i, Affine.zeros(b.nl)),
        ]
        carried = [] if self.effects.bias else [self.carried[0] if self.carried.count else Affine.zeros(b.nw)]
        motion = [*self._travel(i), *self._slots(self.u, i, u0), self.legs[i]]
        own = [y, u0, self._feedforward(), *motion, self.f[i], self.w[i]]
        reference = [self.coast_rates[k], acceleration]
        rest = [*legs, since, self._hand_slope(i), *carried, self.contact.gains[0]]
        return [*own, at.y, at.u, at.legs, *reference, *rest]

    def _hand_slope(self, i: int) -> Affine:
        """Slope of the hand's speed along the normal at stage i.

        At the beginning of each segment the speed is that of the robot, by `begin_speeds`.
        """
        s, k = self.stages[i], self._segments[i]
        first = s.previous < 0 or self._segments[s.previous] != k
        # as `_slots`, but the value before may be another than the last stage's: the freeze changes J, and
        # with it the hand's speed of the same rates
        slope = self.speed[s.members[0]] * 0.0
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + self.speed[m] * w
        return slope + (self.begin_speeds[k][0] if first else self.speed[s.previous]) * s.start

    def _hand_slots(self, i: int) -> list[Affine]:
        """Slots of the block ``force``: the hand's motion by step 7b, not by forward kinematics."""
        s = self.stages[i]
        # n . J is frozen, so the hand's position is the integral of its speed, and forward kinematics would
        # differ
        before = self._mean_before(self.travel, self.joined_travel, s.phase)
        return [before, self._before(s.phase)[0], self.travel[i], self.T[s.phase][0], self.speed[i]]

    def _reference(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``coasting``, at `_instants` in place of the stages."""
        if not self._b.coordinates.legs:
            return {}
        start = [self.contact.state.y, self.contact.u0[0]]
        groups = self._reference_groups()
        slots = [
            [*start, self._before(phase)[0], self.T[phase][0], *(group[k] for group in groups)]
            for k, (phase, _) in enumerate(self._instants())
        ]
        return {"coasting": (slots, [[place] for _, place in self._instants()])}

    def _reference_groups(self) -> tuple[Group, ...]:
        """Variables of the reference's legs, in the order of the block ``coasting``."""
        return self.coast_legs, self.coast_rates, self.coast_accelerations

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

    def _leg_groups(self) -> tuple[Group, ...]:
        return (self.legs,)

    def groups_without_start(self) -> list[Group]:
        return [self.legs, self.f, self.w, self.leg_rates, self.lag, self.speed]

    def states(self) -> tuple[Group, ...]:
        return (*super().states(), self.leg_rates, self.lag)

    def kept_groups(self) -> list[Group]:
        out = [*super().kept_groups(), *self._reference_groups(), self.joined_travel, self.carried]
        out += [*self.begin_speeds, *self.frozen_at, *self.frozen_legs]
        if self._meeting is not None:
            out += [self._meeting.du, self._meeting.w, self._meeting.impulse_group]
        return out

    def determined(self) -> list[Determined]:
        # equal to an affine expression of the collocated legs, as lifted variables are to outputs
        out = [determined(Turn.LIFTED, group.index(0)) for group in self.frozen_legs if group.size]
        out += super().determined()
        for k in range(self.coast_legs.count):
            legs = [leg for g in self._reference_groups() for leg in by_leg(g.index(k))]
            out += [determined(Turn.STAGE_LEGS, leg, j) for j, leg in enumerate(legs)]
        if self.carried.count:
            out.append(determined(Turn.ELEMENT, self.carried.index(0)))
        return [*([] if self._meeting is None else self._meeting.determined()), *out]

    # ------------------------------------------------------------------ constraints
    def add_constraints(self, at: dict[str, tuple[int, int]]) -> None:
        """Add the constraints, as of `Collision`.

        Those of the freezes are first, as they determine variables in which all others are written.
        """
        if self._meeting is not None:
            self._meeting.add_constraints(at)
        self._add_freezes(*at["moved"])
        if "coasting" in at:
            self._add_coasting(*at["coasting"])
        if "carried" in at:
            self._add_carried(at["carried"][0])
        # of the full model, each stage has an instance of ``coasting``; here only the instants above
        super().add_constraints({name: found for name, found in at.items() if name != "coasting"})

    def _add_freezes(self, start: int, size: int) -> None:
        """Equate the states of freezes, and the hand's speeds at the beginnings of segments, to the motion.

        start : index of the block's first output.  size : outputs of an instance.
        """
        b, part = self._b, self._b.parts("moved")
        # instances of the block ``moved``: beginnings of segments, then freezes
        parts = [(group, k, "speed") for k, group in enumerate(self.begin_speeds)]
        parts += [(group, len(self.begin_speeds) + k, "y") for k, group in enumerate(self.frozen_at)]
        for group, instance, name in parts:
            outputs = start + instance * size + part[name]
            measure = along(group.labels, "off") if name == "y" else Measure("m/s", 1.0, "off")
            b.equal("state to freeze at", group.name, group.labels, outputs, measure, affine=-group[0])
            b.lifted.append((group, np.asarray(outputs, dtype=np.intp), 0))
        for group, legs in zip(self.frozen_legs, self._legs_at, strict=True):
            b.equal(
                "state to freeze at",
                group.name,
                group.labels,
                measure=along(group.labels, "off"),
                affine=legs - group[0],
            )

    def _add_coasting(self, start: int, size: int) -> None:
        """Add the constraints of the reference's legs.  start, size : as of `_add_freezes`."""
        b, part = self._b, self._b.parts("coasting")
        closure = [f"{leg.end} {d}" for leg in b.coordinates.legs for d in DIRECTIONS]
        for k in range(self.coast_legs.count):
            term, place = "legs of the coasting reference", f"instant {k}{self.suffix}"
            outputs = start + k * size
            b.equal(term, place, closure, outputs + part["closure"], along(closure, "off"))
            labels = self.coast_rates.labels
            b.equal(term, place, labels, outputs + part["rate"], rates(labels))
            b.equal(term, place, labels, outputs + part["acceleration"], Measure("rad/s^2", 1.0, "off"))

    def _add_carried(self, start: int) -> None:
        """Add the constraints of `carried`.

        They are the wrenches at contact, plus one wrench that is the same on each sole. Together they carry
        the weight and the Coriolis and centrifugal forces.
        """
        b, term, place = self._b, "weight that soles carry", f"contact{self.suffix}"
        outputs = start + b.parts("carried")["base"]
        b.equal(term, place, DIRECTIONS[: b.coordinates.base], outputs, b.limits.unbalanced)
        more = self.carried[0] - self.contact.state.w
        for k in range(1, len(b.coordinates.legs)):
            b.equal(
                term,
                place,
                self.carried.labels[6 * k : 6 * k + 6],
                measure=b.limits.unbalanced[:6],
                affine=more[6 * k : 6 * k + 6] - more[:6],
            )

    def _add_dynamics(self, i: int, place: Place, first: dict[str, int]) -> None:
        """Add the constraints of `Collision` at a stage, and those of the motion by frozen Jacobians."""
        super()._add_dynamics(i, place, first)
        b, part = self._b, self._b.parts("collision")
        for name, labels in (
            ("legs", self.lag.labels),
            ("lag", self.lag.labels),
            ("hand", self.travel.labels),
        ):
            b.equal("collision kinematics", place, labels, first["collision"] + part[name], rates(labels))

    # ------------------------------------------------------------------ initial guess and solution
    def guess_model(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess of variables that only this collision model has.

        The hand's speed is in a constant ratio to the fastest rate, as all rates fall alike.
        """
        k = int(np.argmax(np.abs(rates)))
        if rates[k] != 0:
            p, c = self._b.problem, self._b.coordinates
            ratio = effective_mass(c, p.strikers, p.normal, y, legs, rates)[1] / rates[k]
            for hand, coordinates in (
                (self.speed, self.u),
                (self.travel, self.d),
                (self.joined_travel, self.joined),
            ):
                hand.write(x, coordinates.read(x)[:, k : k + 1] * ratio)
        if self._meeting is not None:
            self._meeting.guess(x, y, rates, legs)
        if not legs.size:
            return
        self.carried.write(x, self.contact.state.w.evaluate(x))
        time = np.ravel([self._time(*at).evaluate(x) for at in self._instants()])
        for k, (angles, motion) in enumerate(coasted(self._b.coordinates, time, y, rates, legs)):
            for group, value in zip(self._reference_groups(), (angles, *motion), strict=True):
                x[group.index(k)] = value
        self.leg_rates.write(x, self.coast_rates.read(x)[:1])
        for group in self.frozen_legs:
            group.write(x, legs)
