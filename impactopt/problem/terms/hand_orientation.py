"""Orientation of the hand at contact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.bodies.world import Vector
from impactopt.contact.fields import about, described
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each
from impactopt.problem.violation import degrees


@dataclass(frozen=True, kw_only=True)
class HandOrientation(Term):
    """An axis of the hand points in a given direction at contact."""

    name: ClassVar[str] = "hand orientation"
    unit: ClassVar[str] = "rad"
    axis: Vector = field(metadata=about("axis of the hand, in the striker's frame", direction=True))
    direction: Vector | None = field(
        default=None,
        metadata=about("its direction at contact, in the world frame; left out: the normal", direction=True),
    )
    angle: float = described(0.2, "largest angle between the two", unit="rad", above=0)

    def __post_init__(self) -> None:
        self.check_angle()
        super().__post_init__()

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"hand_orientation": BlockRecipe(lambda: hand_orientation(coordinates, problem.striker))}

    def add_constraints(self, program: Any) -> None:
        direction = program.problem.normal if self.direction is None else self.direction
        numbers = np.array([*self.axis, *direction, np.sin(self.angle)])
        spots, names = [("contact", [program.contact_state[0]])], [program.problem.striker]
        bounds: dict[str, Any] = {"lower": 1 / np.tan(self.angle), "measure": degrees("too far off")}
        bound_at_each(program, self, "hand_orientation", spots, names, numbers, **bounds)


def hand_orientation(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Cosine of the angle between the hand's axis and its direction.

    z = y;  p = axis (3), direction (3), sine of the largest angle;  out = cosine over that sine. So the
    constraint's slope in the angle is 1 at the bound.
    """
    y, axis, direction, sine = ca.SX.sym("y", c.ny), *(ca.SX.sym(s, 3) for s in "ad"), ca.SX.sym("sin")
    zero = ca.SX.zeros(c.ny)
    rotation, _ = c.rb_frame(f"striker:{striker}", c.upper_motion(y, zero, zero)[0])
    out = ca.dot(direction, ca.mtimes(rotation, axis)) / sine
    return make_block([y], [axis, direction, sine], {"cosine": out})
