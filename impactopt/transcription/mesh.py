"""Where a program has its nodes: breaks of the splines, collocation points of the contact phases."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.targets import Target
from impactopt.kinematics.splines import Radau
from impactopt.problem.problem import ImpactProblem

Array = NDArray[np.float64]
Elements = tuple[tuple[float, ...], ...]  # lengths of each phase's, as fractions of it


@dataclass(frozen=True)
class Stage:
    """One collocation point of the collision."""

    phase: int
    phase_name: str
    place: float  # s in the phase
    weights: Array  # (stages,) of this element's stages in u', d u/ds
    start: float  # weight of the element's start value in u'
    members: tuple[int, ...]  # indices of this element's stages
    previous: int  # index of the stage the element starts from, -1 at contact
    quadrature: Array  # (stages,) weights of the element's u in d
    new_phase: bool  # the element begins a phase, so d starts from zero

    @property
    def name(self) -> str:
        return f"{self.phase_name}, {100 * self.place:.3g} %"  # short elements: several within one per cent


def collision_mesh(
    elements: Sequence[tuple[float, ...]], radau: Radau, names: tuple[str, ...] = Target.phases
) -> list[Stage]:
    """Stages of the contact's phases; ``elements``: their lengths, as fractions of a phase."""
    inverse = np.linalg.inv(radau.a)
    stages: list[Stage] = []
    for phase, name in enumerate(names):
        s = 0.0
        for e, h in enumerate(elements[phase]):
            first = len(stages)
            members = tuple(range(first, first + len(radau.c)))
            for i, c in enumerate(radau.c):
                stages.append(
                    Stage(
                        phase,
                        name,
                        s + c * h,
                        inverse[i] / h,
                        -float(inverse[i].sum()) / h,
                        members,
                        first - 1,
                        radau.a[i] * h,
                        e == 0,
                    )
                )
            s += h
    return stages


def contact_elements(problem: ImpactProblem) -> Elements:
    """Those that a problem asks for, of each phase of its contact; halved if its target has events.

    Where an event may come at once, the phase before it is one element.
    """
    target, (first, last) = problem.target, problem.collision_elements
    if target.guards:
        first, last = halved((first, last))
    before = [first] * (len(target.phases) - 1)
    if target.at_once:
        before[0] = (1.0,)
    return (*before, last)


def halved(elements: Elements) -> Elements:
    """Each of them in two."""
    return tuple(tuple(h / 2 for h in lengths for _ in range(2)) for lengths in elements)


def contact_mesh(problem: ImpactProblem, elements: Elements | None = None) -> list[Stage]:
    """Stages of the contact of a problem; ``elements``: if not those that it asks for."""
    radau = Radau.of_stages(problem.collision_stages)
    return collision_mesh(elements or contact_elements(problem), radau, problem.target.phases)


def percentage(s: float, more: Collection[float]) -> str:
    """What a place on [0, 1] is called; one of ``more`` with more digits, as others are near it."""
    return f"{100 * s:.2f} %" if s in more else f"{100 * s:.0f} %"


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))
