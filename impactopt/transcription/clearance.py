"""Clearance constraints between bodies: one for a pair of convex pieces at a place, their smooth distance.

The distance is `impactopt.bodies.separation`'s; here is what it is a function of. Between two links that is a
chain of turns about z axes with fixed placements between, which are its parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
import scipy.sparse as sp

from impactopt.bodies.separation import Separations
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.robots.couplings import Axis, axis_of
from impactopt.robots.robot import Robot
from impactopt.transcription.batched import Block
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Array, Index, Place, Row, millimetres, stack

TOO_NEAR = millimetres("too near")


@dataclass(frozen=True)
class Chain:
    """Kinematic chain between the frames of two bodies, joint by joint.

    columns (n,) : the joints' places among base coordinates and joints (nv), with their ``ratios``:
    -1 on the way to the root, else 1, times a follower's to its leader.
    turns (n,) : 1 for a joint that turns, 0 for one that slides.  places : n + 1 placements between them
    (pin.SE3).
    base : whether the base's position comes before all that.
    """

    columns: tuple[int, ...]
    ratios: tuple[float, ...]
    turns: tuple[float, ...]
    places: tuple[Any, ...]
    base: bool = False

    def numbers(self, before: Any = None) -> Array:
        """The chain's part of a constraint's parameters; ``before``: a placement in front (pin.SE3)."""
        if before is None:
            return self._numbers
        out = self._numbers.copy()
        out[:12] = _placement(before * self.places[0])
        return out

    @cached_property
    def _numbers(self) -> Array:
        """Thousands of constraints have the same."""
        return np.concatenate([*map(_placement, self.places), self.turns])

    def pattern(self, c: StanceCoordinates, rotation: Array | None = None) -> tuple[Index, Index, Array]:
        """z of a constraint's function, sums of coordinates: slots, coordinates (y, then legs) and factors,
        (k,) each.

        rotation : axes, as columns, of the box that the chain ends at.
        """
        where = _places(c)
        slots = [3 + k for k in range(len(self.columns))]
        coordinates, factors = [where[k] for k in self.columns], list(self.ratios)
        if self.base and rotation is not None:
            for i in range(3):
                slots += [i] * 3
                coordinates += [0, 1, 2]
                factors += [float(rotation[j, i]) for j in range(3)]
        return np.array(slots, dtype=np.intp), np.array(coordinates, dtype=np.intp), np.array(factors)


def _placement(m: Any) -> Array:
    """Rotation by rows, and translation [m] (12)."""
    return np.concatenate([np.asarray(m.rotation).ravel(), m.translation])


def _places(c: StanceCoordinates) -> list[int]:
    """Index of each base coordinate and joint (nv) in y followed by legs."""
    out = [*range(c.base)] + [0] * c.robot.n
    for k, j in enumerate(c.independent):
        out[c.base + int(j)] = c.base + k
    for k, j in enumerate(c.dependent):
        out[c.base + int(j)] = c.ny + k
    return out


def chain_between(model: Any, one: int, other: int) -> Chain:
    """Chain between the frames of joints ``one`` and ``other``; 0: the world."""
    up_one, up_other = list(model.supports[one]), list(model.supports[other])
    shared = max(j for j in up_one if j in up_other)
    if other == 0:
        shared = 0
    place, columns, ratios, turns, places = pin.SE3.Identity(), [], [], [], []
    base = False
    for j in reversed([j for j in up_other if j > shared]):
        joint = axis_of(model, j)
        axis, revolute = _axis_to_z(joint)
        places.append(place * axis)
        columns.append(int(model.joints[j].idx_v))
        ratios.append(-joint.ratio)
        turns.append(revolute)
        place = axis.inverse() * joint.placement.inverse()
    for j in [j for j in up_one if j > shared]:
        if model.joints[j].nv == 6:  # position, and angles about z, y and x in turn
            base, place = True, place * model.jointPlacements[j]
            for column, direction in ((5, [0, 0, 1]), (4, [0, 1, 0]), (3, [1, 0, 0])):
                axis = _turned(np.array(direction, dtype=float))
                places.append(place * axis)
                columns.append(column)
                ratios.append(1.0)
                turns.append(1.0)
                place = axis.inverse()
            continue
        joint = axis_of(model, j)
        axis, revolute = _axis_to_z(joint)
        places.append(place * joint.placement * axis)
        columns.append(int(model.joints[j].idx_v))
        ratios.append(joint.ratio)
        turns.append(revolute)
        place = axis.inverse()
    return Chain(tuple(columns), tuple(ratios), tuple(turns), (*places, place), base)


_chains: WeakKeyDictionary[Robot, dict[tuple[int, int], Chain]] = WeakKeyDictionary()


def _chain(robot: Robot, one: int, other: int) -> Chain:
    """`chain_between`, found once for a robot: hundreds of pairs have one, in every program anew."""
    known = _chains.setdefault(robot, {})
    if (one, other) not in known:
        known[one, other] = chain_between(robot.model, one, other)
    return known[one, other]


def _axis_to_z(joint: Axis) -> tuple[Any, float]:
    """Placement whose z axis is the joint's, and whether it turns."""
    revolute = bool(np.any(joint.subspace[3:]))
    return _turned(joint.subspace[3:] if revolute else joint.subspace[:3]), float(revolute)


