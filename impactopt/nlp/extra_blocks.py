"""Nonlinear functions that only some problems need: of their objectives and of their extra terms.

As in :mod:`impactopt.nlp.blocks`; each with what it depends on beside the robot, the stance and the striker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from impactopt.coordinates import StanceCoordinates
from impactopt.nlp.blocks import FORCE_SCALE, BlockExpression, make_block
from impactopt.nlp.mesh import stage_count
from impactopt.objectives import Effort, PeakForce, TargetEnergy
from impactopt.problem import ImpactProblem


@dataclass(frozen=True)
class ExtraBlock:
    """``key``: what shapes the block beside robot, stance and striker; ``build`` makes its expression."""

    key: tuple[Any, ...]
    build: Callable[[], BlockExpression]


def extra_blocks(problem: ImpactProblem, c: StanceCoordinates) -> dict[str, ExtraBlock]:
    """Block's name -> the block, of what the problem's objectives and terms ask for."""
    kinds = {type(o) for o in problem.objectives}
    out: dict[str, ExtraBlock] = {}
    if PeakForce in kinds:
        stages = stage_count(problem.collision_elements, problem.collision_stages)
        out["peak"] = ExtraBlock((stages,), lambda: peak(stages))
    if TargetEnergy in kinds:
        out["energy"] = ExtraBlock(problem.target.formula(), lambda: energy(problem.target))
    if Effort in kinds:
        out["effort"] = ExtraBlock((), lambda: effort(c.robot.n))
    return out


def peak(stages: int) -> BlockExpression:
    """Lehmer's mean of the contact forces, a smooth maximum.

    z = f [N] at each stage;  out = peak / 100 N.
    """
    f = ca.SX.sym("f", stages)
    g = f / FORCE_SCALE
    # even powers: the sum below is never zero, whatever the signs on the way
    return make_block([f], [], {"peak": ca.sum1(g**9) / (ca.sum1(g**8) + 1e-12)})


def energy(target: Any) -> BlockExpression:
    """What the target holds or has used up.  z = its state;  p = its numbers;  out = energy [J]."""
    state, numbers = ca.SX.sym("state", target.n_states), ca.SX.sym("numbers", len(target.parameters))
    named = {name: numbers[i] for i, name in enumerate(target.parameters)}
    return make_block([state], [numbers], {"energy": ca.SX(target.energy(state, named))})


def effort(n: int) -> BlockExpression:
    """z = torques over limits (n), T [s];  out = T x the sum of their squares [s]."""
    torque, T = ca.SX.sym("torque", n), ca.SX.sym("T")
    return make_block([torque, T], [], {"effort": T * ca.sumsqr(torque)})
