"""Which rows between bodies a program needs, and whether its solution keeps all of them apart."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import MISSED, Bodies, Closest, Near, Places
from impactopt.bodies.robot_bodies import Pair
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.transcription.apart import ApartRow, Held
from impactopt.transcription.at_contact import ContactProgram
from impactopt.transcription.mesh_refinement import NO_MORE, MoreNodes
from impactopt.transcription.plan import Plan
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
Rows = dict[ApartRow, Held]
AFTER = 2  # phase after contact
NEAR = 0.15  # [m] nearer bodies get a row
STEP = 8e-3  # [s] at which a plan is looked at
SHARE = 0.5  # of a margin that may be given up between nodes
OF_START = 0.25  # of how far two bodies are apart at the start: a margin is no more
BETWEEN = 4  # joints at least between two links that get a row because they are near
EXACT = 0.05  # [m] nearer bodies get a row that knows their hulls there
BEAD = 0.02  # [m] radius of its sphere
ROUNDED = 5e-3  # [m] that bodies may be in each other where rounded rows are met
MANY = 8  # rows of two bodies at one place
DEEP = 0.02  # [m] in each other: two bodies then get rows wherever they are nearer than
FAR = 0.6  # this [m]
DEEPEST = 3  # spheres of a pair
SLIP = 2e-3  # [m] that a sphere may come nearer where it is too near at the start
PATCH, CORNERS = 0.015, 4  # [m] of a side that may come next, and how many of its corners


def same_bodies(one: ImpactProblem, other: ImpactProblem) -> bool:
    """Whether rows between bodies mean the same in two problems."""
    if not (one.keeps_apart and other.keeps_apart) or one.robot is not other.robot:
        return False
    return [body.name for body in one.bodies.world] == [body.name for body in other.bodies.world]


class Margins:
    """How far each pair of a problem's bodies is to be apart [m]."""

    def __init__(self, problem: ImpactProblem) -> None:
        self.bodies: Bodies = problem.bodies
        self.own, self.world = problem.self_collision, problem.keep_out
        self._start = Places.of(
            problem.robot, problem.start_posture[None], np.zeros(1), np.zeros(1, dtype=np.intp)
        )
        self._least: dict[Pair, float] = {}

    def term(self, pair: Pair) -> SelfCollision | KeepOut:
        """The one that asks for it."""
        return self.own if pair[1] >= 0 else self.world

    def of(self, pair: Pair) -> float:
        """Of a pair's hulls: the term's, or less where they are near at the start already."""
        if pair not in self._least:
            start = self.bodies.exact(self._start, 0, pair)
            self._least[pair] = min(self.term(pair).margin, max(OF_START * start, 0.0))
        return self._least[pair]

    def reach(self, sphere: int, pair: Pair) -> float:
        """Radius and margin [m] of a sphere of a link: less where it would be too near at the start, as
        spheres and planes are about bodies that are nearer to each other than their hulls.
        """
        gap = self._gaps.get((sphere, pair), FAR)
        margin = min(self.of(pair), OF_START * gap if gap > 0 else gap - SLIP)
        return float(self.bodies.links.radius[sphere]) + margin

    @cached_property
    def _gaps(self) -> dict[tuple[int, Pair], float]:
        """[m] at the start, by spheres and planes."""
        bodies, near = self.bodies, self.bodies.near(self._start, FAR)
        of_all = zip(near.sphere, near.joint, near.other, near.gap, strict=True)
        return {(int(s), bodies.known(int(j), int(o))): float(gap) for s, j, o, gap in of_all}

    def held(self, at: Places, k: int, pair: Pair) -> Held:
        """A row that knows what it keeps apart exactly as it is at instant k, where the two are nearest.

        Of the one link it takes a small sphere that touches its surface there, of the other body the plane
        that does.
        """
        return self._held(at, k, pair, self.bodies.closest(at, k, pair))

    def held_sphere(self, at: Places, k: int, sphere: int, pair: Pair) -> Held:
        """A row for a sphere of a link and the planes about the other body, at instant k."""
        centre = tuple(self.bodies.links.centre[sphere].tolist())
        return Held(centre, self.reach(sphere, pair), None, float(at.travel[k]))

    def _held(self, at: Places, k: int, pair: Pair, found: Closest, more: float = 0.0) -> Held:
        travel, away = float(at.travel[k]), -found.normal  # from the other to the one
        (turn, shift), (facing, place) = (self.bodies.placement(at, k, body) for body in pair)
        centre = turn.T @ (found.one + BEAD * away - shift)
        normal, point = facing.T @ away, facing.T @ (found.other - place)
        plane = (*normal.tolist(), float(normal @ point))
        return Held(tuple(centre.tolist()), BEAD + self.of(pair) + more, plane, travel)

    def held_around(self, at: Places, k: int, pair: Pair, more: float = 0.0) -> list[Held]:
        """As :meth:`held`, and corners of the one link around, which come next where two flat sides slide or
        turn.  more [m] : than the margin.
        """
        found = self.bodies.closest(at, k, pair)
        first = self._held(at, k, pair, found, more)
        assert first.facing is not None
        turn, _ = self.bodies.placement(at, k, pair[0])
        facing, _ = self.bodies.placement(at, k, pair[1])
        away = turn.T @ (facing @ np.array(first.facing[:3]))
        corners = np.concatenate([piece.vertices for piece in found.pieces])
        height = corners @ away
        lowest = corners[height < height.min() + PATCH]
        chosen: list[Array] = [np.array(first.centre) - BEAD * away]
        while len(chosen) <= CORNERS:
            apart = np.min([np.linalg.norm(lowest - c, axis=1) for c in chosen], axis=0)
            if apart.max() < PATCH:
                break
            chosen.append(lowest[int(apart.argmax())])
        reach = self.of(pair) + more
        return [first, *(first._replace(centre=tuple(c.tolist()), reach=reach) for c in chosen[1:])]


