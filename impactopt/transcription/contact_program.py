"""Base class of the nonlinear programs that contain a contact phase."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.contact.fields import in_order
from impactopt.errors import InputError
from impactopt.problem.objectives import OBJECTIVES, PEAK_SCALE, Objective
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.problem.terms.base import kind_of
from impactopt.problem.violation import Measure, Place
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Block, Builder
from impactopt.transcription.clearance import (
    ClearanceKey,
    SeparatingDirection,
    TargetDisplacement,
    add_clearance_constraints,
    coupled,
    move_bodies,
)
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_blocks import DEPTH_SCALE
from impactopt.transcription.contact_set import ContactSet
from impactopt.transcription.contact_state import ContactEnd, DrivePoint, joint_motion_slots
from impactopt.transcription.frozen_collision import InstantImpact
from impactopt.transcription.layout import Affine, Constraints, Group, Layout, Turn, by_choice, determined
from impactopt.transcription.objective import Prices, Quantity, assemble, quantities
from impactopt.transcription.springs import SpringPoint, add_hinges, add_springs
from impactopt.transcription.structured import StructuredProgram

Program = TypeVar("Program", bound="ContactProgram")


class BodyState(NamedTuple):
    """Configuration of the robot at a node.

    phase : 0 before contact, 2 after it, 3 after a missed one.
    name : of the node.
    time : since the start [s].
    q : configuration (nq,).
    """

    phase: int
    name: str
    time: float
    q: Array


class ContactProgram(ABC):
    """Nonlinear program (NLP) with a contact; subclasses add the motion's other parts.

    A subclass builds its parts and calls :meth:`_finish`. Terms and objectives use the methods up to
    :meth:`squares`.

    Attributes
    ----------
    program : for a solver.
    builder : variables, blocks and constraints of all parts.
    hit : collisions with all targets.
    problem, coordinates, robot, functions, y0, legs0 : the builder's.
    angular_momentum : after contact, a group of three variables, if it is in the objective.
    objectives : of the problem, as far as this program has them, with their quantities.
    clearance_constraints : clearance constraints, in the program's order; they are its last constraints.
    displacements : of the target in the world (3,) [m], at each of `body_spots`.
    postures : of `strongest_posture` that are known, by seed; copies of the program share them.
    """

    program: StructuredProgram

    def __init__(self, builder: Builder, hit: ContactSet) -> None:
        self.builder, self.hit = builder, hit
        self.problem, self.coordinates, self.robot = builder.problem, builder.coordinates, builder.robot
        self.functions, self.y0, self.legs0 = builder.functions, builder.y0, builder.legs0
        self.angular_momentum: Group | None = None
        self.objectives: list[tuple[Objective, Quantity]] = []
        self.clearance_constraints: Mapping[ClearanceKey, SeparatingDirection] = {}
        self.postures: dict[int, Array] = {}
        # without clearance constraints, but with all their couplings; made when the first are added
        self._base: StructuredProgram | None = None

    # ------------------------------------------------------------------ for terms and objectives
    @property
    def layout(self) -> Layout:
        return self.builder.layout

    @property
    def constraints(self) -> Constraints:
        return self.builder.constraints

    @property
    def blocks(self) -> list[Block]:
        return self.builder.blocks

    def add_block(self, name: str, instances: list[Any], parameters: Array) -> int:
        """:meth:`impactopt.transcription.builder.Builder.add_block`."""
        return self.builder.add_block(name, instances, parameters)

    def lift(self, name: str, outputs: Index, **options: Any) -> Group:
        """:meth:`impactopt.transcription.builder.Builder.lift`."""
        return self.builder.lift(name, outputs, **options)

    def equal(
        self,
        term: str,
        place: Place | str,
        components: Sequence[str],
        outputs: Any,
        measure: Measure | Sequence[Measure] | None = None,
    ) -> None:
        """:meth:`impactopt.transcription.builder.Builder.equal`."""
        self.builder.equal(term, place, components, outputs, measure)

    @property
    def expected(self) -> Collision | InstantImpact:
        """The collision with the expected target."""
        return self.hit.expected

    @property
    def contact_state(self) -> tuple[Affine, Affine, Affine]:
        """y, y' and y'' at contact."""
        y, y1, y2, *_ = self.hit.contact.state
        return y, y1, y2

    @property
    def contact_T(self) -> Affine:
        """The duration [s] of the phase that `contact_state` is of, so that ydot = y'/T."""
        return self.hit.contact.state.T

    @property
    def contact_legs(self) -> Affine:
        """Legs at contact."""
        return self.hit.contact.state.legs

    @property
    def contact_w(self) -> Affine:
        """Sole wrenches at contact."""
        return self.hit.contact.state.w

    @property
    def feedforward(self) -> Group:
        """Feed-forward torques over limit (n,), constant during contact."""
        return self.hit.contact.feedforward

    @property
    def u0(self) -> Group:
        """Rate ydot (ny,) at contact."""
        return self.hit.contact.u0

    def drive_points(self) -> list[DrivePoint]:
        """Torques and motions of the joints at the nodes and at the collocation points of all collisions."""
        return self._points

    @cached_property
    def _points(self) -> list[DrivePoint]:
        nodes = [
            DrivePoint(place, torque, joint_motion_slots(y, y1, y2, T, legs))
            for place, torque, (y, y1, y2, legs, _, T) in self._nodes()
        ]
        return [*nodes, *self.hit.drives()]

    def wrenches(self) -> list[tuple[Place, Affine]]:
        """Wrenches on soles and supporting hands (6 each), at the nodes and at the collocation points of all
        collisions.
        """
        nodes = [(place, slots[4]) for place, slots in self._node_slots()]
        return [*nodes, *(found for collision in self.hit.lasting for found in collision.wrenches())]

    def positions_in_contact(self) -> list[tuple[Place, list[Affine]]]:
        """Slots y0, d1, T1, d, T of the coordinates y = y0 + T1 d1 + T d at the collocation points of the
        expected collision, where y0 is at contact; none for an impact without duration.
        """
        return self.expected.positions() if isinstance(self.expected, Collision) else []

    def first_instants(self) -> list[tuple[Place, Index]]:
        """First instants of damped contacts, if a term needs them.

        Place, and indices of the outputs (n,) that are -armature x acceleration over the torque limit. The
        torque there is `feedforward`.
        """
        return self.hit.first_instants()

    def contact_ends(self) -> list[ContactEnd]:
        """Joint motions before and after each collision."""
        return self.hit.contact_ends()

    def deepest_penetration(self) -> Affine:
        """Penetration [m] at the end of the expected target's compression, as a variable."""
        return self.lift("deepest penetration", self.hit.deepest)[0] * DEPTH_SCALE

    def target_energy(self) -> Affine:
        """Energy [J] of the target at separation, as a variable."""

        def parameters(problem: ImpactProblem) -> Array:
            return np.array(list(problem.target.parameters.values()))

        at = self.add_block("energy", [[self.expected.target_state]], parameters(self.problem))
        self.builder.follow(lambda b: b.block("energy").take_parameters(parameters(b.problem)))
        return self.lift("target energy", np.array([at]))[0]

    def peak_force(self) -> Affine:
        """Largest contact force [N] of the expected collision, as a variable."""
        assert isinstance(self.expected, Collision)
        forces = self.expected.f
        y, y1, _ = self.contact_state

        def parameters(problem: ImpactProblem) -> Array:
            before = float(problem.target.speed_before())
            return np.array([*problem.normal, *problem.law.parameters.values(), before])

        slots = [y, y1, self.contact_T, *(forces[i] for i in range(forces.count))]
        at = self.add_block("peak", [slots], parameters(self.problem))
        self.builder.follow(lambda b: b.block("peak").take_parameters(parameters(b.problem)))
        return self.lift("peak force", np.array([at]))[0] * PEAK_SCALE

    def squares(self, group: Group) -> Quantity:
        """Sum of the squares of a group's variables, in physical units."""
        return Quantity(Affine.zeros(1), group)

    # ------------------------------------------------------------------ the program
    def _finish(self, terms: tuple[Term, ...], objectives: tuple[Objective, ...]) -> None:
        """Add the constraints of springs, hinges and terms, and assemble the objective."""
        if self.builder.robot.sprung.any():
            add_springs(self.builder, self._spring_points(), self.hit.contact.gains[0])
        if self.builder.robot.hinges.any():
            add_hinges(self.builder, [(place, torque) for place, torque, _ in self._nodes()])
        # after the contact's constraints, which determine the target's motion
        displacement = TargetDisplacement(self.builder, self.expected)
        self.displacements = self._displacements(displacement)
        displacement.add_constraints()
        for term in terms:
            # the parts have the constraints of the other terms
            if type(term).add_constraints is not Term.add_constraints:
                since, before = len(self.constraints.origins), self.builder.n_outputs
                term.add_constraints(self)
                self.constraints.measured(since, term.name, term.unit)
                if not kind_of(term, Term).__module__.startswith("impactopt."):
                    self._check_own(type(term).__name__, since, before)
        # In the order of a problem file, as terms are.
        self.objectives = quantities(self, in_order(objectives, OBJECTIVES))
        self._objective = assemble(self.layout, self.objectives, self._prices())
        # each round's set of clearance constraints is added to a copy of this builder
        self._without_clearance = self.builder
        self.program = self._assembled(self._objective[1])

    def _check_own(self, kind: str, since: int, before: int) -> None:
        """InputError unless a user's own term has added constraints, with all outputs of the blocks it added.

        kind : its class.  since, before : numbers of constraints, and of outputs of blocks, before it.
        """
        if len(self.constraints.origins) == since:
            raise InputError(
                f"{kind}.add_constraints adds no constraint with a finite bound, so a plan ignores the term: "
                "call program.constraints.add with a bound, or leave the term out; whole_motion = True "
                "leaves it out of strikes"
            )
        added = np.arange(before, self.builder.n_outputs)
        unused = np.setdiff1d(added, np.concatenate([*self.constraints.outputs, *self.constraints.unbounded]))
        if unused.size:
            raise InputError(
                f"{kind}.add_constraints: {unused.size} of the {added.size} outputs of its blocks are in no "
                f"constraint, such as number {unused[0] - before} from the first that add_block returned: an "
                "instance's outputs follow those of the instance before"
            )

    def _assembled(self, quadratic: Any, base: StructuredProgram | None = None) -> StructuredProgram:
        """Program of the builder.  quadratic, base: as of `StructuredProgram`."""
        objective, _, linear = self._objective
        return StructuredProgram(
            self.layout,
            self.blocks,
            self.constraints,
            objective=objective,
            quadratic=quadratic,
            linear=linear,
            determined=by_choice(
                [
                    *(determined(Turn.LIFTED, g.index(0), step) for g, _, step in self.builder.lifted),
                    *self._determined(),
                ]
            ),
            base=base,
        )

    def with_clearance(self: Program, constraints: Mapping[ClearanceKey, SeparatingDirection]) -> Program:
        """The same program with exactly these clearance constraints, of those at its nodes."""
        # Another mesh of the contact has other nodes there.
        places = {place.name for place, _ in self.body_spots}
        constraints = {key: held for key, held in constraints.items() if key.place in places}
        other = copy.copy(self)
        other.builder = self._without_clearance.copy()
        order = add_clearance_constraints(other.builder, self.body_spots, self.displacements, constraints)
        other.clearance_constraints = {key: constraints[key] for key in order}
        if not order:
            other.program = other._assembled(self._objective[1])
            return other
        if self._base is None:
            # one structure for all sets of clearance constraints, which solvers can reuse
            quadratic = coupled(self._objective[1], self.body_spots, self.displacements)
            bare = copy.copy(self)
            bare.builder = self._without_clearance
            self._base = other._base = bare._assembled(quadratic)
        other.program = other._assembled(self._base.quadratic, self._base)
        return other

    @cached_property
    def body_spots(self) -> list[tuple[Place, list[Affine]]]:
        """Nodes with coordinates and legs, at which clearance and tendons' ranges are constrained."""
        return [*self.swing_spots(), *self.follow_spots()]

    def move_to(self, problem: ImpactProblem, *, anew: bool = True) -> None:
        """Update the program to a problem with another point, law or target.

        anew : update the least durations of contact phases, too (`ContactParameters.update_parameters`).

        All functions registered by `Builder.follow` are called. `StructuredProgram.same_parameters` tells
        whether that has updated everything that depends on the problem.
        """
        self.problem, self.postures = problem, {}
        # without clearance constraints the program's builder is that one itself, which is to be updated once
        builders = [self._without_clearance]
        if self.builder is not self._without_clearance:
            builders.append(self.builder)
        for b in builders:
            b.problem = problem
        self.hit.update_parameters(anew=anew)
        for b in builders:
            for update in b.followers:
                update(b)
        # `with_clearance` appends its blocks after all others
        own = len(self._without_clearance.blocks)
        move_bodies(problem, self.blocks[own:], self.clearance_constraints)
        self.program.update_parameters(self.layout, self.blocks, self.constraints)

    def with_lifted(self, x: Array) -> Array:
        """Variables (n,) with lifted ones set to the outputs of blocks that they equal; 0 for NaN and inf."""
        x = x.copy()
        # in rounds, as one may be a function of others
        for _ in self.builder.lifted:
            before, found = x.copy(), self.program.all_outputs(x)
            for group, outputs, _ in self.builder.lifted:
                group.write(x, np.where(np.isfinite(found[outputs]), found[outputs], 0.0))
            if np.array_equal(x, before):
                break
        return x

    # ------------------------------------------------------------------ for subclasses
    @abstractmethod
    def _determined(self) -> list[Determined]:
        """Variables of all parts that linear or block constraints determine."""

    @abstractmethod
    def _nodes(self) -> list[tuple[Place, Affine, list[Affine]]]:
        """Place, torques over limit, and slots of the block ``node``, at each node."""

    @abstractmethod
    def _node_slots(self) -> list[tuple[Place, list[Affine]]]:
        """Place and slots of the block ``node`` at each node; torques are no variables in some programs."""

    def _spring_points(self) -> list[SpringPoint]:
        """Points where springs of joints obey their law."""
        return [SpringPoint(place, torque, y, y1, T) for place, torque, (y, y1, _, _, _, T) in self._nodes()]

    @abstractmethod
    def _prices(self) -> Prices:
        """Small quadratic costs that make the optimum unique."""

    @abstractmethod
    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Swing's nodes with coordinates and legs, from a fraction of the swing on to the contact."""

    @abstractmethod
    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        """Nodes after contact with coordinates and legs."""

    @abstractmethod
    def body_states(self, x: Array) -> list[BodyState]:
        """Configurations at the nodes of `body_spots`, in their order, for solver variables (n,)."""

    @abstractmethod
    def _displacements(self, target: TargetDisplacement) -> list[Affine]:
        """Displacement of the target in the world (3,) [m], at each of `body_spots`."""

    @abstractmethod
    def decode(self, x: Array) -> Any:
        """Plan or strike, from solver variables (n,)."""

    # ------------------------------------------------------------------ solution
    def posture(self, x: Array, slots: list[Affine]) -> Array:
        """Configuration (nq,) of coordinates and legs, for solver variables (n,)."""
        y, legs = slots
        return self.coordinates.join(y.evaluate(x), legs.evaluate(x))

    def achieved(self, x: Array) -> dict[str, float]:
        """Values of the objectives' quantities by name, for solver variables (n,)."""
        return {o.name: quantity.evaluate(x) for o, quantity in self.objectives}

    def impulse(self, x: Array) -> float:
        """Impulse to the expected target [N s], for solver variables (n,)."""
        return self.hit.impulse(x)