def _turned(direction: Array) -> Any:
    """A placement at the origin whose z axis has this direction."""
    up = np.array([0.0, 0.0, 1.0])
    if np.abs(direction + up).max() < 1e-8:
        return pin.SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return pin.SE3(pin.Quaternion.FromTwoVectors(up, direction).matrix(), np.zeros(3))


# ---- functions


class SeparationPart:
    """Values (``what`` = 0), gradients (1) or Hessians (2) of a block, as `BatchedFunction`."""

    def __init__(self, of: Separations, what: int, width: int) -> None:
        self._of, self._what, self._width = of, what, width
        self.inputs = [np.zeros(0), of.numbers]
        self.write_to(np.zeros(self.size))

    @property
    def size(self) -> int:
        """Numbers that a call writes."""
        return self._of.count * self._width

    def write_to(self, numbers: Array) -> None:
        """Sets the array (size,) that later calls write to."""
        self.output = numbers.reshape(self._of.count, self._width)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        """Rows are instances: z (count, n_z) -> (count, numbers of each), overwritten by the next call."""
        self._of.write(self._what, z, self.output, multipliers)
        return self.output


@dataclass
class SeparationBlock(Block):
    """Distances of pairs of pieces, with derivatives by `Separations`."""

    of: Separations

    @classmethod
    def of_separations(cls, name: str, of: Separations, lift: Affine) -> SeparationBlock:
        """Block of separations with the z of all instances as one expression."""
        size = of.joints + 3
        everything = np.arange(size)
        columns, rows = np.triu_indices(size)  # of a lower triangle, column by column
        parts: list[Any] = [
            SeparationPart(of, what, width) for what, width in enumerate((1, size, len(rows)))
        ]
        return cls(
            name=name,
            value=parts[0],
            jacobian=parts[1],
            hessian=parts[2],
            n_in=size,
            n_out=1,
            count=of.count,
            lift=lift,
            jac_pattern=(np.zeros_like(everything), everything),
            hess_pattern=(rows, columns),
            of=of,
        )

    def take_parameters(self, parameters: Array) -> None:
        self.of.numbers[...] = parameters
        self.of.forget()

    def copy(self) -> Block:
        made = SeparationBlock.of_separations(self.name, self.of.copy(), self.lift)
        return replace(made, jac_pattern=self.jac_pattern, hess_pattern=self.hess_pattern)


# ---- constraints


class ApartRow(NamedTuple):
    """Key of a clearance constraint: node and pair of convex pieces.

    place : of the program.  joint : of the link.  other : joint of the other link; or -1 - the index of a
    body of the world.  number : of the two pieces among those of these two bodies.
    """

    place: str
    joint: int
    other: int
    number: int = 0


class Held(NamedTuple):
    """Separating direction and distance of a clearance constraint.

    way (3) : direction from the other to the one in the other's frame, near which they are apart.
    reach [m] : how far.  travel [m] : of the target, if the other moves with it.
    """

    way: tuple[float, ...]
    reach: float
    travel: float = 0.0


