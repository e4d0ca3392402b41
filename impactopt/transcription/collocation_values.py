"""Values and slopes of the contact at collocation points, and their integrals phase by phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from impactopt.contact.laws import ContactLaw
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Index, Place, percent, rates
from impactopt.transcription.contact_state import Contact, ContactEnd, DrivePoint, still
from impactopt.transcription.impact_onset import jump
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.mesh import CollocationPoint


class Collocated:
    """Its stages, and variables that all contacts have: who completes it makes them.

    Attributes
    ----------
    stages : collocation points of the phases.  end : the last one of each phase.  T : durations [s] of them.
    u, d : rates and travel of the robot.  xt : travel of the target.  joined, joined_x : those of two phases
        of three as one.  suffix : of places' names.
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
        return integral[self.end[0]] if phase == 1 else joined[0]

    def _time(self, phase: int, place: float) -> Affine:
        """[s] since contact."""
        return self._before(phase)[0] + self.T[phase][0] * place

    def _integrals(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, each with its group of the first two phases of three as one."""
        return [(self.d, self.joined), (self.xt, self.joined_x)]

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``: integrals in the first two phases of three as one."""
        first, second = self.end[:2]
        times = self.T[0][0], self.T[1][0]
        parts = [(integral[first], integral[second], joined[0]) for integral, joined in self._integrals()]
        return [
            [*times, *(integral[k : k + 1] for integral in integrals)]
            for integrals in parts
            for k in range(integrals[0].size)
        ]

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
        """Slots of a `impactopt.problem.joint_motion.joint_motion` at a stage."""
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
