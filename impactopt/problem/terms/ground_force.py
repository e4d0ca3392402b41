"""Normal force of the ground on the soles."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import Measure
from impactopt.robots.loads import fading, weight_of


@dataclass(frozen=True, kw_only=True)
class GroundForce(Term):
    """The normal forces of the soles, of each and in all, are bounded, so that they stay loaded and the robot
    does not land hard.

    The bounds hold at the nodes of the motion, and during contact with all targets. The contact wrench cone
    does not contain them, as it has no scale: near free fall a wrench within it may be too small for a sole
    to stay in place on a soft floor.
    """

    name: ClassVar[str] = "ground force"
    unit: ClassVar[str] = "of weight"
    least: float = field(
        default=0.5,
        metadata=about("least normal force of all soles over the weight", least=0, most=0.9),
    )
    most: float = field(
        default=1.7,
        metadata=about("largest normal force of all soles over the weight", least=1.1),
    )
    sole: float = field(
        default=0.2,
        metadata=about("least normal force of each sole over the weight", least=0, most=0.45),
    )

    enabled: bool = field(default=True, metadata=about("false: soles may be unloaded, and land hard"))

    def add_constraints(self, program: Any) -> None:
        legs, weight = program.coordinates.legs, weight_of(program.problem.robot)
        soles = [k for k, leg in enumerate(legs) if leg.sole is not None]
        if not soles or not weight:
            return
        p = program.problem
        # soles that touch down or lift off at an end of the phase are unloaded there
        fades = {s.name for s, on in zip(p.soles, fading(p.standing)[p.blow], strict=True) if on}
        each = [k for k in soles if len(soles) > 1 and legs[k].name not in fades]
        sets = [("all soles", soles), *((legs[k].end, [k]) for k in each)]
        # sums of normal forces over the weight, one row for each set of soles
        normal = np.zeros((len(sets), 6 * len(legs)))
        for row, (_, indices) in zip(normal, sets, strict=True):
            row[6 * np.array(indices) + 2] = 1 / weight
        alone = len(sets) - 1
        for place, wrench in program.wrenches():
            program.constraints.add(
                term=self.name,
                place=place,
                components=[name for name, _ in sets],
                affine=wrench.apply(normal),
                lower=[self.least, *[self.sole] * alone],
                upper=[self.most, *[np.inf] * alone],
                measure=Measure("% of the weight", 100.0, "out of range"),
            )
