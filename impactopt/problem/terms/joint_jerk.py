"""Bounds on joint jerks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each, of_joints
from impactopt.problem.violation import percent


@dataclass(frozen=True, kw_only=True)
class JointJerk(Term):
    """|joint jerk| is bounded in swing, follow-through and abort motion.

    The jerk of a joint is constant in each interval of a spline. The joints of legs that fixed soles
    determine have no bound. Position and velocity of the servo's reference jump as contact ends. If the limit
    is given by joint, other joints have no bound.
    """

    name: ClassVar[str] = "joint jerk"
    unit: ClassVar[str] = "of limit"
    whole_motion: ClassVar[bool] = True
    limit: float | Mapping[str, float] = field(
        metadata=about("largest jerk, of all or by joint", unit="rad/s^3", above=0, by_joint=True)
    )

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"joint_jerk": BlockRecipe(lambda: joint_jerk(coordinates))}

    def add_constraints(self, program: Any) -> None:
        names = [program.robot.joint_names[k] for k in program.coordinates.independent]
        most = of_joints(self.limit, names) / TYPICAL
        measure = [percent("over its limit", of=limit) for limit in most]
        spots = program.third_derivatives()
        bound_at_each(program, self, "joint_jerk", spots, names, lower=-most, upper=most, measure=measure)


TYPICAL = 1e3  # [rad/s^3] of a strike, by which the constraints are scaled


def joint_jerk(c: StanceCoordinates) -> BlockExpression:
    """Jerks of the independent joints.

    z = y''' (ny), T [s], with the jerk y'''/T^3;  out = jerks over 1000 rad/s^3 (ny less the base's).
    """
    third, T = ca.SX.sym("third", c.ny), ca.SX.sym("T")
    return make_block([third, T], [], {"jerk": third[c.base :] / T**3 / TYPICAL})
