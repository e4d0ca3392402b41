"""Collision geometry of a replay, and record of unintended contacts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from impactopt.arrays import Array

FLOOR = -1  # in place of a solid's number
NEAR = 0.05  # [m] between the enclosing balls of two solids in the reference's motion; others are ignored
SAMPLING = 0.02  # [s] between the instants of the reference that are checked


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A convex solid of a link of the robot, or of the world.

    name : of the link, or of the body.
    joint : index in the model of the joint that moves it; 0: a body of the world.
    vertices (k, 3) [m] : of a hull, in the joint's frame; None: a box with half sides ``half`` (3,) [m],
        inflated by ``radius`` [m], at ``place`` (3,) with axes ``rotation`` (3, 3).
    of_target : it exists only with the target.
    moves : it moves with the target.
    strikable : the striking link may touch it.
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
        """Centre (3,) and radius [m] of an enclosing ball, in the joint's frame."""
        if self.vertices is not None:
            centre = (self.vertices.max(axis=0) + self.vertices.min(axis=0)) / 2
            return centre, float(np.linalg.norm(self.vertices - centre, axis=1).max())
        assert self.half is not None and self.place is not None
        return np.asarray(self.place), float(np.linalg.norm(self.half)) + self.radius


@dataclass(frozen=True, kw_only=True, eq=False)
class Solids:
    """Solids of a scene.

    pairs : of numbers of solids that must not touch; `FLOOR` stands for the floor.
    floor : height of the floor [m], for pairs with it.
    """

    solids: tuple[Solid, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()
    floor: float = 0.0

    def moved(self, displacement: Array) -> Solids:
        """Copy with the target and its support displaced by (3,) [m]."""
        return replace(
            self,
            solids=tuple(
                replace(s, place=np.asarray(s.place) + displacement) if s.of_target else s
                for s in self.solids
            ),
        )

    def without_target(self) -> Solids:
        """Copy without the target's solids."""
        gone = {k for k, s in enumerate(self.solids) if s.of_target}
        return replace(self, pairs=tuple(p for p in self.pairs if not gone & set(p)))

    def near(self, model: Any, reference: Any) -> tuple[tuple[int, int], ...]:
        """Pairs that may come near when the robot follows a reference: time (k,), q (k, nq)."""
        time = np.asarray(reference.time)
        instants = np.arange(time[0], time[-1] + SAMPLING, SAMPLING)
        sampled = np.searchsorted(time, instants).clip(0, len(time) - 1)
        return self.near_at(model, np.asarray(reference.q)[sampled])

    def links_between(self, model: Any, moves: Array) -> Solids:
        """Copy with only the pairs of links whose distance changes by a motion of the joints.

        moves (nv,) : velocity, or displacement in the tangent space; zero for joints that do not move.
        """
        # joint 1 moves the whole robot; a follower has its leader's place in `moves`, and nv = 0
        moving = {
            j
            for j, joint in enumerate(model.joints)
            if j >= 2 and np.any(moves[joint.idx_v : joint.idx_v + max(joint.nv, 1)])
        }
        paths = [moving.intersection(model.supports[solid.joint]) for solid in self.solids]
        links = [k for k, solid in enumerate(self.solids) if solid.vertices is not None]
        chosen = [p for p in self.pairs if set(p) <= set(links) and paths[p[0]] != paths[p[1]]]
        return replace(self, pairs=tuple(chosen))

    def least_distance(self, model: Any, q: Array) -> Array:
        """Least distance (k,) [m] between hulls of links in configurations q (k, nq).

        It is < 0 for penetration, and inf where no pair comes near.
        """
        near = self.near_at(model, q)
        data, request, out = model.createData(), coal.DistanceRequest(), np.full(len(q), np.inf)
        for i, posture in enumerate(q):
            pin.forwardKinematics(model, data, posture)
            joints = {k: data.oMi[self.solids[k].joint] for pair in near for k in pair}
            at = {k: coal.Transform3s(joint.rotation, joint.translation) for k, joint in joints.items()}
            for one, other in near:
                result, shapes = coal.DistanceResult(), (self.solids[one].hull, self.solids[other].hull)
                coal.distance(shapes[0], at[one], shapes[1], at[other], request, result)
                out[i] = min(out[i], result.min_distance)
        return out

    def near_at(self, model: Any, q: Array) -> tuple[tuple[int, int], ...]:
        """Pairs whose enclosing balls come within `NEAR` in configurations q (k, nq).

        Pairs with a body that moves with the target are always included.
        """
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
                distance = np.linalg.norm(centre[:, one] - centre[:, other], axis=1)
                gap = distance - radius[one] - radius[other]
            # where the target goes depends on the simulated contact, which the reference does not have
            moving = other != FLOOR and (self.solids[one].moves or self.solids[other].moves)
            if moving or gap.min() < NEAR:
                out.append((one, other))
        return tuple(out)


@dataclass(frozen=True, kw_only=True)
class UnintendedContact:
    """Contact of two bodies that must not touch: names, start and end [s], largest depth [m] and force [N].

    force : None where the engine's bodies do not collide.
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


class UnintendedContacts:
    """Record of contacts between the solids of a compiled MuJoCo world.

    Solids are the geoms ``solid <number>``; the floor is geom 0.
    """

    def __init__(self, world: Any, solids: Solids) -> None:
        self._names = np.array(["ground", *(s.name for s in solids.solids)])
        self._number = [-1] * world.ngeom  # of each geom: index in the names, or -1
        self._number[0] = 0
        for k in range(world.ngeom):
            kind, _, number = world.geom(k).name.partition(" ")
            # geoms are numbered by MuJoCo; names keep the scene's numbers, of which only some have a geom
            if kind == "solid":
                self._number[k] = 1 + int(number)
        self._mocap = int(world.body("target").mocapid[0])
        self._contacts: dict[tuple[int, int], list[float]] = {}  # start, end, depth, force

    def place_target(self, data: Any, displacement: Array) -> None:
        """Sets the displacement (3,) [m] of the bodies that move with the target."""
        data.mocap_pos[self._mocap] = displacement

    def update(self, data: Any, t: float) -> None:
        """Records the contacts at a time [s]; to be called once a step's forces are known."""
        if not data.ncon:
            return
        contacts, number = data.contact, self._number
        for k, (first, second) in enumerate(contacts.geom.tolist()):  # few: no array is as fast
            # a pair has one entry, whichever of its geoms MuJoCo names first
            other, one = sorted((number[first], number[second]))
            if other < 0 or contacts.dist[k] >= 0:
                continue
            # -1: MuJoCo has left the contact out; else its first constraint is the normal one
            address = contacts.efc_address[k]
            force = float(data.efc_force[address]) if address >= 0 else 0.0
            contact = self._contacts.setdefault((one, other), [t, t, 0.0, 0.0])
            contact[1] = t
            contact[2] = max(contact[2], -float(contacts.dist[k]))
            contact[3] = max(contact[3], force)

    def contacts(self) -> tuple[UnintendedContact, ...]:
        """All contacts, deepest first."""
        out = [
            UnintendedContact(
                one=str(self._names[one]),
                other=str(self._names[other]),
                start=start,
                end=end,
                depth=depth,
                force=force,
            )
            for (one, other), (start, end, depth, force) in self._contacts.items()
        ]
        return tuple(sorted(out, key=lambda contact: -contact.depth))
