"""Numbers of a contact's law and target, and what follows from them in a program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from impactopt.problem.scenario import Scenario
from impactopt.transcription.builder import Builder
from impactopt.transcription.guess import natural_durations
from impactopt.transcription.layout import Array, Group
from impactopt.transcription.mesh import CollocationPoint
from impactopt.transcription.phases import alike, shortest_phases


class ContactNumbers:
    """Part of a `impactopt.transcription.collision.Collision`, which has its attributes too.

    law, target : numbers by name.  shortest : least durations [s] of the phases.
    mass : of the robot at its striker [kg].  natural : how long the last phase [s] is of a point mass's blow.
    """

    _b: Builder
    scenario: Scenario | None
    stages: Sequence[CollocationPoint]
    end: list[int]
    T: list[Group]
    mass: float
    law: dict[str, float]
    target: dict[str, float]
    _known: Array

    def renew(self, mass: float | None = None, *, anew: bool = True) -> None:
        """Take the numbers of the builder's problem.

        mass : of the robot at its striker [kg], if it is another.  anew : the least durations too; else those
        are kept where numbers are alike, as they are far below what a blow takes.
        """
        p = self._b.problem
        self.mass = self.mass if mass is None else mass
        self.law, self.target = p.law.parameters, p.target.parameters
        if self.scenario is not None:
            self.law, self.target = self.scenario.numbers(p.law, p.target)
        numbers = np.array([*self.law.values(), *self.target.values(), self.mass])
        if not anew and alike(numbers, self._known):
            return
        self._known = numbers
        # how long the last phase [s] is of a point mass's blow: the unit of what is too short
        self.natural = float(natural_durations(*self.alone(), self.mass)[-1])
        self.shortest = shortest_phases(p, self.natural)

    def alone(self) -> tuple[Any, Any]:
        """Law and target as one of all strikers has them, which has its share of a mass."""
        p, numbers = self._b.problem, dict(self.target)
        numbers |= {"mass": numbers["mass"] / len(p.strikers)} if "mass" in numbers else {}
        return type(p.law)(**self.law), type(p.target)(**numbers)

    def follow(self) -> None:
        """Bounds of durations follow the problem."""
        longest = self._b.problem.contact_duration[1]
        for T, least in zip(self.T, self.shortest, strict=True):
            self._b.layout.bound(T, least, longest)

    def force_numbers(self) -> list[list[float]]:
        """Parameters of the block ``force``, of each stage."""
        p = self._b.problem
        phases = np.column_stack([np.eye(len(self.end)), self.shortest])
        within = phases if p.target.guards else phases[:, :0]
        numbers = [*self.law.values(), *self.target.values()]
        numbers += [] if p.second is None else [*p.second.point]
        return [
            [*p.point, *p.normal, float(s.phase == len(self.end) - 1), *within[s.phase], *numbers]
            for s in self.stages
        ]
