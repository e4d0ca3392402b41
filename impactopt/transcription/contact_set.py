"""Set of collisions of a problem: with the expected target, and with those of scenarios."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import numpy as np

from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision, FirstInstant
from impactopt.transcription.contact_guess import mass_at_contact
from impactopt.transcription.contact_state import Contact, ContactEnd, DrivePoint
from impactopt.transcription.frozen_collision import FrozenCollision, InstantImpact
from impactopt.transcription.layout import Array, Index, Place, Turn, determined, percent
from impactopt.transcription.mesh import Elements, Shares, contact_elements, contact_mesh, guessed_shares
from impactopt.transcription.plan import PlannedScenario

DRIFT = 2e-3  # of the contact's time: tolerance of the instants at which the model is frozen


def approaches(outputs: dict[str, Array]) -> Array:
    """Speeds (strikers,) [m/s] along the normal at contact, from the blocks' outputs."""
    names = ("contact", "second_contact")
    return np.array([float(outputs[name][0, 3]) for name in names if name in outputs])


class ContactSet:
    """Collisions of an NLP: with the expected target, and with that of each scenario that has one.

    They are collocated, or impulses if the collision has no duration.

    elements : lengths of each phase's elements; empty: the problem's.
    shares : fraction of the contact's time that each phase lasts, which fixes the instants at which the model
        is frozen; empty: those of a point mass.
    after : True if the position after the expected collision is a variable.

    Attributes
    ----------
    contact : state at contact, from which all collisions start.
    expected, scenarios : the collisions.
    elements, stages : of the phases of every collision, and their collocation points.
    shares : as above; empty if nothing is frozen during contact.
    guarded : True if elements were given: an earlier plan was inaccurate on the problem's. As its force may
        have pulled within a phase, collisions then have constraints against that.
    first : first instants of the collisions, if a term needs them.
    """

    def __init__(
        self, b: Builder, contact: Contact, elements: Elements = (), shares: Shares = (), *, after: bool
    ) -> None:
        self._b, self.contact, p = b, contact, b.problem
        self.guarded = bool(elements)
        self.shares = shares or (guessed_shares(p) if p.freezes else ())
        self.elements = elements or contact_elements(p, self.shares)
        self.stages = contact_mesh(p, self.elements)
        self.scenarios: list[Collision] = []
        self.expected: Collision | InstantImpact
        if p.lasts:
            common: dict[str, Any] = {"mass": self.mass, "guarded": self.guarded}
            labels = {"labels": b.coordinates.labels}
            kind: Callable[..., Collision] = Collision
            if p.frozen is not None:
                kind = partial(FrozenCollision, shares=self.shares)
            with_target = [scenario for scenario in p.scenarios if not scenario.missing]
            self.scenarios = [
                kind(b, contact, self.stages, number=k, scenario=s, after=labels, **common)
                for k, s in enumerate(with_target, start=1)
            ]
            own = b.limits.of_y if after else None
            self.expected = kind(b, contact, self.stages, number=0, after=own, **common)
        else:
            self.expected = InstantImpact(b, contact)
        self.first: list[FirstInstant] = []
        if p.first_instant:
            self.first = [FirstInstant(b, contact, c.law, c.suffix) for c in self.lasting]

    @property
    def collisions(self) -> list[Any]:
        """All collisions, the expected one first."""
        return [self.expected, *self.scenarios]

    @property
    def lasting(self) -> list[Collision]:
        """Collisions with a duration."""
        return [c for c in self.collisions if isinstance(c, Collision)]

    @cached_property
    def mass(self) -> float:
        """Effective mass [kg] of the robot at its striker, where inverse kinematics reaches the target."""
        return mass_at_contact(self._b.problem)

    # ------------------------------------------------------------------ constraints
    def add_feedforward(self, torque: Index) -> None:
        """Constrains the feed-forward to the torque at contact.  torque (n,) : numbers of block outputs."""
        self._b.rows.add(
            term="feed-forward that makes the robot coast",
            place="contact",
            components=self._b.robot.joint_names,
            outputs=torque,
            affine=-self.contact.feedforward[0],
            lower=0,
            upper=0,
            measure=percent("of the joint's limit off"),
        )

    def add_rows(self) -> None:
        """Adds the blocks, each with the instances of all collisions, and the collisions' constraints."""
        b = self._b
        slots: dict[str, list[Any]] = {}
        parameters: dict[str, list[Any]] = {}
        first: list[dict[str, int]] = []  # of each collision: number of its first instance in each block
        for collision in self.collisions:
            found = collision.instances()
            first.append({name: len(slots.get(name, ())) for name in found})
            for name, (instances, numbers) in found.items():
                slots.setdefault(name, []).extend(instances)
                parameters.setdefault(name, []).extend(numbers)
        self._at = {name: b.add_block(name, slots[name], np.array(parameters[name])) for name in slots}
        if "force" in slots:
            b.follow(self._follow_force)
        sizes = {block.name: block.n_out for block in b.blocks}
        for collision, index in zip(self.collisions, first, strict=True):
            collision.add_rows(
                {name: (self._at[name] + k * sizes[name], sizes[name]) for name, k in index.items()}
            )

        if self.first:
            slots_of, numbers = zip(*(first.instance() for first in self.first), strict=True)
            at = b.add_block("first", list(slots_of), np.array(numbers))
            b.follow(self._follow_first)
            for k, each in enumerate(self.first):
                each.add_rows(at + k * b.blocks[-1].n_out)

    def renew(self, *, anew: bool) -> None:
        """Updates the parameters of all collisions to the builder's problem, as of `Collision.renew`."""
        self.__dict__.pop("mass", None)  # is computed again
        for collision in self.lasting:
            collision.renew(self.mass, anew=anew)
        for first, collision in zip(self.first, self.lasting, strict=False):
            first.law = collision.law

    def _follow_force(self, b: Builder) -> None:
        """Writes parameters of the block ``force``, and bounds of durations, for the builder's problem."""
        numbers = [numbers for c in self.collisions for numbers in c.force_numbers()]
        b.block("force").take_parameters(np.array(numbers))
        for collision in self.collisions:
            collision.follow()

    def _follow_first(self, b: Builder) -> None:
        """Writes the parameters of the block ``first`` for the builder's problem."""
        b.block("first").take_parameters(np.array([first.instance()[1] for first in self.first]))

    def output(self, collision: int, stage: int, part: str) -> Index:
        """Numbers of the outputs that are a ``part`` of the block ``force``, at a stage of a collision.

        Needs :meth:`add_rows` first, and a collision with a duration.
        """
        size = self._b.block("force").n_out
        at = self._at["force"] + (collision * len(self.stages) + stage) * size
        return np.asarray(at + self._b.parts("force")[part])

    def drives(self) -> list[DrivePoint]:
        """Torques and joint motions at collocation points; none of an impact without duration."""
        return [point for collision in self.lasting for point in collision.drives()]

    def contact_ends(self) -> list[ContactEnd]:
        """States at the beginning and the end of all contacts."""
        return [collision.contact_end() for collision in self.collisions]

    def first_instants(self) -> list[tuple[Place, Index]]:
        """First instants of contact, at which accelerations jump.

        Place, and numbers (n,) of the outputs that are the rotors' part of gear loads.
        """
        return [(first.place, first.rotors) for first in self.first]

    @property
    def deepest(self) -> Index:
        """Number of the output that is the penetration at the end of the expected target's compression."""
        assert isinstance(self.expected, Collision)
        return self.output(0, self.expected.end[-2], "penetration")

    def determined(self) -> list[Determined]:
        """Variables that can be eliminated: those of all collisions, and the feed-forward."""
        found = [each for part in (*self.collisions, *self.first) for each in part.determined()]
        return [*found, determined(Turn.FEEDFORWARD, self.contact.feedforward.index(0))]

    # ------------------------------------------------------------------ solution
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the contact's initial guess to x (n,), from coordinates y, rates (ny,) and legs (nl,)."""
        self.contact.u0.write(x, rates)
        for part in (*self.collisions, *self.first):
            part.guess(x, y, rates, legs)

    def drifted(self, x: Array) -> Shares | None:
        """Shares of the contact's time at solver variables x (n,), if the model should be frozen by these.

        None if nothing is frozen during contact, or they differ by `DRIFT` at most from those that it was
        frozen by.
        """
        if not self.shares or not isinstance(self.expected, Collision):
            return None
        times = np.concatenate([T.read(x)[0] for T in self.expected.T])
        found = times / times.sum()
        if np.abs(found - self.shares).max() <= DRIFT:
            return None
        return tuple(float(share) for share in found)

    def impulse(self, x: Array) -> float:
        """Impulse to the expected target [N s], at solver variables x (n,)."""
        return float(self.expected.impulse.evaluate(x)[0])

    def decode(self, x: Array, outputs: dict[str, Array]) -> dict[str, Any]:
        """Contact data of plans and strikes, from solver variables x (n,) and the blocks' outputs."""
        approach = approaches(outputs)
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
            "hand_speed": float(approach[0]),
            "impulse": self.impulse(x),
            "scenarios": tuple(scenarios),
        }
