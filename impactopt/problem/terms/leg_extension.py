"""Distance from straight knees."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class LegExtension(Term):
    """The knees of standing legs stay bent.

    At the nodes of swing and follow-through, the determinant of the leg's Jacobian (from joints to sole) over
    its value in the start posture has a lower bound. Near a straight knee the joint rates that keep the sole
    in place grow without bound, and the leg could become too short between two nodes: at 0.35 TALOS has 7 mm
    left.
    """

    name: ClassVar[str] = "leg extension"
    unit: ClassVar[str] = "of start"
    minimum: float = field(
        default=0.35,
        metadata=about(
            "least determinant of the leg's Jacobian over that at the start",
            least=0,
            most=1,
        ),
    )
