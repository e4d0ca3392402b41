"""Peak contact force."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.laws import ContactLaw
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.objectives.base import WEIGHT, Objective

TYPICAL = 100.0  # [N] by which forces are scaled


@dataclass(frozen=True, kw_only=True)
class PeakForce(Objective):
    """The largest contact force; a weight below zero keeps it small.

    In N, of the forces at first touch and at collocation points, as the smooth maximum sum f^9 / sum f^8
    (Lehmer mean). This is at most the largest force, and equal to it if the others are zero or as large; for
    a half sine it is some 2 % less. With a damped law and several touches, the jumps at the later ones are
    not among these forces.
    """

    name: ClassVar[str] = "smooth peak force"
    unit: ClassVar[str] = "N"
    contact: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        striker, law = problem.striker, problem.law
        return {
            "peak": BlockRecipe(partial(peak, coordinates, striker, law), law.formula(), of_stages=True),
        }

    def quantity(self, program: Any) -> Any:
        return program.peak_force()


def peak(c: StanceCoordinates, striker: str, law: ContactLaw, stages: int) -> BlockExpression:
    """Lehmer mean of the contact forces, a smooth maximum.

    z = y, y', T at contact; f [N] at each stage.
    p = normal (3,); parameters of the law; the target's speed before [m/s].
    out = peak / 100 N.
    """
    y, y1, T, f = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T"), ca.SX.sym("f", stages)
    normal, of_law, before = ca.SX.sym("n", 3), ca.SX.sym("law", len(law.parameters)), ca.SX.sym("before")
    zero = ca.SX.zeros(c.ny)
    _, velocity, _ = striker_kinematics(c, striker)(*c.upper_motion(y, y1 / T, zero))
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    # a damped law has a force as soon as bodies touch; collocation points begin later
    first = law.branch(0.0, ca.dot(normal, velocity) - before, True, named)
    g = ca.vertcat(first, f) / TYPICAL
    # with an even power the divisor is positive, though iterates may have negative forces
    out = ca.sum1(g**9) / (ca.sum1(g**8) + 1e-12)
    return make_block([y, y1, T, f], [normal, of_law, before], {"peak": out}, lanes=2)
