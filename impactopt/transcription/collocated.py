"""What is known of a contact at collocation points: values, slopes, and what they come to phase by phase."""

from __future__ import annotations

from collections.abc import Sequence

from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Group
from impactopt.transcription.mesh import Stage
from impactopt.transcription.rows import Place, rates


class Collocated:
    """Its stages, and variables that all contacts have: who completes it makes them.

    Attributes
    ----------
    stages : collocation points of the phases.  end : the last one of each phase.  T : durations [s] of them.
    u, d : rates and travel of the robot.  xt : travel of the target.  joined, joined_x : those of two phases
        of three as one.  suffix : of places' names.
    """

    _b: Builder
    stages: Sequence[Stage]
    end: list[int]
    T: list[Group]
    u: Group
    d: Group
    xt: Group
    joined: Group
    joined_x: Group
    suffix: str

    def _before(self, phase: int) -> tuple[Affine, Affine, Affine]:
        """Time [s], travel and the target's travel in the phases before one, both divided by that time."""
        time = Affine.zeros(1)
        for T in self.T[:phase]:
            time = time + T[0]
        return time, self._way(self.d, self.joined, phase), self._way(self.xt, self.joined_x, phase)

    def _way(self, way: Group, joined: Group, phase: int) -> Affine:
        """What a way has come to in the phases before one, over their time."""
        if phase == 0:
            return Affine.zeros(way.size)
        return way[self.end[0]] if phase == 1 else joined[0]

    def _time(self, phase: int, place: float) -> Affine:
        """[s] since contact."""
        return self._before(phase)[0] + self.T[phase][0] * place

    def _ways(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, each with its group of the first two phases of three as one."""
        return [(self.d, self.joined), (self.xt, self.joined_x)]

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``: ways in the first two phases of three as one."""
        first, second = self.end[:2]
        times = self.T[0][0], self.T[1][0]
        parts = [(way[first], way[second], joined[0]) for way, joined in self._ways()]
        return [[*times, *(way[k : k + 1] for way in ways)] for ways in parts for k in range(ways[0].size)]

    def _slots(self, group: Group, i: int, start: Affine, *, anew: bool = False) -> tuple[Affine, Affine]:
        """Value and d/ds of a collocated group at stage i; ``start``: at contact; ``anew``: of each phase."""
        s = self.stages[i]
        slope = Affine.zeros(group.size)
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + group[m] * w
        begins = s.previous < 0 or (anew and s.new_phase)
        before = start if begins else group[s.previous]
        return group[i], slope + before * s.start

    def _place(self, s: Stage) -> Place:
        time = self._before(s.phase)[0] + self.T[s.phase][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

    def _integral_rows(self, i: int, place: Place, ways: Group, rate: Group) -> None:
        """A way is the integral of its rate in the phase so far."""
        s, labels = self.stages[i], ways.labels
        way = ways[i]
        for m, w in zip(s.members, s.quadrature, strict=True):
            way = way - rate[m] * w
        if not s.new_phase:
            way = way - ways[s.previous]
        self._b.rows.add(
            term="collision kinematics",
            place=place,
            components=labels,
            affine=way,
            lower=0,
            upper=0,
            measure=rates(labels),
        )
