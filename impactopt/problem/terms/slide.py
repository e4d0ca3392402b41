"""Limit on the striking point's slide across the target."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.kinematics.operational_space import across
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import millimetres


@dataclass(frozen=True, kw_only=True)
class Slide(Term):
    """The striking point stays near the hit point until contact ends.

    Bounded along each of two tangents, with the expected target. With little friction at the hit, or none, a
    long push at an angle may slide off what it pushes: in replays a target's face ends 0.2 m from the hit
    point.

    It holds with its defaults where a problem does not have it. Rows are then added once a motion without
    them goes beyond; where it is given they are there from the start, and in strikes.
    """

    name: ClassVar[str] = "slide"
    unit: ClassVar[str] = "m"
    most: float = field(default=0.1, metadata=about("largest way along each tangent", unit="m", above=0))
    enabled: bool = field(default=True, metadata=about("false: it goes as far as it goes"))

    def add_rows(self, program: Any) -> None:
        problem = program.problem
        after = program.follow_spots()[0][1][0]
        for k, tangent in enumerate(across(problem.normal), start=1):
            place = float(tangent @ problem.point)
            row = len(program.rows.lower)
            program.builder.follow(partial(self._follow, row=row, tangent=tangent))
            program.rows.add(
                term=self.name,
                place="after contact",
                components=[f"tangent {k}"],
                outputs=np.array([program.add_block("approach", [[after]], tangent)]),
                lower=place - self.most,
                upper=place + self.most,
                measure=millimetres("too far"),
            )

    def _follow(self, b: Any, row: int, tangent: Any) -> None:
        place = float(tangent @ b.problem.point)
        b.rows.bound(row, place - self.most, place + self.most)