@dataclass(frozen=True, kw_only=True)
class Spots:
    """The places of a program at solver variables: their names, their instants [s], and where bodies are."""

    names: tuple[str, ...]
    time: Array
    at: Places


def spots_of(t: ContactProgram, x: Array) -> Spots:
    """All places of a program with coordinates and legs."""
    states = t.body_states(x)
    phase, time = np.array([s.phase for s in states], dtype=np.intp), np.array([s.time for s in states])
    travel = np.where(phase == AFTER, t.travel(x, time), 0.0)
    q = np.array([s.q for s in states])
    return Spots(names=tuple(s.name for s in states), time=time, at=Places.of(t.robot, q, travel, phase))


def rows_near(t: ContactProgram, x: Array, margins: Margins, within: float = NEAR) -> Rows:
    """Rows between all bodies that come near at solver variables (n,).

    Links with few joints between them are always near, and can hardly meet: they get rows only where they do.
    """
    spots = spots_of(t, x)
    return _rows_of(margins, spots, margins.bodies.near(spots.at, within, BETWEEN).least())


def _rows_of(margins: Margins, spots: Spots, near: Near) -> Rows:
    """A row for each that is near: of the hulls where they are, else of the sphere."""
    out, bodies = dict[ApartRow, Held](), margins.bodies
    for k, sphere, joint, other, gap in zip(
        near.at, near.sphere, near.joint, near.other, near.gap, strict=True
    ):
        pair = bodies.known(int(joint), int(other))
        if not margins.term(pair).enabled:
            continue
        if -DEEP < gap < EXACT:
            out[ApartRow(spots.names[k], *pair)] = margins.held(spots.at, int(k), pair)
        else:
            row = ApartRow(spots.names[k], int(joint), int(other), -1 - int(sphere))
            out[row] = margins.held_sphere(spots.at, int(k), int(sphere), pair)
    return out


def _rows_all_along(margins: Margins, spots: Spots, deep: Near) -> Rows:
    """Rows for the spheres that go deepest into other bodies, at all places that are not far from there."""
    out, bodies = dict[ApartRow, Held](), margins.bodies
    worst: dict[Pair, set[int]] = {}
    for n in np.argsort(deep.gap, kind="stable"):
        chosen = worst.setdefault((int(deep.joint[n]), int(deep.other[n])), set())
        if len(chosen) < DEEPEST:
            chosen.add(int(deep.sphere[n]))
    only = {bodies.known(*pair) for pair in worst}
    near = bodies.near(spots.at, FAR, BETWEEN, only) if only else deep
    for k, sphere, joint, other in zip(near.at, near.sphere, near.joint, near.other, strict=True):
        if int(sphere) in worst.get((int(joint), int(other)), ()):
            row = ApartRow(spots.names[k], int(joint), int(other), -1 - int(sphere))
            pair = bodies.known(int(joint), int(other))
            out[row] = margins.held_sphere(spots.at, int(k), int(sphere), pair)
    return out


class Violated(NamedTuple):
    """Rows that a solution needs beside its own, how deep [m] bodies are in each other without them, and
    which pairs of them are deeper than `DEEP`. And the places on their splines that need a node, as bodies
    meet there although rows keep them apart by more than is asked before and after.
    """

    rows: Rows
    depth: float
    deep: frozenset[Pair] = frozenset()
    nodes: MoreNodes = NO_MORE


