"""Headroom of the joints' velocities."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class VelocityLimit(Term):
    """|joint velocity| is at most a fraction of each joint's limit.

    The bounds are on the spline's velocity control points, so they hold everywhere; those of the legs are at
    the nodes.
    """

    name: ClassVar[str] = "velocity limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = field(default=0.95, metadata=about("share of the limit", above=0, most=1))

    def most(self, robot: Robot) -> Any:
        """Largest magnitude (n,) of each joint's velocity [rad/s] or [m/s]."""
        return self.fraction * robot.velocity_limit
