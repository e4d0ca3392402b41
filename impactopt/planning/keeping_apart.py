"""Rows that keep a program's bodies apart: how far, where, and how each knows its two bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import Bodies, Closest, Near, Places
from impactopt.bodies.fit import PLANES
from impactopt.bodies.robot_bodies import Pair
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.transcription.apart import ROUND, ApartRow, Held
from impactopt.transcription.at_contact import ContactProgram

Array = NDArray[np.float64]
Rows = dict[ApartRow, Held]
WITHIN, AFTER = 1, 2  # phases in and after contact
NEAR = 0.15  # [m] nearer bodies get a row
OF_START = 0.25  # of how far two bodies are apart at the start: a margin is no more
BETWEEN = 4  # joints at least between two links that get a row because they are near
EXACT = 0.05  # [m] nearer bodies get a row that knows their hulls there
BEAD = 0.02  # [m] radius of its sphere
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

    @property
    def most(self) -> float:
        """[m] of any two."""
        return max(self.own.margin, self.world.margin)

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

    def held(self, at: Places, k: int, pair: Pair, more: float = 0.0) -> Held:
        """A row that knows what it keeps apart exactly as it is at instant k, where the two are nearest.

        Of the one link it takes a small sphere that touches its surface there, of the other body the plane
        that does.  more [m] : than the margin.
        """
        return self._held(at, k, pair, self.bodies.closest(at, k, pair), more)

    def held_sphere(self, at: Places, k: int, sphere: int, pair: Pair) -> Held:
        """A row for a sphere of a link and the planes about the other body, at instant k."""
        centre = tuple(self.bodies.links.centre[sphere].tolist())
        return Held(centre, self.reach(sphere, pair), None, float(at.travel[k]))

    def _held(self, at: Places, k: int, pair: Pair, found: Closest, more: float) -> Held:
        travel, away = float(at.travel[k]), -found.normal  # from the other to the one
        (turn, shift), (facing, place) = (self.bodies.placement(at, k, body) for body in pair)
        centre = turn.T @ (found.one + BEAD * away - shift)
        normal, point = facing.T @ away, facing.T @ (found.other - place)
        plane = (*normal.tolist(), float(normal @ point))
        return Held(tuple(centre.tolist()), BEAD + self.of(pair) + more, plane, travel)

    def held_around(self, at: Places, k: int, pair: Pair, more: float = 0.0) -> list[Held]:
        """As :meth:`held`, and corners of the one link around, which come next where two flat sides slide or
        turn.
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

    def sharp(self, at: Places, k: int, pair: Pair, held: Held) -> Held:
        """The same row, asking for what its rounding hides at instant k besides."""
        turn, shift = self.bodies.placement(at, k, pair[0])
        facing, place = self.bodies.placement(at, k, pair[1])
        normal, offset = np.split(self.bodies.planes(pair[1]).with_facing(held.facing), [3 * PLANES])
        far = normal.reshape(-1, 3) @ (facing.T @ (turn @ np.array(held.centre) + shift - place)) - offset
        return held._replace(reach=held.reach + rounded_most(far) - float(far.max()))


def rounded_most(far: Array) -> float:
    """The largest of lengths (a power of two of them) [m], rounded as rows have it."""
    while len(far) > 1:
        one, two = far[::2], far[1::2]
        far = (one + two + np.sqrt((one - two) ** 2 + ROUND**2)) / 2
    return float(far[0])


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


def rows_all_along(margins: Margins, spots: Spots, deep: Near) -> Rows:
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
