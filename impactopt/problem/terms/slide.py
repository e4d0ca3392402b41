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

    Its offset along each of two tangents is bounded, with the expected target. With little friction or none,
    a long push at an angle may slide off the target, whose face ends 0.2 m from the hit point in replays. The
    hit point is where it was before contact, also of a target that friction moves across the normal.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term, also in strikes.
    """

    name: ClassVar[str] = "slide"
    unit: ClassVar[str] = "m"
    most: float = field(default=0.1, metadata=about("largest offset along each tangent", unit="m", above=0))
    enabled: bool = field(default=True, metadata=about("false: the offset is not bounded"))

    def add_constraints(self, program: Any) -> None:
        problem = program.problem
        after = program.follow_spots()[0][1][0]
        for k, tangent in enumerate(across(problem.normal), start=1):
            hit = float(tangent @ problem.point)
            index = len(program.constraints.lower)
            program.builder.follow(partial(self._follow, index=index, tangent=tangent))
            program.constraints.add(
                term=self.name,
                place="after contact",
                components=[f"tangent {k}"],
                outputs=np.array([program.add_block("approach", [[after]], tangent)]),
                lower=hit - self.most,
                upper=hit + self.most,
                measure=millimetres("too far"),
            )

    def _follow(self, b: Any, index: int, tangent: Any) -> None:
        """Move the bounds of a constraint to another hit point."""
        hit = float(tangent @ b.problem.point)
        b.constraints.bound(index, hit - self.most, hit + self.most)
