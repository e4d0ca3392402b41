"""Clearances of all bodies of a scene: lower bounds by smooth distances, exact values by convex hulls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import coal
import numpy as np

from impactopt.arrays import Array, Index, Mask
from impactopt.bodies.convex_hulls import Piece
from impactopt.bodies.robot_bodies import Pair, RobotBodies, bodies_of, distance, transform
from impactopt.bodies.separation import THIN, Placed, Shapes
from impactopt.bodies.world import BEHIND, WorldBody
from impactopt.errors import InputError
from impactopt.robots.build import parent_body
from impactopt.robots.robot import Robot

MISSED = 3  # phase without a target
FAR = 1.0  # [m] clearance that stands for all larger ones
_REQUEST = coal.DistanceRequest()
# [m], [s] Two bodies that penetrate by more than the first are evaluated once in the second.
_SHALLOW, _DEEP_INTERVAL = 2e-3, 5e-3
_CLOSE = 2e-2  # [m] clearance up to which a survey is tried first
SINKING = 3e-3  # [m] by which a link without load that is on the ground at the start may sink into it
DEEPEST = -1e-6  # [m] distance below which bodies penetrate
SLACK = 2 * THIN  # [m] by which bodies may be nearer than the smooth distances of their thinned hulls
SURVEYED = 0.1  # [m] larger clearances are not measured in surveys of a motion
_CHUNK = 256  # instants that are evaluated together; memory is proportional to them times the pairs


class Touch(NamedTuple):
    """Penetration of two bodies: their names, start and end [s], and largest depth [m]."""

    one: str
    other: str
    start: float
    end: float
    depth: float


class Survey(NamedTuple):
    """Least distance [m] in a motion, its time [s] and bodies; and the penetrations, deepest first."""

    clearance: float
    time: float
    nearest: tuple[str, ...]
    touches: tuple[Touch, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Placements of the bodies at k instants.

    rotation (k, joints, 3, 3), translation (k, joints, 3) [m] : of the model's joints.
    displacement (k, 3) [m] : of the target.
    phase (k,) : 0 before, 1 in, 2 after contact; 3: without a target.
    """

    rotation: Array
    translation: Array
    displacement: Array
    phase: Index

    @classmethod
    def of(cls, robot: Robot, q: Array, phase: Index, displacement: Array | None = None) -> Places:
        """Placements for configurations q (k, nq); displacement None: the target is at its place."""
        rotation, translation = robot.forward_kinematics(q)
        moved = np.zeros((len(phase), 3)) if displacement is None else displacement
        return cls(rotation=rotation, translation=translation, displacement=moved, phase=phase)

    def __len__(self) -> int:
        return len(self.phase)

    def part(self, first: int, last: int) -> Places:
        """Placements at the instants first, ..., last - 1."""
        chosen = slice(first, last)
        return Places(
            rotation=self.rotation[chosen],
            translation=self.translation[chosen],
            displacement=self.displacement[chosen],
            phase=self.phase[chosen],
        )

    @cached_property
    def transforms(self) -> dict[tuple[int, int], Any]:
        """Cache of transforms by instant and body, for exact distances."""
        return {}


class Closest(NamedTuple):
    """Closest points of two bodies.

    distance [m] : < 0 for penetration.  one, other (3,) [m] : points of both, in the world.
    normal (3,) : direction from the one to the other.
    pieces : of the first body, that may touch the nearest piece of the other.
    """

    distance: float
    one: Array
    other: Array
    normal: Array
    pieces: tuple[Piece, ...]