def add_apart_rows(
    b: Builder, spots: Sequence[tuple[Place, list[Affine]]], rows: Mapping[ApartRow, Held]
) -> list[ApartRow]:
    """Blocks and constraints for these, and their names in the order of the program's constraints.

    spots : places of a program, with coordinates and legs.
    """
    if not rows:
        return []
    bodies, shapes = b.problem.bodies, b.problem.bodies.shapes
    spot_of = {place.name: k for k, (place, _) in enumerate(spots)}
    width = b.ny + b.nl
    everywhere = stack([part for _, slots in spots for part in slots])
    coordinates, constants = everywhere.matrix(b.layout.n), everywhere.const
    known: dict[tuple[int, int], _Known] = {}
    groups: dict[int, _Group] = {}
    for row, held in rows.items():
        body = bodies.world[-1 - row.other] if row.other < 0 else None
        pair = row.joint, row.other
        if pair not in known:
            chain = _chain(b.robot, row.joint, max(row.other, 0))
            pattern = chain.pattern(b.coordinates, None if body is None else body.rotation)
            known[pair] = _Known(chain, pattern, " and ".join(bodies.names(pair)))
        chain, pattern, name = known[pair]
        before = None
        if body is not None:
            shift = held.travel * bodies.normal * body.moves
            before = pin.SE3(body.rotation, body.place + shift).inverse()
        n = shapes.index[row.joint, row.other, row.number]
        group = groups.setdefault(len(chain.columns), _Group())
        group.names.append(row)
        group.pairs.append(n)
        group.ways.append(held.way)
        group.patterns.append(pattern)
        group.spots.append(spot_of[row.place])
        group.numbers.append(np.append(chain.numbers(before), held.reach + shapes.radius[n]))
        term = (SelfCollision if row.other >= 0 else KeepOut).name
        # pieces of the same two bodies have names of their own, as multipliers go by them
        piece = f"{name} {row.number + 1}" if row.number else name
        group.origins.append(Row(term, spots[spot_of[row.place]][0], piece, TOO_NEAR, whole=name))
    for length, group in groups.items():
        size, count = length + 3, len(group.pairs)
        counts = [len(slots) for slots, _, _ in group.patterns]
        slots, columns, factors = (np.concatenate([p[k] for p in group.patterns]) for k in range(3))
        instance = np.repeat(np.arange(count), counts)
        at = np.repeat(group.spots, counts) * width + columns
        chosen = sp.csr_array((factors, (instance * size + slots, at)), shape=(count * size, len(constants)))
        of = Separations(
            shapes, length, np.array(group.pairs), np.array(group.numbers), np.array(group.ways, dtype=float)
        )
        lift = Affine.of_matrix(chosen @ coordinates, chosen @ constants)
        first = b.append(SeparationBlock.of_separations(f"apart{length}", of, lift))
        b.rows.add_each(group.origins, outputs=first + np.arange(count), lower=0.0)
    return [name for group in groups.values() for name in group.names]


def coupled(matrix: Any, spots: Sequence[tuple[Place, list[Affine]]]) -> sp.csc_array:
    """A matrix (n, n) with room, as zeros, for what the coordinates and legs of any place couple."""
    own = sp.coo_array(matrix)
    rows, columns, values = [own.coords[0]], [own.coords[1]], [own.data]
    for _, slots in spots:
        touched = np.unique(stack(slots).cols)
        rows.append(np.repeat(touched, len(touched)))
        columns.append(np.tile(touched, len(touched)))
        values.append(np.zeros(len(touched) ** 2))
    at = np.concatenate(rows), np.concatenate(columns)
    return sp.csc_array(sp.coo_array((np.concatenate(values), at), shape=matrix.shape))


def move_apart(problem: ImpactProblem, blocks: Sequence[Block], rows: Mapping[ApartRow, Held]) -> None:
    """Blocks of these constraints with the world's bodies where this problem has them; none is turned."""
    of_name = {block.name: block for block in blocks}
    numbers = {name: block.parameters.copy() for name, block in of_name.items()}
    seen = dict.fromkeys(of_name, 0)
    for row, held in rows.items():
        chain = _chain(problem.robot, row.joint, max(row.other, 0))
        name = f"apart{len(chain.columns)}"
        if row.other < 0:
            placed = chain.places[0]
            body, normal = problem.bodies.world[-1 - row.other], problem.bodies.normal
            at = pin.SE3(body.rotation, body.place + held.travel * normal * body.moves)
            numbers[name][seen[name], :12] = _placement(at.inverse() * placed)
        seen[name] += 1
    for name, block in of_name.items():
        block.take_parameters(numbers[name])


class _Known(NamedTuple):
    """Data that all constraints of a pair of bodies share."""

    chain: Chain
    pattern: tuple[Index, Index, Array]
    name: str


@dataclass(frozen=True)
class _Group:
    """Constraints whose chains have as many joints, with how z comes from the coordinates at each one's
    spot.
    """

    names: list[ApartRow] = field(default_factory=list)
    pairs: list[int] = field(default_factory=list)
    ways: list[tuple[float, ...]] = field(default_factory=list)
    origins: list[Row] = field(default_factory=list)
    patterns: list[tuple[Index, Index, Array]] = field(default_factory=list)
    spots: list[int] = field(default_factory=list)
    numbers: list[Array] = field(default_factory=list)
