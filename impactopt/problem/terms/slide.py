"""Limit on the striking point's slide across the target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.operational_space import across
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each
from impactopt.problem.violation import millimetres


@dataclass(frozen=True, kw_only=True)
class Slide(Term):
    """The striking point is near the hit point until contact ends.

    Its offset along each of two tangents is bounded at the collocation points of the collision with the
    expected target (`slide_mm` in `summary.json`: the largest). With little friction or none, a long push at
    an angle may slide off the target, whose face ends 0.2 m from the hit point in replays, or from a
    `HitRegion`. The hit point is where the striking point meets the target, anywhere in a `HitRegion`; it
    stays there also on a target that friction moves across the normal.

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
        # none in an impact without duration: nothing slides
        points, tangents = program.positions_in_contact(), across(program.problem.normal)
        bounds: dict[str, Any] = {"lower": -self.most, "upper": self.most, "measure": millimetres("too far")}
        names = ["tangent 1", "tangent 2"]
        bound_at_each(program, self, "slide", points, names, tangents.ravel(), **bounds)


def slide(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Slide of the striking point across the target since contact.

    z = of `ContactProgram.positions_in_contact`;  p = tangents (6, one after the other);  out = slide along
    each [m].
    """
    y, d1, d = (ca.SX.sym(name, c.ny) for name in ("y", "d1", "d"))
    T1, T = ca.SX.sym("T1"), ca.SX.sym("T")
    after, tangents, zero = y + T1 * d1 + T * d, ca.SX.sym("tangents", 6), ca.SX.zeros(c.ny)
    at = striker_kinematics(c, striker)
    begin, end = (at(*c.upper_motion(each, zero, zero)[:2], ca.SX.zeros(c.rb.nv))[0] for each in (y, after))
    moved = ca.mtimes(ca.reshape(tangents, 3, 2).T, end - begin)
    return make_block([y, d1, T1, d, T], [tangents], {"moved": moved}, lanes=1)