class Bodies:
    """Bodies of a scene, and their pairs that must not touch.

    overlaps : links that are not checked as they touch at the start, which neighbours alone should.
    """

    def __init__(
        self,
        robot: Robot,
        world: tuple[WorldBody, ...],
        start: Array,
        *,
        striking: tuple[int, ...],
        standing: tuple[int, ...],
        strict: bool,
    ) -> None:
        """start (nq,) : posture; links that touch in it, or nearly (`FITTED`), are not checked.

        strict : refuse a start posture that penetrates a body of the world.
        striking, standing : joints of the striking links, and of the feet on fixed soles.
        """
        self.robot, self.world, self.striking = robot, world, striking
        self.start, self.standing = start, standing
        self.links: RobotBodies = bodies_of(robot)
        left_out = {frozenset(pair) for pair in robot.disable_collisions}
        self.pairs, touching = self.links.piece_pairs(start, left_out)
        self.overlaps = sorted((min(pair), max(pair)) for pair in self.links.overlaps(touching))
        at = Places.of(robot, start[None], np.zeros(1, dtype=np.intp))
        self.world_pairs: list[Pair] = []
        self._first_lowered = len(world)  # index of the first ground that is lowered for a link on it
        for w, body in enumerate(world):
            for j in self.links.joints:
                # Fixed soles stand on the ground, and a fixed base is mounted on it.
                rooted = j in standing or (not robot.floating and parent_body(robot.model, j) == 0)
                on_ground = body.ground and rooted
                strikes = j in striking
                # only striking links are checked against a core; all others keep off the target itself
                core = strikes and not self._strikes_from_inside(j)
                if on_ground or (strikes and body.strikable) or (body.core and not core):
                    continue
                if strict and not body.ground and self.exact(at, 0, (j, -1 - w)) < 0:
                    raise InputError(
                        f"at the start the link {self.links.name(j)!r} is in the body {body.name!r}: start "
                        "from another posture, or move the body or make it smaller"
                    )
                depth = -self.exact(at, 0, (j, -1 - w)) if body.ground else -np.inf
                if depth < 0:
                    self.world_pairs.append((j, w))
                else:  # a foot without load, or a toe: a constraint would be violated at once
                    lower = body.place - (depth + SINKING) * np.array([0.0, 0.0, 1.0])
                    self.world_pairs.append((j, len(self.world)))
                    self.world += (replace(body, place=lower),)

    def with_target_moved(self, displacement: Array) -> Bodies:
        """Copy with the target and its supports displaced by (3,) [m]; the pairs are the same."""
        moved = copy(self)
        moved.world = tuple(
            replace(body, place=body.place + displacement) if body.of_target else body for body in self.world
        )
        return moved

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes of the pairs that must not touch, for smooth distances."""
        return Shapes(self.links, self.world, self.pairs, self.world_pairs)

    def placed(self, at: Places) -> Placed:
        """Placements of the shapes at k instants, for smooth distances."""
        k = len(at)
        joints = np.concatenate([at.rotation.reshape(k, -1, 9), at.translation], axis=2)
        world = np.zeros((k, len(self.world), 12))
        present = np.zeros((k, len(self.world)), dtype=np.uint8)
        for w, body in enumerate(self.world):
            world[:, w, :9] = body.rotation.ravel()
            # Only the target moves.
            world[:, w, 9:] = body.place + at.displacement * body.moves
            present[:, w] = self.present(body, at)
        return Placed(np.ascontiguousarray(joints), world, present)

    def _strikes_from_inside(self, joint: int) -> bool:
        """True if all strikers of a link lie deeper than `BEHIND` inside one of its pieces.

        Such a body, as a box of inertia about a point mass, meets a target's core however it strikes.
        """
        frames, depths = self.robot.model.frames, []
        for striker in self.robot.strikers.values():
            frame = frames[self.robot.model.getFrameId(striker.model_frame)]
            if frame.parentJoint == joint:
                depths.append(
                    max(piece.depth(frame.placement.translation) for piece in self.links.of_joint[joint])
                )
        return bool(depths) and min(depths) > BEHIND

    @staticmethod
    def present(body: WorldBody, at: Places) -> Mask:
        """Mask (k,) of the instants at which a body of the world is present."""
        return np.asarray(at.phase == 0) if body.before else (at.phase != MISSED) | (not body.of_target)

    # ------------------------------------------------------------------ exact distances
    def exact(self, at: Places, k: int, pair: Pair) -> float:
        """Distance [m] at instant k of a pair: two joints, or a joint and the world body -1 - index."""
        a, b = pair
        here, there = self._transform(at, k, a), self._transform(at, k, b)
        return min(distance(one.shape, here, two.shape, there) for one, two in self._pieces(pair))

    def exact_piece(self, at: Places, k: int, number: int) -> float:
        """Distance [m] at instant k of a pair of pieces, by its index in `shapes`."""
        (a, b), n = self.shapes.pairs[number].tolist(), int(self.shapes.number[number])
        one, two = self._pieces((a, b))[n]
        return distance(one.shape, self._transform(at, k, a), two.shape, self._transform(at, k, b))

    def closest(self, at: Places, k: int, pair: Pair) -> Closest:
        """Closest points of a pair at instant k, or the deepest penetration."""
        a, b = pair
        here, there = self._transform(at, k, a), self._transform(at, k, b)
        pieces = self._pieces(pair)
        best: Any = None
        nearest: Any = None
        for one, two in pieces:
            found = coal.DistanceResult()
            coal.distance(one.shape, here, two.shape, there, _REQUEST, found)
            if best is None or found.min_distance < best.min_distance:
                best, nearest = found, two
        return Closest(
            float(best.min_distance),
            np.array(best.getNearestPoint1()),
            np.array(best.getNearestPoint2()),
            np.array(best.normal),
            tuple(one for one, two in pieces if two is nearest),
        )

    def _pieces(self, pair: Pair) -> Sequence[tuple[Any, Any]]:
        """Pairs of convex pieces of two bodies that may touch."""
        a, b = pair
        return self.pairs[pair] if b >= 0 else [(one, self.world[-1 - b]) for one in self.links.of_joint[a]]

    def _transform(self, at: Places, k: int, body: int) -> Any:
        # Cached, as all pairs of a body need it.
        known = at.transforms.get((k, body))
        if known is None:
            known = at.transforms[k, body] = transform(*self.placement(at, k, body))
        return known

    def placement(self, at: Places, k: int, body: int) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) [m] of a joint, or of the world body -1 - index."""
        if body >= 0:
            return at.rotation[k, body], at.translation[k, body]
        solid = self.world[-1 - body]
        return solid.rotation, solid.place + at.displacement[k] * solid.moves

    def lower_bounds(self, at: Places, within: float) -> Iterator[tuple[float, int, Pair]]:
        """Smooth distances [m] below ``within``, with instant and pair, by increasing distance.

        Minus `SLACK` they are lower bounds of the exact distances, and ``within`` minus `SLACK` is one for
        all others.
        """
        shapes, found = self.shapes, dict[tuple[int, Pair], float]()
        every = np.ones(len(shapes), dtype=bool)
        for first in range(0, len(at), _CHUNK):
            placed = self.placed(at.part(first, first + _CHUNK))
            directions = np.zeros((len(placed.joints), len(shapes), 3))
            near = shapes.look(placed, within, directions, every)
            for gap, k, number in zip(near.gap, near.spot.tolist(), near.pair.tolist(), strict=True):
                a, b = shapes.pairs[number].tolist()
                key = first + k, (a, b)
                # Of all pieces of two bodies the nearest two count.
                found[key] = min(float(gap), found.get(key, np.inf))
        for (k, pair), gap in sorted(found.items(), key=lambda item: item[1]):
            yield gap, k, pair

    def survey(self, time: Array, at: Places, within: float = SURVEYED) -> Survey:
        """Least distance of all pairs at all instants, and all penetrations.

        time (k,) [s] : of the instants.  within [m] : clearances above it count as `FAR`.
        Deep penetrations are evaluated every 5 ms only, which is the accuracy of their start and end.
        """
        # In most motions the nearest two bodies are close; then pairs farther apart need no evaluation.
        close = SLACK + _CLOSE
        if close < within:
            found = self._survey(time, at, close)
            if found.clearance <= _CLOSE:
                return found
        return self._survey(time, at, within)

    def touches(self, time: Array, at: Places) -> tuple[Touch, ...]:
        """Penetrations of a survey alone: pairs whose smooth distance is larger than `SLACK` have none."""
        return self._survey(time, at, SLACK).touches

    def _survey(self, time: Array, at: Places, within: float) -> Survey:
        least, when, which = FAR, 0, None
        found: dict[Pair, list[tuple[int, float]]] = {}
        seen: set[tuple[Pair, int]] = set()
        for bound, k, pair in self.lower_bounds(at, within):
            # Bounds rise from here on, so no pair is nearer than the least distance, nor penetrates.
            if bound - SLACK >= max(least, 0.0):
                break
            # A deep pair penetrates at many instants in a row, of which one an interval is enough.
            interval = pair, int(time[k] / _DEEP_INTERVAL)
            if interval in seen:
                continue
            distance = self.exact(at, k, pair)
            # a link that begins on the ground has no clearance from it
            if distance < (min(least, 0.0) if -1 - pair[1] >= self._first_lowered else least):
                least, when, which = distance, k, pair
            if distance < DEEPEST:
                found.setdefault(pair, []).append((k, distance))
            if distance < -_SHALLOW:
                seen.add(interval)
        touches = []
        for pair, penetrations in found.items():
            # One touch a pair, from its first penetration to its last, also if it is interrupted.
            instants = time[[k for k, _ in penetrations]]
            depth = -min(d for _, d in penetrations)
            touches.append(Touch(*self.names(pair), float(instants.min()), float(instants.max()), depth))
        touches.sort(key=lambda t: -t.depth)
        names = () if which is None else self.names(which)
        return Survey(least, float(time[when]), names, tuple(touches))

    def names(self, pair: Pair) -> tuple[str, str]:
        """Names of the two bodies in messages."""
        a, b = pair
        return self.links.name(a), self.links.name(b) if b >= 0 else self.world[-1 - b].name
