"""The contact's phases in the program: Radau IIA collocation of the whole equation of motion.

Compression and restitution, each of which is smooth, or the phases of a target with events. One contact for
the expected target, one for each scenario. They share the state at contact, the
feed-forward and the servo; durations, motion, force and wrenches are each one's own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.problem.objectives import PeakForce
from impactopt.problem.scenario import Scenario
from impactopt.solvers.program import Determined
from impactopt.transcription.blocks import FORCE_SCALE, typical_state
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact import Contact
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.guess import blow, effective_mass
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.limits import DIRECTIONS
from impactopt.transcription.mesh import Stage
from impactopt.transcription.nodes import add_cone_rows
from impactopt.transcription.phases import pulls_apart, shortest_phases, switches
from impactopt.transcription.plan import PlannedCollision, total_ground_wrench
from impactopt.transcription.rows import Measure, Place, along, by_leg, percent, rates


class Collision:
    """Variables and rows of the contact with one target.

    contact : what all start from.  stages : collocation points of its phases.
    number : of the program's collisions; 0 that with the expected target.
    mass : of the robot at its striker [kg].
    guarded : whether its force may not pull within a phase, whatever the law.
    scenario : None: the expected target.  after : what the variables of the position after contact have
    (labels, bounds); None: there are none, a follow-through starts there.
    """

    def __init__(
        self,
        b: Builder,
        contact: Contact,
        stages: Sequence[Stage],
        *,
        number: int,
        mass: float,
        guarded: bool,
        scenario: Scenario | None = None,
        after: dict[str, Any] | None,
    ) -> None:
        self._b, self.contact, self.stages = b, contact, stages
        self.number, self.scenario = number, scenario
        p, c, limits = b.problem, b.coordinates, b.limits
        phases = range(len(p.target.phases))
        self.end = [max(i for i, s in enumerate(self.stages) if s.phase == k) for k in phases]
        named = f"{scenario.name}: " if scenario is not None else ""
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        self.law, self.target = p.law.parameters, p.target.parameters
        if scenario is not None:
            self.law, self.target = scenario.numbers(p.law, p.target)
        self.torque_fraction = scenario.torque if scenario else limits.torque.collision
        self.cone_margin = scenario.cone_margin if scenario else limits.cone.collision_margin
        n = len(self.stages)

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(named + name, n, size, **options)

        law, target = type(p.law)(**self.law), type(p.target)(**self.target)
        # how long the last phase [s] is of a point mass's blow: the unit of what is too short
        ends = np.arange(len(p.target.phases), dtype=np.intp), np.ones(len(p.target.phases))
        self.natural = float(blow(law, target, mass, 1.0, *ends).durations[-1])
        self.shortest, longest = shortest_phases(p, self.natural), p.contact_duration[1]
        self.T = [
            b.duration(f"{named}{name} duration", (least, longest), 0.01)
            for name, least in zip(p.target.phases, self.shortest, strict=True)
        ]
        self.coast_legs = add("coasting legs", b.nl, labels=c.leg_labels)
        self.coast_rates = add("coasting leg rates", b.nl, labels=c.leg_labels)
        self.u = add("collision rate", b.ny, labels=c.labels)
        self.d = add("collision travel", b.ny, labels=c.labels)
        self.legs = add("collision legs", b.nl, **limits.of_legs)
        # it ends with contact; where law or target might make it pull, it has to be kept from that
        last = (np.arange(n) == n - 1)[:, None]
        least = 0.0 if p.target.guards or pulls_apart(p.law) or guarded else np.where(last, 0.0, -np.inf)
        # what is driven and rattles is held on to meanwhile: see `rattle`; of no use where forces are wanted
        self.holds = not p.target.turns and not any(isinstance(o, PeakForce) for o in p.objectives)
        if self.holds:
            driven = np.array([0 < s.phase < len(self.end) - 1 for s in self.stages])
            least = np.where(driven, -np.inf, 0.0)[:, None]
        most = np.where(last, 0.0, np.inf)
        self.f = add("contact force", 1, scale=FORCE_SCALE, lower=least, upper=most)
        self.state = add("target state", p.target.n_states, scale=typical_state(p.target))
        self.xt = add("target travel", 1)
        self.p = add("impulse so far", 1)
        self.w = add("collision sole wrench", b.nw, **limits.of_wrenches)
        joined = int(bool(p.target.guards))
        self.joined = b.layout.add(f"{named}travel in compression", joined, b.ny, labels=c.labels)
        self.joined_x = b.layout.add(f"{named}target travel in compression", joined, 1)
        wanted = int(after is not None)
        self.after = b.layout.add(f"{named}position after contact", wanted, b.ny, **(after or {}))

    @property
    def impulse(self) -> Affine:
        """To the target [N s]."""
        return self.p[self.end[-1]]

    @property
    def target_state(self) -> Affine:
        """Of the target, at separation."""
        return self.state[self.end[-1]]

    def _before(self, phase: int) -> tuple[Affine, Affine, Affine]:
        """Time [s], travel and the target's travel in the phases before one, both divided by that time."""
        if phase == 0:
            return Affine.zeros(1), Affine.zeros(self._b.ny), Affine.zeros(1)
        if phase == 1:
            return self.T[0][0], self.d[self.end[0]], self.xt[self.end[0]]
        return self.T[0][0] + self.T[1][0], self.joined[0], self.joined_x[0]

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of each block's instances, one a stage."""
        b, p, r = self._b, self._b.problem, self._b.robot
        y, u0, ff = self.contact.state.y, self.contact.u0[0], self.contact.feedforward[0]
        none, still = Affine.zeros(1), Affine.zeros(p.target.n_states)
        phases = np.column_stack([np.eye(len(self.end)), self.shortest])
        within = phases if p.target.guards else phases[:, :0]
        gains = np.concatenate([r.kp, r.kd, r.torque_limit, b.limits.units])
        coasting, collision, force, coasting_p, collision_p, force_p = [], [], [], [], [], []
        for i, s in enumerate(self.stages):
            u, u1 = self._slots(self.u, i, u0)
            state = self._slots(self.state, i, still)
            travelled = self._slots(self.xt, i, none, anew=True)
            given = self._slots(self.p, i, none)[1]
            T, (T1, d1, x1) = self.T[s.phase][0], self._before(s.phase)
            coast, travel = [self.coast_legs[i], self.coast_rates[i]], [d1, T1, self.d[i], T]
            hit = [self.legs[i], self.f[i], self.w[i]]
            after = float(s.phase > 0)
            coasting.append([y, u0, T1, T, *coast])
            coasting_p.append([s.place, after])
            collision.append([y, u0, *coast, ff, *travel, u, u1, *hit])
            collision_p.append(np.concatenate([p.normal, [s.place, after], gains]))
            force.append([y, *travel, u, self.f[i], *state, *travelled, x1, given])
            branch = [float(self._restitution(i)), *within[s.phase]]
            numbers = [*self.law.values(), *self.target.values()]
            force_p.append([*p.point, *p.normal, *branch, *numbers])
        out: dict[str, tuple[list[list[Affine]], list[Any]]] = {
            "collision": (collision, collision_p),
            "force": (force, force_p),
        }
        if b.coordinates.legs:
            out["coasting"] = coasting, coasting_p
        if p.target.guards:
            out["join"] = self._join(), [np.zeros(0)] * (b.ny + 1)
        return out

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``: ways in the first two phases of three as one."""
        first, second = self.end[:2]
        times = self.T[0][0], self.T[1][0]
        ways = self.d[first], self.d[second], self.joined[0]
        slots = [[*times, *(way[k : k + 1] for way in ways)] for k in range(self._b.ny)]
        return [*slots, [*times, self.xt[first], self.xt[second], self.joined_x[0]]]

    def _restitution(self, i: int) -> bool:
        return self.stages[i].phase == len(self.end) - 1

    def _slots(self, group: Group, i: int, start: Affine, *, anew: bool = False) -> tuple[Affine, Affine]:
        """Value and d/ds of a collocated group at stage i; ``start``: at contact; ``anew``: of each phase."""
        s = self.stages[i]
        slope = Affine.zeros(group.size)
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + group[m] * w
        begins = s.previous < 0 or (anew and s.new_phase)
        before = start if begins else group[s.previous]
        return group[i], slope + before * s.start

    def determined(self) -> list[Determined]:
        """Of each stage, leg by leg; and element by element what its rows determine.

        An element's travel comes first, by linear rows; last come the ways as one, if there are three phases.
        """
        out: list[Determined] = []
        for i in range(len(self.stages)):
            legs = [leg for g in (self.coast_legs, self.coast_rates, self.legs) for leg in by_leg(g.index(i))]
            out += [determined(Turn.STAGE_LEGS, leg, k) for k, leg in enumerate(legs)]
        groups, last = (self.u, self.w, self.f, self.state, self.xt, self.p), self.end[-1]
        step = 0
        for members in sorted({s.members for s in self.stages}):
            # the last force is given
            part = [g.index(i) for i in members for g in groups if g is not self.f or i != last]
            out += [determined(Turn.ELEMENT, self.d.index(i), step) for i in members]
            out.append(determined(Turn.ELEMENT, np.concatenate(part), step + 1))
            step += 2
        if self.joined.count:
            ways = np.concatenate([self.joined.index(0), self.joined_x.index(0)])
            out.append(determined(Turn.ELEMENT, ways, step))
        if self.scenario is not None:
            out.append(determined(Turn.AFTER, self.after.index(0)))
        return out

    # ------------------------------------------------------------------ rows
    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        """``at``: of each block, the index of the first output of this collision and the outputs a stage."""
        for i, s in enumerate(self.stages):
            place = self._place(s)
            self._integral_rows(i, place)
            first = {name: start + i * size for name, (start, size) in at.items()}
            self._dynamics_rows(i, place, first)
        start, size = at["force"]
        part, where = self._b.parts("force"), self.suffix.lstrip(", ")
        target, order = self._b.problem.target, percent("off")
        if target.guards:  # first, as they determine variables of their own
            names = [*self._b.coordinates.labels, "target"]
            outputs = at["join"][0] + np.arange(self._b.ny + 1)
            self._b.equal("travel in compression", where, names, outputs, along(names, "off"))
        ends = [(name, "target", k, "event", order) for k, name in enumerate(target.guards)]
        if target.turns:
            still = Measure("m/s", 1.0, "left")
            ends.append(("end of compression", "approach speed", len(ends), "rate", still))
        ends.append(("separation", "force", len(ends), "separation", Measure("N", FORCE_SCALE, "left")))
        for term, component, k, name, measure in ends:
            self._b.equal(term, where, [component], start + self.end[k] * size + part[name], measure)

    def _place(self, s: Stage) -> Place:
        time = self._before(s.phase)[0] + self.T[s.phase][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

    def _integral_rows(self, i: int, place: Place) -> None:
        """d is the integral of u in the phase so far."""
        s, labels = self.stages[i], self._b.coordinates.labels
        way = self.d[i]
        for m, w in zip(s.members, s.quadrature, strict=True):
            way = way - self.u[m] * w
        if not s.new_phase:
            way = way - self.d[s.previous]
        self._b.rows.add(
            term="collision kinematics",
            place=place,
            components=labels,
            affine=way,
            lower=0,
            upper=0,
            measure=rates(labels),
        )

    def _dynamics_rows(self, i: int, place: Place, first: dict[str, int]) -> None:
        b, c, joints = self._b, self._b.coordinates, self._b.robot.joint_names
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        if c.legs:
            names = [*closure, *[f"{n} rate" for n in closure]]
            measures = [*along(closure, "off"), *rates(closure)]
            outputs = first["coasting"] + np.arange(len(names))
            b.equal("legs of the coasting reference", place, names, outputs, measures)
        part = b.parts("collision")
        b.equal("closed legs", place, closure, first["collision"] + part["closure"], along(closure, "open"))
        base, joint = first["collision"] + part["base"], first["collision"] + part["joints"]
        b.equal("collision dynamics", place, DIRECTIONS[: c.base], base, b.limits.unbalanced)
        b.equal("collision dynamics", place, joints, joint, percent("of the joint's limit off"))
        b.rows.add(
            term=f"{b.limits.torque.name} in collision",
            place=place,
            components=joints,
            outputs=first["collision"] + part["torque"],
            lower=-self.torque_fraction,
            upper=self.torque_fraction,
            measure=percent("over its limit", of=self.torque_fraction),
        )
        if self.cone_margin is not None:
            minimum = b.limits.cone.minimum_force if self.scenario is None else 0.0
            add_cone_rows(b, self.w[i], place, self.cone_margin, minimum)
        self._target_rows(i, place, first["force"])

    def _target_rows(self, i: int, place: Place, first: int) -> None:
        b, target = self._b, self._b.problem.target
        part, fast = b.parts("force"), Measure("m/s", 1.0, "off")
        if i != self.end[-1]:  # there the force is zero by its bounds
            force = Measure("N", FORCE_SCALE, "off")
            b.equal("contact law", place, ["force"], first + part["law"], force)
        states = [f"state {k}" for k in range(target.n_states)]
        of_size = percent("of its size off")
        b.equal("target's motion", place, states, first + part["target"], of_size)
        b.equal("target's motion", place, ["travel"], first + part["travel"], fast)
        b.equal("impulse", place, ["target"], first + part["impulse"], Measure("N s", 1.0, "off"))
        if i in self.end:
            return
        if switches(b.problem.law) and target.guards:
            back = self._restitution(i)
            b.rows.add(
                term="approach speed",
                place=place,
                components=["striker and target"],
                outputs=first + part["rate"],
                lower=-np.inf if back else 0.0,
                upper=0.0 if back else np.inf,
                measure=Measure("m/s", 1.0, "the other way"),
            )
        k, still = self.stages[i].phase, [0.0] * target.n_states
        if target.invariant(still, 0.0, k):
            b.rows.add(
                term=target.guards[min(k, len(target.guards) - 1)],
                place=place,
                components=["target"],
                outputs=first + part["lasting"],
                lower=0,
                measure=percent("out of turn"),
            )

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link``: this state after contact to a ``start`` (y, d y/ds, duration [s])."""
        last = len(self.end) - 1
        time, travel, _ = self._before(last)
        ways = travel, self.d[self.end[last]]
        return self.contact.link(start, (time, self.T[last][0]), ways, self.u[self.end[last]])

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
        mass, speed = effective_mass(c, p.striker, p.normal, y, legs, rates)
        law, target = type(p.law)(**self.law), type(p.target)(**self.target)
        found = blow(law, target, mass, speed, phase, place)
        times = np.clip(found.durations, *np.transpose([layout.bounds(group) for group in self.T]))
        for group, value in zip(self.T, times, strict=True):
            group.write(x, value)
        before = np.concatenate([[0.0], np.cumsum(times)])
        elapsed = before[phase] + place * times[phase]
        per_time = (1 / found.durations[phase])[:, None]
        d = found.way[:, None] * per_time * rates
        self.u.write(x, found.speed[:, None] * rates)
        self.d.write(x, d)
        self.state.write(x, found.state)
        self.xt.write(x, found.travel[:, None] * per_time)
        self.f.write(x, np.where(np.arange(len(place)) == self.end[-1], 0.0, found.force)[:, None])
        self.p.write(x, found.impulse[:, None])
        if p.target.guards:
            share = times[:2, None] / before[2]
            self.joined.write(x, (share * d[self.end[:2]]).sum(axis=0))
            self.joined_x.write(x, (share * self.xt.read(x)[self.end[:2]]).sum(axis=0))
        self.after.write(x, y + float(found.way[self.end].sum()) * rates)
        if c.legs:
            self.legs.write(x, legs)
            self.w.write(x, self.contact.state.w.evaluate(x))
            for k, at in enumerate(elapsed):
                with contextlib.suppress(InputError):  # out of the legs' reach: the solver has to mend it
                    legs = c.solve_legs(y + rates * at, legs)
                v = c.complete_motion(y + rates * at, rates, np.zeros(c.ny), legs)[1]
                x[self.coast_legs.index(k)], x[self.coast_rates.index(k)] = legs, v[c.base + c.dependent]

    def durations(self, x: Array) -> tuple[float, float]:
        """Compression and restitution [s]."""
        *compression, restitution = (float(g.read(x)[0, 0]) for g in self.T)
        return sum(compression), restitution

    def decode(self, x: Array, outputs: dict[str, Array], approach: float) -> PlannedCollision:
        """The collision that solver variables (n,) stand for; ``outputs`` are the blocks'."""
        b, target = self._b, self._b.problem.target
        durations = [float(g.read(x)[0, 0]) for g in self.T]
        time = [sum(durations[: s.phase]) + s.place * durations[s.phase] for s in self.stages]
        first = float(b.problem.law.branch(0.0, approach, True, self.law))
        wrench = self.w.read(x)
        start = self.number * len(self.stages)  # of its instances in the blocks
        of_stages = slice(start, start + len(self.stages))
        torque = outputs["collision"][of_stages, b.parts("collision")["torque"]]
        speed = outputs["force"][of_stages, b.parts("force")["speed"][0]]
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=np.array([first, *self.f.read(x)[:, 0]]),
            target_speed=np.array([0.0, *speed]),
            torque=np.vstack([self.contact.feedforward.read(x), torque]) * b.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(b.coordinates, wrench),
            outcome=target.outcome(self.state.read(x)[-1], self.target),
        )
