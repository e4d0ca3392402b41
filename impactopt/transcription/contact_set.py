"""Contacts with all targets of a problem, the expected one and those of scenarios."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np

from impactopt.problem.scenario import Scenario
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision, FirstInstant
from impactopt.transcription.contact_guess import mass_at_contact
from impactopt.transcription.contact_state import Contact, ContactEnd, DrivePoint
from impactopt.transcription.frozen_collision import FrozenCollision, InstantImpact
from impactopt.transcription.layout import Array, Index, Place, Turn, determined, percent
from impactopt.transcription.mesh import Elements, Shares, contact_elements, contact_mesh, guessed_shares
from impactopt.transcription.plan import PlannedScenario

DRIFT = 2e-3  # of the contact's time: how far a freeze may be from where it is asked for


class Contacts:
    """The collision with the expected target, and one for each scenario that hits one.

    Attributes
    ----------
    contact : what all collisions start from.
    expected, scenarios : the collisions; who completes this makes them. All of them, the expected one first,
        are `collisions`.
    elements, stages, shares, guarded, first : of a collocated contact, see `Hit`; others have none.
    """

    expected: Any
    scenarios: Sequence[Any]
    elements: Elements = ()
    stages: Sequence[Any] = ()
    first: Sequence[Any] = ()
    shares: Shares = ()
    guarded = False

    def __init__(self, b: Builder, contact: Contact) -> None:
        self._b, self.contact = b, contact

    @property
    def collisions(self) -> list[Any]:
        return [self.expected, *self.scenarios]

    @property
    def hit(self) -> list[Scenario]:
        """Scenarios with a target."""
        return [s for s in self._b.problem.scenarios if not s.missing]

    @cached_property
    def mass(self) -> float:
        """Effective mass [kg] of the robot at its striker, where inverse kinematics reaches the target."""
        return mass_at_contact(self._b.problem)

    def add_feedforward_rows(self, torque: Index) -> None:
        """The feed-forward is the torque at the node at contact, whose outputs are given."""
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

    def determined(self) -> list[Determined]:
        """The feed-forward."""
        return [determined(Turn.FEEDFORWARD, self.contact.feedforward.index(0))]

    def drives(self) -> list[DrivePoint]:
        """Drives in contact, as far as they are known; none for an impact without duration."""
        return []

    def first_instants(self) -> list[tuple[Place, Index]]:
        """Instants at which accelerations jump, with the indices of the outputs that rotors subtract from
        gear loads.
        """
        return []

    def contact_ends(self) -> list[ContactEnd]:
        """States at the beginning and the end of all contacts."""
        return [collision.contact_end() for collision in self.collisions]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write what a contact starts from with these coordinates and rates (ny,) and legs (nl,)."""
        self.contact.u0.write(x, rates)

    def drifted(self, x: Array) -> Shares | None:
        """The phases' shares of the contact's time in solver variables (n,), where freezes on the way went by
        others; None where they did not.
        """
        return None

    def impulse(self, x: Array) -> float:
        """Impulse to the expected target [N s], for solver variables (n,)."""
        return float(self.expected.impulse.evaluate(x)[0])


def approaches(outputs: dict[str, Array]) -> Array:
    """Speeds (strikers,) [m/s] along the normal at contact, from the blocks' outputs."""
    names = ("contact", "second_contact")
    return np.array([float(outputs[name][0, 3]) for name in names if name in outputs])


class Hit(Contacts):
    """Takes what all collisions start from; hands them back.

    elements : lengths of each phase's; none: those that the problem asks for.
    shares : of the contact's time that each phase lasts, by which freezes on the way come when they do; none:
        those of a point mass.
    after : whether the position after the expected target is among the variables.

    Attributes
    ----------
    elements, stages : of every collision's phases, and their collocation points.
    shares : of the phases, where something is frozen on the way.
    guarded : the elements are given, and finer, because a plan was wrong on others: it may have pulled within
        a phase.
    """

    def __init__(
        self, b: Builder, contact: Contact, elements: Elements = (), shares: Shares = (), *, after: bool
    ) -> None:
        super().__init__(b, contact)
        p = b.problem
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
            self.scenarios = [
                kind(b, contact, self.stages, number=k, scenario=s, after=labels, **common)
                for k, s in enumerate(self.hit, start=1)
            ]
            own = b.limits.of_y if after else None
            self.expected = kind(b, contact, self.stages, number=0, after=own, **common)
        else:
            self.expected = InstantImpact(b, contact)
        self.first: list[FirstInstant] = []
        if p.first_instant:
            lasting = [c for c in self.collisions if isinstance(c, Collision)]
            self.first = [FirstInstant(b, contact, c.law, c.suffix) for c in lasting]

    # ------------------------------------------------------------------ constraints
    def add_rows(self) -> None:
        """One block for all collisions, each with its constraints."""
        b = self._b
        slots: dict[str, list[Any]] = {}
        parameters: dict[str, list[Any]] = {}
        first: list[dict[str, int]] = []
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
        """Renews all collisions (:meth:`impactopt.transcription.collision.Collision.renew`)."""
        self.__dict__.pop("mass", None)
        lasting = [c for c in self.collisions if isinstance(c, Collision)]
        for collision in lasting:
            collision.renew(self.mass, anew=anew)
        for first, collision in zip(self.first, lasting, strict=False):
            first.law = collision.law

    def _follow_force(self, b: Builder) -> None:
        numbers = [numbers for c in self.collisions for numbers in c.force_numbers()]
        b.block("force").take_parameters(np.array(numbers))
        for collision in self.collisions:
            collision.follow()

    def _follow_first(self, b: Builder) -> None:
        b.block("first").take_parameters(np.array([first.instance()[1] for first in self.first]))

    def output(self, collision: int, stage: int, part: str) -> Index:
        """Numbers of outputs of the block ``force``, whose ``part`` they are: at a stage of a collision.

        Once constraints are there, and of collisions that last.
        """
        size = self._b.block("force").n_out
        at = self._at["force"] + (collision * len(self.stages) + stage) * size
        return np.asarray(at + self._b.parts("force")[part])

    def drives(self) -> list[DrivePoint]:
        return [point for c in self.collisions if isinstance(c, Collision) for point in c.drives()]

    def first_instants(self) -> list[tuple[Place, Index]]:
        return [(first.place, first.rotors) for first in self.first]

    @property
    def deepest(self) -> Index:
        """Number of the output that is the penetration at the end of the expected target's compression."""
        assert isinstance(self.expected, Collision)
        return self.output(0, self.expected.end[-2], "penetration")

    def determined(self) -> list[Determined]:
        """Determined variables of all collisions, and of the feed-forward."""
        parts = [*self.collisions, *self.first]
        return [*(each for part in parts for each in part.determined()), *super().determined()]

    # ------------------------------------------------------------------ numbers
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        super().guess(x, y, rates, legs)
        for part in (*self.collisions, *self.first):
            part.guess(x, y, rates, legs)

    def drifted(self, x: Array) -> Shares | None:
        if not self.shares or not isinstance(self.expected, Collision):
            return None
        times = np.concatenate([T.read(x)[0] for T in self.expected.T])
        found = times / times.sum()
        if np.abs(found - self.shares).max() <= DRIFT:
            return None
        return tuple(float(share) for share in found)

    def decode(self, x: Array, outputs: dict[str, Array]) -> dict[str, Any]:
        """Contact data of plans and strikes, for solver variables (n,) and the blocks' outputs."""
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
