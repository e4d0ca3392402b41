"""The two contact phases in the program: Radau IIA collocation of the whole equation of motion.

One for the expected target, one for each scenario. They share the state at contact, the feed-forward and the
servo; durations, motion, force and wrenches are each one's own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.nlp.blocks import DEPTH_SCALE, FORCE_SCALE
from impactopt.nlp.layout import Affine, Array, Group
from impactopt.nlp.mesh import Stage
from impactopt.nlp.rows import Measure, Place, along, millimetres, percent, rates
from impactopt.plan import PlannedCollision, total_ground_wrench
from impactopt.scenario import Scenario

if TYPE_CHECKING:
    from impactopt.nlp.at_contact import ContactProgram

DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")


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
        self.end = [max(i for i, s in enumerate(self.stages) if s.phase == k) for k in (0, 1)]
        named = f"{scenario.name}: " if scenario is not None else ""
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        factors = (scenario.mass, scenario.stiffness, scenario.damping) if scenario else (1.0, 1.0, 1.0)
        self.mass = p.target.mass * factors[0]
        scale = {"stiffness": factors[1], "damping": factors[2]}
        self.law = [value * scale.get(name, 1.0) for name, value in p.law.parameters.items()]
        self.torque_fraction = scenario.torque if scenario else t.torque.collision
        self.cone_margin = scenario.cone_margin if scenario else t.cone.collision_margin
        n = len(self.stages)

        def add(name: str, size: int, **options: Any) -> Group:
            return t.layout.add(named + name, n, size, **options)

        self.T = [
            t.duration(f"{named}{name} duration", p.contact_duration, 0.01)
            for name in ("compression", "restitution")
        ]
        self.coast_legs = add("coasting legs", t.nl, labels=c.leg_labels)
        self.coast_rates = add("coasting leg rates", t.nl, labels=c.leg_labels)
        self.u = add("collision rate", t.ny, labels=c.labels)
        self.d = add("collision travel", t.ny, labels=c.labels)
        self.legs = add("collision legs", t.nl, **t.of_legs)
        self.f = add("contact force", 1, scale=FORCE_SCALE)
        self.vt = add("target speed", 1)
        self.xt = add("target travel", 1)
        self.w = add("collision sole wrench", t.nw, **t.of_wrenches)
        wanted = int(after is not None)
        self.after = t.layout.add(f"{named}position after contact", wanted, t.ny, **(after or {}))

    @property
    def impulse(self) -> Affine:
        """To the target [N s]."""
        return self.vt[self.end[1]] * self.mass

    @property
    def target_state(self) -> Affine:
        """Of the target, at separation."""
        return self.vt[self.end[1]]

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of each block's instances, one a stage."""
        t, p, r = self.t, self.t.problem, self.t.robot
        y, u0, ff = t.contact_state[0], t.u0[0], t.feedforward[0]
        zero, none = Affine.zeros(t.ny), Affine.zeros(1)
        gains = np.concatenate([r.kp, r.kd, r.torque_limit, t.units])
        coasting, collision, force, coasting_p, collision_p, force_p = [], [], [], [], [], []
        for i, s in enumerate(self.stages):
            u, u1 = self._slots(self.u, i, u0)
            v, v1 = self._slots(self.vt, i, none)
            T, T1 = self.T[s.phase][0], self.T[0][0] if s.phase else none
            d1 = self.d[self.end[0]] if s.phase else zero
            x1 = self.xt[self.end[0]] if s.phase else none
            coast, travel = [self.coast_legs[i], self.coast_rates[i]], [d1, T1, self.d[i], T]
            hit = [self.legs[i], self.f[i], self.w[i]]
            phase = float(s.phase)
            coasting.append([y, u0, T1, T, *coast])
            coasting_p.append([s.place, phase])
            collision.append([y, u0, *coast, ff, *travel, u, u1, *hit])
            collision_p.append(np.concatenate([p.normal, [s.place, phase], gains]))
            force.append([y, *travel, u, self.f[i], v, v1, self.xt[i], x1])
            force_p.append([*p.point, *p.normal, phase, 1 / self.mass, *self.law])
        out: dict[str, tuple[list[list[Affine]], list[Any]]] = {
            "collision": (collision, collision_p),
            "force": (force, force_p),
        }
        if t.coordinates.legs:
            out["coasting"] = coasting, coasting_p
        return out

    def _slots(self, group: Group, i: int, start: Affine) -> tuple[Affine, Affine]:
        """Value and d/ds of a collocated group (u or target speed) at stage i; ``start``: at contact."""
        s = self.stages[i]
        slope = Affine.zeros(group.size)
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + group[m] * w
        before = group[s.previous] if s.previous >= 0 else start
        return group[i], slope + before * s.start

    # ------------------------------------------------------------------ rows
    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        """``at``: of each block, the index of the first output of this collision and the outputs a stage."""
        for i, s in enumerate(self.stages):
            place = self._place(s)
            self._integral_rows(i, place)
            first = {name: start + i * size for name, (start, size) in at.items()}
            self._dynamics_rows(i, place, first)
        start, size = at["force"]
        for term, component, k, part, measure in (
            ("end of compression", "approach speed", self.end[0], 2, Measure("m/s", 1.0, "left")),
            ("separation", "penetration", self.end[1], 3, millimetres("left", scale=DEPTH_SCALE)),
        ):
            output = np.array([start + k * size + part])
            self.t.equal(term, self.suffix.lstrip(", "), [component], output, measure)

    def _place(self, s: Stage) -> Place:
        time = self.T[1][0] * s.place + self.T[0][0] if s.phase else self.T[0][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

    def _integral_rows(self, i: int, place: Place) -> None:
        """d and the target's travel are the integrals of u and of the target's speed in the phase so far."""
        s = self.stages[i]
        names = self.t.coordinates.labels
        for term, integral, rate, labels, measures in (
            ("collision kinematics", self.d, self.u, names, rates(names)),
            ("target kinematics", self.xt, self.vt, ("target",), [Measure("m/s", 1.0, "off")]),
        ):
            expression = integral[i]
            for m, w in zip(s.members, s.quadrature, strict=True):
                expression = expression - rate[m] * w
            if not s.new_phase:
                expression = expression - integral[s.previous]
            self.t.rows.add(
                term=term,
                place=place,
                components=labels,
                affine=expression,
                lower=0,
                upper=0,
                measure=measures,
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
        minimum = t.cone.minimum_force if self.scenario is None else 0.0
        t.cone_rows(self.w[i], place, self.cone_margin, minimum)
        law, motion = (np.array([first["force"] + k]) for k in (0, 1))
        t.equal("contact law", place, ["force"], law, Measure("N", FORCE_SCALE, "off"))
        t.equal("target's motion", place, ["speed"], motion, Measure("m/s", 1.0, "off"))

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link``: this state after contact to a ``start`` (y, d y/ds, duration [s])."""
        first, second = self.end
        times = self.T[0][0], self.T[1][0]
        return self.t.link_slots(start, times, (self.d[first], self.d[second]), self.u[second])

    @property
    def state_after(self) -> list[Affine]:
        """Coordinates, rates, legs and T (1 s) after contact, if its position is a variable."""
        end = self.end[1]
        return [self.after[0], self.u[end], self.legs[end], Affine.constant(1.0)]

    def link_after(self) -> list[list[Affine]]:
        """Slots of the block ``link`` that make its position what the contact leaves behind."""
        y, rate, _, one = self.state_after
        return self.link((y, rate, one))

    # ------------------------------------------------------------------ numbers
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """A uniform push: the target gains 0.8 m/s while the robot loses 0.4 of its rates."""
        t, c = self.t, self.t.coordinates
        times = np.clip([0.015, 0.02], *t.problem.contact_duration)
        total = float(times.sum())
        for group, value in zip(self.T, times, strict=True):
            group.write(x, value)
        place = np.array([s.place for s in self.stages])
        phase = np.array([s.phase for s in self.stages])
        elapsed = np.where(phase == 0, place * times[0], times[0] + place * times[1])
        fraction = elapsed / total
        speed = 0.8
        self.vt.write(x, (speed * fraction)[:, None])
        self.u.write(x, (1 - 0.4 * fraction)[:, None] * rates)
        # integrals over each phase of a linear ramp, in the phase's own s
        start = np.where(phase == 0, 0.0, times[0] / total)
        mean = (start + fraction) / 2 * place
        self.xt.write(x, (speed * mean)[:, None])
        self.d.write(x, (place - 0.4 * mean)[:, None] * rates)
        self.f.write(x, self.mass * speed / total)
        self.after.write(x, y + 0.8 * total * rates)
        if c.legs:
            self.legs.write(x, legs)
            self.w.write(x, t.contact_w.evaluate(x))
            for k, at in enumerate(elapsed):
                legs = c.solve_legs(y + rates * at, legs)
                v = c.complete_motion(y + rates * at, rates, np.zeros(c.ny), legs)[1]
                x[self.coast_legs.index(k)], x[self.coast_rates.index(k)] = legs, v[c.base + c.dependent]

    def durations(self, x: Array) -> tuple[float, float]:
        """Compression and restitution [s]."""
        first, second = (float(g.read(x)[0, 0]) for g in self.T)
        return first, second

    def decode(self, x: Array, outputs: dict[str, Array], approach: float) -> PlannedCollision:
        """The collision that solver variables (n,) stand for; ``outputs`` are the blocks'."""
        t, durations = self.t, self.durations(x)
        time = [(durations[0] if s.phase else 0.0) + s.place * durations[s.phase] for s in self.stages]
        law = dict(zip(t.problem.law.parameters, self.law, strict=True))
        first = float(t.problem.law.branch(0.0, approach, True, law))
        wrench = self.w.read(x)
        start = t.collisions.index(self) * len(self.stages)  # of its instances in the blocks
        torque = outputs["collision"][start : start + len(self.stages), t.parts("collision")["torque"]]
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=np.array([first, *self.f.read(x)[:, 0]]),
            target_speed=np.array([0.0, *self.vt.read(x)[:, 0]]),
            torque=np.vstack([t.feedforward.read(x), torque]) * t.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(t.coordinates, wrench),
        )
