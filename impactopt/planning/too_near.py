"""Where a solution brings bodies too near to each other, and the rows and nodes that it lacks for that.

Every round with what is found here makes progress. At a place of the program where two bodies are too near, a
row is added that the solution violates. Where they are too near only between two places, those are asked for
more, once; then there is a node at that instant, with such a row. Rows change no faster than bodies move. So
two solutions, of which only the latter has a row, differ there by a part of the margin over the links'
lengths at least; and bodies take time from a place where they are apart to an instant where they are not.
So the rows at a place and the nodes of a motion are finitely many (as with the cutting planes of Blankenship
and Falk, 1976): rounds end with bodies that are apart, or with a program that has no solution.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import DEEPEST, MISSED, Places
from impactopt.bodies.robot_bodies import Pair
from impactopt.planning.keeping_apart import (
    AFTER,
    BETWEEN,
    DEEP,
    EXACT,
    Margins,
    Rows,
    Spots,
    rows_all_along,
    spots_of,
)
from impactopt.transcription.apart import ApartRow
from impactopt.transcription.at_contact import ContactProgram
from impactopt.transcription.mesh_refinement import MoreNodes
from impactopt.transcription.plan import Plan
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
STEP = 8e-3  # [s] at which a plan is looked at
SHARE = 0.5  # of a margin that may be given up between nodes
AT_NODES = 0.25  # and at them
CUT = 0.1  # of a margin that a row asks for more, at least
SHORTEST = 2e-3  # [s] between two nodes that get another
INNER = 0.2  # of the time between two nodes: another one is not nearer to them


class Violated(NamedTuple):
    """Rows that a solution needs beside its own, how deep [m] bodies are in each other without them, which
    pairs are too near, and which are deeper than `DEEP` so that rows help. And the program's nodes with those
    that it needs, as bodies meet between two at which they are apart.
    """

    rows: Rows
    depth: float
    pairs: frozenset[Pair]
    deep: frozenset[Pair]
    nodes: MoreNodes


class _Between(NamedTuple):
    """Where two bodies are nearest between two places: how far apart [m], when [s], on which motion."""

    apart: float
    time: float
    missed: bool


def rows_to_add(t: Transcription, x: Array, margins: Margins, *, share: float = SHARE) -> Violated | None:
    """What keeps apart bodies that are too near, at the nodes of a solution or between them; None: none is.

    Too near is what gives up more than a ``share`` of its margin by exact geometry.
    """
    plan, bodies, spots = t.decode(x), margins.bodies, spots_of(t, x)
    worst, deepest = dict[tuple[tuple[int, ...], Pair], _Between](), -np.inf
    for missed in (False, True) if plan.abort is not None else (False,):
        motion = plan.motion(STEP, missed=missed)
        at = Places.of(t.robot, motion.q, motion.travel, np.where(missed, MISSED, motion.phase))
        near = bodies.near(at, margins.most + bodies.slack).least()
        columns = (a.tolist() for a in (near.at, near.joint, near.other, near.gap))
        for k, joint, other, gap in zip(*columns, strict=True):
            pair = bodies.known(joint, other)
            least = (1 - share) * margins.of(pair) + DEEPEST
            if not margins.term(pair).enabled or gap - bodies.slack > least:
                continue
            found = _Between(bodies.exact(at, k, pair), float(motion.time[k]), missed)
            if found.apart < least:
                deepest = max(deepest, -found.apart)
                key = tuple(_beside(spots, found.time, missed)), pair
                worst[key] = min(worst.get(key, found), found)
    if not worst:
        return None
    wanted, nodes = _Wanted(t, spots, margins), _Nodes(t, plan)
    at_places: dict[Pair, float] = {}
    for (beside, pair), found in sorted(worst.items(), key=lambda item: item[1].apart):
        if wanted.keep_apart(beside, pair, found.apart):
            at_places[pair] = min(at_places.get(pair, np.inf), found.apart)
        elif not nodes.add(found, wanted.jumps(beside, pair)):
            wanted.ask_more(beside, pair, found.apart)
    deep = frozenset(pair for pair, apart in at_places.items() if apart < -DEEP)
    pairs = frozenset(pair for _, pair in worst)
    wanted.wherever_near(pairs - deep)
    rows = wanted.rows
    if deep:
        own = bodies.near(spots.at, -DEEP, BETWEEN, set(deep)).least()
        rows = {**rows_all_along(margins, spots, own), **rows}
    new = {key: held for key, held in rows.items() if key not in t.apart_rows}
    return Violated(new, deepest, pairs, deep, nodes.all)


def missing_rows(
    t: ContactProgram, x: Array, margins: Margins, *, all_along: bool = False, spots: Spots | None = None
) -> Rows:
    """Rows for the bodies that are too near at the places of a program themselves.

    all_along : and for these bodies wherever they are near.  spots : the places, if they are known.
    """
    spots, bodies = spots_of(t, x) if spots is None else spots, margins.bodies
    near, wanted = bodies.near(spots.at, margins.most + bodies.slack).least(), _Wanted(t, spots, margins)
    for k, joint, other in zip(near.at, near.joint, near.other, strict=True):
        pair = bodies.known(int(joint), int(other))
        if margins.term(pair).enabled and wanted.distance(int(k), pair) < (1 - SHARE) * margins.of(pair):
            wanted.add(int(k), pair, around=False)
    if all_along:
        wanted.wherever_near({(row.joint, row.other) for row in wanted.rows})
    return wanted.rows


class _Wanted:
    """Rows that a program lacks at its places, where bodies are as its solution has them."""

    def __init__(self, t: ContactProgram, spots: Spots, margins: Margins) -> None:
        self.spots, self.margins, self.rows = spots, margins, Rows()
        self._known = Counter((row.place, row.joint, row.other) for row in t.apart_rows if row.number >= 0)
        self._distance: dict[tuple[int, Pair], float] = {}
        self._more: dict[tuple[int, Pair], float] = {}

    def distance(self, spot: int, pair: Pair) -> float:
        """[m] of the two there."""
        if (spot, pair) not in self._distance:
            self._distance[spot, pair] = self.margins.bodies.exact(self.spots.at, spot, pair)
        return self._distance[spot, pair]

    def add(self, spot: int, pair: Pair, more: float = 0.0, *, around: bool = True) -> None:
        """What keeps the two apart there by so much more [m] than their margin; where rows that are there do
        not, in place of one that knows where they are nearest, several ``around`` it.
        """
        at, place = self.spots.at, self.spots.names[spot]
        if self._more.get((spot, pair), -1.0) >= more:
            return
        self._more[spot, pair] = more
        known = self._known[place, pair[0], pair[1]]
        if known and around:
            found = self.margins.held_around(at, spot, pair, more)
        else:
            found = [self.margins.held(at, spot, pair, more)]
        for number, held in enumerate(found, known):
            self.rows[ApartRow(place, *pair, number)] = self.margins.sharp(at, spot, pair, held)

    def keep_apart(self, beside: Sequence[int], pair: Pair, apart: float) -> bool:
        """Rows for two that are so far apart [m] between places; whether the solution violates one of
        them.
        """
        asked = self.margins.of(pair)
        enough = (1 - AT_NODES) * asked + DEEPEST
        near = {spot: 0.0 for spot in beside if self.distance(spot, pair) < enough}
        if not near and apart >= 0:
            # they miss no more than what the places beside may give
            more = asked - apart
            near = {spot: more for spot in beside if self.distance(spot, pair) < asked + more - CUT * asked}
        for spot in beside:
            if spot in near or not self._known[self.spots.names[spot], pair[0], pair[1]]:
                self.add(spot, pair, near.get(spot, 0.0))
        return bool(near)

    def jumps(self, beside: Sequence[int], pair: Pair) -> bool:
        """Whether the one is on two sides of the other at the places beside."""
        bodies, at = self.margins.bodies, self.spots.at
        normals = [bodies.closest(at, spot, pair).normal for spot in beside]
        return bool(normals[0] @ normals[-1] < 0)

    def ask_more(self, beside: Sequence[int], pair: Pair, apart: float) -> None:
        """Rows at the places beside for what is missing between them [m], which has none of its own."""
        asked = self.margins.of(pair)
        for spot in beside:
            already = max(self.distance(spot, pair) - asked, 0.0)
            self.add(spot, pair, already + min(asked - apart, DEEP))

    def wherever_near(self, pairs: Set[Pair]) -> None:
        """Rows for these pairs at all places where they are near: bodies that are pushed apart at one come to
        be too near at the next.
        """
        near = self.margins.bodies.near(self.spots.at, EXACT, only=set(pairs)).least()
        for k, joint, other in zip(near.at, near.joint, near.other, strict=True):
            pair = self.margins.bodies.known(int(joint), int(other))
            if not self._known[self.spots.names[int(k)], pair[0], pair[1]]:
                self.add(int(k), pair)


class _Nodes:
    """The nodes that a program has beside those of its intervals, and those that it gets."""

    def __init__(self, t: Transcription, plan: Plan) -> None:
        self._plan, self._places = plan, {0: set(t.nodes.swing), AFTER: set(t.nodes.follow)}

    @property
    def all(self) -> MoreNodes:
        return MoreNodes(tuple(sorted(self._places[0])), tuple(sorted(self._places[AFTER])))

    def add(self, found: _Between, jumps: bool) -> bool:
        """One at that instant, or as near to it as others are not; two beside it, where bodies jump from one
        side to the other.  False: the others are too near to each other, or it is in contact, which has none.
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
