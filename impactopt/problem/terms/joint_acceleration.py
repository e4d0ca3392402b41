"""Bounds on joint accelerations."""

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
class JointAcceleration(Term):
    """|joint acceleration| is bounded at the nodes of swing, follow-through and abort motion.

    Accelerations of joints outside the legs are linear between nodes, so they are bounded everywhere but in
    contact, where the servo's reference has none. If the limit is given by joint, other joints have no bound.
    """

    name: ClassVar[str] = "joint acceleration"
    unit: ClassVar[str] = "of limit"
    whole_motion: ClassVar[bool] = True
    limit: float | Mapping[str, float] = field(
        metadata=about("largest acceleration, of all or by joint", unit="rad/s^2", above=0, by_joint=True)
    )

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"joint_acceleration": BlockRecipe(lambda: joint_acceleration(coordinates))}

    def add_constraints(self, program: Any) -> None:
        names = program.robot.joint_names
        most = of_joints(self.limit, names) / TYPICAL
        measure = [percent("over its limit", of=limit) for limit in most]
        spots = program.motion()
        bound_at_each(
            program, self, "joint_acceleration", spots, names, lower=-most, upper=most, measure=measure
        )


TYPICAL = 100.0  # [rad/s^2] of a strike, by which the constraints are scaled


def joint_acceleration(c: StanceCoordinates) -> BlockExpression:
    """Accelerations of all joints.

    z = y, y', y'' (ny each), legs (nl), T [s];  out = joint accelerations over 100 rad/s^2 (n).
    """
    y, y1, y2, u, udot = (ca.SX.sym(s, c.ny) for s in ("y", "y1", "y2", "u", "udot"))
    legs, T = ca.SX.sym("legs", c.nl), ca.SX.sym("T")
    _, a = c.motion(y, legs, u, udot)
    through = [(u, y1 / T), (udot, y2 / T**2)]
    return make_block([y, y1, y2, legs, T], [], {"acceleration": a[c.base :] / TYPICAL}, through)
