"""Clearance constraints of a program, as they enter on the way, and clearance violations of a solution.

A program begins with those of bodies that are near at its start. Others enter at the iterate at which their
bodies come near, before these can touch: the solver leaves the program there, gets the one with them, and
goes on at its barrier. No step goes so far that bodies without a constraint penetrate at its end, or
on another side of each other. So a solution's bodies are on the side of each other that they began on.

If two bodies violate their clearance between two nodes, a node is added at that instant, which gets
constraints as its bodies are near there. Where nodes are too dense for another, or in contact, which has
none, the required clearance at the adjacent nodes is raised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import DEEPEST, MISSED, Bodies, Places
from impactopt.bodies.robot_bodies import Pair
from impactopt.bodies.separation import ROUNDING, THIN, Looked, Placed
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.refinement import Guess, Outcome, Program
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.solvers.program import SolverResult
from impactopt.solvers.run import Path
from impactopt.transcription.clearance import ClearanceKey, SeparatingDirection
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.layout import stack
from impactopt.transcription.mesh import MoreNodes
from impactopt.transcription.plan import Plan
from impactopt.transcription.transcription import Transcription

__all__ = [
    "Margins",
    "Violated",
    "Watch",
    "clearance_violations",
    "deepest_penetration",
    "same_bodies",
    "solved_apart",
    "spots_of",
]

Array = NDArray[np.float64]
Rows = dict[ClearanceKey, SeparatingDirection]
WITHIN, AFTER = 1, 2  # phases in and after contact
# [m] nearer bodies get a constraint: when there are to be more of them, and what asks for more
NEAR, ENTERS = 0.1, 0.03
# the same of links with few joints between: they are always near, and can hardly meet
BETWEEN, NEAR_BETWEEN, ENTERS_BETWEEN = 4, 0.03, 0.015
OF_START = 0.25  # of how far two bodies are apart at the start: a margin is no more
SLIP = 2e-3  # [m] that two may come nearer where they penetrate at the start, as distances are rounded
ROUNDED = 2 * np.log(2) * ROUNDING  # [m] by which the rounded distance of two edges is less than theirs
LEAST = 0.01  # [m] a step brings bodies without a constraint no nearer, nor
OF_GAP = 0.5  # by more than this part of their distance
THROUGH = 5e-3  # [m] penetration on the way: bodies that are apart before and after a step are on other sides
_HALVED = 8  # times at most that a step is
_TIMES = 25  # that constraints enter in one solve, at most


def same_bodies(one: ImpactProblem, other: ImpactProblem) -> bool:
    """True if clearance constraints mean the same in two problems."""
    if not (one.keeps_apart and other.keeps_apart) or one.robot is not other.robot:
        return False
    return [body.name for body in one.bodies.world] == [body.name for body in other.bodies.world]


class Margins:
    """Required clearance [m] of each pair of a problem's bodies.

    Attributes
    ----------
    pieces (P,) [m] : of the pairs of pieces of `Bodies.shapes`, by their rounded distance, which is less.
    wanted (P,) : whether the problem asks for it.
    """

    def __init__(self, problem: ImpactProblem) -> None:
        self.bodies: Bodies = problem.bodies
        self.own, self.world = problem.self_collision, problem.keep_out
        self._start = Places.of(
            problem.robot, problem.start_posture[None], np.zeros(1), np.zeros(1, dtype=np.intp)
        )
        self._least: dict[Pair, float] = {}
        shapes = self.bodies.shapes
        own = shapes.pairs[:, 1] >= 0
        self.wanted = np.where(own, self.own.enabled, self.world.enabled)
        asked = np.where(own, self.own.margin, self.world.margin)
        self.pieces = np.maximum(asked - ROUNDED, asked / 2)
        ways = np.zeros((1, len(shapes), 3))
        found = shapes.look(self.bodies.placed(self._start), self.most / OF_START, ways, self.wanted)
        exact = np.array([self.bodies.exact_piece(self._start, 0, n) for n in found.pair.tolist()])
        # constraints are on rounded distances, which are less than the exact ones by up to ROUNDED: so much
        # less is required of them, or a posture that is allowed would violate them
        least = OF_START * exact - np.minimum(exact - found.gap, ROUNDED)
        least = np.where(found.gap > 0, np.clip(least, 0.0, found.gap / 2), found.gap - SLIP)
        self.pieces[found.pair] = np.minimum(self.pieces[found.pair], least)

    @property
    def most(self) -> float:
        """[m] of any two."""
        return max(self.own.margin, self.world.margin)

    def term(self, pair: Pair) -> SelfCollision | KeepOut:
        """The one that asks for it."""
        return self.own if pair[1] >= 0 else self.world

    def of(self, pair: Pair) -> float:
        """Required clearance [m] of a pair's hulls: the term's, or less if they are nearer at the start
        already.
        """
        if pair not in self._least:
            start = self.bodies.exact(self._start, 0, pair)
            self._least[pair] = min(self.term(pair).margin, max(OF_START * start, 0.0))
        return self._least[pair]


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
    travel = np.where(phase == WITHIN, 0.0, t.travel(x, time))
    q = np.array([s.q for s in states])
    return Spots(names=tuple(s.name for s in states), time=time, at=Places.of(t.robot, q, travel, phase))


class Watch:
    """Watches clearances while a program is solved and limits the solver's step where bodies come near.

    Attributes
    ----------
    left : whether the last iterate that it was asked about lacks constraints.
    path : where the solver was left there.
    """

    def __init__(self, t: ContactProgram, margins: Margins, x: Array) -> None:
        """x (n,) : where the solve starts; the target is where it is there."""
        self._t, self._margins, self._shapes = t, margins, margins.bodies.shapes
        spots = spots_of(t, x)
        self._names, self._travel, self._phase = spots.names, spots.at.travel, spots.at.phase
        slots = {place.name: parts for place, parts in t.body_spots()}
        lift = stack([part for name in self._names for part in slots[name]])
        self._lift, self._const = lift.matrix(t.layout.n), lift.const
        shape = len(self._names), len(self._shapes)
        self._ways, self._has = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
        number = {name: k for k, name in enumerate(self._names)}
        for row, held in t.apart_rows.items():
            at = number[row.place], self._shapes.index[row[1:]]
            self._has[at], self._ways[at] = True, held.way
        close = self._shapes.between < BETWEEN
        self._near = np.where(close, NEAR_BETWEEN, NEAR)
        self._enters = np.where(close, ENTERS_BETWEEN, ENTERS)
        self._x: Array | None = None
        self._next: tuple[Array, Array, tuple[Placed, Looked]] | None = None
        self._entered, self.left = 0, False
        self.path: Path | None = None
        self._go_to(x)

    def rows(self, within: float = NEAR) -> Rows:
        """Constraints for all that is near at the last iterate and has none; it has them from now on.

        within [m] : how near; links with few joints between them by a part of it.
        """
        _, found = self._shapes_at(self._at, self._ways, within)
        new = (found.gap < within / NEAR * self._near[found.pair]) & ~self._has[found.spot, found.pair]
        out = Rows()
        for k, n in zip(found.spot[new].tolist(), found.pair[new].tolist(), strict=True):
            (joint, other), number = self._shapes.pairs[n].tolist(), int(self._shapes.number[n])
            way, reach = self._ways[k, n].tolist(), float(self._margins.pieces[n])
            out[ClearanceKey(self._names[k], joint, other, number)] = SeparatingDirection(
                tuple(way), reach, float(self._travel[k])
            )
        self._has[found.spot, found.pair] |= new
        self.left = False
        return out

    def leave(self, path: Path) -> None:
        self.path = path

    def lacks(self, x: Array) -> bool:
        self._go_to(x)
        self.left, self.path = False, None
        if self._entered < _TIMES and self._bare(self._found[1], self._enters).any():
            self._entered += 1
            self.left = True
        return self.left

    def limit(self, x: Array, step: Array, most: float) -> float:
        self._go_to(x)
        here, length = self._found, most
        for _ in range(_HALVED):
            there = x + length * step
            ways = self._ways.copy()
            found = self._shapes_at(self._placed(there), ways)
            clear = not self._violates_clearance(here[1], found[1])
            if clear and not self._passes(x, step, length, here, found):
                self._next = there, ways, found
                break
            length *= 0.5
        return length

    # ------------------------------------------------------------------ where bodies are
    def _go_to(self, x: Array) -> None:
        """Take over where bodies are at an iterate (n,), and on which side of each other."""
        if self._x is not None and np.array_equal(self._x, x):
            return
        if self._next is not None and np.array_equal(self._next[0], x):
            _, self._ways, self._found = self._next
        else:
            self._found = self._shapes_at(self._placed(x), self._ways)
        self._x, self._at, self._next = x.copy(), self._found[0], None

    def _placed(self, x: Array) -> Placed:
        c, ny = self._t.coordinates, self._t.builder.ny
        z = (self._lift @ x + self._const).reshape(len(self._names), -1)
        q = c.join(z[:, :ny], z[:, ny:])
        return self._margins.bodies.placed(Places.of(self._t.robot, q, self._travel, self._phase))

    def _shapes_at(self, at: Placed, ways: Array, within: float = ENTERS) -> tuple[Placed, Looked]:
        return at, self._shapes.look(at, within, ways, self._margins.wanted)

    # ------------------------------------------------------------------ clearance violations
    def _bare(self, found: Looked, within: Array | float) -> NDArray[np.bool_]:
        """Mask of the pairs found that are nearer than ``within`` [m], a number or (P,), and have no
        constraint.
        """
        least = np.broadcast_to(within, len(self._shapes))[found.pair]
        return np.asarray(~self._has[found.spot, found.pair] & (found.gap < least))

    def _violates_clearance(self, before: Looked, found: Looked) -> bool:
        """True if a step has brought bodies without a constraint too close to each other."""
        fell = found.gap < OF_GAP * before.gaps[found.spot, found.pair]
        return bool((fell & self._bare(found, LEAST)).any())

    def _passes(
        self, x: Array, step: Array, length: float, one: tuple[Placed, Looked], two: tuple[Placed, Looked]
    ) -> bool:
        """True if bodies are clear before and after a step, but penetrate each other half way."""
        spot, pair = self._shapes.may_meet(one, two, self._margins.wanted)
        if not len(spot):
            return False
        these = np.zeros(len(self._shapes), dtype=bool)
        these[pair] = True
        half = self._placed(x + 0.5 * length * step)
        found = self._shapes.look(half, ENTERS, self._ways.copy(), these)
        deep = np.where(self._has[spot, pair], -THROUGH, 0.0)
        return bool((found.gaps[spot, pair] < deep).any())


def solved_apart(budget: Budget, margins: Margins | None, guess: Guess[Program]) -> Outcome[Program]:
    """Outcome of a program with constraints for bodies that come near in its initial guess and on the way to
    its solution.

    margins : None: the program as it is.
    """
    t, start = guess.program, guess.warm or guess.x
    if margins is None:
        return Outcome.of(t, budget.run(t.program, start, guess.barrier, guess.most), guess)
    watch = Watch(t, margins, guess.x)
    t, start = _with_more(t, watch, start)
    result = budget.run(t.program, start, guess.barrier, guess.most, watch=watch)
    # other solvers do not ask on the way
    while watch.left or (not budget.interior and result.status.usable and watch.lacks(result.x)):
        last, before, path = result, t, watch.path
        t, start = _with_more(t, watch, last)
        if path is not None:
            path = replace(path, rows=_of_names(path.rows, before, t, np.nan))
        new = budget.run(t.program, start, None, guess.most, watch=watch, path=path)
        result = one_after_the_other(last, new)
    return Outcome.of(t, result, guess)


def _with_more(t: Program, watch: Watch, start: Array | SolverResult) -> tuple[Program, Array | SolverResult]:
    """The program with what is near, and its start."""
    rows = watch.rows()
    if not rows:
        return t, start
    new = t.with_apart({**t.apart_rows, **rows})
    if isinstance(start, SolverResult):
        start = replace(start, multipliers=_of_names(start.multipliers, t, new, 0.0))
    return new, start


def _of_names(numbers: Array, old: ContactProgram, new: ContactProgram, other: float) -> Array:
    """A program's constraints' numbers (m,) for one with more constraints between bodies, whose are
    ``other``.
    """
    own = len(numbers) - len(old.apart_rows)
    known = dict(zip(old.apart_rows, numbers[own:].tolist(), strict=True))
    return np.append(numbers[:own], [known.get(name, other) for name in new.apart_rows])


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
                    self.rows[ClearanceKey(*row)] = held._replace(reach=reach)


class _Nodes:
    """The nodes that a program has beside those of its intervals, and those that it gets."""

    def __init__(self, t: Transcription, plan: Plan) -> None:
        self._plan, self._places = plan, {0: set(t.nodes.swing), AFTER: set(t.nodes.follow)}
        self._stands = t.nodes.stands

    @property
    def all(self) -> MoreNodes:
        return MoreNodes(tuple(sorted(self._places[0])), tuple(sorted(self._places[AFTER])), self._stands)

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
