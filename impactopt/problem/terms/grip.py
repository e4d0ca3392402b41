"""Limits of a supporting hand's grip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import Measure


@dataclass(frozen=True, kw_only=True)
class Grip(Term):
    """Each component of the wrench on a supporting hand is bounded, in the axes of the hand's link.

    The hand is fixed in all six directions, and can pull as well as push. The bounds hold at the nodes of the
    motion, and during contact with all targets. Moments are about the hand's striking point, which is fixed.
    """

    name: ClassVar[str] = "grip"
    unit: ClassVar[str] = "N, N m"
    force: float = field(metadata=about("largest force along each axis", unit="N", above=0))
    moment: float = field(metadata=about("largest moment about each axis", unit="N m", above=0))

    def add_constraints(self, program: Any) -> None:
        most = np.repeat([self.force, self.moment], 3)
        measure = [
            Measure(unit, m, "too much") for unit, m in zip(["N"] * 3 + ["N m"] * 3, most, strict=True)
        ]
        for place, wrench in program.wrenches():
            for k, leg in enumerate(program.coordinates.legs):
                if leg.sole is not None:
                    continue
                program.constraints.add(
                    term=self.name,
                    place=place,
                    components=[f"{leg.end} {name}" for name in WRENCH],
                    affine=wrench[6 * k : 6 * k + 6].apply(np.diag(1 / most)),
                    lower=-1,
                    upper=1,
                    measure=measure,
                )


WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
