"""Displacement of the expected target from its place at contact, as variables.

Clearance constraints depend on them: the harder the blow, the farther the target is from the follow-through.
Each is base + T v, with another displacement as its base, and a mean velocity v over a time T. The first ones
are at the ends of the contact's phases. After contact a free target keeps its last velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impactopt.arrays import Array
from impactopt.problem.violation import Place, millimetres
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.frozen_collision import InstantImpact
from impactopt.transcription.layout import Affine, Group

TERM = "displacement of the target"
# [m] Unit of the variables. An error of an early step, of a metre, must not outweigh all other constraints.
_UNIT = 10.0


@dataclass(frozen=True)
class _Sum:
    """Variables that equal base + T v.  step : of their elimination, as of `Builder.lifted`."""

    group: Group
    place: Place
    base: Affine
    T: Affine
    v: Affine
    step: int

    def slots(self) -> list[list[Affine]]:
        """Slots of the block ``link``, whose equation of position is base + T v for yf = 0."""
        zero, one, each = Affine.zeros(1), Affine.constant(1.0), range(self.group.size)
        parts = [(self.base[k : k + 1], self.v[k : k + 1]) for k in each]
        return [
            [zero, zero, one, -y, zero, one, self.T, zero, -v * (1 / _UNIT), zero, zero, zero]
            for y, v in parts
        ]


class TargetDisplacement:
    """Displacements (3,) [m] of the target in the world; zero if no body that is kept clear moves with it.

    The variables are along the normal and, if friction moves the target, across it.
    """

    def __init__(self, b: Builder, hit: Collision | InstantImpact) -> None:
        p = b.problem
        self._b, self._hit, self._sums = b, hit, list[_Sum]()
        moving = [body for body in p.bodies.world if body.moves] if p.keep_out.enabled else []
        self._moves = bool(moving)
        # a board is not there any more once contact begins
        self._moves_on = not all(body.before for body in moving)
        across = isinstance(hit, Collision) and hit.tangential.size > 0
        self._labels = ["along the normal", *(f"across it, {axis}" for axis in "xyz" * across)]
        self._axes: Array = _UNIT * np.column_stack([p.normal, np.eye(3)[:, : 3 * across]])
        self._ends: list[Affine] = []  # components at the ends of the contact's phases

    def before(self, remaining: Affine) -> Affine:
        """Displacement at this time [s] before contact."""
        speed = float(self._b.problem.target.speed_before()) if self._moves else 0.0
        return remaining.apply(-speed / _UNIT * self._axes[:, :1])

    def in_contact(self, stage: int, place: Place) -> Affine:
        """Displacement at a collocation point."""
        if not self._moves_on or not isinstance(self._hit, Collision):
            return Affine.zeros(3)
        base = self._end(self._hit.stages[stage].phase)
        return self._add(place, base, *self._hit.target_moved(stage)).apply(self._axes)

    def after(self, since: Affine | None, place: Place) -> Affine:
        """Displacement at this time [s] after contact; None: at its end."""
        if not self._moves_on:
            return Affine.zeros(3)
        base = self._end(len(self._hit.phases))
        if since is not None and not self._b.problem.target.stays:
            base = self._add(place, base, since, self._hit.target_velocity)
        return base.apply(self._axes)

    def add_constraints(self) -> None:
        """Add the constraints of all variables so far."""
        b = self._b
        instances = [slots for each in self._sums for slots in each.slots()]
        if not instances:
            return
        outputs = b.add_block("link", instances, np.zeros(0)) + 3 * np.arange(len(instances))
        outputs = outputs.reshape(len(self._sums), -1) + b.parts("link")["position"]
        for each, at in zip(self._sums, outputs, strict=True):
            far = millimetres("off", scale=_UNIT)
            b.equal(TERM, each.place, each.group.labels, at, far, affine=-each.group[0])
            b.lifted.append((each.group, at, each.step))

    def _end(self, phases: int) -> Affine:
        """Components after so many phases of the contact."""
        if not phases:
            return Affine.zeros(len(self._labels))
        while len(self._ends) < phases:
            assert isinstance(self._hit, Collision)
            k = len(self._ends)
            place = Place.plain(f"end of {self._hit.phases[k].name}")
            # other displacements begin at these, which are eliminated after them
            step = len(self._hit.phases) - k
            self._ends.append(self._add(place, self._end(k), *self._hit.target_moved(self._hit.end[k]), step))
        return self._ends[phases - 1]

    def _add(self, place: Place, base: Affine, T: Affine, v: Affine, step: int = 0) -> Affine:
        """Components base + T v, as variables."""
        name = f"{TERM}, {place.name}"
        group = self._b.layout.add(name, 1, base.size, labels=self._labels)
        self._sums.append(_Sum(group, place, base, T, v, step))
        return group[0]
