"""Effort of the joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.objectives.base import WEIGHT, Objective


@dataclass(frozen=True, kw_only=True)
class Effort(Objective):
    """Cost: integral of (torque / limit)^2 over swing and follow-through, summed over joints.

    In s, by the trapezoidal rule on the nodes; stance phases before and after them are not counted. It is
    meant as a secondary objective with a small weight.
    """

    name: ClassVar[str] = "effort"
    unit: ClassVar[str] = "s"
    cost: ClassVar[bool] = True
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        return {"effort": BlockRecipe(lambda: effort(coordinates.robot.n))}

    def quantity(self, program: Any) -> Any:
        """Trapezoidal sum of T sum(tau^2), which is a lifted variable at each node."""
        swing, follow = program.torque_profiles()[:2]
        # from rest the torque at the start is constant; after a stance phase it is a variable
        known = int(not swing.torques[0].cols.size)
        slots = [[tau, swing.T] for tau in swing.torques[known:]] + [
            [tau, follow.T] for tau in follow.torques
        ]
        at = program.add_block("effort", slots, np.zeros(0))
        places = [*map(swing.place_at, swing.nodes[known:]), *map(follow.place_at, follow.nodes)]
        # by these names a program with more nodes maps the variables
        labels = [place.name for place in places]
        of_node = program.lift("effort of a node", at + np.arange(len(slots)), labels=labels)[0]
        of_swing = trapezoid(swing.nodes)
        weights = np.array([*of_swing[known:], *trapezoid(follow.nodes)])
        at_start = known * of_swing[0] * float(np.sum(swing.torques[0].const ** 2))
        return of_node.apply(weights[None]) + swing.T * at_start


def effort(n: int) -> BlockExpression:
    """Integrand of the effort.

    z = torques over limits (n), T [s];  out = T x sum of their squares [s].
    """
    torque, T = ca.SX.sym("torque", n), ca.SX.sym("T")
    return make_block([torque, T], [], {"effort": T * ca.sumsqr(torque)})


def trapezoid(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (k,) of the trapezoidal rule on ascending nodes (k,)."""
    half = np.diff(nodes) / 2
    return np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])
