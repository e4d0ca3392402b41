"""Cone of allowed directions of the impact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.bodies.world import face_axes
from impactopt.contact.fields import described
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each
from impactopt.problem.violation import Measure

TYPICAL = 1.0  # [m/s] speed of a strike, by which the constraint is scaled


@dataclass(frozen=True, kw_only=True)
class HitCone(Term):
    """The striking point's velocity at contact, relative to the target's, lies in a cone about the normal;
    this replaces `incidence`.
    """

    name: ClassVar[str] = "hit cone"
    unit: ClassVar[str] = "m/s"
    angle: float = described(0.1, "largest angle between velocity and normal", unit="rad", above=0)

    def __post_init__(self) -> None:
        self.check_angle()
        super().__post_init__()

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"hit_cone": BlockRecipe(lambda: hit_cone(coordinates, problem.striker))}

    def add_constraints(self, program: Any) -> None:
        problem, (y, y1, _) = program.problem, program.contact_state
        # none of these is a parameter that a built program may change
        before = problem.target.speed_before()
        numbers = np.array([*face_axes(problem.normal).ravel(), before, np.tan(self.angle)])
        spots, measure = [("contact", [y, y1, program.contact_T])], Measure("m/s", 1.0, "too fast")
        names = ["across the normal"]
        bound_at_each(program, self, "hit_cone", spots, names, numbers, lower=0, measure=measure)


def hit_cone(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Margin of the striking point's velocity in its cone.

    z = y, y', T;  p = axes of the face (9, row by row), speed of the target [m/s], tangent of the angle;
    out = ((tangent x speed of approach)^2 - (speed across the normal)^2) / (2 tangent x 1 m/s) [m/s].

    The squares keep it smooth where there is no speed across the normal. Another constraint requires that the
    speed of approach is positive.
    """
    y, y1, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T")
    axes, before, tangent = ca.SX.sym("axes", 9), ca.SX.sym("before"), ca.SX.sym("tan")
    q, v, _ = c.upper_motion(y, y1 / T, ca.SX.zeros(c.ny))
    velocity = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[1]
    along, *across = ca.vertsplit(ca.mtimes(ca.reshape(axes, 3, 3).T, velocity))
    room = ((tangent * (along - before)) ** 2 - ca.sumsqr(ca.vertcat(*across))) / (2 * tangent * TYPICAL)
    return make_block([y, y1, T], [axes, before, tangent], {"room": room}, lanes=2)
