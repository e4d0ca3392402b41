"""Distance from the joints' ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import degrees
from impactopt.robots.tools import inside


@dataclass(frozen=True, kw_only=True)
class PositionLimit(Term):
    """Joints stay inside their limits of position.

    The bounds are on the spline's control points, so they hold everywhere; those of legs and tendons are at
    the nodes. The margin of tendons and of hinges of soles, whose range may be small, is at most a quarter of
    it.
    """

    name: ClassVar[str] = "position limit"
    unit: ClassVar[str] = "rad"
    margin: float = field(default=0.02, metadata=about("distance from each limit", unit="rad", least=0))

    def add_constraints(self, program: Any) -> None:
        """Add the constraints of the tendons; joints have bounds of variables."""
        c, own = program.coordinates, program.robot.ranges
        lower, upper = (limit[program.robot.n :] for limit in inside(program.robot, self.margin))
        if not lower.size:
            return
        # tendon lengths are of_y @ y + (matrix of the legs) @ legs
        of_y = np.pad(own.matrix[:, c.independent], ((0, 0), (c.base, 0)))
        for place, (y, legs) in program.body_spots:
            program.constraints.add(
                term=self.name,
                place=place,
                components=own.names[program.robot.n :],
                affine=y.apply(of_y) + legs.apply(own.matrix[:, c.dependent]),
                lower=lower,
                upper=upper,
                measure=degrees("outside"),
            )
