"""Collisions of a program with all its targets: the expected one and those of scenarios."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.contact.friction import moves_target
from impactopt.problem.violation import Place, percent
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision, FirstInstant
from impactopt.transcription.contact_guess import mass_at_contact
from impactopt.transcription.contact_state import Contact, ContactEnd, DrivePoint
from impactopt.transcription.frozen_collision import FrozenCollision, InstantImpact
from impactopt.transcription.layout import Turn, determined
from impactopt.transcription.mesh import Elements, Shares, contact_elements, contact_mesh, guessed_shares
from impactopt.transcription.plan import PlannedScenario

# Deviation of a freeze from its place, as a fraction of the contact's time, that does not justify another
# solve.
MAX_DRIFT = 2e-3


class ContactSet:
    """The collision with the expected target, and one for each scenario that hits one.

    contact : state at contact, which all collisions share.
    elements : lengths of each phase's collocation elements, as fractions of the phase; (): those that the
        problem asks for.
    shares : fraction of the contact's time that each phase lasts, which places the freezes of a frozen model;
        (): those of a point mass.
    after : add the position after the expected target's collision as variables.
    lifted : add the positions during that collision as variables (`Collision.spots`).

    Attributes
    ----------
    expected, scenarios : the collisions; all of them, the expected one first, are `collisions`.
    elements, stages : of every collision, and their collocation points.
    shares : as above; () without freezes.
    mass [kg] : effective, of the robot at its striker, where inverse kinematics reaches the target; only of
        collisions that last.
    guarded : the elements were given, because a plan was wrong on others. Its force may have pulled within a
        phase, which is forbidden now.
    first : first instants of the collisions that last, if a term needs them.
    """

    def __init__(
        self,
        b: Builder,
        contact: Contact,
        elements: Elements = (),
        shares: Shares = (),
        *,
        after: bool,
        lifted: bool = False,
    ) -> None:
        self._b, self.contact = b, contact
        p = b.problem
        self.guarded = bool(elements)
        self.shares = shares or (guessed_shares(p) if p.freezes else ())
        self.elements = elements or contact_elements(p, self.shares)
        self.stages = contact_mesh(p, self.elements)
        self.scenarios: list[Collision] = []
        self.expected: Any  # a Collision or an InstantImpact
        self.first: list[FirstInstant] = []
        if not p.lasts:
            self.expected = InstantImpact(b, contact)
            return
        self.mass = mass_at_contact(p)
        common: dict[str, Any] = {"mass": self.mass, "guarded": self.guarded}
        kind: Callable[..., Collision] = Collision
        if p.frozen is not None:
            kind = partial(FrozenCollision, shares=self.shares)
        labels = {"labels": b.coordinates.labels}
        self.scenarios = [
            kind(b, contact, self.stages, number=k, scenario=s, after=labels, **common)
            for k, s in enumerate((s for s in p.scenarios if not s.missing), start=1)
        ]
        own = b.limits.of_y if after else None
        self.expected = kind(b, contact, self.stages, number=0, after=own, lifted=lifted, **common)
        if p.first_instant:
            self.first = [FirstInstant(b, contact, c.law, c.suffix) for c in self.lasting]

    @property
    def collisions(self) -> list[Any]:
        return [self.expected, *self.scenarios]

    @property
    def lasting(self) -> list[Collision]:
        """The collisions that have a duration: all or none."""
        return [c for c in self.collisions if isinstance(c, Collision)]

    # ------------------------------------------------------------------ constraints
    def add_constraints(self) -> None:
        """Add the blocks, each with instances of all collisions, and the constraints."""
        b = self._b
        slots: dict[str, list[Any]] = {}
        parameters: dict[str, list[Any]] = {}
        first: list[dict[str, int]] = []  # of each collision, its first instance by block
        for collision in self.collisions:
            found = collision.instances()
            first.append({name: len(slots.get(name, ())) for name in found})
            for name, (instances, own_parameters) in found.items():
                slots.setdefault(name, []).extend(instances)
                parameters.setdefault(name, []).extend(own_parameters)
        self._at = {name: b.add_block(name, slots[name], np.array(parameters[name])) for name in slots}
        if "force" in slots:
            b.follow(self._update_force)
        sizes = {block.name: block.n_out for block in b.blocks}
        for collision, index in zip(self.collisions, first, strict=True):
            collision.add_constraints(
                {name: (self._at[name] + k * sizes[name], sizes[name]) for name, k in index.items()}
            )
        if self.first:
            instances, first_parameters = zip(*(instant.instance() for instant in self.first), strict=True)
            # added last of the contact's blocks, so `b.blocks[-1]` below is it
            at = b.add_block("first", list(instances), np.array(first_parameters))
            b.follow(self._update_first)
            for k, instant in enumerate(self.first):
                instant.add_constraints(at + k * b.blocks[-1].n_out)

    def add_feedforward_constraints(self, torque: Index) -> None:
        """Constrain the feed-forward to the torque at the node at contact, whose outputs (n,) are given."""
        self._b.equal(
            "feed-forward that makes the robot coast",
            "contact",
            self._b.robot.joint_names,
            torque,
            percent("of the joint's limit off"),
            affine=-self.contact.feedforward[0],
        )

    def update_parameters(self, *, anew: bool) -> None:
        """Take the parameters of the builder's problem (`Collision.update_parameters`)."""
        if self.lasting:
            self.mass = mass_at_contact(self._b.problem)
        for collision in self.lasting:
            collision.update_parameters(self.mass, anew=anew)
        for first, collision in zip(self.first, self.lasting, strict=False):
            first.law = collision.law

    def _update_force(self, b: Builder) -> None:
        parameters = [each for c in self.collisions for each in c.force_parameters()]
        b.block("force").take_parameters(np.array(parameters))
        if moves_target(b.problem.friction):  # the target's mass is in the equations of motion, too
            parameters = [each for c in self.lasting for each in c.dynamics_parameters()]
            b.block("collision").take_parameters(np.array(parameters))
        for collision in self.collisions:
            collision.update_bounds()

    def _update_first(self, b: Builder) -> None:
        b.block("first").take_parameters(np.array([first.instance()[1] for first in self.first]))

    def output(self, collision: int, stage: int, part: str) -> Index:
        """Indices of the outputs ``part`` of the block ``force``, at a stage of a collision that lasts.

        They are known after :meth:`add_constraints`.
        """
        size = self._b.block("force").n_out
        at = self._at["force"] + (collision * len(self.stages) + stage) * size
        return np.asarray(at + self._b.parts("force")[part])

    def drives(self) -> list[DrivePoint]:
        """States of the drives at the collocation points; none for an impact without duration."""
        return [point for collision in self.lasting for point in collision.drives()]

    def contact_ends(self) -> list[ContactEnd]:
        """Joint motions before and after each collision."""
        return [collision.contact_end() for collision in self.collisions]

    def first_instants(self) -> list[tuple[Place, Index]]:
        """First instants of contact, with the indices of outputs that are the rotors' part of gear loads."""
        return [(first.place, first.rotors) for first in self.first]

    @property
    def deepest(self) -> Index:
        """Index of the output that is the penetration at the end of the expected target's compression."""
        assert isinstance(self.expected, Collision)
        return self.output(0, self.expected.end[-2], "penetration")

    def determined(self) -> list[Determined]:
        """Determined variables of all collisions, and the feed-forward."""
        parts = [*self.collisions, *self.first]
        feedforward = determined(Turn.FEEDFORWARD, self.contact.feedforward.index(0))
        return [*(each for part in parts for each in part.determined()), feedforward]

    # ------------------------------------------------------------------ initial guess and solution
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess to x (n,), for coordinates and rates (ny,) and legs (nl,) at contact."""
        self.contact.u0.write(x, rates)
        for part in (*self.collisions, *self.first):
            part.guess(x, y, rates, legs)

    def drifted(self, x: Array) -> Shares | None:
        """Phases' fractions of the contact's time in solver variables (n,), if they differ from `shares`.

        None if freezes are where `shares` places them, or there are none.
        """
        if not self.shares or not isinstance(self.expected, Collision):
            return None
        times = np.concatenate([T.read(x)[0] for T in self.expected.T])
        found = times / times.sum()
        if np.abs(found - self.shares).max() <= MAX_DRIFT:
            return None
        return tuple(float(share) for share in found)

    def impulse(self, x: Array) -> float:
        """Impulse to the expected target [N s], for solver variables (n,)."""
        return float(self.expected.impulse.evaluate(x)[0])

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


def approaches(outputs: dict[str, Array]) -> Array:
    """Speeds (strikers,) along the normal at contact [m/s], from the blocks' outputs."""
    names = ("contact", "second_contact")
    return np.array([float(outputs[name][0, 3]) for name in names if name in outputs])
