"""Clearances of all bodies of a scene: fast by spheres and planes, exact by convex hulls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.convex_hulls import Piece
from impactopt.bodies.fit import Planes
from impactopt.bodies.robot_bodies import Pair, RobotBodies, bodies_of, distance, transform
from impactopt.bodies.separation import Placed, Shapes
from impactopt.bodies.world import BEHIND, WorldBody
from impactopt.errors import InputError
from impactopt.robots.robot import Robot

__all__ = ["Bodies", "Near", "Places", "Survey", "Touch"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
MISSED = 3  # phase in which there is no target
FAR = 1.0  # [m] no clearance beyond this is asked for
_REQUEST = coal.DistanceRequest()
SHALLOW, EVERY = 2e-3, 5e-3  # [m] deeper bodies are looked at once in so long [s]
CLOSE = 2e-2  # [m] that is looked at first
DEEPEST = -1e-6  # [m] what is deeper is a touch


class Touch(NamedTuple):
    """Penetration of two bodies: names, from when till when [s], and how deep [m] at most."""

    one: str
    other: str
    start: float
    end: float
    depth: float


class Survey(NamedTuple):
    """Clearance of a motion's bodies: the least distance [m], its time [s], the two bodies, and the
    contacts, deepest first.
    """

    clearance: float
    time: float
    nearest: tuple[str, ...]
    touches: tuple[Touch, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Placements of the bodies at k instants.

    rotation (k, joints, 3, 3), translation (k, joints, 3) [m] : of the model's joints.  travel (k,) [m] : of
    the target along its normal.  phase (k,) : 0 before, 1 in, 2 after contact; 3: none.
    """

    rotation: Array
    translation: Array
    travel: Array
    phase: Index

    @classmethod
    def of(cls, robot: Robot, q: Array, travel: Array, phase: Index) -> Places:
        """Placements for configurations q (k, nq)."""
        model, data = robot.model, robot.model.createData()
        placements = np.zeros((len(q), model.njoints, 4, 4))
        for k, posture in enumerate(q):
            pin.forwardKinematics(model, data, posture)
            placements[k] = [joint.homogeneous for joint in data.oMi]
        rotation, translation = placements[..., :3, :3].copy(), placements[..., :3, 3].copy()
        return cls(rotation=rotation, translation=translation, travel=travel, phase=phase)

    def __len__(self) -> int:
        return len(self.travel)

    @cached_property
    def transforms(self) -> dict[tuple[int, int], Any]:
        """Transforms by instant and body, for exact distances: those computed so far."""
        return {}


@dataclass(frozen=True, kw_only=True, eq=False)
class Near:
    """Close pairs: at instant ``at`` (m,), a sphere of the robot and another link or a body of the world.

    sphere (m,) : its number.  joint (m,) : that moves it.  other (m,) : joint of the link; or -1 - the index
    of the world's body.  gap (m,) [m] : between sphere and planes, < 0 for penetration.
    """

    at: Index
    sphere: Index
    joint: Index
    other: Index
    gap: Array

    def least(self) -> Near:
        """Nearest sphere of each instant and pair."""
        order = np.argsort(self.gap, kind="stable")
        key = np.zeros(len(order), dtype=np.int64)
        for part in (self.at, self.joint, self.other) if len(order) else ():  # one number, in their order
            key = key * (int(np.ptp(part)) + 1) + (part - part.min())
        return self.only(order[np.unique(key[order], return_index=True)[1]])

    def only(self, chosen: NDArray[Any]) -> Near:
        """These of them, by number or by mask."""
        return Near(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})


class Closest(NamedTuple):
    """Distance [m] of two bodies, < 0 for penetration; the points (3,) [m] of both there, in the world; the
    direction (3,) from the one to the other; and the pieces of the one that may meet the other's there.
    """

    distance: float
    one: Array
    other: Array
    normal: Array
    pieces: tuple[Piece, ...]


