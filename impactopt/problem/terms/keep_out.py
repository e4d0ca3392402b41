"""Distance from the world."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class KeepOut(Term):
    """The robot has clearance from target, ground and obstacles; the striking link may touch the target's
    face.

    Fixed soles stand on the ground.
    """

    name: ClassVar[str] = "keep out"
    unit: ClassVar[str] = "m"
    margin: float = field(
        default=0.01, metadata=about("least distance from a link to any of them", unit="m", least=0)
    )
    enabled: bool = field(default=True, metadata=about("false: the robot may pass through them"))
