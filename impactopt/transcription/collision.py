"""Collocated contact phases: Radau IIA collocation of the whole equation of motion, and the impact's onset.

Compression and restitution, each of which is smooth, or the phases of a target with events. One contact for
the expected target, one for each scenario. They share the state at contact, the
feed-forward and the servo; durations, motion, force and wrenches are each one's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets.base import SEPARATION, TOUCH, TURN
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.objectives import PeakForce
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.robots.mass_matrix import mass_matrix
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_blocks import DEPTH_SCALE, FORCE_SCALE, typical_state
from impactopt.transcription.contact_guess import blow, coasted, effective_mass
from impactopt.transcription.contact_state import (
    Contact,
    ContactEnd,
    ContactNumbers,
    DrivePoint,
    pulls_apart,
    still,
    switches,
)
from impactopt.transcription.layout import (
    DIRECTIONS,
    Affine,
    Array,
    Group,
    Index,
    Measure,
    Place,
    Turn,
    along,
    by_leg,
    determined,
    percent,
    rates,
)
from impactopt.transcription.mesh import CollocationPoint
from impactopt.transcription.motion_phase import add_cone_rows
from impactopt.transcription.plan import PlannedCollision, total_ground_wrench

TYPICAL = 100.0  # [rad/s^2]


class FirstInstant:
    """Variables and constraints of it.

    law : numbers of the contact law.  suffix : of the names of its place and variables.
    """

    def __init__(self, b: Builder, contact: Contact, law: dict[str, float], suffix: str) -> None:
        self._b, self.contact, self.law = b, contact, law
        self.place = Place.plain(f"first instant of contact{suffix}")

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(name + suffix, 1, size, **options)

        self.change = add("jump of acceleration", b.ny, scale=TYPICAL, labels=b.coordinates.labels)
        of_wrenches = {name: b.limits.of_wrenches[name] for name in ("scale", "labels")}
        self.w = add("jump of sole wrench", b.nw, **of_wrenches)
        self.f = add("first force", 1, scale=FORCE_SCALE)

    def instance(self) -> tuple[list[Affine], Array]:
        """Slots and parameters of the block ``first``."""
        b, state = self._b, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.change[0], self.w[0], self.f[0]]
        law, robot = np.array([*self.law.values()]), b.robot
        before = np.array([float(b.problem.target.speed_before())])
        numbers = [b.problem.normal, law, before, robot.armature, robot.torque_limit, b.limits.units]
        return slots, np.concatenate([*numbers, friction_numbers(b.problem)])

    def add_rows(self, at: int) -> None:
        """``at``: number of the first output of its instance."""
        b, part = self._b, self._b.parts("first")
        term, share = "jump of acceleration", percent("of the joint's limit off")
        b.equal(term, self.place, DIRECTIONS[: b.coordinates.base], at + part["base"], b.limits.unbalanced)
        b.equal(term, self.place, b.robot.joint_names, at + part["joints"], share)
        b.equal("contact law", self.place, ["force"], at + part["law"], Measure("N", FORCE_SCALE, "off"))
        self._rotors = at + part["rotors"]

    @property
    def rotors(self) -> Index:
        """Numbers of the outputs that are the rotors' part of the gears' load, once constraints are there."""
        return np.asarray(self._rotors)

    def determined(self) -> list[Determined]:
        """All of it, as of one element."""
        groups = (self.change, self.w, self.f)
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in groups]))]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write what it is for coordinates and rates (ny,) and legs (nl,) at contact."""
        b, law = self._b, type(self._b.problem.law)(**self.law)
        force, change, w, _ = jump(b.problem, b.coordinates, law, y, rates, legs)
        self.f.write(x, force)
        self.change.write(x, change)
        self.w.write(x, w)


def friction_numbers(problem: ImpactProblem) -> Array:
    """Parameters of the striking points' friction (2,); (0,) where there is none."""
    return np.array(() if problem.friction is None else problem.friction.parameters, dtype=float)


