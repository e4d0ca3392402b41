"""Distance between the robot's own links."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class SelfCollision(Term):
    """Links of the robot have clearance, except where a joint connects them or they touch at the start
    (neighbours: start within 2 mm).

    It is required from start to rest, after a miss too. Other links that are nearer than the margin at
    the start may stay so near.
    """

    name: ClassVar[str] = "self-collision"
    unit: ClassVar[str] = "m"
    margin: float = field(default=0.01, metadata=about("least distance between two links", unit="m", least=0))
    enabled: bool = field(default=True, metadata=about("false: links may pass through each other"))
