"""The robot as a point mass: what the paper compares its model with."""

from __future__ import annotations

from dataclasses import dataclass, field

from impactopt.collision.effects import Effects
from impactopt.collision.symbolic import SymbolicModel

__all__ = ["VirtualMass"]


@dataclass(frozen=True, kw_only=True, eq=False)
class VirtualMass(SymbolicModel):
    """A point of the robot's effective mass m_a = 1 / (n' J P J' n) meets the target; no servo, no gravity.

    The simplest model of the hierarchy (paper, fig. 9, Table III; after Asada and Ogawa, and Khatib): P is
    the inverse inertia of the robot as held. It knows nothing of joint torques, sole wrenches and ZMP (None
    in its results); the velocity after the collision is that of free joints. Attributes and errors as of
    `SymbolicModel`.
    """

    effects: Effects = field(init=False, default=Effects.none())

    @property
    def n_servos(self) -> int:
        return 0
