"""What a plan does between its program's nodes, and the nodes that it takes to keep its limits there, too.

A program holds torques and the ground's wrench to their limits at its nodes. Between two of them the motion
is a spline, and what it needs is not: right after a blow, where accelerations are largest, the ZMP can leave
the soles on its way from one node to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.kinematics.support import margin, zmp
from impactopt.problem.terms import ContactWrenchCone, TorqueLimit
from impactopt.transcription.plan import Plan
from impactopt.transcription.planned_loads import gear_share
from impactopt.transcription.reference import complete_reference

Array = NDArray[np.float64]
_SHARE = 0.5  # of a margin that may be given up between nodes
_ZMP, _TORQUE = 1e-3, 0.01  # [m], and of the limit: what may be given up of any
GEAR = 0.03  # of what a gear may bear: what it may bear more between nodes, or collocation points


class MoreNodes(NamedTuple):
    """Places on [0, 1] of nodes beside the ends and middles of a spline's intervals: of the swing, and of all
    ways to rest."""

    swing: tuple[float, ...] = ()
    follow: tuple[float, ...] = ()

    @property
    def total(self) -> int:
        return len(self.swing) + len(self.follow)


NO_MORE = MoreNodes()


def nodes_to_add(plan: Plan, known: MoreNodes) -> MoreNodes:
    """Those known, and more where the plan leaves its limits half-way from one node to the next.

    That is where it gives up more than half of a margin that it has at the nodes: of the ZMP to the edge of
    the support polygon, of torques to all that the motors have; where a joint of a held leg is faster than it
    may be; and where a gear bears 3 % more than it may.
    """
    start = plan.coordinates.split(plan.problem.start_posture)[1]
    swing, legs = _middles_outside(plan, 0, start)
    follow = _middles_outside(plan, 2, legs)[0]
    if plan.abort is not None:
        follow += _middles_outside(plan, 2, legs, missed=True)[0]
    return MoreNodes(
        tuple(sorted({*known.swing, *swing})),
        tuple(sorted({*known.follow, *follow})),
    )


def _middles_outside(
    plan: Plan, phase: int, legs: Array, *, missed: bool = False
) -> tuple[list[float], Array]:
    """Middles between nodes at which the plan is out of its limits, and the legs at the last of them."""
    p, c = plan.problem, plan.coordinates
    curve, begin, nodes, _ = plan.segment(phase, missed=missed)
    places = (nodes[1:] + nodes[:-1]) / 2
    y, yd, ydd, wrench = plan.independent(phase, begin + places * curve.duration, missed=missed)
    q, v, a, torque, ground = complete_reference(p, y, yd, ydd, wrench, legs)
    limit, cone = p.term(TorqueLimit).fraction, p.term(ContactWrenchCone)
    ratio = np.abs(torque / p.robot.torque_limit).max(axis=1, initial=0.0)
    outside = ratio > limit + max(_SHARE * (1.0 - limit), _TORQUE)
    # the others' rates are bounded by their splines' control points
    outside |= (np.abs(v[:, c.base :]) > p.robot.velocity_limit)[:, c.dependent].any(axis=1)
    outside |= gear_share(p, torque, a[:, c.base :]) > 1.0 + GEAR
    if len(plan.polygon):
        inside = margin(plan.polygon, zmp(ground)) >= cone.margin - max(_SHARE * cone.margin, _ZMP)
        outside |= ~inside | (ground[:, 2] <= 0.0)
    return [float(s) for s in places[outside]], c.split(q[-1])[1]
