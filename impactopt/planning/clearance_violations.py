"""Detects clearance violations of a solution and selects the constraints and nodes to add.

At its nodes a program has constraints on the clearance of near bodies (`clearance_constraints`). If two
bodies violate their clearance between two nodes, a node is added at that instant, which gets constraints as
its bodies are near there. Where nodes are too dense for another, or in contact, which has none, the required
clearance at the adjacent nodes is raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import DEEPEST, MISSED, Places
from impactopt.bodies.robot_bodies import Pair
from impactopt.bodies.separation import THIN
from impactopt.planning.clearance_constraints import AFTER, Margins, Rows, Spots, spots_of
from impactopt.transcription.clearance import ApartRow
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.mesh_refinement import MoreNodes
from impactopt.transcription.plan import Plan
from impactopt.transcription.transcription import Transcription

__all__ = ["Violated", "clearance_violations", "deepest_penetration"]

Array = NDArray[np.float64]
STEP = 8e-3  # [s] at which a plan is looked at
SHARE = 0.5  # of a margin that may be given up between nodes
AT_NODES = 0.25  # and at them
MOST = 0.02  # [m] that a place is asked for more at once
ROUND = 0.01  # [m] pieces that are so much farther apart than the nearest two of a pair are asked for no more
SHORTEST = 2e-3  # [s] between two nodes that get another
INNER = 0.2  # of the time between two nodes: another one is not nearer to them


class Violated(NamedTuple):
    """Additions that a solution's clearance violations call for: constraints in place of its own, the depth
    [m] of the penetration without them, the violating pairs, and the program's nodes with those to add.
    """

    rows: Rows
    depth: float
    pairs: frozenset[Pair]
    nodes: MoreNodes


class _Between(NamedTuple):
    """Closest approach of two bodies between two nodes: distance [m], time [s], motion."""

    apart: float
    time: float
    missed: bool


def clearance_violations(
    t: Transcription, x: Array, margins: Margins, *, share: float = SHARE
) -> Violated | None:
    """Additions that remove clearance violations at a solution's nodes or between them; None if there are
    none.

    Too near is what gives up more than a ``share`` of its margin by exact geometry.
    """
    plan, bodies, spots = t.decode(x), margins.bodies, spots_of(t, x)
    worst, depth = dict[tuple[tuple[int, ...], Pair], _Between](), -np.inf
    for missed in (False, True) if plan.abort is not None else (False,):
        motion = plan.motion(STEP, missed=missed)
        at = Places.of(t.robot, motion.q, motion.travel, np.where(missed, MISSED, motion.phase))
        for k, pair, apart in _near(margins, at, share):
            depth = max(depth, -apart)
            found = _Between(apart, float(motion.time[k]), missed)
            key = tuple(_beside(spots, found.time, missed)), pair
            worst[key] = min(worst.get(key, found), found)
    if not worst:
        return None
    asked, nodes = _Asked(t, spots, margins), _Nodes(t, plan)
    for (beside, pair), found in sorted(worst.items(), key=lambda item: item[1].apart):
        least = (1 - AT_NODES) * margins.of(pair) + DEEPEST
        here = [k for k in beside if bodies.exact(spots.at, k, pair) < least]
        if here:  # at a place: as bodies are near there, it has constraints from then on
            asked.more(here, pair, found.apart)
            continue
        # Between nodes a node helps, constraints at the nodes beside it do not, unless no node fits. Normals
        # that turn round say that one body passes through the other, from one node to the next.
        normals = [bodies.closest(spots.at, k, pair).normal for k in beside]
        if not nodes.add(found, bool(normals[0] @ normals[-1] < 0)):
            asked.more(beside, pair, found.apart)
    return Violated(asked.rows, depth, frozenset(pair for _, pair in worst), nodes.all)


def deepest_penetration(t: ContactProgram, x: Array, margins: Margins) -> tuple[float, list[Pair]]:
    """Deepest penetration [m] at a program's nodes, < 0 if there is none, and the pairs in contact."""
    touching = list(_near(margins, spots_of(t, x).at, 1.0))
    return max((-apart for _, _, apart in touching), default=-np.inf), [pair for _, pair, _ in touching]


