"""Peak contact force."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.objectives.base import WEIGHT, Objective

TYPICAL = 100.0  # [N] by which forces are scaled


@dataclass(frozen=True, kw_only=True)
class PeakForce(Objective):
    """The largest contact force; a weight below zero keeps it small.

    In N, of the forces at collocation points, as the smooth maximum sum f^9 / sum f^8 (Lehmer mean). This is
    at most the largest force, and equal to it if the others are zero or as large; for a half sine it is some
    2 % less. The force's jump at first touch, with a damped law, is not at a collocation point.
    """

    name: ClassVar[str] = "peak force"
    unit: ClassVar[str] = "N"
    contact: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        return {"peak": BlockRecipe(peak, of_stages=True)}

    def quantity(self, program: Any) -> Any:
        return program.peak_force()


def peak(stages: int) -> BlockExpression:
    """Lehmer mean of the contact forces, a smooth maximum.

    z = f [N] at each stage;  out = peak / 100 N.
    """
    f = ca.SX.sym("f", stages)
    g = f / TYPICAL
    # with an even power the divisor is positive, though iterates may have negative forces
    return make_block([f], [], {"peak": ca.sum1(g**9) / (ca.sum1(g**8) + 1e-12)}, lanes=2)
