"""Limit on the striking point's speed across the normal."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class Incidence(Term):
    """The striking point's speed across the normal at contact is bounded, so that it does not glance off.

    :class:`impactopt.HitCone` replaces it.
    """

    name: ClassVar[str] = "incidence"
    unit: ClassVar[str] = "m/s"
    speed: float = field(
        default=0.05,
        metadata=about(
            "largest speed along each of two tangents; inf: any", unit="m/s", least=0, endless=True
        ),
    )
