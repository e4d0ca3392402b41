"""Distance from the joints' ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class PositionLimit(Term):
    """Joints stay inside their limits of position.

    Everywhere: it holds on the spline's control points; for the legs at the nodes. Hinges of soles, whose
    range is small, keep a quarter of it at most.
    """

    name: ClassVar[str] = "position limit"
    unit: ClassVar[str] = "rad"
    margin: float = field(default=0.02, metadata=about("distance from each limit", unit="rad", least=0))
