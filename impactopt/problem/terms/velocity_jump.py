"""Limit on the jump of joint velocities in the impact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, joint_motion, make_block
from impactopt.problem.terms.base import Term, of_joints
from impactopt.problem.violation import Measure


@dataclass(frozen=True, kw_only=True)
class VelocityJump(Term):
    """|joint speed after contact - before it| is bounded, with all targets.

    If the limit is given by joint, other joints have no bound.
    """

    name: ClassVar[str] = "velocity jump"
    unit: ClassVar[str] = "rad/s"
    limit: float | Mapping[str, float] = field(
        metadata=about("largest jump, of all or by joint", unit="rad/s", above=0, by_joint=True)
    )

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        if not coordinates.legs:
            return {}
        return {"leg_jump": BlockRecipe(lambda: leg_jump(coordinates))}

    def add_constraints(self, program: Any) -> None:
        """Add the constraints: linear ones in the rates of independent joints, and a block's for the legs."""
        c = program.coordinates
        robot = program.robot
        most = np.where(robot.passive, np.inf, of_joints(self.limit, robot.joint_names))
        measure = Measure("rad/s", 1.0, "too much")
        ends = program.contact_ends()
        at = 0
        if c.legs:
            at = program.add_block("leg_jump", [[*e.before, *e.after] for e in ends], np.zeros(0))
        for k, end in enumerate(ends):
            program.constraints.add(
                term=self.name,
                place=end.place,
                components=c.labels[c.base :],
                affine=end.change[c.base :],
                lower=-most[c.independent],
                upper=most[c.independent],
                measure=measure,
            )
            program.constraints.add(
                term=self.name,
                place=end.place,
                components=c.leg_labels,
                outputs=at + c.nl * k + np.arange(c.nl),
                lower=-most[c.dependent],
                upper=most[c.dependent],
                measure=measure,
            )


def leg_jump(c: StanceCoordinates) -> BlockExpression:
    """Jump of the legs' rates.

    z = z of `joint_motion` before contact, and after it;  out = change of the legs' rates [rad/s] (nl).
    """
    before, after = joint_motion(c), joint_motion(c)
    legs = [int(j) for j in c.dependent]
    change = ca.vertcat(*[after.velocity[j] - before.velocity[j] for j in legs])
    through = [*before.through, *after.through]
    return make_block([*before.z, *after.z], [], {"jump": change}, through)
