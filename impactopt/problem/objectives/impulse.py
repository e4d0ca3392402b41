"""Impulse to the target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.problem.objectives.base import WEIGHT, Objective


@dataclass(frozen=True, kw_only=True)
class Impulse(Objective):
    """The impulse to the target."""

    name: ClassVar[str] = "impulse"
    unit: ClassVar[str] = "N s"
    weight: float = field(default=1.0, metadata=WEIGHT)

    def quantity(self, program: Any) -> Any:
        return program.expected.impulse
