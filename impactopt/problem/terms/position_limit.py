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

    Everywhere: it holds on the spline's control points; for the legs at the nodes, and so for tendons. Hinges
    of soles and tendons, whose range may be small, keep a quarter of it at most.
    """

    name: ClassVar[str] = "position limit"
    unit: ClassVar[str] = "rad"
    margin: float = field(default=0.02, metadata=about("distance from each limit", unit="rad", least=0))

    def add_rows(self, program: Any) -> None:
        """Constraints of the tendons; the joints' are bounds of variables."""
        c, own = program.coordinates, program.robot.ranges
        lower, upper = (limit[program.robot.n :] for limit in inside(program.robot, self.margin))
        if not lower.size:
            return
        of_y = np.pad(own.matrix[:, c.independent], ((0, 0), (c.base, 0)))
        for place, (y, legs) in program.body_spots():
            program.rows.add(
                term=self.name,
                place=place,
                components=own.names[program.robot.n :],
                affine=y.apply(of_y) + legs.apply(own.matrix[:, c.dependent]),
                lower=lower,
                upper=upper,
                measure=degrees("outside"),
            )
