"""Checks a plan's limits between its program's nodes, and selects the nodes to add.

A program holds torques and the ground's wrench to their limits at its nodes. Between two of them the motion
is a spline, and what it needs is not: right after a blow, where accelerations are largest, the ZMP can leave
the soles on its way from one node to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.kinematics.wrench_cone import contact_wrench_cone
from impactopt.problem.terms import ContactWrenchCone, TorqueLimit
from impactopt.robots.sole_margins import cop_margin, least_kept, weight_of
from impactopt.transcription.plan import Plan, sampled
from impactopt.transcription.planned_loads import gear_share
from impactopt.transcription.reference import complete_reference

Array = NDArray[np.float64]
STEP = 1e-3  # [s] at which a motion is looked at: as the servo's reference is sampled
_SHARE, _TORQUE = 0.5, 0.01  # of the room to all torque, and of the limit: what may be given up between nodes
_FRICTION = 1.1  # of the friction coefficient that a plan may use: what it may use between nodes
_ROUNDING = 1e-6  # of the weight, by which a cone's constraints may be off
GEAR = 0.03  # of what a gear may bear: what it may carry more between nodes, or collocation points


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
    """Nodes to add: those known, and the middle between two nodes where the plan leaves its limits.

    It is looked at every millisecond. That is where a sole gives up more than half of a margin that it has at
    the nodes: of its centre of pressure to its own edges, or of its least normal force; or uses a tenth more
    friction than it may; where torques give up half of the room to all that the motors have; where a joint of
    a constrained leg is faster than it may be; and where a gear carries 3 % more than it may.
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
    """Middles between nodes between which the plan is out of its limits, and the legs at its end."""
    p, c = plan.problem, plan.coordinates
    curve, begin, nodes, _ = plan.segment(phase, missed=missed)
    time = sampled(0.0, curve.duration, STEP)
    at = complete_reference(p, *plan.independent(phase, begin + time, missed=missed), legs)
    limit, joints = p.term(TorqueLimit).fraction, slice(c.base, None)
    ratio = np.abs(at.torque / p.robot.torque_limit).max(axis=1, initial=0.0)
    outside = ratio > limit + max(_SHARE * (1.0 - limit), _TORQUE)
    # the others' rates are bounded by their splines' control points
    outside |= (np.abs(at.v[:, joints]) > p.robot.velocity_limit)[:, c.dependent].any(axis=1)
    outside |= gear_share(p, at.torque, at.a[:, joints]) > 1.0 + GEAR
    outside |= _soles_outside(plan, at.sole_wrench)
    between = np.searchsorted(nodes, time[outside] / curve.duration, side="right").clip(1, len(nodes) - 1)
    middles = [float((nodes[k - 1] + nodes[k]) / 2) for k in np.unique(between)]
    return middles, c.split(at.q[-1])[1]


def _soles_outside(plan: Plan, wrenches: Array) -> NDArray[np.bool_]:
    """Instants (k,) at which some sole keeps too little of its limits, from wrenches (k, 6 a sole)."""
    robot, soles, cone = plan.problem.robot, plan.coordinates.soles, plan.problem.term(ContactWrenchCone)
    own, least = wrenches.reshape(len(wrenches), -1, 6)[:, : len(soles)], least_kept(cone.margin)
    outside = (cop_margin(robot, [sole.polygon for sole in soles], own) < least).any(axis=1)
    outside |= (own[:, :, 2] < _SHARE * cone.minimum_force).any(axis=1)
    # friction and torsion: the cone of the corners moved inwards by no more than what the margin has to keep
    for k, sole in enumerate(soles):
        rows = contact_wrench_cone(sole.polygon, _FRICTION * cone.friction, margin=max(least, 0.0))
        outside |= (own[:, k] @ rows.T < -_ROUNDING * weight_of(robot)).any(axis=1)
    return np.asarray(outside)
