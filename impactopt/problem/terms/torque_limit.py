"""Headroom of the joints' torques."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class TorqueLimit(Term):
    """|torque| is at most a fraction of each joint's limit; the servo has the rest for its feedback."""

    name: ClassVar[str] = "torque limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = field(
        default=0.85,
        metadata=about("share of the limit in swing and follow-through", above=0, most=1),
    )
    collision: float = field(default=0.85, metadata=about("share of the limit in contact", above=0, most=1))