def jump(
    problem: ImpactProblem, c: StanceCoordinates, law: ContactLaw, y: Array, rates: Array, legs: Array
) -> tuple[float, Array, Array, Array]:
    """First force [N] of all strikers; by how much it changes yddot (ny,) and the sole wrenches (6 a sole);
    and the joints' accelerations (n,) then, of a robot that has coasted until then.
    """
    model = problem.robot.model
    q, v, a = c.complete_motion(y, rates, np.zeros(c.ny), legs)
    data: Any = model.createData()
    inertia = mass_matrix(model, data, q)
    soles = c.sole_jacobians(q)[0] if c.legs else np.zeros((0, model.nv))
    hands = [model.getFrameId(problem.robot.striker(name).model_frame) for name in problem.strikers]
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED
    found = [np.reshape(pin.getFrameJacobian(model, data, hand, axes), (6, model.nv))[:3] for hand in hands]
    rows = np.array([problem.normal @ jacobian for jacobian in found])
    pushes = rows
    if problem.friction is not None:
        pushes = np.array([problem.friction.way(problem.normal, each @ v) @ each for each in found])
    rates = rows @ v - float(problem.target.speed_before())
    forces = np.array([float(law.branch(0.0, float(rate), True)) for rate in rates])
    both = np.linalg.solve(inertia, np.column_stack([soles.T, -forces @ pushes]))
    spread, free = both[:, :-1], both[:, -1]
    w: Array = np.zeros(0)
    if len(soles):
        w = np.asarray(np.linalg.lstsq(soles @ spread, -soles @ free, rcond=None)[0])
    change = free + spread @ w
    base = change[: c.base].copy()
    if c.base:  # from the base's own frame to rates of its coordinates
        base[:3] = pin.rpy.rpyToMatrix(y[3:6]) @ base[:3]
        base[3:] = np.linalg.solve(pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL), base[3:])
    independent = np.concatenate([base, change[c.base :][c.independent]])
    return float(forces.sum()), independent, w, np.asarray((a + change)[c.base :])


