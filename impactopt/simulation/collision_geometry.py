"""Collision geometry of a replay, and contacts that are not intended."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

__all__ = ["FLOOR", "Besides", "Solid", "Solids", "Touched"]

Array = NDArray[np.float64]
FLOOR = -1  # in place of a solid's number
NEAR = 0.05  # [m] of the balls about two solids in the reference's motion: others are not looked at
LOOK = 0.02  # [s] at which it is looked at


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A convex solid: of the link that a joint of the model moves, or of the world.

    name : of the link, or of the body.  joint : index in the model; 0: of the world.
    vertices (k, 3) [m] : of a hull, in the joint's frame; None: a box with half sides ``half`` (3,) [m],
    inflated by ``radius`` [m], at ``place`` (3,) with axes ``rotation`` (3, 3).
    of_target : it is there only if the target is.  moves : with it.  before : it is gone after contact.
    strikable : the link that strikes may touch it.
    """

    name: str
    joint: int = 0
    vertices: Array | None = None
    half: Array | None = None
    radius: float = 0.0
    place: Array | None = None
    rotation: Array | None = None
    of_target: bool = False
    moves: bool = False
    before: bool = False
    strikable: bool = False

    @cached_property
    def hull(self) -> Any:
        """Convex hull of its vertices, for coal."""
        assert self.vertices is not None
        points, facets = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(list(self.vertices))
        facets.extend([coal.Triangle(*map(int, facet)) for facet in ConvexHull(self.vertices).simplices])
        return coal.Convex(points, facets)

    def ball(self) -> tuple[Array, float]:
        """Centre (3,) and radius [m] of a ball about it, in its frame."""
        if self.vertices is not None:
            centre = (self.vertices.max(axis=0) + self.vertices.min(axis=0)) / 2
            return centre, float(np.linalg.norm(self.vertices - centre, axis=1).max())
        assert self.half is not None and self.place is not None
        return np.asarray(self.place), float(np.linalg.norm(self.half)) + self.radius


