"""What programs have about the contact: the state before it, collisions, and what they leave behind."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from impactopt.kinematics.support import support_polygon
from impactopt.kinematics.wrench_cone import inward_edges
from impactopt.problem.objectives import AngularMomentum, Objective
from impactopt.problem.terms import HitCone, HitRegion, Term
from impactopt.transcription.apart import ApartRow, Held, add_apart_rows
from impactopt.transcription.blocks import DEPTH_SCALE
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.guess import effective_mass
from impactopt.transcription.impulse import InstantImpact
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.mesh import Elements, contact_elements, contact_mesh
from impactopt.transcription.objective import Prices, Quantity, assemble, quantities
from impactopt.transcription.plan import PlannedScenario
from impactopt.transcription.rows import Index, Measure, Place, Rank, millimetres, percent
from impactopt.transcription.structured import StructuredProgram

Program = TypeVar("Program", bound="ContactProgram")


def rotation_rows(normal: Array) -> Array:
    """(3, 3) rows: the normal and two tangents."""
    _, _, vt = np.linalg.svd(normal.reshape(1, 3))
    rows = np.vstack([normal, vt[1:]])
    return rows


class BodyState(NamedTuple):
    """Where the robot is at a place: phase (0 before contact, 2 after it, 3 after one that met nothing), the
    place's name, time [s] since the start, and configuration (nq,).
    """

    phase: int
    name: str
    time: float
    q: Array


class ContactProgram(Builder):
    """A program with a contact in it.

    Whoever completes it says what the contact starts from, before :meth:`_hit`.

    contact_state : y, y' and y'' at contact; contact_T: the duration [s] of the phase that they are of, so
        that ydot = y'/T; contact_legs, contact_w: legs and sole wrenches there.
    """

    contact_state: tuple[Affine, Affine, Affine]
    contact_T: Affine
    contact_legs: Affine
    contact_w: Affine
    elements: Elements = ()  # of the contact; none: those that the problem asks for

    def _hit(self, *, after: bool, rates: dict[str, Any] | None = None) -> None:
        """Variables of the hit.

        after : the position after the expected one is among them.  rates : bounds of the rates at contact.
        """
        p, labels = self.problem, self.coordinates.labels
        # finer elements are there because a plan was wrong on others: it may have pulled within a phase
        self.guarded = bool(self.elements)
        self.elements = self.elements or contact_elements(p)
        self.stages = contact_mesh(p, self.elements)
        compression, restitution, _ = p.law.formula()
        self.law_switches = compression != restitution
        self.law_pulls = float(p.law.branch(1e-6, -10.0, False)) < 0  # when bodies part fast
        limit, names = self.torque.fraction, self.robot.joint_names
        self.feedforward = self.layout.add(
            "feed-forward at contact", 1, self.robot.n, lower=-limit, upper=limit, labels=names
        )
        self.u0 = self.layout.add("rate at contact", 1, self.ny, labels=labels, **(rates or {}))
        self.angular_momentum: Group | None = None  # after contact, if an objective asks for it
        self.scenarios: list[Collision] = []
        self.expected: Collision | InstantImpact
        if p.collision == "dynamics":
            self.scenarios = [
                Collision(self, s, after={"labels": labels}) for s in p.scenarios if not s.missing
            ]
            self.expected = Collision(self, after=self.of_y if after else None)
        else:
            self.expected = InstantImpact(self)
        self.collisions = [self.expected, *self.scenarios]

    @cached_property
    def mass_at_contact(self) -> float:
        """Of the robot at its striker [kg], where inverse kinematics reaches the target."""
        c, p = self.coordinates, self.problem
        y, legs = c.split(p.contact_posture)
        return effective_mass(c, p.striker, p.normal, y, legs, np.zeros(c.ny))[0]

    def _feedforward_rows(self, torque: Index) -> None:
        """The feed-forward is the torque at the node at contact, whose outputs are given."""
        self.rows.add(
            term="feed-forward that makes the robot coast",
            place="contact",
            components=self.robot.joint_names,
            outputs=torque,
            affine=-self.feedforward[0],
            lower=0,
            upper=0,
            measure=percent("of the joint's limit off"),
        )

    def _contact_rows(self) -> None:
        """Where and how the striking point meets the target."""
        p = self.problem
        y, y1, _ = self.contact_state
        at = self.add_block("contact", [[y, y1, self.contact_T]], rotation_rows(p.normal).ravel())
        if p.extra(HitRegion) is None:
            self.rows.add(
                term="hit point",
                place=Place("contact", ""),
                components=["x", "y", "z"],
                outputs=at + np.arange(3),
                lower=p.point,
                upper=p.point,
                measure=millimetres("away"),
            )
        self.rows.add(
            term="approach speed",
            place="contact",
            components=["normal"],
            outputs=np.array([at + 3]),
            lower=0.05,
            measure=Measure("m/s", 1.0, "too slow"),
        )
        if p.extra(HitCone) is None:
            self.rows.add(
                term=self.incidence.name,
                place="contact",
                components=["tangent 1", "tangent 2"],
                outputs=at + np.array([4, 5]),
                lower=-self.incidence.speed,
                upper=self.incidence.speed,
                measure=Measure("m/s", 1.0, "too fast across the normal"),
                whole="",
            )

    def _collision_rows(self) -> None:
        """One block for all collisions, each with its rows."""
        slots: dict[str, list[Any]] = {}
        parameters: dict[str, list[Any]] = {}
        first: list[dict[str, int]] = []
        for collision in self.collisions:
            found = collision.instances()
            first.append({name: len(slots.get(name, ())) for name in found})
            for name, (instances, numbers) in found.items():
                slots.setdefault(name, []).extend(instances)
                parameters.setdefault(name, []).extend(numbers)
        at = {name: self.add_block(name, slots[name], np.array(parameters[name])) for name in slots}
        sizes = {block.name: block.n_out for block in self.blocks}
        if isinstance(self.expected, Collision):
            self._deepest = (
                at["force"] + self.expected.end[-2] * sizes["force"] + self.parts("force")["penetration"]
            )
        for collision, index in zip(self.collisions, first, strict=True):
            collision.add_rows({name: (at[name] + k * sizes[name], sizes[name]) for name, k in index.items()})

    def _balance_rows(self, after: list[Affine]) -> None:
        """Balance of what each target leaves behind; ``after``: y, y', legs and T after the expected one."""
        y, y1, _ = self.contact_state
        found = [(after, self.balance.capture_margin, "after contact")]
        for other in self.scenarios:
            assert other.scenario is not None
            found.append((other.state_after, other.scenario.capture_margin, f"after contact{other.suffix}"))
        for s in self.problem.scenarios:
            if s.missing:
                slots = [y, y1, self.contact_legs, self.contact_T]
                found.append((slots, s.capture_margin, f"contact, if {s.name}"))
        inward, offset = inward_edges(support_polygon(self.robot, self.coordinates))
        parameters = [np.column_stack([inward, offset + (m or 0.0)]).ravel() for _, m, _ in found]
        at = self.add_block("balance", [slots for slots, _, _ in found], np.array(parameters))
        k = len(inward)
        wanted = any(isinstance(o, AngularMomentum) for o in self.problem.objectives)
        for i, (_, margin, place) in enumerate(found):
            start = at + i * (k + 4)
            if margin is not None:
                self.rows.add(
                    term="capture point",
                    place=place,
                    components=[f"edge {e}" for e in range(k)],
                    outputs=start + np.arange(k),
                    lower=0,
                    measure=millimetres("outside"),
                    whole="",
                )
            slow, still = self.balance.vertical_speed, self.balance.angular_momentum
            self.rows.add(
                term="vertical speed",
                place=place,
                components=["z"],
                outputs=np.array([start + k]),
                lower=-slow,
                upper=slow,
                measure=Measure("m/s", 1.0, "too fast"),
            )
            outputs, turning = start + k + 1 + np.arange(3), Measure("N m s", 1.0, "too much")
            if wanted and i == 0:
                self.angular_momentum = self.lift(
                    "angular momentum",
                    outputs,
                    place=place,
                    labels=["x", "y", "z"],
                    measure=turning,
                    lower=-still,
                    upper=still,
                )
                continue
            self.rows.add(
                term="angular momentum",
                place=place,
                components=["x", "y", "z"],
                outputs=outputs,
                lower=-still,
                upper=still,
                measure=turning,
            )

    def link_slots(
        self,
        start: tuple[Affine, Affine, Affine],
        times: tuple[Affine, Affine],
        travel: tuple[Affine, Affine],
        rate: Affine,
    ) -> list[list[Affine]]:
        """Slots of the block ``link``, coordinate by coordinate: from the state at contact to a later start.

        start : y and d y/ds of what starts, and its duration [s].  times [s], travel : of two phases between,
        whose ways are time x travel.  rate : ydot after them.
        """
        y, y1, _ = self.contact_state
        out = []
        for k in range(self.ny):
            yk, rk, a, b, one, two, u0, u = (
                e[k : k + 1] for e in (*start[:2], y, y1, *travel, self.u0[0], rate)
            )
            out.append([yk, rk, start[2], a, b, self.contact_T, *times, one, two, u0, u])
        return out

    def _finish(self, terms: tuple[Term, ...], objectives: tuple[Objective, ...]) -> None:
        """Rows that these terms bring, the objective, and the program."""
        for term in terms:
            if type(term).add_rows is not Term.add_rows:  # those of the others are there
                term.add_rows(self)
        self.objectives = quantities(self, objectives)
        self._worth = assemble(self.layout, self.objectives, self._prices())
        self.apart_rows: Mapping[ApartRow, Held] = {}
        self._bare = tuple(self.blocks), self.rows

    @cached_property
    def program(self) -> StructuredProgram:
        """All of it, for a solver."""
        objective, quadratic, linear = self._worth
        return StructuredProgram(
            self.layout,
            self.blocks,
            self.rows,
            objective=objective,
            quadratic=quadratic,
            linear=linear,
            determined=self._determined(),
        )

    def with_apart(self: Program, rows: Mapping[ApartRow, Held]) -> Program:
        """The same program with just these rows between bodies."""
        other = copy.copy(self)
        other.__dict__.pop("program", None)
        blocks, bare = self._bare
        other.blocks, other.rows = [block.copy() for block in blocks], bare.copy()
        other.apart_rows = dict(rows)
        add_apart_rows(other, other.apart_rows)
        return other

    # ------------------------------------------------------------------ for objectives
    def deepest_penetration(self) -> Affine:
        """[m], of a contact that lasts: at the end of compression, as a variable."""
        return self.lift("deepest penetration", self._deepest)[0] * DEPTH_SCALE

    def squares(self, group: Group) -> Quantity:
        """The sum of the squares of a group's variables, in physical units."""
        return Quantity(Affine.zeros(1), group)

    # ------------------------------------------------------------------ structure
    def _determined(self) -> list[tuple[Rank, Index]]:
        """What rows determine by themselves, with its rank in the elimination.

        Where there are rows to choose from, what stands first here takes the rows that stand first.
        """
        out = [((0, k), part) for parts in self._nodes() for k, part in enumerate(parts, -len(parts))]
        out += [((1, 0), group.index(0)) for group, _ in self._lifted]
        found = [c.determined() for c in self.collisions]
        out += [((4, k), legs) for stages, _ in found for parts in stages for k, legs in enumerate(parts)]
        out += [((5, k), part) for _, steps in found for k, parts in enumerate(steps) for part in parts]
        out.append(((3, 0), self.feedforward.index(0)))
        out += [((6, 0), c.after.index(0)) for c in self.scenarios]
        return out + [((6, 0), start) for start in self._starts()]

    def _nodes(self) -> list[list[Index]]:
        """Variables that the rows of each node determine, one after the other: of each leg, and the first
        sole's wrench.
        """
        raise NotImplementedError

    def _starts(self) -> list[Index]:
        """Variables that the state after contact determines."""
        return []

    def _prices(self) -> Prices:
        raise NotImplementedError

    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        """Places of the swing's nodes with coordinates and legs, from a fraction of it on to the contact."""
        raise NotImplementedError

    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places after contact with coordinates and legs."""
        raise NotImplementedError

    def body_states(self, x: Array) -> list[BodyState]:
        """Where bodies are at all places of `swing_spots` and `follow_spots`, for solver variables (n,)."""
        raise NotImplementedError

    def posture(self, x: Array, slots: list[Affine]) -> Array:
        """Configuration (nq,) of coordinates and legs."""
        y, legs = slots
        return self.coordinates.join(y.evaluate(x), legs.evaluate(x))

    def travel(self, x: Array, time: Array) -> Array:
        """How far (k,) [m] the target has gone at these times [s] since the start."""
        raise NotImplementedError

    # ------------------------------------------------------------------ solution
    def achieved(self, x: Array) -> dict[str, float]:
        """What the objectives' quantities come to, by their names, for solver variables (n,)."""
        return {o.name: quantity.evaluate(x) for o, quantity in self.objectives}

    def impulse(self, x: Array) -> float:
        """To the expected target [N s], for solver variables (n,)."""
        return float(self.expected.impulse.evaluate(x)[0])

    def _decode_hit(self, x: Array) -> dict[str, Any]:
        """What plans and strikes say of the contact, for solver variables (n,)."""
        outputs = self.program.outputs(x)
        approach = float(outputs["contact"][0, 3])
        compression, restitution = self.expected.durations(x)
        scenarios = [
            PlannedScenario(
                name=other.scenario.name,
                impulse=float(other.impulse.evaluate(x)[0]),
                collision=other.decode(x, outputs, approach),
            )
            for other in self.scenarios
            if other.scenario is not None
        ]
        return {
            "compression": compression,
            "restitution": restitution,
            "collision": self.expected.decode(x, outputs, approach),
            "hand_speed": approach,
            "impulse": self.impulse(x),
            "scenarios": tuple(scenarios),
        }
