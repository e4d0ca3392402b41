"""Rows that keep bodies apart: spheres of the robot out of its other links, and of the bodies of the world.

The function of such a row knows no robot: it is a chain of turns about z axes with fixed placements between,
which are its parameters. Chains are filled up to a few lengths, so that a handful of compiled functions
serves all pairs of all robots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
import pinocchio as pin
import scipy.sparse as sp

from impactopt.bodies.fit import PLANES
from impactopt.codegen.cache import FunctionGroup
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.robots.robot import Robot
from impactopt.transcription.batched import Block
from impactopt.transcription.blocks import BlockExpression, make_block
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Array, stack
from impactopt.transcription.rows import Place, Row, millimetres
from impactopt.transcription.simd import in_lanes
from impactopt.transcription.structured import derivative_functions

LENGTHS = (4, 8, 12, 16, 20)  # of chains, in joints
ROUND = 4e-3  # [m] over which two planes pass into each other
TOO_NEAR = millimetres("too near")


@dataclass(frozen=True)
class Chain:
    """How to get from a body's frame to another's, joint by joint.

    columns (n,) : the joints' places among base coordinates and joints (nv), with their ``signs``.
    turns (n,) : 1 for a joint that turns, 0 for one that slides.  places : n + 1 placements between them
    (pin.SE3).
    base : whether the base's position comes before all that.
    """

    columns: tuple[int, ...]
    signs: tuple[float, ...]
    turns: tuple[float, ...]
    places: tuple[Any, ...]
    base: bool = False

    @cached_property
    def length(self) -> int:
        """To which it is filled up."""
        return next((n for n in LENGTHS if n >= len(self.columns)), len(self.columns))

    def numbers(self, before: Any = None) -> Array:
        """The chain's part of a row's parameters; ``before``: a placement in front of all (pin.SE3)."""
        if before is None:
            return self._numbers
        out = self._numbers.copy()
        out[:12] = _placement(before * self.places[0])
        return out

    @cached_property
    def _numbers(self) -> Array:
        """Thousands of rows have the same."""
        more = self.length - len(self.columns)
        places = [*self.places, *[pin.SE3.Identity()] * more]
        return np.concatenate([*map(_placement, places), self.turns, np.ones(more)])

    def pattern(self, c: StanceCoordinates, rotation: Array | None = None) -> tuple[Array, Array, Array]:
        """z of a row's function, sums of coordinates: slots, coordinates (y, then legs), factors, (k,) each.

        rotation : axes, as columns, of the box that the chain ends at.
        """
        where = _places(c)
        slots = [3 + k for k in range(len(self.columns))]
        coordinates, factors = [where[k] for k in self.columns], list(self.signs)
        if self.base and rotation is not None:
            for i in range(3):
                slots += [i] * 3
                coordinates += [0, 1, 2]
                factors += [float(rotation[j, i]) for j in range(3)]
        return np.array(slots), np.array(coordinates), np.array(factors)


def _placement(m: Any) -> Array:
    """Rotation by rows, and translation [m] (12)."""
    return np.concatenate([np.asarray(m.rotation).ravel(), m.translation])


def _places(c: StanceCoordinates) -> list[int]:
    """Of each base coordinate and joint (nv): where it is in y and, behind them, legs."""
    out = [*range(c.base)] + [0] * c.robot.n
    for k, j in enumerate(c.independent):
        out[c.base + int(j)] = c.base + k
    for k, j in enumerate(c.dependent):
        out[c.base + int(j)] = c.ny + k
    return out


def chain_between(model: Any, one: int, other: int) -> Chain:
    """From the frame of joint ``one`` to that of joint ``other``; 0: the world."""
    up_one, up_other = list(model.supports[one]), list(model.supports[other])
    shared = max(j for j in up_one if j in up_other)
    if other == 0:
        shared = 0
    place, columns, signs, turns, places = pin.SE3.Identity(), [], [], [], []
    base = False
    for j in reversed([j for j in up_other if j > shared]):
        turn, axis, revolute = _joint(model, j)
        places.append(place * axis)
        columns.append(turn)
        signs.append(-1.0)
        turns.append(revolute)
        place = axis.inverse() * model.jointPlacements[j].inverse()
    for j in [j for j in up_one if j > shared]:
        if model.joints[j].nv == 6:  # position, and angles about z, y and x in turn
            base, place = True, place * model.jointPlacements[j]
            for column, direction in ((5, [0, 0, 1]), (4, [0, 1, 0]), (3, [1, 0, 0])):
                axis = _turned(np.array(direction, dtype=float))
                places.append(place * axis)
                columns.append(column)
                signs.append(1.0)
                turns.append(1.0)
                place = axis.inverse()
            continue
        turn, axis, revolute = _joint(model, j)
        places.append(place * model.jointPlacements[j] * axis)
        columns.append(turn)
        signs.append(1.0)
        turns.append(revolute)
        place = axis.inverse()
    return Chain(tuple(columns), tuple(signs), tuple(turns), (*places, place), base)


_chains: WeakKeyDictionary[Robot, dict[tuple[int, int], Chain]] = WeakKeyDictionary()


def _chain(robot: Robot, one: int, other: int) -> Chain:
    """`chain_between`, found once for a robot: hundreds of pairs have one, in every program anew."""
    known = _chains.setdefault(robot, {})
    if (one, other) not in known:
        known[one, other] = chain_between(robot.model, one, other)
    return known[one, other]


def _joint(model: Any, j: int) -> tuple[int, Any, float]:
    """Column, placement whose z axis is the joint's, and whether it turns."""
    data = model.joints[j].createData()
    model.joints[j].calc(data, pin.neutral(model))
    subspace = np.asarray(data.S).reshape(6)
    revolute = bool(np.any(subspace[3:]))
    return int(model.joints[j].idx_v), _turned(subspace[3:] if revolute else subspace[:3]), float(revolute)


