"""The contact's phases in the program: Radau IIA collocation of the whole equation of motion.

Compression and restitution, each of which is smooth, or the phases of a target with events. One contact for
the expected target, one for each scenario. They share the state at contact, the
feed-forward and the servo; durations, motion, force and wrenches are each one's own.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.errors import InputError
from impactopt.problem.objectives import PeakForce
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.transcription.blocks import FORCE_SCALE, typical_state
from impactopt.transcription.guess import blow, effective_mass
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.mesh import Stage
from impactopt.transcription.plan import PlannedCollision, total_ground_wrench
from impactopt.transcription.rows import Index, Measure, Place, along, by_leg, percent, rates

if TYPE_CHECKING:
    from impactopt.transcription.at_contact import ContactProgram

# of the shortest compression that each of the two may last which an event makes of it, and the first of them
# where that may come at once: tiny, as nothing has happened until then, but accelerations are over it
SHARE, AT_ONCE = 0.1, 0.05
# of a phase without a shortest time: share of the natural one, and [s] at most
OF_NATURAL, LEAST = 0.15, 2e-3
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")


def shortest_phases(problem: ImpactProblem, natural: float) -> list[float]:
    """How long [s] each phase of the contact lasts at least; ``natural``: its last one, of a point mass."""
    target, shortest = problem.target, problem.contact_duration[0]
    if not shortest:  # no bound: far below what a blow takes, as rows are over these times
        shortest = min(OF_NATURAL * natural, LEAST)
    shares = [SHARE if target.events else 1.0] * (len(target.phases) - 1) + [1.0]
    if target.at_once:
        shares[0] = AT_ONCE
    return [share * shortest for share in shares]


class Collision:
    """Variables and rows of the contact with one target.

    scenario : None: the expected target.  after : what the variables of the position after contact have
    (labels, bounds); None: there are none, a follow-through starts there.
    """

    def __init__(
        self, t: ContactProgram, scenario: Scenario | None = None, *, after: dict[str, Any] | None
    ) -> None:
        self.t, self.scenario, self.stages = t, scenario, t.stages
        p, c = t.problem, t.coordinates
        phases = range(len(p.target.phases))
        self.end = [max(i for i, s in enumerate(self.stages) if s.phase == k) for k in phases]
        named = f"{scenario.name}: " if scenario is not None else ""
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        self.law, self.target = p.law.parameters, p.target.parameters
        if scenario is not None:
            self.law, self.target = scenario.numbers(p.law, p.target)
        self.torque_fraction = scenario.torque if scenario else t.torque.collision
        self.cone_margin = scenario.cone_margin if scenario else t.cone.collision_margin
        n = len(self.stages)

        def add(name: str, size: int, **options: Any) -> Group:
            return t.layout.add(named + name, n, size, **options)

        law, target = type(p.law)(**self.law), type(p.target)(**self.target)
        # how long the last phase [s] is of a point mass's blow: the unit of what is too short
        ends = np.arange(len(p.target.phases), dtype=np.intp), np.ones(len(p.target.phases))
        self.natural = float(blow(law, target, t.mass_at_contact, 1.0, *ends).durations[-1])
        self.shortest, longest = shortest_phases(p, self.natural), p.contact_duration[1]
        self.T = [
            t.duration(f"{named}{name} duration", (least, longest), 0.01)
            for name, least in zip(p.target.phases, self.shortest, strict=True)
        ]
        self.coast_legs = add("coasting legs", t.nl, labels=c.leg_labels)
        self.coast_rates = add("coasting leg rates", t.nl, labels=c.leg_labels)
        self.u = add("collision rate", t.ny, labels=c.labels)
        self.d = add("collision travel", t.ny, labels=c.labels)
        self.legs = add("collision legs", t.nl, **t.of_legs)
        # it ends with contact; where law or target might make it pull, it has to be kept from that
        last = (np.arange(n) == n - 1)[:, None]
        least = 0.0 if p.target.events or t.law_pulls or t.guarded else np.where(last, 0.0, -np.inf)
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
        self.w = add("collision sole wrench", t.nw, **t.of_wrenches)
        joined = int(bool(p.target.events))
        self.joined = t.layout.add(f"{named}travel in compression", joined, t.ny, labels=c.labels)
        self.joined_x = t.layout.add(f"{named}target travel in compression", joined, 1)
        wanted = int(after is not None)
        self.after = t.layout.add(f"{named}position after contact", wanted, t.ny, **(after or {}))

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
            return Affine.zeros(1), Affine.zeros(self.t.ny), Affine.zeros(1)
        if phase == 1:
            return self.T[0][0], self.d[self.end[0]], self.xt[self.end[0]]
        return self.T[0][0] + self.T[1][0], self.joined[0], self.joined_x[0]

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of each block's instances, one a stage."""
        t, p, r = self.t, self.t.problem, self.t.robot
        y, u0, ff = t.contact_state[0], t.u0[0], t.feedforward[0]
        none, still = Affine.zeros(1), Affine.zeros(p.target.n_states)
        phases = np.column_stack([np.eye(len(self.end)), self.shortest])
        within = phases if p.target.events else phases[:, :0]
        gains = np.concatenate([r.kp, r.kd, r.torque_limit, t.units])
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
        if t.coordinates.legs:
            out["coasting"] = coasting, coasting_p
        if p.target.events:
            out["join"] = self._join(), [np.zeros(0)] * (t.ny + 1)
        return out

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``: ways in the first two phases of three as one."""
        first, second = self.end[:2]
        times = self.T[0][0], self.T[1][0]
        ways = self.d[first], self.d[second], self.joined[0]
        slots = [[*times, *(way[k : k + 1] for way in ways)] for k in range(self.t.ny)]
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

    def determined(self) -> tuple[list[list[Index]], list[list[Index]]]:
        """Variables that the rows of each stage determine, leg by leg; and step by step those that rows of
        elements do.

        An element's travel comes first, by linear rows; last come the ways as one, if there are three phases.
        """
        stages, last = range(len(self.stages)), self.end[-1]
        legs = [
            [leg for g in (self.coast_legs, self.coast_rates, self.legs) for leg in by_leg(g.index(i))]
            for i in stages
        ]
        groups = (self.u, self.w, self.f, self.state, self.xt, self.p)
        steps = []
        for members in sorted({s.members for s in self.stages}):
            # the last force is given
            part = [g.index(i) for i in members for g in groups if g is not self.f or i != last]
            steps += [[self.d.index(i) for i in members], [np.concatenate(part)]]
        if self.joined.count:
            steps.append([np.concatenate([self.joined.index(0), self.joined_x.index(0)])])
        return legs, steps

    # ------------------------------------------------------------------ rows
    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        """``at``: of each block, the index of the first output of this collision and the outputs a stage."""
        for i, s in enumerate(self.stages):
            place = self._place(s)
            self._integral_rows(i, place)
            first = {name: start + i * size for name, (start, size) in at.items()}
            self._dynamics_rows(i, place, first)
        start, size = at["force"]
        part, where = self.t.parts("force"), self.suffix.lstrip(", ")
        target, order = self.t.problem.target, percent("off")
        if target.events:  # first, as they determine variables of their own
            names = [*self.t.coordinates.labels, "target"]
            outputs = at["join"][0] + np.arange(self.t.ny + 1)
            self.t.equal("travel in compression", where, names, outputs, along(names, "off"))
        ends = [(name, "target", k, "event", order) for k, name in enumerate(target.events)]
        if target.turns:
            still = Measure("m/s", 1.0, "left")
            ends.append(("end of compression", "approach speed", len(ends), "rate", still))
        ends.append(("separation", "force", len(ends), "separation", Measure("N", FORCE_SCALE, "left")))
        for term, component, k, name, measure in ends:
            self.t.equal(term, where, [component], start + self.end[k] * size + part[name], measure)

    def _place(self, s: Stage) -> Place:
        time = self._before(s.phase)[0] + self.T[s.phase][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

    def _integral_rows(self, i: int, place: Place) -> None:
        """d is the integral of u in the phase so far."""
        s, labels = self.stages[i], self.t.coordinates.labels
        way = self.d[i]
        for m, w in zip(s.members, s.quadrature, strict=True):
            way = way - self.u[m] * w
        if not s.new_phase:
            way = way - self.d[s.previous]
        self.t.rows.add(
            term="collision kinematics",
            place=place,
            components=labels,
            affine=way,
            lower=0,
            upper=0,
            measure=rates(labels),
        )

    def _dynamics_rows(self, i: int, place: Place, first: dict[str, int]) -> None:
        t, c, joints = self.t, self.t.coordinates, self.t.robot.joint_names
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        if c.legs:
            names = [*closure, *[f"{n} rate" for n in closure]]
            measures = [*along(closure, "off"), *rates(closure)]
            outputs = first["coasting"] + np.arange(len(names))
            t.equal("legs of the coasting reference", place, names, outputs, measures)
        part = t.parts("collision")
        t.equal("closed legs", place, closure, first["collision"] + part["closure"], along(closure, "open"))
        base, joint = first["collision"] + part["base"], first["collision"] + part["joints"]
        t.equal("collision dynamics", place, DIRECTIONS[: c.base], base, t.unbalanced)
        t.equal("collision dynamics", place, joints, joint, percent("of the joint's limit off"))
        t.rows.add(
            term=f"{t.torque.name} in collision",
            place=place,
            components=joints,
            outputs=first["collision"] + part["torque"],
            lower=-self.torque_fraction,
            upper=self.torque_fraction,
            measure=percent("over its limit", of=self.torque_fraction),
        )
        if self.cone_margin is not None:
            minimum = t.cone.minimum_force if self.scenario is None else 0.0
            t.cone_rows(self.w[i], place, self.cone_margin, minimum)
        self._target_rows(i, place, first["force"])

    def _target_rows(self, i: int, place: Place, first: int) -> None:
        t, target = self.t, self.t.problem.target
        part, fast = t.parts("force"), Measure("m/s", 1.0, "off")
        if i != self.end[-1]:  # there the force is zero by its bounds
            force = Measure("N", FORCE_SCALE, "off")
            t.equal("contact law", place, ["force"], first + part["law"], force)
        states = [f"state {k}" for k in range(target.n_states)]
        of_size = percent("of its size off")
        t.equal("target's motion", place, states, first + part["target"], of_size)
        t.equal("target's motion", place, ["travel"], first + part["travel"], fast)
        t.equal("impulse", place, ["target"], first + part["impulse"], Measure("N s", 1.0, "off"))
        if i in self.end:
            return
        if t.law_switches and target.events:
            back = self._restitution(i)
            t.rows.add(
                term="approach speed",
                place=place,
                components=["striker and target"],
                outputs=first + part["rate"],
                lower=-np.inf if back else 0.0,
                upper=0.0 if back else np.inf,
                measure=Measure("m/s", 1.0, "the other way"),
            )
        k, still = self.stages[i].phase, [0.0] * target.n_states
        if target.lasting(still, 0.0, k):
            t.rows.add(
                term=target.events[min(k, len(target.events) - 1)],
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
        return self.t.link_slots(start, (time, self.T[last][0]), ways, self.u[self.end[last]])

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
        t, c, p = self.t, self.t.coordinates, self.t.problem
        place = np.array([s.place for s in self.stages])
        phase = np.array([s.phase for s in self.stages])
        mass, speed = effective_mass(c, p.striker, p.normal, y, legs, rates)
        law, target = type(p.law)(**self.law), type(p.target)(**self.target)
        found = blow(law, target, mass, speed, phase, place)
        times = np.clip(found.durations, *np.transpose([t.layout.bounds(group) for group in self.T]))
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
        if p.target.events:
            share = times[:2, None] / before[2]
            self.joined.write(x, (share * d[self.end[:2]]).sum(axis=0))
            self.joined_x.write(x, (share * self.xt.read(x)[self.end[:2]]).sum(axis=0))
        self.after.write(x, y + float(found.way[self.end].sum()) * rates)
        if c.legs:
            self.legs.write(x, legs)
            self.w.write(x, t.contact_w.evaluate(x))
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
        t, target = self.t, self.t.problem.target
        durations = [float(g.read(x)[0, 0]) for g in self.T]
        time = [sum(durations[: s.phase]) + s.place * durations[s.phase] for s in self.stages]
        first = float(t.problem.law.branch(0.0, approach, True, self.law))
        wrench = self.w.read(x)
        start = t.collisions.index(self) * len(self.stages)  # of its instances in the blocks
        of_stages = slice(start, start + len(self.stages))
        torque = outputs["collision"][of_stages, t.parts("collision")["torque"]]
        speed = outputs["force"][of_stages, t.parts("force")["speed"][0]]
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=np.array([first, *self.f.read(x)[:, 0]]),
            target_speed=np.array([0.0, *speed]),
            torque=np.vstack([t.feedforward.read(x), torque]) * t.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(t.coordinates, wrench),
            outcome=target.outcome(self.state.read(x)[-1], self.target),
        )