@dataclass(frozen=True, kw_only=True, eq=False)
class Solids:
    """All solids of a scene; pairs of their numbers that are not to touch, the floor's being `FLOOR`.

    floor : its height [m], where a pair has it.
    """

    solids: tuple[Solid, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()
    floor: float = 0.0

    def moved(self, way: Array) -> Solids:
        """Copy with the target and its support moved by ``way`` (3,) [m]."""
        return replace(
            self,
            solids=tuple(
                replace(s, place=np.asarray(s.place) + way) if s.of_target else s for s in self.solids
            ),
        )

    def without_target(self) -> Solids:
        """Copy without the target's solids."""
        gone = {k for k, s in enumerate(self.solids) if s.of_target}
        return replace(self, pairs=tuple(p for p in self.pairs if not gone & set(p)))

    def near(self, model: Any, reference: Any) -> tuple[tuple[int, int], ...]:
        """Pairs that can come near when the robot follows a reference: time (k,), q (k, nq)."""
        time = np.asarray(reference.time)
        chosen = np.searchsorted(time, np.arange(time[0], time[-1] + LOOK, LOOK)).clip(0, len(time) - 1)
        return self.near_at(model, np.asarray(reference.q)[chosen])

    def links_between(self, model: Any, moves: Array) -> Solids:
        """Copy with only the pairs of links whose distance changes when velocities move (nv,) are not 0."""
        moving = {j for j in range(2, model.njoints) if np.any(_own(model.joints[j], moves))}
        paths = [moving.intersection(model.supports[solid.joint]) for solid in self.solids]
        links = [k for k, solid in enumerate(self.solids) if solid.vertices is not None]
        chosen = [p for p in self.pairs if set(p) <= set(links) and paths[p[0]] != paths[p[1]]]
        return replace(self, pairs=tuple(chosen))

    def apart(self, model: Any, q: Array) -> Array:
        """(k,) [m] between the two links that are nearest to each other in configurations q (k, nq), by their
        hulls; < 0 for penetration, inf where none come near.
        """
        near = self.near_at(model, q)
        data, asked, out = model.createData(), coal.DistanceRequest(), np.full(len(q), np.inf)
        for i, posture in enumerate(q):
            pin.forwardKinematics(model, data, posture)
            at = {k: _placed(data.oMi[self.solids[k].joint]) for pair in near for k in pair}
            for one, other in near:
                found, shapes = coal.DistanceResult(), (self.solids[one].hull, self.solids[other].hull)
                coal.distance(shapes[0], at[one], shapes[1], at[other], asked, found)
                out[i] = min(out[i], found.min_distance)
        return out

    def near_at(self, model: Any, q: Array) -> tuple[tuple[int, int], ...]:
        """Pairs that can come near in configurations q (k, nq)."""
        data = model.createData()
        balls = [s.ball() for s in self.solids]
        radius = np.array([r for _, r in balls])
        centre = np.zeros((len(q), len(balls), 3))
        for i, posture in enumerate(q):
            pin.forwardKinematics(model, data, posture)
            for n, (solid, (middle, _)) in enumerate(zip(self.solids, balls, strict=True)):
                centre[i, n] = data.oMi[solid.joint].act(middle)
        out = []
        for one, other in self.pairs:
            if other == FLOOR:
                gap = centre[:, one, 2] - radius[one] - self.floor
            else:
                way = centre[:, one] - centre[:, other]
                gap = np.linalg.norm(way, axis=1) - radius[one] - radius[other]
            moving = other != FLOOR and (self.solids[one].moves or self.solids[other].moves)
            if moving or gap.min() < NEAR:
                out.append((one, other))
        return tuple(out)


@dataclass(frozen=True, kw_only=True)
class Touched:
    """Two that touched what they should not: names, from when till when [s], how deep [m] and with which
    force [N] at most; no force where nothing pushes back.
    """

    one: str
    other: str
    start: float
    end: float
    depth: float
    force: float | None = None

    def summary(self) -> dict[str, Any]:
        """JSON form, as it stands in ``summary.json``."""
        out = {
            "one": self.one,
            "other": self.other,
            "start_s": self.start,
            "end_s": self.end,
            "depth_mm": 1e3 * self.depth,
        }
        return out if self.force is None else {**out, "force_N": self.force}


def _own(joint: Any, moves: Array) -> Array:
    return moves[joint.idx_v : joint.idx_v + max(joint.nv, 1)]  # a follower has its leader's


def _placed(place: Any) -> Any:
    return coal.Transform3s(place.rotation, place.translation)


class Besides:
    """Watches a compiled world's solids, named ``solid <number>``; the floor is geom 0."""

    def __init__(self, world: Any, solids: Solids) -> None:
        self._names = np.array(["ground", *(s.name for s in solids.solids)])
        self._number = np.full(world.ngeom, -1)
        self._number[0] = 0
        for k in range(world.ngeom):
            kind, _, number = world.geom(k).name.partition(" ")
            if kind == "solid":
                self._number[k] = 1 + int(number)
        self._mocap = int(world.body("target").mocapid[0])
        self._found: dict[tuple[int, int], list[float]] = {}

    def place(self, data: Any, way: Array) -> None:
        """Bodies that move with the target are ``way`` (3,) [m] from where they were."""
        data.mocap_pos[self._mocap] = way

    def look(self, data: Any, t: float) -> None:
        """Records the contacts at a time [s]; called once a step's forces are known."""
        if not data.ncon:
            return
        contacts = data.contact
        numbers = self._number[contacts.geom]
        both = numbers.min(axis=1) >= 0
        if not both.any():
            return
        for k in np.flatnonzero(both & (contacts.dist < 0)):
            one, other = (int(n) for n in sorted(numbers[k], reverse=True))
            address = contacts.efc_address[k]
            force = float(data.efc_force[address]) if address >= 0 else 0.0
            row = self._found.setdefault((one, other), [t, t, 0.0, 0.0])
            row[1] = t
            row[2] = max(row[2], -float(contacts.dist[k]))
            row[3] = max(row[3], force)

    def touched(self) -> tuple[Touched, ...]:
        """All that has touched, deepest first."""
        rows = [
            Touched(
                one=str(self._names[one]),
                other=str(self._names[other]),
                start=start,
                end=end,
                depth=depth,
                force=force,
            )
            for (one, other), (start, end, depth, force) in self._found.items()
        ]
        return tuple(sorted(rows, key=lambda row: -row.depth))
