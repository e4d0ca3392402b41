"""What is known of a contact at collocation points: values, slopes, and what they come to phase by phase."""

from __future__ import annotations

from collections.abc import Sequence

from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Group
from impactopt.transcription.mesh import CollocationPoint
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
    stages: Sequence[CollocationPoint]
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
        return time, self._so_far(self.d, self.joined, phase), self._so_far(self.xt, self.joined_x, phase)

    def _so_far(self, integral: Group, joined: Group, phase: int) -> Affine:
        """What an integral has come to in the phases before one, over their time."""
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
        begins = s.previous < 0 or (anew and s.new_phase)
        before = start if begins else group[s.previous]
        return group[i], slope + before * s.start

    def _place(self, s: CollocationPoint) -> Place:
        time = self._before(s.phase)[0] + self.T[s.phase][0] * s.place
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", time)

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
