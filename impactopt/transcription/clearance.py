"""Clearance constraints between bodies: the smooth distance of a pair of convex pieces at a node.

`impactopt.bodies.separation` has the distance as a function of the joints between the two bodies: a kinematic
chain of rotations about z axes, or translations along them. The fixed placements between the joints are
parameters. This module finds the chains, and adds blocks and constraints to a program.

The constraints depend on the displacement of the expected target from its place at contact: the harder the
blow, the farther the target is from the follow-through. Displacements are variables: each is base + T v, with
another displacement as its base, and a mean velocity v over a time T. The first ones are at the ends of the
contact's phases. After contact a free target keeps its last velocity.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import pinocchio as pin
import scipy.sparse as sp

from impactopt.arrays import Array, Index
from impactopt.bodies.separation import Separations
from impactopt.bodies.world import WorldBody
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.problem.violation import Place, millimetres
from impactopt.robots.model import Axis, axis_of
from impactopt.robots.robot import Robot
from impactopt.transcription.builder import Block, Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.frozen_collision import InstantImpact
from impactopt.transcription.layout import Affine, ConstraintOrigin, Group, stack

TOO_NEAR = millimetres("too near")
DISPLACEMENT = "displacement of the target"
# [m] Unit of displacements as variables. An error of an early step, of a metre, must not outweigh all other
# constraints.
_DISPLACEMENT_UNIT = 10.0


@dataclass(frozen=True)
class Chain:
    """Kinematic chain of n joints from the frame of one body to that of another.

    columns : index of each joint among base coordinates and joints (nv).
    ratios : factor on each joint's coordinate: -1 towards the root, else 1, times a follower's ratio to its
        leader.
    revolute : 1 for a revolute joint, 0 for a prismatic one.
    placements : n + 1 placements (pin.SE3) before, between and after the joints.
    base : the position of the floating base comes before all joints.
    """

    columns: tuple[int, ...]
    ratios: tuple[float, ...]
    revolute: tuple[float, ...]
    placements: tuple[Any, ...]
    base: bool = False

    def parameters(self, before: Any = None) -> Array:
        """Parameters of the chain in a constraint.  before : a placement (pin.SE3) in front of the chain."""
        if before is None:
            return self._parameters
        out = self._parameters.copy()
        out[:12] = _placement(before * self.placements[0])
        return out

    @cached_property
    def _parameters(self) -> Array:
        # cached, as thousands of constraints have the same
        return np.concatenate([*map(_placement, self.placements), self.revolute])

    def pattern(self, c: StanceCoordinates, body: WorldBody | None = None) -> tuple[Index, Index, Array]:
        """z of a constraint as sums: indices in z, indices in (y, legs, displacement), factors; (k,) each.

        z = position of the base, less the displacement of the target if the other body moves with it, in the
        axes of the other body (3); coordinates of the joints (n,).

        body : of the world, that the chain begins at.
        """
        # Sums, as the base's position is turned into the other body's axes: R' p has three terms a component.
        # Links of one robot do not need it: the base moves both.
        index = _coordinate_indices(c)
        slots = [3 + k for k in range(len(self.columns))]
        coordinates, factors = [index[k] for k in self.columns], list(self.ratios)
        if body is not None:
            moved = c.ny + len(c.dependent)
            for first, sign in ((0, float(self.base)), (moved, -float(body.moves))):
                for i in range(3 if sign else 0):
                    slots += [i] * 3
                    coordinates += [first, first + 1, first + 2]
                    factors += [sign * float(body.rotation[j, i]) for j in range(3)]
        return np.array(slots, dtype=np.intp), np.array(coordinates, dtype=np.intp), np.array(factors)


def _placed(body: WorldBody) -> Any:
    """Placement (pin.SE3) of a body of the world, which its target moves in z (`Chain.pattern`)."""
    return pin.SE3(body.rotation, body.place)


def _placement(m: Any) -> Array:
    """Rotation matrix, row by row, and translation [m]: (12,)."""
    return np.concatenate([np.asarray(m.rotation).ravel(), m.translation])


def _coordinate_indices(c: StanceCoordinates) -> list[int]:
    """Index of each base coordinate and joint (nv) in (y, legs)."""
    out = [*range(c.base)] + [0] * c.robot.n
    for k, j in enumerate(c.independent):
        out[c.base + int(j)] = c.base + k
    for k, j in enumerate(c.dependent):
        out[c.base + int(j)] = c.ny + k
    return out


def chain_between(model: Any, one: int, other: int) -> Chain:
    """Chain from the frame of joint ``other`` to that of ``one``; 0: the world."""
    # Pinocchio numbers joints from the root outwards, so the largest number that both have is the nearest
    # common ancestor; 0, the world, is in all lists.
    up_one, up_other = list(model.supports[one]), list(model.supports[other])
    shared = max(j for j in up_one if j in up_other)  # lowest common ancestor
    # The chain goes up from the other body to the common ancestor, and down to the one. `place` collects the
    # fixed placements until the next joint.
    place, placements, base = pin.SE3.Identity(), [], False
    joints: list[tuple[int, float, float]] = []  # column, ratio, 1 if it is revolute
    # Upwards each joint is passed from its child side: its axis placement, minus its coordinate (the ratio
    # -1), and the inverse of what comes before the joint downwards.
    for j in reversed([j for j in up_other if j > shared]):
        joint = axis_of(model, j)
        axis, revolute = _axis_to_z(joint)
        placements.append(place * axis)
        joints.append((int(model.joints[j].idx_v), -joint.ratio, revolute))
        place = axis.inverse() * joint.placement.inverse()
    for j in [j for j in up_one if j > shared]:
        if model.joints[j].nv == 6:  # floating base: position, and yaw, pitch, roll in turn
            base, place = True, place * model.jointPlacements[j]
            # R = Rz(yaw) Ry(pitch) Rx(roll), so the chain turns by yaw first; columns are of y = (p, roll,
            # pitch, yaw)
            for column, direction in ((5, [0, 0, 1]), (4, [0, 1, 0]), (3, [1, 0, 0])):
                axis = _turned(np.array(direction, dtype=float))
                placements.append(place * axis)
                joints.append((column, 1.0, 1.0))
                place = axis.inverse()
            continue
        joint = axis_of(model, j)
        axis, revolute = _axis_to_z(joint)
        placements.append(place * joint.placement * axis)
        joints.append((int(model.joints[j].idx_v), joint.ratio, revolute))
        place = axis.inverse()
    columns, ratios, revolutes = zip(*joints, strict=True) if joints else ((), (), ())
    return Chain(columns, ratios, revolutes, (*placements, place), base)


_chains: WeakKeyDictionary[Robot, dict[tuple[int, int], Chain]] = WeakKeyDictionary()


def _chain(robot: Robot, one: int, other: int) -> Chain:
    """`chain_between`, cached for each robot: hundreds of pairs in every program have the same."""
    known = _chains.setdefault(robot, {})
    if (one, other) not in known:
        known[one, other] = chain_between(robot.model, one, other)
    return known[one, other]


def _axis_to_z(joint: Axis) -> tuple[Any, float]:
    """Placement whose z axis is the joint's axis; 1 for a revolute joint, else 0."""
    revolute = bool(np.any(joint.subspace[3:]))
    return _turned(joint.subspace[3:] if revolute else joint.subspace[:3]), float(revolute)