def _turned(direction: Array) -> Any:
    """A placement at the origin whose z axis has this direction."""
    up = np.array([0.0, 0.0, 1.0])
    if np.abs(direction + up).max() < 1e-8:
        return pin.SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return pin.SE3(pin.Quaternion.FromTwoVectors(up, direction).matrix(), np.zeros(3))


# ---- functions


def _chained(n: int, points: list[Any]) -> tuple[list[Any], list[Any], list[Any]]:
    """z and p of a chain of n joints, and where it takes points (SX)."""
    shift, angle = ca.SX.sym("t", 3), ca.SX.sym("q", n)
    places = ca.SX.sym("places", 12 * (n + 1))
    turns = ca.SX.sym("turns", n)
    found = []
    for x in points:
        at = _moved(places, n, x)
        for k in reversed(range(n)):
            cosine, sine = ca.cos(turns[k] * angle[k]), ca.sin(turns[k] * angle[k])
            at = ca.vertcat(
                cosine * at[0] - sine * at[1],
                sine * at[0] + cosine * at[1],
                at[2] + (1 - turns[k]) * angle[k],
            )
            at = _moved(places, k, at)
        found.append(shift + at)
    return [shift, angle], [places, turns], found


def _moved(places: Any, k: int, x: Any) -> Any:
    rows = [places[12 * k + 3 * r : 12 * k + 3 * r + 3] for r in range(3)]
    return ca.vertcat(*[ca.dot(row, x) for row in rows]) + places[12 * k + 9 : 12 * k + 12]


def apart(n: int) -> BlockExpression:
    """A sphere and planes about a body, n joints apart.

    z = shift (3), joints (n);  p = the chain's; the sphere's centre (3) in its frame; normals (3 a plane) and
    offsets of the planes in theirs; R, radius and margin.  out = max_i (n_i . x - h_i) - R [m], rounded where
    planes meet: above it by at most `ROUND` / 2 for each time that their number can be halved.
    """
    a, reach = ca.SX.sym("a", 3), ca.SX.sym("R")
    normals, offsets = ca.SX.sym("n", 3 * PLANES), ca.SX.sym("h", PLANES)
    z, p, (found,) = _chained(n, [a])
    at = ca.SX.sym("at", 3)
    far = [ca.dot(normals[3 * k : 3 * k + 3], at) - offsets[k] for k in range(PLANES)]
    while len(far) > 1:
        far = [_larger(one, two) for one, two in zip(far[::2], far[1::2], strict=True)]
    return make_block(z, [*p, a, normals, offsets, reach], {"gap": far[0] - reach}, [(at, found)])


def _larger(a: Any, b: Any) -> Any:
    """The larger of two lengths, rounded."""
    return (a + b + ca.sqrt((a - b) ** 2 + ROUND**2)) / 2


def apart_groups() -> list[FunctionGroup]:
    """What is compiled for all rows: the same for every robot."""
    out: list[FunctionGroup] = []
    for n in LENGTHS:
        name = f"apart{n}"

        def functions(name: str = name, n: int = n) -> list[Any]:
            b = apart(n)
            return in_lanes(derivative_functions(name, b.z, b.p, b.out, b.through), b.lanes)

        out.append(FunctionGroup(name=name, recipe=(name,), build=functions))
    return out


# ---- rows


class ApartRow(NamedTuple):
    """What one row keeps apart at one place: its name.

    place : of the program.  joint : of the link, a sphere of which is kept out.  other : joint of the other
    link; or -1 - the index of a body of the world.  number : of rows for the same two there.
    """

    place: str
    joint: int
    other: int
    number: int = 0


