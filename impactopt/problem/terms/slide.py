"""Limit on the striking point's slide across the target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.operational_space import across
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import millimetres


@dataclass(frozen=True, kw_only=True)
class Slide(Term):
    """The striking point is near the hit point as contact ends.

    Its offset there along each of two tangents is bounded, with the expected target; on the way there it may
    be larger (`slide_mm` in `summary.json`). With little friction or none, a long push at an angle may slide
    off the target, whose face ends 0.2 m from the hit point in replays, or from a `HitRegion`. The hit point
    is where the striking point meets the target, anywhere in a `HitRegion`; it stays there also on a target
    that friction moves across the normal.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term, also in strikes.
    """

    name: ClassVar[str] = "slide"
    unit: ClassVar[str] = "m"
    most: float = field(default=0.1, metadata=about("largest offset along each tangent", unit="m", above=0))
    enabled: bool = field(default=True, metadata=about("false: the offset is not bounded"))

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"slide": BlockRecipe(lambda: slide(coordinates, problem.striker))}

    def add_constraints(self, program: Any) -> None:
        after = program.follow_spots()[0][1][0]
        slots, tangents = [program.contact_state[0], after], across(program.problem.normal)
        at = program.add_block("slide", [slots], tangents.ravel())
        program.constraints.add(
            term=self.name,
            place="after contact",
            components=["tangent 1", "tangent 2"],
            outputs=at + np.arange(2),
            lower=-self.most,
            upper=self.most,
            measure=millimetres("too far"),
        )


def slide(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Slide of the striking point across the target during contact.

    z = y at contact, y after it;  p = tangents (6, one after the other);  out = slide along each [m].
    """
    y, after = ca.SX.sym("y", c.ny), ca.SX.sym("after", c.ny)
    tangents, zero = ca.SX.sym("tangents", 6), ca.SX.zeros(c.ny)
    at = striker_kinematics(c, striker)
    begin, end = (at(*c.upper_motion(each, zero, zero)[:2], ca.SX.zeros(c.rb.nv))[0] for each in (y, after))
    moved = ca.mtimes(ca.reshape(tangents, 3, 2).T, end - begin)
    return make_block([y, after], [tangents], {"moved": moved}, lanes=1)
