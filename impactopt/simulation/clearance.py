"""Least clearances between the bodies of a replay, by exact geometry that is independent of the engines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import MISSED, Places
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.collision_geometry import Touched
from impactopt.simulation.result import Simulation

__all__ = ["with_clearance"]

Array = NDArray[np.float64]
STEP = 1e-3  # [s] at which a replay is looked at
MOVED = 5e-4  # [rad, m] by which a coordinate has moved since the last look, as at 0.5 rad/s in such a step


def with_clearance(problem: ImpactProblem, simulation: Simulation) -> Simulation:
    """The simulation with its least clearance; and what touched what, where the engine has not said so
    itself.
    """
    time = simulation.time
    chosen = _instants(time, simulation.q, simulation.travel())
    phase = np.full(len(time), MISSED) if simulation.missed else simulation.phase()
    bodies = problem.bodies
    at = Places.of(problem.robot, simulation.q[chosen], simulation.travel()[chosen], phase[chosen])
    found = bodies.survey(time[chosen], at)
    touched = simulation.touched
    if simulation.fall is None or not problem.keeps_apart:  # this replay's robot has no solids
        touched = tuple(
            Touched(one=t.one, other=t.other, start=t.start, end=t.end, depth=t.depth) for t in found.touches
        )
    return replace(
        simulation,
        clearance=found.clearance,
        nearest=found.nearest,
        touched=touched,
    )


def _instants(time: Array, q: Array, travel: Array) -> NDArray[np.intp]:
    """Indices of the first and last instant, and of those at which bodies have moved since the one before."""
    _, every = np.unique(np.floor(time / STEP), return_index=True)
    places = np.column_stack([q, travel])
    chosen = [0]
    for k in map(int, every[1:]):
        if np.abs(places[k] - places[chosen[-1]]).max() > MOVED:
            chosen.append(k)
    return np.unique([*chosen, len(time) - 1])