class Held(NamedTuple):
    """How a row keeps them apart.

    centre (3) [m] : of the sphere, in the joint's frame.  reach [m] : its radius and the margin.
    facing (4) : normal and offset [m] of a plane, in the other's frame, in place of that of its planes that
    is most like it; None: those.  travel [m] : of the target, if the other moves with it.
    """

    centre: tuple[float, ...]
    reach: float
    facing: tuple[float, ...] | None = None
    travel: float = 0.0


def add_apart_rows(
    b: Builder, spots: Sequence[tuple[Place, list[Affine]]], rows: Mapping[ApartRow, Held]
) -> None:
    """Blocks and rows for these.  spots : places of a program, with coordinates and legs."""
    if not rows:
        return
    bodies, links = b.problem.bodies, b.problem.bodies.links
    spot_of = {place.name: k for k, (place, _) in enumerate(spots)}
    width = b.ny + b.nl
    everywhere = stack([part for _, slots in spots for part in slots])
    coordinates, constants = everywhere.matrix(b.layout.n), everywhere.const
    chains: dict[tuple[int, int], tuple[Chain, Any]] = {}
    names: dict[tuple[int, int], str] = {}
    groups: dict[str, _Group] = {}
    for row, held in rows.items():
        body = bodies.world[-1 - row.other] if row.other < 0 else None
        if (row.joint, row.other) not in chains:
            chain = _chain(b.robot, row.joint, max(row.other, 0))
            pattern = chain.pattern(b.coordinates, None if body is None else body.rotation)
            chains[row.joint, row.other] = chain, pattern
            names[row.joint, row.other] = " and ".join(bodies.names((row.joint, row.other)))
        chain, pattern = chains[row.joint, row.other]
        before = None
        if body is not None:
            shift = held.travel * bodies.normal * body.moves
            before = pin.SE3(body.rotation, body.place + shift).inverse()
        planes = (links.planes[row.other] if body is None else body.planes).with_facing(held.facing)
        name = f"apart{chain.length}"
        if name not in groups:
            groups[name] = _Group(chain.length + 3)
        group = groups[name]
        group.rows.append(row)
        group.patterns.append(pattern)
        group.spots.append(spot_of[row.place])
        group.numbers.append(np.concatenate([chain.numbers(before), held.centre, planes, [held.reach]]))
    for name, group in groups.items():
        counts = [len(slots) for slots, _, _ in group.patterns]
        slots, columns, factors = (np.concatenate([p[k] for p in group.patterns]) for k in range(3))
        instance = np.repeat(np.arange(len(counts)), counts)
        at = np.repeat(group.spots, counts) * width + columns
        shape = len(counts) * group.size, len(constants)
        chosen = sp.csr_array((factors, (instance * group.size + slots, at)), shape=shape)
        lift = Affine.of_matrix(chosen @ coordinates, chosen @ constants)
        first = b.add_lifted(name, lift, len(counts), np.array(group.numbers))
        origins = [
            Row(
                (SelfCollision if row.other >= 0 else KeepOut).name,
                spots[spot][0],
                names[row.joint, row.other],
                TOO_NEAR,
            )
            for row, spot in zip(group.rows, group.spots, strict=True)
        ]
        b.rows.add_each(origins, outputs=first + np.arange(len(counts)), lower=0.0)


def move_apart(problem: ImpactProblem, blocks: Sequence[Block], rows: Mapping[ApartRow, Held]) -> None:
    """Blocks of these rows with the world's bodies where this problem has them; none is turned."""
    of_name = {block.name: block for block in blocks}
    numbers = {name: block.parameters.copy() for name, block in of_name.items()}
    seen = dict.fromkeys(of_name, 0)
    for row, held in rows.items():
        chain = _chain(problem.robot, row.joint, max(row.other, 0))
        name = f"apart{chain.length}"
        if row.other < 0:
            placed = chain.places[0]
            body, normal = problem.bodies.world[-1 - row.other], problem.bodies.normal
            at = pin.SE3(body.rotation, body.place + held.travel * normal * body.moves)
            numbers[name][seen[name], :12] = _placement(at.inverse() * placed)
        seen[name] += 1
    for name, block in of_name.items():
        block.take_parameters(numbers[name])


@dataclass(frozen=True)
class _Group:
    """Rows of one function of z (size,), with how that comes from the coordinates at each one's spot."""

    size: int
    rows: list[ApartRow] = field(default_factory=list)
    patterns: list[tuple[Array, Array, Array]] = field(default_factory=list)
    spots: list[int] = field(default_factory=list)
    numbers: list[Array] = field(default_factory=list)
