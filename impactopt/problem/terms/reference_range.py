"""Range of the servo's reference while it coasts through the contact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import Measure


@dataclass(frozen=True, kw_only=True)
class ReferenceRange(Term):
    """The servo's reference stays inside the joints' position limits until contact ends.

    During contact the reference coasts at the rates at contact, while the target brakes the robot. So in a
    long contact it moves farther than the joints, and a robot's controller would clip it. Joints without a
    motor, hinges of soles and soft grips, have no reference.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term, also in strikes.
    """

    name: ClassVar[str] = "reference range"
    unit: ClassVar[str] = "rad"
    margin: float = field(
        default=0.0, metadata=about("distance from each limit as contact ends", unit="rad", least=0)
    )
    enabled: bool = field(default=True, metadata=about("false: the reference is not bounded"))

    def limits(self, robot: Any) -> tuple[Any, Any]:
        """Least and largest angles (n,) of the reference [rad], infinite for joints without a motor."""
        margin = np.where(robot.passive, -np.inf, self.margin)
        return robot.lower + margin, robot.upper - margin

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        phases = len(problem.contact_phases)
        return {"coasted": BlockRecipe(lambda: coasted(coordinates, phases), key=(phases,))}

    def add_constraints(self, program: Any) -> None:
        if not program.problem.lasts:
            return
        c, hit = program.coordinates, program.expected
        lower, upper = self.limits(program.robot)
        z = [program.contact_state[0], program.u0[0], *(duration[0] for duration in hit.T)]
        at = program.add_block("coasted", [z], np.zeros(0))
        bounds = {
            "term": self.name,
            "place": "end of contact",
            "measure": Measure("rad", 1.0, "too far"),
        }
        program.constraints.add(
            components=c.labels[c.base :],
            outputs=at + np.arange(c.ny - c.base),
            lower=lower[c.independent],
            upper=upper[c.independent],
            **bounds,
        )
        if c.legs:  # their angles at the end of contact are variables already
            program.constraints.add(
                components=c.leg_labels,
                affine=hit.coast_legs[hit.coast_legs.count - 1],
                lower=lower[c.dependent],
                upper=upper[c.dependent],
                **bounds,
            )


def coasted(c: StanceCoordinates, phases: int) -> BlockExpression:
    """Reference at the end of contact.

    z = y, ydot at contact, duration [s] of each phase of the contact;  out = joints at its end [rad].
    """
    y, rate, times = ca.SX.sym("y", c.ny), ca.SX.sym("rate", c.ny), ca.SX.sym("T", phases)
    return make_block([y, rate, times], [], {"joints": (y + rate * ca.sum1(times))[c.base :]}, lanes=1)
