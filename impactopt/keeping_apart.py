"""Which rows between bodies a program needs, and whether its solution keeps all of them apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import MISSED, Bodies, Places
from impactopt.bodies.robot_bodies import Pair
from impactopt.nlp.apart import ApartRow
from impactopt.nlp.transcription import Transcription
from impactopt.plan import Plan
from impactopt.problem import ImpactProblem
from impactopt.terms import KeepOut, SelfCollision

Array = NDArray[np.float64]
Bounds = dict[ApartRow, tuple[float, float]]
NEAR = 0.10  # [m] nearer bodies get a row
STEP = 8e-3  # [s] at which a plan is looked at
SHARE = 0.5  # of a margin that may be given up between nodes


class Margins:
    """How far each pair of a problem's bodies is to be apart [m]."""

    def __init__(self, problem: ImpactProblem) -> None:
        self.bodies: Bodies = problem.bodies
        self.own, self.world = problem.term(SelfCollision), problem.term(KeepOut)
        self._start = Places.of(
            problem.robot, problem.start_posture[None], np.zeros(1), np.zeros(1, dtype=np.intp)
        )
        self._least: dict[Pair, float] = {}
        # spheres stick out of hulls: where they are too near at the start, they may come nearer by as much as the
        # hulls may
        near = self.bodies.near(self._start, max(self.own.margin, self.world.margin))
        self._gap: dict[tuple[int, int], float] = {}
        for sphere, joint, other, gap in zip(near.sphere, near.joint, near.other, near.gap, strict=True):
            pair = self.bodies.known(int(joint), int(other))
            slack = self.bodies.exact(self._start, 0, pair) - self.of(pair)
            self._gap[int(sphere), int(other)] = min(self.term(pair).margin, float(gap) - slack)

    def term(self, pair: Pair) -> SelfCollision | KeepOut:
        """The one that asks for it."""
        return self.own if pair[1] >= 0 else self.world

    def of(self, pair: Pair) -> float:
        """Of a pair's hulls: the term's, or less where they are nearer at the start."""
        if pair not in self._least:
            start = self.bodies.exact(self._start, 0, pair)
            self._least[pair] = min(self.term(pair).margin, max(start, 0.0))
        return self._least[pair]

    def bound(self, sphere: int, other: int) -> float:
        """Of a sphere's gap to another body."""
        return self._gap.get((sphere, other), self.term((0, other)).margin)


@dataclass(frozen=True, kw_only=True)
class Spots:
    """The places of a program at solver variables: their names, and where bodies are there."""

    names: tuple[str, ...]
    at: Places


def spots_of(t: Transcription, x: Array) -> Spots:
    """All places of a program with coordinates and legs."""
    c, plan = t.coordinates, t.decode(x)
    found = [(0, *spot) for spot in t.swing_spots()]
    for missed, follow in enumerate(t.follows):
        found += [(MISSED if missed else 2, *spot) for spot in follow.spots()]
    q = np.array([c.join(y.evaluate(x), legs.evaluate(x)) for _, _, (y, legs) in found])
    phase = np.array([p for p, _, _ in found], dtype=np.intp)
    time = np.array([place.time.evaluate(x)[0] if place.time is not None else 0.0 for _, place, _ in found])
    travel = np.where(phase == 2, plan.travel(time + plan.contact_end), 0.0)
    return Spots(names=tuple(place.name for _, place, _ in found), at=Places.of(t.robot, q, travel, phase))


def rows_near(t: Transcription, x: Array, margins: Margins, within: float = NEAR) -> Bounds:
    """Rows between all bodies that come near at solver variables (n,): of each pair the nearest sphere."""
    spots = spots_of(t, x)
    near = margins.bodies.near(spots.at, within).least()
    out: Bounds = {}
    for k, sphere, other in zip(near.at, near.sphere, near.other, strict=True):
        if margins.term((0, other)).enabled:
            bound = margins.bound(int(sphere), int(other))
            out[ApartRow(spots.names[k], int(sphere), int(other))] = bound, float(spots.at.travel[k])
    return out
