"""Interface of the contact transcriptions (collocated, frozen, shooting, impulsive)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from impactopt.problem.scenario import Scenario
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact import Contact
from impactopt.transcription.drives import ContactEnd, DrivePoint
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.guess import mass_at_contact
from impactopt.transcription.layout import Array
from impactopt.transcription.mesh import Elements, Shares
from impactopt.transcription.rows import Index, Place, percent


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
