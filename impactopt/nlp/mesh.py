"""Where a program has its nodes: breaks of the splines, collocation points of the contact phases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.motion import Radau

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stage:
    """One collocation point of the collision."""

    phase: int  # 0 compression, 1 restitution
    place: float  # s in the phase
    weights: Array  # (stages,) of this element's stages in u', d u/ds
    start: float  # weight of the element's start value in u'
    members: tuple[int, ...]  # indices of this element's stages
    previous: int  # index of the stage the element starts from, -1 at contact
    quadrature: Array  # (stages,) weights of the element's u in d
    new_phase: bool  # the element begins a phase, so d starts from zero

    @property
    def name(self) -> str:
        return f"{('compression', 'restitution')[self.phase]}, {100 * self.place:.0f} %"


def collision_mesh(elements: tuple[tuple[float, ...], tuple[float, ...]], radau: Radau) -> list[Stage]:
    """Stages of both contact phases; ``elements`` are the elements' lengths as fractions of each phase."""
    inverse = np.linalg.inv(radau.a)
    stages: list[Stage] = []
    for phase, lengths in enumerate(elements):
        s = 0.0
        for e, h in enumerate(lengths):
            first = len(stages)
            members = tuple(range(first, first + len(radau.c)))
            for i, c in enumerate(radau.c):
                stages.append(
                    Stage(
                        phase,
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


def stage_count(elements: tuple[tuple[float, ...], tuple[float, ...]], stages: int) -> int:
    """Number of collocation points of a mesh with so many stages an element."""
    return stages * sum(len(lengths) for lengths in elements)


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))
