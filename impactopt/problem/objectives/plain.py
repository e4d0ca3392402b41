"""Objectives whose quantity every program has: impulse, penetration, angular momentum after contact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.errors import InputError
from impactopt.problem.objectives.base import WEIGHT, Objective


@dataclass(frozen=True, kw_only=True)
class Impulse(Objective):
    """The impulse to the target."""

    name: ClassVar[str] = "impulse"
    unit: ClassVar[str] = "N s"
    weight: float = field(default=1.0, metadata=WEIGHT)

    def quantity(self, program: Any) -> Any:
        return program.expected.impulse


@dataclass(frozen=True, kw_only=True)
class Penetration(Objective):
    """The deepest penetration; a weight below zero keeps it small.

    In m, at the end of compression.
    """

    name: ClassVar[str] = "penetration"
    unit: ClassVar[str] = "m"
    contact: ClassVar[bool] = True
    weight: float = field(default=1000.0, metadata=WEIGHT)

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        if not turns:
            raise InputError("Penetration has no peak in the blow on a nail: take PeakForce or TargetEnergy")

    def quantity(self, program: Any) -> Any:
        return program.deepest_penetration()


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(Objective):
    """Cost: angular momentum after contact, squared.

    |angular momentum|^2 about the centre of mass [(N m s)^2]. It is for robots that stand on soles.
    """

    name: ClassVar[str] = "angular momentum after contact, squared"
    unit: ClassVar[str] = "(N m s)^2"
    cost: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        if not balance:
            raise InputError("AngularMomentum is of a robot that stands: leave it out on a fixed base")

    def quantity(self, program: Any) -> Any:
        return program.squares(program.angular_momentum)
