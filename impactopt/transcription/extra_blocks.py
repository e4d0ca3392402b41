"""Nonlinear functions that only some problems need: of their objectives and of their extra terms.

As in :mod:`impactopt.transcription.blocks`; each with what it depends on beside the robot, the stance and
the striker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.extra_terms import Gaze, HandOrientation, HitCone, HitRegion
from impactopt.problem.objectives import Effort, Objective, PeakForce, TargetEnergy
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import kind_of
from impactopt.transcription.blocks import (
    FORCE_SCALE,
    BlockExpression,
    builders,
    make_block,
    striker_kinematics,
)
from impactopt.transcription.mesh import Elements, contact_mesh
from impactopt.transcription.own_blocks import key_of, own_blocks


@dataclass(frozen=True)
class ExtraBlock:
    """``key``: what shapes the block beside robot, stance and striker; ``build`` makes its expression."""

    key: tuple[Any, ...]
    build: Callable[[], BlockExpression]


def extra_blocks(
    problem: ImpactProblem, c: StanceCoordinates, elements: Elements = ()
) -> dict[str, ExtraBlock]:
    """Block's name -> the block, of what the problem's objectives and terms ask for.

    elements : of the contact, if not those that the problem asks for.
    """
    kinds = {kind_of(o, Objective) for o in problem.objectives}
    out: dict[str, ExtraBlock] = {}
    if PeakForce in kinds:
        stages = len(contact_mesh(problem, elements))
        out["peak"] = ExtraBlock((stages,), lambda: peak(stages))
    if TargetEnergy in kinds:
        out["energy"] = ExtraBlock(problem.target.formula(), lambda: energy(problem.target))
    if Effort in kinds:
        out["effort"] = ExtraBlock((), lambda: effort(c.robot.n))
    out |= _of_terms(problem, c)
    own = own_blocks(problem, c, [*out, *builders(c, problem.striker, problem.law, problem.target, 0)])
    return out | {name: _built(block) for name, block in own.items()}


def _built(block: BlockExpression) -> ExtraBlock:
    return ExtraBlock(key_of(block), lambda: block)


def _of_terms(problem: ImpactProblem, c: StanceCoordinates) -> dict[str, ExtraBlock]:
    out: dict[str, ExtraBlock] = {}
    if problem.extra(HandOrientation) is not None:
        out["hand_orientation"] = ExtraBlock((), lambda: hand_orientation(c, problem.striker))
    if (gazing := problem.extra(Gaze)) is not None:
        out["gaze"] = ExtraBlock((gazing.frame,), lambda: gaze(c, gazing.frame))
    if (region := problem.extra(HitRegion)) is not None:
        disc = region.size is None
        out["hit_region"] = ExtraBlock((disc,), lambda: hit_region(c, problem.striker, disc))
    if problem.extra(HitCone) is not None:
        out["hit_cone"] = ExtraBlock((), lambda: hit_cone(c, problem.striker))
    return out


def peak(stages: int) -> BlockExpression:
    """Lehmer's mean of the contact forces, a smooth maximum.

    z = f [N] at each stage;  out = peak / 100 N.
    """
    f = ca.SX.sym("f", stages)
    g = f / FORCE_SCALE
    # even powers: the sum below is never zero, whatever the signs on the way
    return make_block([f], [], {"peak": ca.sum1(g**9) / (ca.sum1(g**8) + 1e-12)}, lanes=2)


def energy(target: Any) -> BlockExpression:
    """What the target holds or has used up.  z = its state;  p = its numbers;  out = energy [J]."""
    state, numbers = ca.SX.sym("state", target.n_states), ca.SX.sym("numbers", len(target.parameters))
    named = {name: numbers[i] for i, name in enumerate(target.parameters)}
    return make_block([state], [numbers], {"energy": ca.SX(target.energy(state, named))}, lanes=2)


def effort(n: int) -> BlockExpression:
    """z = torques over limits (n), T [s];  out = T x the sum of their squares [s]."""
    torque, T = ca.SX.sym("torque", n), ca.SX.sym("T")
    return make_block([torque, T], [], {"effort": T * ca.sumsqr(torque)})


# ---- terms


def hand_orientation(c: StanceCoordinates, striker: str) -> BlockExpression:
    """z = y;  p = axis (3), direction (3), sine of the angle;  out = cosine between them over that sine."""
    y, axis, direction, sine = ca.SX.sym("y", c.ny), *(ca.SX.sym(s, 3) for s in "ad"), ca.SX.sym("sin")
    still = ca.SX.zeros(c.ny)
    rotation, _ = c.rb_frame(f"striker:{striker}", c.upper_motion(y, still, still)[0])
    out = ca.dot(direction, ca.mtimes(rotation, axis)) / sine
    return make_block([y], [axis, direction, sine], {"cosine": out})


def gaze(c: StanceCoordinates, frame: str) -> BlockExpression:
    """z = y, legs;  p = axis (3), point (3), sine of the angle;  out = as :func:`hand_orientation`."""
    y, legs, sine = ca.SX.sym("y", c.ny), ca.SX.sym("legs", c.nl), ca.SX.sym("sin")
    axis, point = ca.SX.sym("axis", 3), ca.SX.sym("point", 3)
    rotation, origin = c.rb_frame(frame, c.configuration(y, legs))
    way = point - origin
    out = ca.dot(way, ca.mtimes(rotation, axis)) / ca.sqrt(ca.sumsqr(way) + 1e-8) / sine
    return make_block([y, legs], [axis, point, sine], {"cosine": out})


def hit_region(c: StanceCoordinates, striker: str, disc: bool) -> BlockExpression:
    """z = y;  p = point (3), axes of the face (9, by rows), radius if it is a disc.

    out = of the striking point, distance before the face [m]; and across and up [m], or for a disc
    (r^2 - radius^2) / (2 radius) [m].
    """
    y, point, rows = ca.SX.sym("y", c.ny), ca.SX.sym("point", 3), ca.SX.sym("axes", 9)
    radius, still = ca.SX.sym("radius", int(disc)), ca.SX.zeros(c.ny)
    q, v, _ = c.upper_motion(y, still, still)
    at = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[0]
    way = ca.mtimes(ca.reshape(rows, 3, 3).T, at - point)
    side = (ca.sumsqr(way[1:]) - radius**2) / (2 * radius) if disc else way[1:]
    return make_block([y], [point, rows, radius], {"depth": way[0], "side": side}, lanes=2)


TYPICAL = 1.0  # [m/s] of a strike


def hit_cone(c: StanceCoordinates, striker: str) -> BlockExpression:
    """z = y, y', T;  p = axes of the face (9, by rows), tangent of the angle.

    out = ((tangent x speed along the normal)^2 - (speed across it)^2) / (2 tangent x 1 m/s) [m/s]: smooth,
    also where there is no speed across. That the speed along the normal is one of approach is a row anyway.
    """
    y, y1, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T")
    rows, tangent = ca.SX.sym("axes", 9), ca.SX.sym("tan")
    q, v, _ = c.upper_motion(y, y1 / T, ca.SX.zeros(c.ny))
    speed = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[1]
    along, *across = ca.vertsplit(ca.mtimes(ca.reshape(rows, 3, 3).T, speed))
    room = ((tangent * along) ** 2 - ca.sumsqr(ca.vertcat(*across))) / (2 * tangent * TYPICAL)
    return make_block([y, y1, T], [rows, tangent], {"room": room}, lanes=2)
