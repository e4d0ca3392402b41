"""What a planner solves next, after a program whose solution is not right yet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.solvers.program import SolverResult
from impactopt.transcription.mesh import Elements
from impactopt.transcription.mesh_refinement import MoreNodes
from impactopt.transcription.start import carried_over
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Round:
    """A program that is to be solved next, and from where: from one after the other, until it is."""

    program: Transcription
    starts: tuple[Array | SolverResult, ...]
    name: str
    why: str
    barrier: float | None = None


def start_of(finer: Transcription, t: Transcription, x0: Array) -> Array:
    """What a program started from, for one with more nodes or elements."""
    return carried_over(finer, t, x0, np.zeros(t.program.m), np.zeros(t.layout.n))[0]


def more_of(nodes: MoreNodes, elements: Elements | None, rows: int) -> str:
    """What is more in a program, in words."""
    words = [f"{nodes.total} more node{'s' if nodes.total > 1 else ''}"] if nodes.total else []
    words += [f"{sum(map(len, elements))} contact elements"] if elements is not None else []
    words += [f"{rows} more rows between bodies"] if rows else []
    return ", ".join(words)
