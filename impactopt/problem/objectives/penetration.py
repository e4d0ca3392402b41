"""Deepest penetration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.errors import InputError
from impactopt.problem.objectives.base import WEIGHT, Objective


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
