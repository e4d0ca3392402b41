"""Where a program has its nodes: breaks of the splines, collocation points of the contact phases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.motion import Radau
from impactopt.problem import ImpactProblem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stage:
    """One collocation point of the collision."""

    phase: int  # the last one is restitution
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
        return f"{self.phase_name}, {100 * self.place:.0f} %"


def contact_phases(breaks: bool) -> tuple[str, ...]:
    """Names of the pieces of a contact in each of which all is smooth; ``breaks``: the target does."""
    return ("compression", *(("compression after the break",) if breaks else ()), "restitution")


def collision_mesh(
    elements: tuple[tuple[float, ...], tuple[float, ...]], radau: Radau, *, breaks: bool = False
) -> list[Stage]:
    """Stages of the contact's phases; ``elements``: lengths of those of compression and of restitution, as
    fractions of a phase.
    """
    names = contact_phases(breaks)
    inverse = np.linalg.inv(radau.a)
    stages: list[Stage] = []
    for phase, name in enumerate(names):
        lengths = elements[int(name == "restitution")]
        s = 0.0
        for e, h in enumerate(lengths):
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


def contact_mesh(problem: ImpactProblem) -> list[Stage]:
    """Stages of the contact of a problem; elements are halved if its target sticks, slips or breaks."""
    target, elements = problem.target, problem.collision_elements
    if target.switching:
        first, second = (tuple(h / 2 for h in lengths for _ in range(2)) for lengths in elements)
        elements = first, second
    return collision_mesh(elements, Radau.of_stages(problem.collision_stages), breaks=target.breaks)


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))