class Bodies:
    """All bodies of a scene, and which pairs of them are not to touch."""

    def __init__(
        self,
        robot: Robot,
        world: tuple[WorldBody, ...],
        start: Array,
        *,
        normal: Array,
        striking: tuple[int, ...],
        standing: tuple[int, ...],
        strict: bool,
    ) -> None:
        """start (nq,) : the posture in which what touches may touch for good.  normal (3,) : the blow's.

        strict : whether a start in a body of the world is refused.  striking, standing : joints of the links
        that strike, and of the soles that are held.
        """
        self.robot, self.world, self.normal, self.striking = robot, world, normal, striking
        self.start, self.standing = start, standing
        self.links: RobotBodies = bodies_of(robot)
        left_out = {frozenset(pair) for pair in robot.disable_collisions}
        self.pairs, self.touching = self.links.piece_pairs(start, left_out)
        at = Places.of(robot, start[None], np.zeros(1), np.zeros(1, dtype=np.intp))
        self.world_pairs: list[Pair] = []
        for w, body in enumerate(world):
            for j in self.links.joints:
                rooted = j in standing or (not robot.floating and robot.model.parents[j] == 0)
                on_ground = body.ground and rooted
                mine = j in striking
                core = mine and not self._strikes_from_inside(j)
                if on_ground or (mine and body.strikable) or (body.core and not core):
                    continue
                if strict and not body.ground and self.exact(at, 0, (j, -1 - w)) < 0:
                    raise InputError(
                        f"at the start the link {self.links.name(j)!r} is in the body {body.name!r}: start "
                        "from another posture, or move the body or make it smaller"
                    )
                if body.ground and self.exact(at, 0, (j, -1 - w)) <= 0:
                    self.touching.append((self.links.name(j), body.name))
                    continue
                self.world_pairs.append((j, w))

    @cached_property
    def shapes(self) -> Shapes:
        """Shapes of all pairs that must not touch, for smooth distances."""
        return Shapes(self.links, self.world, self.pairs, self.world_pairs)

    def placed(self, at: Places) -> Placed:
        """Placements of the shapes at k instants, for smooth distances."""
        k = len(at)
        joints = np.concatenate([at.rotation.reshape(k, -1, 9), at.translation], axis=2)
        world = np.zeros((k, len(self.world), 12))
        present = np.zeros((k, len(self.world)), dtype=np.uint8)
        for w, body in enumerate(self.world):
            world[:, w, :9] = body.rotation.ravel()
            world[:, w, 9:] = body.place + np.outer(at.travel, self.normal) * body.moves
            present[:, w] = self.present(body, at)
        return Placed(np.ascontiguousarray(joints), world, present)

    def _strikes_from_inside(self, joint: int) -> bool:
        """True if a link's body surrounds its strikers by more than the depth of a target's core behind the
        face.

        Such a body, as a box of inertia about a point mass, meets the core however it strikes.
        """
        frames, depths = self.robot.model.frames, []
        for striker in self.robot.strikers.values():
            frame = frames[self.robot.model.getFrameId(striker.model_frame)]
            if frame.parentJoint == joint:
                depths.append(
                    max(piece.depth(frame.placement.translation) for piece in self.links.of_joint[joint])
                )
        return bool(depths) and min(depths) > BEHIND

    # ------------------------------------------------------------------ by spheres and planes
    @cached_property
    def _of_joint(self) -> dict[int, Index]:
        return {j: np.flatnonzero(self.links.joint == j) for j in self.links.joints}

    @cached_property
    def _about_spheres(self) -> dict[int, tuple[Array, float]]:
        """Bounding ball of all spheres of each joint: centre (3,) and radius [m]."""
        links, out = self.links, {}
        for j, own in self._of_joint.items():
            centre = links.balls[j][0]
            away = np.linalg.norm(links.centre[own] - centre, axis=1)
            out[j] = centre, float((away + links.radius[own]).max())
        return out

    @cached_property
    def directed(self) -> dict[Pair, Pair]:
        """Direction of each pair's check: the joint whose spheres are tested against the other's planes,
        fitting best.
        """
        out = self.links.out
        return {(a, b): (a, b) if out[a] <= out[b] else (b, a) for a, b in self.pairs}

    def _ball_gaps(self, at: Places) -> Array:
        """(k, pairs) [m] at least between what two joints move."""
        balls = self.links.balls
        place = {j: k for k, j in enumerate(balls)}
        centre = np.stack([self._placed(at, j, balls[j][0][None])[:, 0] for j in balls], axis=1)
        radius = np.array([balls[j][1] for j in balls])
        one, two = (np.array([place[p[k]] for p in self.pairs], dtype=np.intp) for k in (0, 1))
        apart = np.linalg.norm(centre[:, one] - centre[:, two], axis=2)
        return np.asarray(apart - radius[one] - radius[two])

    @staticmethod
    def _placed(at: Places, joint: int, points: Array) -> Array:
        """Points (m, 3) of a joint's frame in the world (k, m, 3)."""
        return np.asarray(points @ at.rotation[:, joint].transpose(0, 2, 1) + at.translation[:, joint, None])

    @cached_property
    def _between(self) -> list[int]:
        """Number of joints between the two of each pair."""
        up = [set(joints) for joints in self.robot.model.supports]
        return [len(up[a] ^ up[b]) for a, b in self.pairs]

    def near(self, at: Places, within: float, between: int = 0, only: set[Pair] | None = None) -> Near:
        """All spheres that are nearer than ``within`` [m] to what they are not to touch.

        between : of two links, so many joints at least are between them.  only : of these pairs, if given.
        """
        links, found = self.links, list[tuple[Index, Index, int, int, Array]]()
        close = self._ball_gaps(at) < within
        for n, pair in enumerate(self.pairs):
            when = np.flatnonzero(close[:, n])
            if not len(when) or self._between[n] < between or (only is not None and pair not in only):
                continue
            a, b = self.directed[pair]
            own = self._of_joint[a]
            points = (
                links.centre[own] @ at.rotation[when, a].transpose(0, 2, 1) + at.translation[when, a, None]
            )
            local = np.matmul(points - at.translation[when, b, None], at.rotation[when, b])
            gap = _outside(links.planes[b], local) - links.radius[own]
            i, c = np.nonzero(gap < within)
            found.append((when[i], own[c], a, b, gap[i, c]))
        for w, body in enumerate(self.world):
            joints = [j for j, k in self.world_pairs if k == w and (only is None or (j, -1 - w) in only)]
            when = np.flatnonzero(self.present(body, at))
            shift = body.place + np.outer(at.travel[when], self.normal) * body.moves
            for j in joints if len(when) else ():
                own, (centre, radius) = self._of_joint[j], self._about_spheres[j]
                ball = centre @ at.rotation[when, j].transpose(0, 2, 1) + at.translation[when, j]
                gap = _outside(body.planes, ((ball - shift) @ body.rotation)[:, None])[:, 0] - radius
                near = np.flatnonzero(gap < within)
                points = (
                    links.centre[own] @ at.rotation[when[near], j].transpose(0, 2, 1)
                    + at.translation[when[near], j, None]
                )
                local = (points - shift[near, None]) @ body.rotation
                gap = _outside(body.planes, local) - links.radius[own]
                i, c = np.nonzero(gap < within)
                found.append((when[near[i]], own[c], j, -1 - w, gap[i, c]))
        none = np.zeros(0, dtype=np.intp)
        instants = np.concatenate([none, *(f[0] for f in found)])
        sphere = np.concatenate([none, *(f[1] for f in found)])
        counts = [len(f[0]) for f in found]
        joint = np.repeat([f[2] for f in found], counts).astype(np.intp)
        other = np.repeat([f[3] for f in found], counts).astype(np.intp)
        return Near(
            at=instants,
            sphere=sphere,
            other=other,
            joint=joint,
            gap=np.concatenate([np.zeros(0), *(f[4] for f in found)]),
        )

    @staticmethod
    def present(body: WorldBody, at: Places) -> NDArray[np.bool_]:
        """Mask (k,) of the instants at which a body of the world is present."""
        return np.asarray(at.phase == 0) if body.before else (at.phase != MISSED) | (not body.of_target)

    # ------------------------------------------------------------------ exactly
    def exact(self, at: Places, k: int, pair: Pair) -> float:
        """Distance [m] at instant k of two joints, or of a joint and a body of the world, -1 - its index."""
        a, b = pair
        here, there = self._transform(at, k, a), self._transform(at, k, b)
        return min(distance(one.shape, here, two.shape, there) for one, two in self._pieces(pair))

    def exact_piece(self, at: Places, k: int, number: int) -> float:
        """Distance [m] at instant k of a pair of pieces, by its number in `shapes`."""
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
        """Convex pieces of a pair that may meet."""
        a, b = pair
        return self.pairs[pair] if b >= 0 else [(one, self.world[-1 - b]) for one in self.links.of_joint[a]]

    def _transform(self, at: Places, k: int, body: int) -> Any:
        known = at.transforms.get((k, body))
        if known is None:
            known = at.transforms[k, body] = transform(*self.placement(at, k, body))
        return known

    def placement(self, at: Places, k: int, body: int) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) [m] of a joint, or of a body of the world, -1 - its index."""
        if body >= 0:
            return at.rotation[k, body], at.translation[k, body]
        solid = self.world[-1 - body]
        return solid.rotation, solid.place + at.travel[k] * self.normal * solid.moves

    def planes(self, body: int) -> Planes:
        """About what a joint moves, or about a body of the world, -1 - its index."""
        return self.links.planes[body] if body >= 0 else self.world[-1 - body].planes

    @cached_property
    def slack(self) -> float:
        """[m] by how much bodies may be nearer than their spheres and planes say."""
        return max(self.links.short.values(), default=0.0)

    def lower_bounds(self, at: Places, within: float) -> Iterator[tuple[float, int, Pair]]:
        """No pair is nearer than this [m] at that instant, but for what spheres fall short; nearest first."""
        near = self.near(at, within).least()
        for n in np.argsort(near.gap, kind="stable"):
            a, b = int(near.joint[n]), int(near.other[n])
            yield float(near.gap[n]), int(near.at[n]), self.known(a, b)

    def known(self, joint: int, other: int) -> Pair:
        """A pair as it stands in ``pairs``, if it is one of two joints."""
        return (joint, other) if other < 0 or (joint, other) in self.pairs else (other, joint)

    def survey(self, time: Array, at: Places, within: float = 0.1) -> Survey:
        """The least distance of any pair at any instant, and all that touches.

        time (k,) [s] : of the instants.  within [m] : pairs that are farther apart count as `FAR`.
        Deep penetrations are looked at every `EVERY`, so that begin and end are that fine.
        """
        close = self.slack + CLOSE  # of most motions the nearest two are, and then no others matter
        if close < within:
            found = self._survey(time, at, close)
            if found.clearance <= CLOSE:
                return found
        return self._survey(time, at, within)

    def _survey(self, time: Array, at: Places, within: float) -> Survey:
        least, when, which = FAR, 0, None
        found: dict[Pair, list[tuple[int, float]]] = {}
        seen: set[tuple[Pair, int]] = set()
        for bound, k, pair in self.lower_bounds(at, within):
            if bound - self.slack >= max(least, 0.0):
                break
            moment = pair, int(time[k] / EVERY)
            if moment in seen:
                continue
            distance = self.exact(at, k, pair)
            if distance < least:
                least, when, which = distance, k, pair
            if distance < DEEPEST:
                found.setdefault(pair, []).append((k, distance))
            if distance < -SHALLOW:
                seen.add(moment)
        touches = []
        for pair, hits in found.items():
            instants = time[[k for k, _ in hits]]
            depth = -min(d for _, d in hits)
            touches.append(Touch(*self.names(pair), float(instants.min()), float(instants.max()), depth))
        touches.sort(key=lambda t: -t.depth)
        names = () if which is None else self.names(which)
        return Survey(least, float(time[when]), names, tuple(touches))

    def names(self, pair: Pair) -> tuple[str, str]:
        """Names of the two bodies in messages."""
        a, b = pair
        return self.links.name(a), self.links.name(b) if b >= 0 else self.world[-1 - b].name


def _outside(planes: Planes, points: Array) -> Array:
    """Least distance (k, m) [m] of points (k, m, 3) from a body, < 0 inside."""
    return np.asarray((points @ planes.normal.T - planes.offset).max(axis=2))