def _turned(direction: Array) -> Any:
    """Placement at the origin whose z axis has this direction."""
    up = np.array([0.0, 0.0, 1.0])
    # opposite vectors do not determine the axis of their rotation: half a turn about x
    if np.abs(direction + up).max() < 1e-8:
        return pin.SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return pin.SE3(pin.Quaternion.FromTwoVectors(up, direction).matrix(), np.zeros(3))


# ---- functions


class SeparationPart:
    """Values, gradients or Hessians of a block of separations, with the interface of `BatchedFunction`.

    order : of the derivative: 0, 1 or 2.  width : numbers of an instance.
    """

    def __init__(self, of: Separations, order: int, width: int) -> None:
        self._of, self._order, self._width = of, order, width
        self.inputs = [np.zeros(0), of.numbers]
        self.write_to(np.zeros(self.size))

    @property
    def size(self) -> int:
        """Length of the array that a call writes."""
        return self._of.count * self._width

    def write_to(self, numbers: Array) -> None:
        """Sets the array (size,) that later calls write to."""
        self.output = numbers.reshape(self._of.count, self._width)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        """Result (count, width) for z (count, n_z), which the next call overwrites."""
        self._of.write(self._order, z, self.output, multipliers)
        return self.output


@dataclass
class SeparationBlock(Block):
    """Block of distances of pairs of convex pieces, with derivatives by `Separations`."""

    of: Separations

    @classmethod
    def of_separations(cls, name: str, of: Separations, lift: Affine) -> SeparationBlock:
        """Block of separations with z of all instances as one expression."""
        size = of.joints + 3
        everything = np.arange(size)
        columns, rows = np.triu_indices(size)  # lower triangle, column by column
        parts: list[Any] = [
            SeparationPart(of, order, width) for order, width in enumerate((1, size, len(rows)))
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
        # in place, as the functions' inputs are this array
        self.of.numbers[...] = parameters
        self.of.forget()

    def copy(self) -> Block:
        made = SeparationBlock.of_separations(self.name, self.of.copy(), self.lift)
        return replace(made, jac_pattern=self.jac_pattern, hess_pattern=self.hess_pattern)


# ---- constraints


class ClearanceKey(NamedTuple):
    """Key of a clearance constraint: a node and a pair of convex pieces.

    place : name of the node.
    joint : of the link.
    other : joint of the other link, or -1 - index of a body of the world.
    number : index of the pair of pieces among those of the two bodies.
    """

    place: str
    joint: int
    other: int
    number: int = 0


class SeparatingDirection(NamedTuple):
    """Direction and least distance of a clearance constraint.

    vector (3) : unit vector from the other body to the link, in the other's frame. The maximization of the
        separation starts there.
    least_distance : [m].
    """

    vector: tuple[float, ...]
    least_distance: float


def add_clearance_constraints(
    b: Builder,
    spots: Sequence[tuple[Place, list[Affine]]],
    displacements: Sequence[Affine],
    constraints: Mapping[ClearanceKey, SeparatingDirection],
) -> list[ClearanceKey]:
    """Add blocks and constraints; returns the keys in the order of the program's constraints.

    spots : nodes of the program, with coordinates and legs.
    displacements : of the target in the world (3,) [m] there.
    """
    if not constraints:
        return []
    bodies, shapes = b.problem.bodies, b.problem.bodies.shapes
    spot_of = {place.name: k for k, (place, _) in enumerate(spots)}
    width = b.ny + b.nl + 3
    # All nodes' (y, legs, displacement) as one sparse matrix, of which a product with a selection takes the z
    # of all constraints at once.
    everywhere = stack(
        [part for (_, slots), moved in zip(spots, displacements, strict=True) for part in (*slots, moved)]
    )
    coordinates, constants, radius = everywhere.matrix(b.layout.n), everywhere.const, shapes.radius.tolist()
    known: dict[tuple[int, int], tuple[Chain, tuple[Index, Index, Array], str]] = {}
    groups: dict[int, list[tuple[Any, ...]]] = {}  # constraints by number of joints: a block has one
    for key, direction in constraints.items():
        body = bodies.world[-1 - key.other] if key.other < 0 else None
        pair = key.joint, key.other
        if pair not in known:
            chain = _chain(b.robot, key.joint, max(key.other, 0))
            known[pair] = chain, chain.pattern(b.coordinates, body), " and ".join(bodies.names(pair))
        chain, pattern, name = known[pair]
        # distances are in the body's frame
        parameters = chain.parameters(None if body is None else _placed(body).inverse())
        n, spot = shapes.index[key.joint, key.other, key.number], spot_of[key.place]
        # capsules and spheres are their axes and centres, at a distance that is larger by their radius
        distance = direction.least_distance + radius[n]
        term = (SelfCollision if key.other >= 0 else KeepOut).name
        # each pair of pieces of two bodies has a name of its own, by which multipliers are mapped
        piece = f"{name} {key.number + 1}" if key.number else name
        origin = ConstraintOrigin(term, spots[spot][0], piece, TOO_NEAR, whole=name)
        group = groups.setdefault(len(chain.columns), [])
        group.append((key, n, direction.vector, origin, pattern, spot, parameters, distance))
    # z is a selection of the coordinates at all nodes, which are affine in the variables
    for length, group in groups.items():
        _, pairs, vectors, origins, patterns, nodes, numbers, distances = zip(*group, strict=True)
        size, count = length + 3, len(pairs)
        counts = [len(slots) for slots, _, _ in patterns]
        slots, columns, factors = (np.concatenate([p[k] for p in patterns]) for k in range(3))
        instance = np.repeat(np.arange(count), counts)
        # rows of `coordinates`: (y, legs, displacement) of one node after the other, `width` each
        at = np.repeat(nodes, counts) * width + columns
        chosen = sp.csr_array((factors, (instance * size + slots, at)), shape=(count * size, len(constants)))
        chains = np.column_stack([np.array(numbers), distances])
        of = Separations(shapes, length, np.array(pairs), chains, np.array(vectors, dtype=float))
        lift = Affine.of_matrix(chosen @ coordinates, chosen @ constants)
        first = b.append(SeparationBlock.of_separations(f"apart{length}", of, lift))
        b.constraints.add_each(origins, outputs=first + np.arange(count), lower=0.0)
    return [constraint[0] for group in groups.values() for constraint in group]


def coupled(
    matrix: Any, spots: Sequence[tuple[Place, list[Affine]]], displacements: Sequence[Affine]
) -> sp.csc_array:
    """Matrix (n, n) with explicit zeros wherever clearance constraints may couple variables.

    They couple the variables of coordinates, legs and displacement at each node of ``spots``. So the
    structure of the Hessian does not depend on which constraints there are.
    """
    own = sp.coo_array(matrix)
    rows, columns, values = [own.coords[0]], [own.coords[1]], [own.data]
    for (_, slots), moved in zip(spots, displacements, strict=True):
        # a dense square of each node's variables: any pair of bodies may get a constraint there in a later
        # round
        touched = np.unique(stack([*slots, moved]).cols)
        rows.append(np.repeat(touched, len(touched)))
        columns.append(np.tile(touched, len(touched)))
        values.append(np.zeros(len(touched) ** 2))
    at = np.concatenate(rows), np.concatenate(columns)
    return sp.csc_array(sp.coo_array((np.concatenate(values), at), shape=matrix.shape))


def move_bodies(
    problem: ImpactProblem,
    blocks: Sequence[Block],
    constraints: Iterable[ClearanceKey],
) -> None:
    """Update the blocks of these constraints to a problem that has moved, but not rotated, bodies."""
    of_name = {block.name: block for block in blocks}
    parameters = {name: block.parameters.copy() for name, block in of_name.items()}
    # Constraints are in the order of `add_clearance_constraints`, so counting them by block finds the
    # instance.
    instance = dict.fromkeys(of_name, 0)
    for key in constraints:
        chain = _chain(problem.robot, key.joint, max(key.other, 0))
        name = f"apart{len(chain.columns)}"
        if key.other < 0:
            at = _placed(problem.bodies.world[-1 - key.other])
            parameters[name][instance[name], :12] = _placement(at.inverse() * chain.placements[0])
        instance[name] += 1
    for name, block in of_name.items():
        block.take_parameters(parameters[name])


@dataclass(frozen=True)
class _Sum:
    """Variables that equal base + T v.  step : of their elimination, as of `Builder.lifted`."""

    group: Group
    place: Place
    base: Affine
    T: Affine
    v: Affine
    step: int

    def slots(self) -> list[list[Affine]]:
        """Slots of the block ``link``, whose equation of position is base + T v for yf = 0."""
        zero, one, each = Affine.zeros(1), Affine.constant(1.0), range(self.group.size)
        parts = [(self.base[k : k + 1], self.v[k : k + 1]) for k in each]
        return [
            [zero, zero, one, -y, zero, one, self.T, zero, -v * (1 / _DISPLACEMENT_UNIT), zero, zero, zero]
            for y, v in parts
        ]


class TargetDisplacement:
    """Displacements (3,) [m] of the target in the world; zero if no body that is kept clear moves with it.

    The variables are along the normal and, if friction moves the target, across it.
    """

    def __init__(self, b: Builder, hit: Collision | InstantImpact) -> None:
        p = b.problem
        self._b, self._hit, self._sums = b, hit, list[_Sum]()
        moving = [body for body in p.bodies.world if body.moves] if p.keep_out.enabled else []
        self._moves = bool(moving)
        # a board is not there any more once contact begins
        self._moves_on = not all(body.before for body in moving)
        across = isinstance(hit, Collision) and hit.tangential.size > 0
        self._labels = ["along the normal", *(f"across it, {axis}" for axis in "xyz" * across)]
        self._axes: Array = _DISPLACEMENT_UNIT * np.column_stack([p.normal, np.eye(3)[:, : 3 * across]])
        self._ends: list[Affine] = []  # components at the ends of the contact's phases

    def before(self, remaining: Affine) -> Affine:
        """Displacement at this time [s] before contact."""
        speed = float(self._b.problem.target.speed_before()) if self._moves else 0.0
        return remaining.apply(-speed / _DISPLACEMENT_UNIT * self._axes[:, :1])

    def in_contact(self, stage: int, place: Place) -> Affine:
        """Displacement at a collocation point."""
        if not self._moves_on or not isinstance(self._hit, Collision):
            return Affine.zeros(3)
        base = self._end(self._hit.stages[stage].phase)
        return self._add(place, base, *self._hit.target_moved(stage)).apply(self._axes)

    def after(self, since: Affine | None, place: Place) -> Affine:
        """Displacement at this time [s] after contact; None: at its end."""
        if not self._moves_on:
            return Affine.zeros(3)
        base = self._end(len(self._hit.phases))
        if since is not None and not self._b.problem.target.stays:
            base = self._add(place, base, since, self._hit.target_velocity)
        return base.apply(self._axes)

    def add_constraints(self) -> None:
        """Add the constraints of all variables so far."""
        b = self._b
        instances = [slots for each in self._sums for slots in each.slots()]
        if not instances:
            return
        outputs = b.add_block("link", instances, np.zeros(0)) + 3 * np.arange(len(instances))
        outputs = outputs.reshape(len(self._sums), -1) + b.parts("link")["position"]
        for each, at in zip(self._sums, outputs, strict=True):
            far = millimetres("off", scale=_DISPLACEMENT_UNIT)
            b.equal(DISPLACEMENT, each.place, each.group.labels, at, far, affine=-each.group[0])
            b.lifted.append((each.group, at, each.step))

    def _end(self, phases: int) -> Affine:
        """Components after so many phases of the contact."""
        if not phases:
            return Affine.zeros(len(self._labels))
        while len(self._ends) < phases:
            assert isinstance(self._hit, Collision)
            k = len(self._ends)
            place = Place.plain(f"end of {self._hit.phases[k].name}")
            # other displacements begin at these, which are eliminated after them
            step = len(self._hit.phases) - k
            self._ends.append(self._add(place, self._end(k), *self._hit.target_moved(self._hit.end[k]), step))
        return self._ends[phases - 1]

    def _add(self, place: Place, base: Affine, T: Affine, v: Affine, step: int = 0) -> Affine:
        """Components base + T v, as variables."""
        name = f"{DISPLACEMENT}, {place.name}"
        group = self._b.layout.add(name, 1, base.size, labels=self._labels)
        self._sums.append(_Sum(group, place, base, T, v, step))
        return group[0]
