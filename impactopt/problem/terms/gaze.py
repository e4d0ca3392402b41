"""Gaze direction of the robot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.bodies.world import Vector
from impactopt.contact.fields import about, described
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each
from impactopt.problem.violation import degrees


@dataclass(frozen=True, kw_only=True)
class Gaze(Term):
    """An axis of a frame, such as the head's, points at the hit point during the swing.

    The angle is between the axis and the line from the frame's origin to the problem's point. It is bounded
    at the nodes of the swing after a fraction of it, and at contact.
    """

    name: ClassVar[str] = "gaze"
    unit: ClassVar[str] = "rad"
    frame: str = field(metadata=about("name of the robot's frame"))
    axis: Vector = field(metadata=about("direction of view, in the frame", direction=True))
    angle: float = described(0.5, "largest angle of the hit point to the axis", unit="rad", above=0)
    since: float = described(0.5, "share of the swing before it holds", least=0)

    def __post_init__(self) -> None:
        self.check_angle()
        super().__post_init__()
        if self.since > 1:
            raise InputError(f"Gaze.since is {self.since:g}; give a fraction of the swing, from 0 to 1")

    @property
    def frames(self) -> tuple[str, ...]:
        return (self.frame,)

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"gaze": BlockRecipe(lambda: gaze(coordinates, self.frame), (self.frame,))}

    def add_constraints(self, program: Any) -> None:
        nodes = program.swing_spots(self.since)

        def numbers(point: Any) -> Any:
            return np.array([*self.axis, *point, np.sin(self.angle)])

        bounds: dict[str, Any] = {"lower": 1 / np.tan(self.angle), "measure": degrees("too far off")}
        bound_at_each(program, self, "gaze", nodes, [self.frame], numbers(program.problem.point), **bounds)
        program.builder.follow(lambda b: b.block("gaze").take_parameters(numbers(b.problem.point)))


def gaze(c: StanceCoordinates, frame: str) -> BlockExpression:
    """Cosine of the angle between gaze and hit point.

    z = y, legs;  p = axis (3), point (3), sine of the largest angle;  out = cosine over that sine. So the
    constraint's slope in the angle is 1 at the bound.
    """
    y, legs, sine = ca.SX.sym("y", c.ny), ca.SX.sym("legs", c.nl), ca.SX.sym("sin")
    axis, point = ca.SX.sym("axis", 3), ca.SX.sym("point", 3)
    rotation, origin = c.rb_frame(frame, c.configuration(y, legs))
    line = point - origin
    # 1e-8 m^2 keeps the root smooth where the origin is at the point
    out = ca.dot(line, ca.mtimes(rotation, axis)) / ca.sqrt(ca.sumsqr(line) + 1e-8) / sine
    return make_block([y, legs], [axis, point, sine], {"cosine": out})