class Collocated:
    """Its stages, and variables that all contacts have: who completes it makes them.

    Attributes
    ----------
    stages : collocation points of the phases.  end : the last one of each phase.  T : durations [s] of them.
    u, d : rates and travel of the robot.  xt : travel of the target.  joined, joined_x : those of the first
        two phases as one, of the first three, and so on to all but the last.  suffix : of places' names.
    legs : at the stages.  contact : what it starts from.  torques : over limit at the stages, as variables.
    """

    _b: Builder
    stages: Sequence[CollocationPoint]
    end: list[int]
    T: list[Group]
    u: Group
    d: Group
    xt: Group
    joined: Group
    joined_x: Group
    suffix: str
    legs: Group
    w: Group
    contact: Contact
    torques: list[Affine]

    def _before(self, phase: int) -> tuple[Affine, Affine, Affine]:
        """Time [s], travel and the target's travel in the phases before one, both divided by that time."""
        time = Affine.zeros(1)
        for T in self.T[:phase]:
            time = time + T[0]
        return time, self._so_far(self.d, self.joined, phase), self._so_far(self.xt, self.joined_x, phase)

    def _so_far(self, integral: Group, joined: Group, phase: int) -> Affine:
        """Integral over the phases before one, divided by their time."""
        if phase == 0:
            return Affine.zeros(integral.size)
        return integral[self.end[0]] if phase == 1 else joined[phase - 2]

    def _time(self, phase: int, place: float) -> Affine:
        """[s] since contact."""
        return self._before(phase)[0] + self.T[phase][0] * place

    def _integrals(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, each with its group of the first phases as one."""
        return [(self.d, self.joined), (self.xt, self.joined_x)]

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``: integrals in the first phases as one, phase by phase."""
        out = []
        for phase in range(1, len(self.end) - 1):
            times = self._before(phase)[0], self.T[phase][0]
            for integral, joined in self._integrals():
                parts = self._so_far(integral, joined, phase), integral[self.end[phase]], joined[phase - 1]
                out += [[*times, *(part[k : k + 1] for part in parts)] for k in range(integral.size)]
        return out

    def _slots(self, group: Group, i: int, start: Affine, *, anew: bool = False) -> tuple[Affine, Affine]:
        """Value and d/ds of a collocated group at stage i; ``start``: at contact; ``anew``: of each phase."""
        s = self.stages[i]
        slope = Affine.zeros(group.size)
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + group[m] * w
        # the slope of the polynomial through the element's begin and its stages, by Radau's A^-1: the values
        # at the stages with `weights`, that at the begin with `start`
        begins = s.previous < 0 or (anew and s.new_phase)
        before = start if begins else group[s.previous]
        return group[i], slope + before * s.start

    def _place(self, s: CollocationPoint) -> Place:
        time = self._before(s.phase)[0] + self.T[s.phase][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

    def _travel(self, i: int) -> list[Affine]:
        """Slots of y = y0 + T1 d1 + T d at a stage."""
        s = self.stages[i]
        T1, d1, _ = self._before(s.phase)
        return [d1, T1, self.d[i], self.T[s.phase][0]]

    def _torque_rows(self, place: Place, outputs: Index, most: float) -> None:
        """Servo torques over limit (n) at a stage are bounded; as variables, if a term is about drives."""
        b, term = self._b, f"{self._b.limits.torque.name} in collision"
        common: dict[str, Any] = {"term": term, "place": place, "lower": -most, "upper": most}
        common["measure"] = percent("over its limit", of=most)
        if b.problem.of_drives:
            name = f"torque in collision, {place.name}"
            self.torques.append(b.lift(name, outputs, labels=b.robot.joint_names, **common)[0])
        else:
            b.rows.add(components=b.robot.joint_names, outputs=outputs, **common)

    def drives(self) -> list[DrivePoint]:
        """Drives at each stage; known once constraints are added, if a term is about drives."""
        pairs = zip(self.stages, self.torques, strict=True)
        return [DrivePoint(self._place(s), torque, self._motion(i)) for i, (s, torque) in enumerate(pairs)]

    def wrenches(self) -> list[tuple[Place, Affine]]:
        """Wrenches on soles and supporting hands at each stage."""
        return [(self._place(s), self.w[i]) for i, s in enumerate(self.stages)]

    def _motion(self, i: int) -> list[Affine]:
        """Slots of a `impactopt.problem.block.joint_motion` at a stage."""
        rates = self._slots(self.u, i, self.contact.u0[0])
        return [self.contact.state.y, *self._travel(i), *rates, Affine.constant(1.0), self.legs[i]]

    def contact_end(self) -> ContactEnd:
        state, u0, last = self.contact.state, self.contact.u0[0], self.end[-1]
        before = still(state.y, u0, u0 * 0.0, Affine.constant(1.0), state.legs)
        place = Place.plain(f"after contact{self.suffix}")
        return ContactEnd(place, before, self._motion(last), self.u[last] - u0)

    def _joints(self, x: Array, law: ContactLaw) -> dict[str, Array]:
        """Velocity and acceleration of the joints (m + 1, n), the first at once after contact, for solver
        variables (n,).
        """
        b, c, state = self._b, self._b.coordinates, self.contact.state
        y, rates, legs = (e.evaluate(x) for e in (state.y, self.contact.u0[0], state.legs))
        velocity = [c.complete_motion(y, rates, 0 * rates, legs)[1][c.base :]]
        acceleration = [jump(b.problem, c, law, y, rates, legs)[3]]
        for i in range(len(self.stages)):
            y0, d1, T1, d, T, u, slope, _, legs_there = (e.evaluate(x) for e in self._motion(i))
            _, v, a = c.complete_motion(y0 + T1 * d1 + T * d, u, slope / T, legs_there)
            velocity.append(v[c.base :])
            acceleration.append(a[c.base :])
        return {"velocity": np.array(velocity), "acceleration": np.array(acceleration)}

    def _integral_rows(self, i: int, place: Place, integrals: Group, rate: Group) -> None:
        """A group of integrals over the phase so far, of a group of rates."""
        s, labels = self.stages[i], integrals.labels
        integral = integrals[i]
        for m, w in zip(s.members, s.quadrature, strict=True):
            integral = integral - rate[m] * w
        if not s.new_phase:
            integral = integral - integrals[s.previous]
        self._b.rows.add(
            term="collision kinematics",
            place=place,
            components=labels,
            affine=integral,
            lower=0,
            upper=0,
            measure=rates(labels),
        )


class Collision(ContactNumbers, Collocated):
    """Variables and constraints of the contact with one target.

    contact : what all start from.  stages : collocation points of its phases.
    number : of the program's collisions; 0 that with the expected target.
    mass : of the robot at its striker [kg].  forceless : mask of the stages at which its force is zero.
    guarded : whether its force may not pull within a phase, whatever the law.
    scenario : None: the expected target.  after : what the variables of the position after contact have
    (labels, bounds); None: there are none, a follow-through starts there.
    """

    def __init__(
        self,
        b: Builder,
        contact: Contact,
        stages: Sequence[CollocationPoint],
        *,
        number: int,
        mass: float,
        guarded: bool,
        scenario: Scenario | None = None,
        after: dict[str, Any] | None,
    ) -> None:
        self._b, self.contact, self.stages = b, contact, stages
        self.number, self.scenario, self.torques = number, scenario, []
        self._each = ["", "second "][: len(b.problem.strikers)]  # of the strikers, before names of outputs
        p, c, limits = b.problem, b.coordinates, b.limits
        self.phases = p.contact_phases
        self.end = [max(i for i, s in enumerate(stages) if s.phase == k) for k in range(len(self.phases))]
        # where bodies are apart, and where they part, there is no force
        self.forceless = np.array([self.phases[s.phase].apart for s in stages])
        self.forceless[[i for i, f in zip(self.end, self.phases, strict=True) if f.end == SEPARATION]] = True
        self._named = named = f"{scenario.name}: " if scenario is not None else ""
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        self.mass = mass
        self.renew()
        self.torque_fraction = scenario.torque if scenario else limits.torque.collision
        self.cone_margin = scenario.cone_margin if scenario else limits.cone.collision_margin
        n, self._switches = len(stages), switches(p.law)

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(named + name, n, size, **options)

        longest = p.contact_duration[1]
        self.T = [
            b.duration(f"{named}{phase.name} duration", (least, longest), 0.01)
            for phase, least in zip(self.phases, self.shortest, strict=True)
        ]
        self._add_reference(n)
        self.u = add("collision rate", b.ny, labels=c.labels)
        self.d = add("collision travel", b.ny, labels=c.labels)
        self.legs = add("collision legs", b.nl, **limits.of_legs)
        # where law or target might make it pull, it has to be kept from that
        none = self.forceless[:, None]
        least = 0.0 if p.target.guards or pulls_apart(p.law) or guarded else np.where(none, 0.0, -np.inf)
        # what is driven and rattles is held on to meanwhile, and the check of plans says what that leaves
        # out; of no use where forces are wanted
        self.holds = not p.target.turns and not any(isinstance(o, PeakForce) for o in p.objectives)
        if self.holds:
            driven = np.array([0 < s.phase < len(self.end) - 1 for s in self.stages])
            least = np.where(driven, -np.inf, 0.0)[:, None]
        most = np.where(none, 0.0, np.inf)
        self.f = add("contact force", len(p.strikers), scale=FORCE_SCALE, lower=least, upper=most)
        self.state = add("target state", p.target.n_states, scale=typical_state(p.target))
        self.xt = add("target travel", 1, labels=["target"])
        self.p = add("impulse so far", 1)
        self.w = add("collision sole wrench", b.nw, **limits.of_wrenches)
        joined = len(self.phases) - 2
        self.joined = b.layout.add(f"{named}travel in compression", joined, b.ny, labels=c.labels)
        self.joined_x = b.layout.add(f"{named}target travel in compression", joined, 1)
        wanted = int(after is not None)
        self.after = b.layout.add(f"{named}position after contact", wanted, b.ny, **(after or {}))

    def _add_reference(self, count: int) -> None:
        """Variables of the legs of the reference: angles and rates, at so many instants."""
        nl, add, labels = self._b.nl, self._b.layout.add, {"labels": self._b.coordinates.leg_labels}
        self.coast_legs = add(f"{self._named}coasting legs", count, nl, **labels)
        self.coast_rates = add(f"{self._named}coasting leg rates", count, nl, **labels)

    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self.p[self.end[-1]]

    @property
    def target_state(self) -> Affine:
        """State of the target at separation."""
        return self.state[self.end[-1]]

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of each block's instances, one a stage."""
        b, p = self._b, self._b.problem
        none, still = Affine.zeros(1), Affine.zeros(p.target.n_states)
        collision, force = [], []
        for i, s in enumerate(self.stages):
            state = self._slots(self.state, i, still)
            travelled = self._slots(self.xt, i, none, anew=True)
            given, x1 = self._slots(self.p, i, none)[1], self._before(s.phase)[2]
            collision.append(self._dynamics(i))
            force.append([*self._of_hand(i), self.f[i], *state, *travelled, x1, given])
        of_all = [*self._gains(), b.robot.torque_limit, b.limits.units, friction_numbers(p)]
        gains = np.concatenate(of_all)
        collision_p = [np.concatenate([p.normal, [s.place, s.phase > 0], gains]) for s in self.stages]
        out: dict[str, tuple[list[list[Affine]], list[Any]]] = {
            "collision": (collision, collision_p),
            "force": (force, self.force_numbers()),
            **self._reference(),
        }
        if self.joined.count:
            join = self._join()
            out["join"] = join, [np.zeros(0)] * len(join)
        return out

    def _dynamics(self, i: int) -> list[Affine]:
        """Slots of the block ``collision``."""
        y, u0, ff = self.contact.state.y, self.contact.u0[0], self._feedforward()
        coast = [self.coast_legs[i], self.coast_rates[i]]
        hit = [self.legs[i], self.f[i], self.w[i]]
        return [y, u0, *coast, ff, *self._travel(i), *self._slots(self.u, i, u0), *hit, self.contact.gains[0]]

    def _of_hand(self, i: int) -> list[Affine]:
        """The slots of the block ``force`` that say where the hand is, and how fast."""
        return [self.contact.state.y, *self._travel(i), self.u[i]]

    def _feedforward(self) -> Affine:
        """Torques over limit (n)."""
        return self.contact.feedforward[0]

    def integrated(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, and what they are of."""
        return [(self.d, self.u)]

    def states(self) -> tuple[Group, ...]:
        """Variables with a slope, and a value at contact, beside the rates of `integrated`."""
        return self.state, self.xt, self.p

    def held_over(self) -> list[Group]:
        """Variables that finer elements do not change."""
        return [*self.T, self.joined, self.joined_x, self.after]

    def _at_stage(self) -> tuple[Group, ...]:
        """Legs at each collocation point, in the order of their constraints."""
        return self.coast_legs, self.coast_rates, self.legs

    def loose(self) -> list[Group]:
        """Variables with a value at each collocation point, and no known value at contact."""
        return [self.coast_legs, self.coast_rates, self.legs, self.f, self.w]

    def _gains(self) -> tuple[Array, Array]:
        """Kp and Kd."""
        return self._b.robot.kp, self._b.robot.kd

    def _reference(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``coasting``."""
        if not self._b.coordinates.legs:
            return {}
        start = [self.contact.state.y, self.contact.u0[0]]
        slots = [
            [*start, self._before(s.phase)[0], self.T[s.phase][0], self.coast_legs[i], self.coast_rates[i]]
            for i, s in enumerate(self.stages)
        ]
        return {"coasting": (slots, [[s.place, float(s.phase > 0)] for s in self.stages])}

    def _restitution(self, i: int) -> bool:
        return self.stages[i].phase == len(self.end) - 1

    def determined(self) -> list[Determined]:
        """Variables that each stage's constraints determine, leg by leg, and those of each element.

        An element's travel comes first, by linear constraints; last, if there are three phases or more, the
        integrals of the first ones as one.
        """
        out: list[Determined] = []
        for i in range(len(self.stages)):
            legs = [leg for g in self._at_stage() for leg in by_leg(g.index(i))]
            out += [determined(Turn.STAGE_LEGS, leg, k) for k, leg in enumerate(legs)]
        integrals, states = zip(*self.integrated(), strict=True)
        groups = (*states, self.w, self.f, *self.states())
        step = 0
        for members in sorted({s.members for s in self.stages}):
            # where there is none, the force is given
            part = [g.index(i) for i in members for g in groups if g is not self.f or not self.forceless[i]]
            out += [determined(Turn.ELEMENT, one.index(i), step) for i in members for one in integrals]
            out.append(determined(Turn.ELEMENT, np.concatenate(part), step + 1))
            step += 2
        if self.joined.count:
            joined = [group for _, group in self._integrals()]
            whole = np.concatenate([group.index(k) for k in range(self.joined.count) for group in joined])
            out.append(determined(Turn.ELEMENT, whole, step))
        if self.scenario is not None:
            out.append(determined(Turn.AFTER, self.after.index(0)))
        return out

    # ------------------------------------------------------------------ constraints
    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        """``at``: of each block, the index of the first output of this collision and the outputs a stage."""
        for i, s in enumerate(self.stages):
            place = self._place(s)
            for integral, rate in self.integrated():
                self._integral_rows(i, place, integral, rate)
            first = {name: start + i * size for name, (start, size) in at.items()}
            self._dynamics_rows(i, place, first)
        (start, size), order = at["force"], percent("off")
        part, where = self._b.parts("force"), self.suffix.lstrip(", ")
        if self.joined.count:  # first, as they determine variables of their own
            names = [label for one, _ in self._integrals() for label in one.labels] * self.joined.count
            outputs = at["join"][0] + np.arange(len(names))
            self._b.equal("travel in compression", where, names, outputs, along(names, "off"))
        ends = {
            TURN: ("approach speed", "rate", Measure("m/s", 1.0, "left")),
            SEPARATION: ("force", "separation", Measure("N", FORCE_SCALE, "left")),
            TOUCH: ("penetration", "penetration", Measure("mm", 1e3 * DEPTH_SCALE, "left")),
        }
        for last, phase in zip(self.end, self.phases, strict=True):
            component, name, measure = ends.get(phase.end, ("target", "event", order))
            for one in self._each if phase.end in ends else self._each[:1]:
                outputs = start + last * size + part[one + name]
                self._b.equal(phase.end, where, [one + component], outputs, measure)
            if phase.end == TOUCH:  # they approach then
                self._rate_row(last, start + last * size, back=False)

    def _dynamics_rows(self, i: int, place: Place, first: dict[str, int]) -> None:
        b, c, joints = self._b, self._b.coordinates, self._b.robot.joint_names
        closure = [f"{leg.end} {d}" for leg in c.legs for d in DIRECTIONS]
        if "coasting" in first:
            names = [*closure, *[f"{n} rate" for n in closure]]
            measures = [*along(closure, "off"), *rates(closure)]
            outputs = first["coasting"] + np.arange(len(names))
            b.equal("legs of the coasting reference", place, names, outputs, measures)
        part = b.parts("collision")
        b.equal("closed legs", place, closure, first["collision"] + part["closure"], along(closure, "open"))
        base, joint = first["collision"] + part["base"], first["collision"] + part["joints"]
        b.equal("collision dynamics", place, DIRECTIONS[: c.base], base, b.limits.unbalanced)
        b.equal("collision dynamics", place, joints, joint, percent("of the joint's limit off"))
        self._torque_rows(place, first["collision"] + part["torque"], self.torque_fraction)
        if self.cone_margin is not None:
            minimum = b.limits.cone.minimum_force if self.scenario is None else 0.0
            add_cone_rows(b, self.w[i], place, self.cone_margin, minimum)
        self._target_rows(i, place, first["force"])

    def _target_rows(self, i: int, place: Place, first: int) -> None:
        b, target, phase = self._b, self._b.problem.target, self.phases[self.stages[i].phase]
        part, fast = b.parts("force"), Measure("m/s", 1.0, "off")
        if not self.forceless[i]:  # there the force is zero by its bounds
            force = Measure("N", FORCE_SCALE, "off")
            for one in self._each:
                b.equal("contact law", place, [f"{one}force"], first + part[f"{one}law"], force)
        states = [f"state {k}" for k in range(target.n_states)]
        of_size = percent("of its size off")
        b.equal("target's motion", place, states, first + part["target"], of_size)
        b.equal("target's motion", place, ["travel"], first + part["travel"], fast)
        b.equal("impulse", place, ["target"], first + part["impulse"], Measure("N s", 1.0, "off"))
        k, still = phase.mode, [0.0] * target.n_states
        ends, once = phase.end in target.guards, self._b.problem.planned_touches == 1
        if i in self.end and (ends or once):
            if ends and target.reserve(still, 0.0, k):
                b.rows.add(
                    term=phase.end,
                    place=place,
                    components=["reserve"],
                    outputs=first + part["reserve"],
                    lower=0,
                    measure=percent("short"),
                )
            return
        if self._switches and target.guards:
            self._rate_row(i, first, back=self._restitution(i))
        if target.invariant(still, 0.0, k):
            b.rows.add(
                term=target.guards[min(k, len(target.guards) - 1)],
                place=place,
                components=["target"],
                outputs=first + part["invariant"],
                lower=target.margin(k, self.stages[i].place if ends or once else 0.0),
                measure=percent("out of turn"),
            )

    def _rate_row(self, i: int, first: int, *, back: bool) -> None:
        """Striker and target approach at a stage, or go ``back``; first : its first output of ``force``."""
        self._b.rows.add(
            term="approach speed",
            place=self._place(self.stages[i]),
            components=["striker and target"],
            outputs=first + self._b.parts("force")["rate"],
            lower=-np.inf if back else 0.0,
            upper=0.0 if back else np.inf,
            measure=Measure("m/s", 1.0, "the other way"),
        )

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link``: this state after contact to a ``start`` (y, d y/ds, duration [s])."""
        last = len(self.end) - 1
        time, travel, _ = self._before(last)
        moved = travel, self.d[self.end[last]]
        return self.contact.link(start, (time, self.T[last][0]), moved, self.u[self.end[last]])

    @property
    def state_after(self) -> list[Affine]:
        """Coordinates, rates, legs and T (1 s) after contact, if its position is a variable."""
        end = self.end[-1]
        return [self.after[0], self.u[end], self.legs[end], Affine.constant(1.0)]

    def link_after(self) -> list[list[Affine]]:
        """Slots of the block ``link`` that make its position what the contact leaves behind."""
        y, rate, _, one = self.state_after
        return self.link((y, rate, one))

    # ------------------------------------------------------------------ numbers
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """The robot loses rates all alike, as a point mass in its place does."""
        c, p, layout = self._b.coordinates, self._b.problem, self._b.layout
        place = np.array([s.place for s in self.stages])
        phase = np.array([s.phase for s in self.stages])
        mass, speed = effective_mass(c, p.strikers, p.normal, y, legs, rates)
        found = blow(*self.alone(), mass, speed, phase, place, p.planned_touches)
        times = np.clip(found.durations, *np.transpose([layout.bounds(group) for group in self.T]))
        for group, value in zip(self.T, times, strict=True):
            group.write(x, value)
        before = np.concatenate([[0.0], np.cumsum(times)])
        per_time = (1 / found.durations[phase])[:, None]
        d = found.moved[:, None] * per_time * rates
        self.u.write(x, found.speed[:, None] * rates)
        self.d.write(x, d)
        self.state.write(x, found.state)
        self.xt.write(x, found.travel[:, None] * per_time)
        self.f.write(x, np.where(self.forceless, 0.0, found.force)[:, None])
        self.p.write(x, len(p.strikers) * found.impulse[:, None])
        for joined, each in ((self.joined, d[self.end]), (self.joined_x, self.xt.read(x)[self.end])):
            ways = [(times[:k, None] / before[k] * each[:k]).sum(axis=0) for k in range(2, len(times))]
            joined.write(x, np.reshape(ways, (joined.count, joined.size)))
        self.after.write(x, y + float(found.moved[self.end].sum()) * rates)
        self.guess_model(x, y, rates, legs)
        if c.legs:
            self.legs.write(x, legs)
            self.w.write(x, self.contact.state.w.evaluate(x))

    def guess_model(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Initial guess of a collision model's own variables: here the legs of the reference."""
        if not legs.size:
            return
        elapsed = np.ravel([self._time(s.phase, s.place).evaluate(x) for s in self.stages])
        for k, (there, motion) in enumerate(coasted(self._b.coordinates, elapsed, y, rates, legs)):
            x[self.coast_legs.index(k)], x[self.coast_rates.index(k)] = there, motion[0]

    def durations(self, x: Array) -> tuple[float, float]:
        """Compression and restitution [s]."""
        *before, last = (float(g.read(x)[0, 0]) for g in self.T)
        return sum(before), last

    def decode(self, x: Array, outputs: dict[str, Array], approaches: Array) -> PlannedCollision:
        """The collision that solver variables (n,) stand for; ``outputs`` are the blocks'."""
        b, target = self._b, self._b.problem.target
        durations = [float(g.read(x)[0, 0]) for g in self.T]
        time = [sum(durations[: s.phase]) + s.place * durations[s.phase] for s in self.stages]
        before = float(target.speed_before(self.target))
        first = [float(b.problem.law.branch(0.0, float(v) - before, True, self.law)) for v in approaches]
        forces, wrench = np.vstack([first, self.f.read(x)]), self.w.read(x)
        start = self.number * len(self.stages)  # of its instances in the blocks
        of_stages = slice(start, start + len(self.stages))
        torque = outputs["collision"][of_stages, b.parts("collision")["torque"]]
        speed = outputs["force"][of_stages, b.parts("force")["speed"][0]]
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=forces.sum(axis=1),
            forces=forces,
            target_speed=np.array([before, *speed]),
            torque=np.vstack([self._feedforward().evaluate(x), torque]) * b.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(b.coordinates, wrench),
            outcome=target.outcome(self.state.read(x)[-1], self.target),
            **self._joints(x, type(b.problem.law)(**self.law)),
        )