def rows_to_add(t: Transcription, x: Array, margins: Margins, *, share: float = SHARE) -> Violated | None:
    """What keeps apart bodies that are too near, at the nodes of a solution or between them; None: none is.

    Too near is what gives up more than a ``share`` of its margin by exact geometry. Rows that are there and
    do not keep it, as spheres do not know all of a link, or as the motion leaves them between two nodes, are
    tightened by what is missing. Where tightened rows on both sides are met and do not help, bodies turn
    about each other in less time than there is between two nodes, and a node is asked for.
    """
    plan, bodies = t.decode(x), margins.bodies
    spots, found, deepest = spots_of(t, x), dict[tuple[int, Pair], float](), -np.inf
    worst = dict[tuple[tuple[int, ...], Pair], tuple[float, float, bool]]()
    for missed in (False, True) if plan.abort is not None else (False,):
        motion = plan.motion(STEP, missed=missed)
        at = Places.of(t.robot, motion.q, motion.travel, np.where(missed, MISSED, motion.phase))
        within = max(margins.own.margin, margins.world.margin) + bodies.slack
        near = bodies.near(at, within).least()
        for k, joint, other, gap in zip(near.at, near.joint, near.other, near.gap, strict=True):
            pair = bodies.known(int(joint), int(other))
            asked = margins.of(pair)
            if not margins.term(pair).enabled or gap - bodies.slack > (1 - share) * asked:
                continue
            apart = bodies.exact(at, int(k), pair)
            if apart < (1 - share) * asked:
                deepest = max(deepest, -apart)
                beside = _beside(spots, float(motion.time[k]), missed)
                for spot in beside:
                    found[spot, pair] = min(found.get((spot, pair), np.inf), apart)
                key = (tuple(beside), pair)
                worst[key] = min(
                    worst.get(key, (np.inf, 0.0, missed)), (apart, float(motion.time[k]), missed)
                )
    if not found:
        return None
    rows: Rows = {}
    tightened: set[tuple[int, Pair]] = set()  # met and with more than the margin asked for already
    for (spot, pair), apart in found.items():
        known = [row for row in t.apart_rows if row[:3] == (spots.names[spot], *pair) and row.number >= 0]
        # rows that are met, and yet it is too near: there, as they are rounded, or beside, as motion is not
        # what it is at nodes. They are to ask for more; the former only where others have not helped
        more, here = 0.0, bodies.exact(spots.at, spot, pair)
        enough = (1 - SHARE) * margins.of(pair) if len(known) <= MANY else -ROUNDED
        if known and here > enough:
            before = [t.apart_rows[row].reach - BEAD - margins.of(pair) for row in known]
            more = max(0.0, *before) + margins.of(pair) - max(apart, -DEEP)
            if max(before) > 0.0:
                tightened.add((spot, pair))
        found_here = margins.held_around(spots.at, spot, pair, min(more, DEEP))
        for k, held in enumerate(found_here if known else found_here[:1], len(known)):
            rows[ApartRow(spots.names[spot], *pair, k)] = held
    deep = frozenset(pair for (_, pair), apart in found.items() if apart < -DEEP)
    if deep:
        own = bodies.near(spots.at, -DEEP, BETWEEN, set(deep)).least()
        rows = {**_rows_all_along(margins, spots, own), **rows}
    between = [
        (time, missed)
        for (beside, pair), (_, time, missed) in worst.items()
        if all((spot, pair) in tightened for spot in beside)
    ]
    new = {key: held for key, held in rows.items() if key not in t.apart_rows}
    return Violated(new, deepest, deep, _nodes_at(t, plan, between))


def _nodes_at(t: Transcription, plan: Plan, between: Iterable[tuple[float, bool]]) -> MoreNodes:
    """The program's nodes and more half-way between those around instants [s] of the motion, or of the one
    that has met nothing.
    """
    places: tuple[set[float], set[float]] = set(t.nodes.swing), set(t.nodes.follow)
    for time, missed in between:
        for phase, more in ((0, places[0]), (AFTER, places[1])):
            curve, begin, nodes, _ = plan.segment(phase, missed=missed)
            place = (time - begin) / curve.duration
            if 0.0 < place < 1.0:
                k = int(np.clip(np.searchsorted(nodes, place), 1, len(nodes) - 1))
                more.add(float(nodes[k - 1] + nodes[k]) / 2)
    return MoreNodes(tuple(sorted(places[0])), tuple(sorted(places[1])))


def missing_rows(t: ContactProgram, x: Array, margins: Margins) -> Rows:
    """Rows for the bodies that are too near at the places of a program themselves."""
    spots, bodies = spots_of(t, x), margins.bodies
    near = bodies.near(spots.at, max(margins.own.margin, margins.world.margin) + bodies.slack).least()
    rows: Rows = {}
    for k, joint, other in zip(near.at, near.joint, near.other, strict=True):
        pair = bodies.known(int(joint), int(other))
        asked = margins.of(pair)
        if margins.term(pair).enabled and bodies.exact(spots.at, int(k), pair) < (1 - SHARE) * asked:
            known = sum(row[:3] == (spots.names[k], *pair) and row.number >= 0 for row in t.apart_rows)
            rows[ApartRow(spots.names[k], *pair, known)] = margins.held(spots.at, int(k), pair)
    return rows


def _beside(spots: Spots, time: float, missed: bool) -> list[int]:
    """The places before and after a time [s] of the motion, or of the one that has met nothing."""
    on_way = spots.at.phase != (AFTER if missed else MISSED)
    order = np.flatnonzero(on_way)[np.argsort(spots.time[on_way], kind="stable")]
    k = int(np.searchsorted(spots.time[order], time))
    return [int(order[j]) for j in {max(k - 1, 0), min(k, len(order) - 1)}]
