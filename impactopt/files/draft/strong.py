"""Strongest postures of a bolted arm: blows estimated in many postures, the best solved as strikes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.clearance import Places
from impactopt.errors import InputError
from impactopt.files.draft.hits import Hit
from impactopt.files.draft.target_placement import LOWEST, Arm
from impactopt.kinematics.operational_space import striking_point
from impactopt.kinematics.stance import FixedBase
from impactopt.planning.strike import optimize_strike
from impactopt.problem.feasibility import hopeless
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import Blow, Strength, drawn_blows
from impactopt.problem.terms import FirstTouch
from impactopt.robots.robot import Robot
from impactopt.solvers.program import SolverResult

__all__ = ["ITERATIONS", "SECONDS", "Strong", "duration", "strongest", "touches"]

Array = NDArray[np.float64]
STRIKES, LOOKED_AT = 4, 60  # blows that are solved as strikes; estimated ones that are looked at for them
ALIKE = 0.2  # of the reach: how far apart points with one normal are
# [s] that joints at their contact speed need from the start to contact; and [rad], [m] that the one which
# moves farthest goes there, between these
RUN, BACK = 0.7, (0.35, 0.9)
SHORTER = (1.0, 0.75, 0.55, 0.4)  # of that way, where joints or bodies leave no more
BEHIND = 0.06, 0.15  # [m], and of the reach: of the start behind the target's plane, the smaller at least
PARTS = (0.8, 3.0)  # of the time that joints need for their way: shortest and longest duration
ITERATIONS, SECONDS = 150, 30.0  # of a strike, or a plan, that is tried: most are there in a third of it


@dataclass(frozen=True, kw_only=True, eq=False)
class Strong:
    """A drafted blow: configurations (nq,) to start from and at contact, point (3,) [m], normal (3,), and
    what its strike maximizes, with its unit.
    """

    start: Array
    contact: Array
    point: Array
    normal: Array
    objective: float
    unit: str


def strongest(
    robot: Robot, arm: Arm, q: Array, hit: Hit, *, with_face: bool = True
) -> tuple[list[Strong], str]:
    """Strikes of the blows that are estimated best, the hardest first, and the message of the unsolved one
    that is nearest to a solution; none, and "": check finds a fault with all of them.

    q (nq,) : what does not strike stays as in it.  with_face : the link's face meets the target; else any
    part of it may touch first.
    """
    given = {**hit.given, "terms": () if with_face else (FirstTouch(enabled=False),)}
    strength = Strength(robot=robot, striker=arm.name, law=hit.law, target=hit.target)
    found, unsolved = list[Strong](), list[SolverResult]()
    blows = drawn_blows(strength, q, hit.normals, with_face=with_face)
    for problem, blow in _sound(robot, arm, blows, given):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a strike that fails is no candidate
            solved = optimize_strike(problem, options={"max_iterations": ITERATIONS}, time_limit=SECONDS)
        if solved.status.usable:
            found.append(
                Strong(
                    start=problem.start_posture,
                    contact=blow.q,
                    point=problem.point,
                    normal=problem.normal,
                    objective=sum(solved.objectives.values()),
                    unit=problem.objectives[0].unit,
                )
            )
        else:
            unsolved.append(solved.result)
    nearest = min(unsolved, key=lambda result: result.max_violation, default=None)
    return sorted(found, key=lambda strong: -strong.objective), "" if nearest is None else nearest.message


def duration(robot: Robot, way: Array, usual: tuple[float, float]) -> list[float]:
    """[shortest, longest] [s] of a phase in which joints go a way (n,) [rad] there, or back and there.

    The usual times are those of fast robots. Slow joints need the way over their largest speed at least;
    thrice that leaves room to wind up, and no more than a spline of few intervals can follow.
    """
    needed = float(np.max(np.abs(way) / robot.velocity_limit))
    return [max(short, float(f"{part * needed:.2g}")) for short, part in zip(usual, PARTS, strict=True)]


def _sound(
    robot: Robot, arm: Arm, blows: list[Blow], given: Mapping[str, Any]
) -> Iterator[tuple[ImpactProblem, Blow]]:
    """Problems of the best of estimated blows, unlike each other, that check finds no fault with."""
    blows = [blow for blow in blows if blow.point[2] > LOWEST / 2]
    reach = max((float(np.linalg.norm(blow.point)) for blow in blows), default=0.0)
    taken: list[Blow] = []
    for blow in blows[:LOOKED_AT]:
        near = [b for b in taken if b.normal @ blow.normal > 0.9]
        if any(np.linalg.norm(b.point - blow.point) < ALIKE * reach for b in near):
            continue
        problem = _problem(robot, arm, blow, min(BEHIND[0], BEHIND[1] * reach), given)
        if problem is None:
            continue
        taken.append(blow)
        yield problem, blow
        if len(taken) == STRIKES:
            return


def _problem(
    robot: Robot, arm: Arm, blow: Blow, behind: float, given: Mapping[str, Any]
) -> ImpactProblem | None:
    """A blow's problem, from a start on the way that it comes, so far behind the target's plane at least [m];
    None: there is a fault in it.
    """
    # fewer than three joints reach a curve or a surface, which a rounded point is beside
    point = np.round(blow.point, 3 if len(arm.limb.path) > 2 else 9) + 0.0
    size = float(np.abs(blow.v).max())
    way = blow.v / size * float(np.clip(RUN * size, *BACK))
    for part in SHORTER:
        start = np.array(pin.integrate(robot.model, blow.q, -part * way))
        angles = robot.joint_positions(start)
        edge = 0.02 * np.minimum(robot.upper - robot.lower, 1.0)
        inside = np.all(angles > robot.lower + edge) and np.all(angles < robot.upper - edge)
        at = striking_point(robot, arm.name, start)
        if not inside or blow.normal @ (point - at) < behind or at[2] < LOWEST / 2:
            continue
        try:
            problem = ImpactProblem(
                robot=robot,
                striker=arm.name,
                point=point,
                normal=blow.normal,
                stance=FixedBase(),
                start=start,
                **given,
            )
            clear = not touches(problem, start, blow.q)
        except InputError:
            continue
        if clear and not hopeless(problem):
            return problem
    return None


def touches(problem: ImpactProblem, *postures: Array) -> bool:
    """True if bodies touch in one of these configurations (nq,), before contact."""
    none: Array = np.zeros(len(postures))
    at = Places.of(problem.robot, np.array(postures), none, none.astype(np.intp))
    return bool(problem.bodies.survey(none + np.arange(len(postures)), at).touches)
