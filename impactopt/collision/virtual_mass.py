"""The robot as a point mass: what the paper compares its model with."""

from __future__ import annotations

from dataclasses import dataclass, field

from impactopt.collision.symbolic import SymbolicModel
from impactopt.collision.terms import Terms

__all__ = ["VirtualMass"]


@dataclass(frozen=True, kw_only=True, eq=False)
class VirtualMass(SymbolicModel):
    """A point of the robot's effective mass m_a = 1 / (n' J P J' n) meets the target; no servo, no gravity.

    The lowest rung of the ladder (paper, fig. 9, Table III; after Asada and Ogawa, and Khatib): P is the
    inverse inertia of the robot as held. It knows nothing of joint torques, sole wrenches and ZMP (None in
    its results); the velocity after the collision is that of free joints. Attributes and errors as of
    `SymbolicModel`.
    """

    terms: Terms = field(init=False, default=Terms.none())

    @property
    def n_servos(self) -> int:
        return 0
