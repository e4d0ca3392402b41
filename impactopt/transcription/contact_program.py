"""Base class of the nonlinear programs that contain a contact phase."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from impactopt.problem.objectives import Objective
from impactopt.problem.objectives.peak_force import TYPICAL as PEAK_SCALE
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.solvers.program import Determined
from impactopt.transcription.batched import Block
from impactopt.transcription.builder import Builder
from impactopt.transcription.clearance import ApartRow, Held, add_apart_rows, coupled, move_apart
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_blocks import DEPTH_SCALE
from impactopt.transcription.contact_set import Hit
from impactopt.transcription.contact_state import ContactEnd, DrivePoint, still
from impactopt.transcription.frozen_collision import InstantImpact
from impactopt.transcription.layout import (
    Affine,
    Array,
    Group,
    Index,
    Layout,
    Measure,
    Place,
    Rows,
    Turn,
    by_choice,
    determined,
)
from impactopt.transcription.objective import Prices, Quantity, assemble, quantities
from impactopt.transcription.springs import SpringPoint, add_hinges, add_springs
from impactopt.transcription.structured import StructuredProgram

Program = TypeVar("Program", bound="ContactProgram")


class BodyState(NamedTuple):
    """Configuration of the robot at a node: phase (0 before contact, 2 after it, 3 after a missed one), the
    node's name, time [s] since the start, and configuration (nq,).
    """

    phase: int
    name: str
    time: float
    q: Array


class ContactProgram(ABC):
    """A builder, a hit, and what whoever completes it adds: its parts, and the clearance constraints.

    Attributes
    ----------
    builder : with which all parts are built.  hit : the contact with all targets.
    problem, coordinates, robot, functions, y0, legs0 : the builder's.
    angular_momentum : after contact, a group of three, if an objective asks for it.
    objectives : the problem's that it knows, with their quantities.
    apart_rows : clearance constraints, in the order of their rows, which are the last.
    """

    def __init__(self, builder: Builder, hit: Hit) -> None:
        self.builder, self.hit = builder, hit
        self.problem, self.coordinates, self.robot = builder.problem, builder.coordinates, builder.robot
        self.functions, self.y0, self.legs0 = builder.functions, builder.y0, builder.legs0
        self.angular_momentum: Group | None = None
        self.objectives: list[tuple[Objective, Quantity]] = []
        self.apart_rows: Mapping[ApartRow, Held] = {}

    # ------------------------------------------------------------------ for terms and objectives
    @property
    def layout(self) -> Layout:
        return self.builder.layout

    @property
    def rows(self) -> Rows:
        return self.builder.rows

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
        """Torques over limit (n) at contact, held from there on."""
        return self.hit.contact.feedforward

    @property
    def u0(self) -> Group:
        """The rate ydot (ny) at contact."""
        return self.hit.contact.u0

    def drive_points(self) -> list[DrivePoint]:
        """Torques and motions of the joints, as variables: at the nodes, and at collocation points of all
        contacts.
        """
        return self._points

    @cached_property
    def _points(self) -> list[DrivePoint]:
        nodes = [
            DrivePoint(place, torque, still(y, y1, y2, T, legs))
            for place, torque, (y, y1, y2, legs, _, T) in self._nodes()
        ]
        return [*nodes, *self.hit.drives()]

    def wrenches(self) -> list[tuple[Place, Affine]]:
        """Wrenches on soles and supporting hands (6 each), at the nodes and at collocation points of all
        contacts that last.
        """
        nodes = [(place, slots[4]) for place, slots in self._node_slots()]
        lasting = [c for c in self.hit.collisions if isinstance(c, Collision)]
        return [*nodes, *(found for collision in lasting for found in collision.wrenches())]

    def first_instants(self) -> list[tuple[Place, Index]]:
        """First instants of damped contacts, of a program with a term that looks at them.

        Place, and numbers of the outputs (n) that are -armature x acceleration over the torque limit. The
        torque is that of `feedforward`.
        """
        return self.hit.first_instants()

    def contact_ends(self) -> list[ContactEnd]:
        """States at the beginning and the end of all contacts."""
        return self.hit.contact_ends()

    def deepest_penetration(self) -> Affine:
        """[m], of a contact that lasts: at the end of compression, as a variable."""
        return self.lift("deepest penetration", self.hit.deepest)[0] * DEPTH_SCALE

    def target_energy(self) -> Affine:
        """[J] in the target at separation, as a variable."""

        def numbers(problem: ImpactProblem) -> Array:
            return np.array(list(problem.target.parameters.values()))

        at = self.add_block("energy", [[self.expected.target_state]], numbers(self.problem))
        self.builder.follow(lambda b: b.block("energy").take_parameters(numbers(b.problem)))
        return self.lift("target energy", np.array([at]))[0]

    def peak_force(self) -> Affine:
        """The largest contact force [N], of one that lasts, as a variable."""
        hit: Any = self.expected
        forces = hit.f
        at = self.add_block("peak", [[forces[i] for i in range(forces.count)]], np.zeros(0))
        return self.lift("peak force", np.array([at]))[0] * PEAK_SCALE

    def squares(self, group: Group) -> Quantity:
        """The sum of the squares of a group's variables, in physical units."""
        return Quantity(Affine.zeros(1), group)

    # ------------------------------------------------------------------ the program
    def _finish(self, terms: tuple[Term, ...], objectives: tuple[Objective, ...]) -> None:
        """Rows that these terms bring, those of springs and hinges, and the objective."""
        add_springs(self.builder, self._spring_points(), self.hit.contact.gains[0])
        if self.builder.robot.hinges.any():
            add_hinges(self.builder, [(place, torque) for place, torque, _ in self._nodes()])
        for term in terms:
            if type(term).add_rows is not Term.add_rows:  # those of others are there
                term.add_rows(self)
        self.objectives = quantities(self, objectives)
        self._worth = assemble(self.layout, self.objectives, self._prices())
        self._bare = self.builder

    @cached_property
    def program(self) -> StructuredProgram:
        """All of it, for a solver."""
        objective, quadratic, linear = self._worth
        if self.apart_rows:  # all that such constraints may couple: solvers' structures serve any of them
            quadratic = coupled(quadratic, self.body_spots())
        return StructuredProgram(
            self.layout,
            self.blocks,
            self.rows,
            objective=objective,
            quadratic=quadratic,
            linear=linear,
            determined=by_choice(
                [*(determined(Turn.LIFTED, g.index(0)) for g, _ in self.builder.lifted), *self._determined()]
            ),
        )

    def with_apart(self: Program, rows: Mapping[ApartRow, Held]) -> Program:
        """The same program with just these clearance constraints."""
        other = copy.copy(self)
        other.__dict__.pop("program", None)
        other.builder = self._bare.copy()
        order = add_apart_rows(other.builder, self.body_spots(), rows)
        other.apart_rows = {name: rows[name] for name in order}
        return other

    def body_spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places with coordinates and legs, where bodies are kept apart and tendons in their ranges."""
        return [*self.swing_spots(), *self.follow_spots()]

    def move_to(self, problem: ImpactProblem, *, anew: bool = True) -> None:
        """Take the numbers of a problem with another point, law or target, and leave the rest as it is built.

        anew : the least durations of a contact's phases too, which else are kept where numbers are alike.

        What follows the problem then is what parts have told `Builder.follow`; whether that is all,
        `StructuredProgram.same_numbers` finds.
        """
        self.problem = problem
        builders = [self._bare] if self._bare is self.builder else [self._bare, self.builder]
        for b in builders:
            b.problem = problem
        self.hit.renew(anew=anew)
        for b in builders:
            for take in b.followers:
                take(b)
        own = len(self._bare.blocks)
        move_apart(problem, self.blocks[own:], self.apart_rows)
        self.program.take_numbers(self.layout, self.blocks, self.rows)

    def with_lifted(self, x: Array) -> Array:
        """The variables (n,) with lifted ones made equal to what they stand for."""
        x = x.copy()
        for group, outputs in self.builder.lifted:  # in order: one may be a function of one before
            found = self.program.all_outputs(x)[outputs]
            group.write(x, np.where(np.isfinite(found), found, 0.0))
        return x

    # ------------------------------------------------------------------ what completes it
    @abstractmethod
    def _determined(self) -> list[Determined]:
        """Variables that linear or block constraints determine, of all parts."""

    @abstractmethod
    def _nodes(self) -> list[tuple[Place, Affine, list[Affine]]]:
        """Places of nodes, torques over limit there, and slots of the block ``node``."""

    @abstractmethod
    def _node_slots(self) -> list[tuple[Place, list[Affine]]]:
        """The same without torques, which not every program has as variables."""

    def _spring_points(self) -> list[SpringPoint]:
        """Points where springs of joints obey their law."""
        return [SpringPoint(place, torque, y, y1, T) for place, torque, (y, y1, _, _, _, T) in self._nodes()]

    @abstractmethod
    def _prices(self) -> Prices:
        """Small quadratic costs that make the optimum unique."""

    @abstractmethod
    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Places of the swing's nodes with coordinates and legs, from a fraction of it on to the contact."""

    @abstractmethod
    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places after contact with coordinates and legs."""

    @abstractmethod
    def body_states(self, x: Array) -> list[BodyState]:
        """Configurations at all places of `body_spots`, for solver variables (n,)."""

    @abstractmethod
    def travel(self, x: Array, time: Array) -> Array:
        """Travel (k,) [m] of the target at these times [s] since the start."""

    @abstractmethod
    def decode(self, x: Array) -> Any:
        """The plan or the strike that solver variables (n,) stand for."""

    # ------------------------------------------------------------------ solution
    def posture(self, x: Array, slots: list[Affine]) -> Array:
        """Configuration (nq,) of coordinates and legs."""
        y, legs = slots
        return self.coordinates.join(y.evaluate(x), legs.evaluate(x))

    def achieved(self, x: Array) -> dict[str, float]:
        """Values of the objectives' quantities by name, for solver variables (n,)."""
        return {o.name: quantity.evaluate(x) for o, quantity in self.objectives}

    def impulse(self, x: Array) -> float:
        """Impulse to the expected target [N s], for solver variables (n,)."""
        return self.hit.impulse(x)