def _near(margins: Margins, at: Places, share: float) -> list[tuple[int, Pair, float]]:
    """Instants and pairs that give up more than a share of their margin, and how far they are apart [m]."""
    bodies, shapes, out = margins.bodies, margins.bodies.shapes, list[tuple[int, Pair, float]]()
    ways = np.zeros((len(at), len(shapes), 3))
    found = shapes.look(bodies.placed(at), margins.most + THIN, ways, margins.wanted)
    seen = {
        (k, tuple(pair))
        for k, pair in zip(found.spot.tolist(), shapes.pairs[found.pair].tolist(), strict=True)
    }
    for k, (a, b) in sorted(seen):
        apart = bodies.exact(at, k, (a, b))
        if apart < (1 - share) * margins.of((a, b)) + DEEPEST:
            out.append((k, (a, b), apart))
    return out


class _Asked:
    """Constraints of a program with more reach than they have."""

    def __init__(self, t: ContactProgram, spots: Spots, margins: Margins) -> None:
        self._t, self._spots, self._margins, self.rows = t, spots, margins, Rows()
        shapes = margins.bodies.shapes
        ways = np.zeros((len(spots.names), len(shapes), 3))
        self._gaps = shapes.look(margins.bodies.placed(spots.at), np.inf, ways, margins.wanted).gaps

    def more(self, beside: Sequence[int], pair: Pair, apart: float) -> None:
        """Raises the required clearance of two bodies at these nodes by what is missing between them [m]."""
        missing, index = min(self._margins.of(pair) - apart, MOST), self._margins.bodies.shapes.index
        for k in beside:
            own = {
                row: held
                for row, held in self._t.apart_rows.items()
                if row[:3] == (self._spots.names[k], *pair)
            }
            gaps = {row: float(self._gaps[k, index[row[1:]]]) for row in own}
            least = min(gaps.values(), default=0.0)
            for row, held in own.items():
                if gaps[row] < least + ROUND:
                    reach = max(held.reach, self.rows.get(row, held).reach, least + missing)
                    self.rows[ApartRow(*row)] = held._replace(reach=reach)


class _Nodes:
    """The nodes that a program has beside those of its intervals, and those that it gets."""

    def __init__(self, t: Transcription, plan: Plan) -> None:
        self._plan, self._places = plan, {0: set(t.nodes.swing), AFTER: set(t.nodes.follow)}

    @property
    def all(self) -> MoreNodes:
        return MoreNodes(tuple(sorted(self._places[0])), tuple(sorted(self._places[AFTER])))

    def add(self, found: _Between, jumps: bool) -> bool:
        """One at that instant, or as near to it as others are not; two beside it, where bodies jump from one
        side to the other.  False: the others are too close to each other, or it is in contact, which has
        none.
        """
        for phase, places in self._places.items():
            curve, begin, nodes, _ = self._plan.segment(phase, missed=found.missed)
            place = (found.time - begin) / curve.duration
            if not 0.0 < place < 1.0 or (found.missed and not phase):
                continue
            k = int(np.clip(np.searchsorted(nodes, place), 1, len(nodes) - 1))
            first, last = float(nodes[k - 1]), float(nodes[k])
            span = (last - first) * curve.duration
            if span < 2 * SHORTEST:
                return False
            if not any(first < s < last for s in places):
                inner = INNER * (last - first)
                place = float(np.clip(place, first + inner, last - inner))
                beside = [(first + place) / 2, (place + last) / 2] if jumps and span > 4 * SHORTEST else []
                places.update(round(s, 4) for s in (place, *beside))
            return True
        return False


def _beside(spots: Spots, time: float, missed: bool) -> list[int]:
    """The places before and after a time [s] of the motion, or of the one that has met nothing."""
    on_way = spots.at.phase != (AFTER if missed else MISSED)
    order = np.flatnonzero(on_way)[np.argsort(spots.time[on_way], kind="stable")]
    k = int(np.searchsorted(spots.time[order], time))
    return [int(order[j]) for j in sorted({max(k - 1, 0), min(k, len(order) - 1)})]
