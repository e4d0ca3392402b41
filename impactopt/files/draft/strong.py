"""Strongest impacts of a bolted arm: estimates in many postures, of which the best are solved as strikes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.clearance import Places
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.contact.targets import FreeMass
from impactopt.errors import InputError
from impactopt.files.draft.hits import Hit
from impactopt.files.draft.target_placement import LOWEST, Arm, rounded_point
from impactopt.kinematics.operational_space import striking_point
from impactopt.kinematics.stance import FixedBase
from impactopt.planning.strike import optimize_strike
from impactopt.problem.feasibility import hopeless
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import EstimatedImpact, Strength, drawn_impacts, touches
from impactopt.problem.terms import FirstTouch
from impactopt.robots.robot import Robot
from impactopt.solvers.program import SolverResult

MAX_STRIKES, MAX_CANDIDATES = 6, 60  # impacts solved as strikes; estimated impacts considered for them
MIN_DISTANCE, ALIKE = 0.2, 0.6  # of hit points, over the reach, if the cosine of their normals is larger
# The start posture is that of contact, moved back at the contact velocity for so long [s], so that the joint
# that moves farthest travels between these [rad], [m].
RUN_UP, TRAVEL = 0.7, (0.35, 0.9)
TRAVEL_FACTORS = (1.0, 0.75, 0.55, 0.4)  # on the travel, tried while joint limits or bodies are in conflict
# least distance of the start behind the target's plane: the smaller of so many [m] and so much of the reach
BEHIND = 0.06, 0.15
SWING, FOLLOW = (0.5, 1.2), (0.6, 1.5)  # durations [s] for fast robots
DURATION_FACTORS = (0.8, 3.0)  # shortest and longest duration over the time at the velocity limits
LEVEL = 1e-3  # [m] tolerance of heights, to which hit points are rounded
AFTER = 0.6  # [s] in which a target that flies away may not meet the base
AFTER_STEP = 0.03  # [m] of its travel between two tests
# Limit of a trial strike or plan: most need a third. A time limit would make drafts depend on the machine.
TRIAL = {"max_iterations": 200}


@dataclass(frozen=True, kw_only=True, eq=False)
class Strong:
    """A solved strike: configurations (nq,) at the start and at contact, hit point (3,) [m], normal (3,), and
    the value of its objective, with the unit.
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
    """Solved strikes of the impacts with the best estimates, the hardest first, and a message.

    The message is that of the unsolved strike nearest to a solution, "" if `check` refuses all of them.

    q (nq,) : configuration of the joints that do not strike.  with_face : the striking link's face meets the
    target; else any part of it may touch first.
    """
    given = {**hit.given, "terms": () if with_face else (FirstTouch(enabled=False),)}
    strength = Strength(robot=robot, striker=arm.name, law=hit.law, target=hit.target)
    found, unsolved = list[Strong](), list[SolverResult]()
    impacts = drawn_impacts(strength, q, hit.normals, with_face=with_face)
    candidates = list(_candidates(robot, arm, impacts, given)) or _candidates(
        robot, arm, impacts, given, clipped=True
    )
    for problem, impact in candidates:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a strike that fails is no candidate
            solved = optimize_strike(problem, options=TRIAL)
        if solved.status.usable:
            found.append(
                Strong(
                    start=problem.start_posture,
                    contact=impact.q,
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


def durations(robot: Robot, way: Array) -> dict[str, tuple[float, float]]:
    """Shortest and longest duration [s] of swing and follow, in which joints travel `way` (n,) [rad], with or
    without winding up.

    Slow joints need at least the travel over their velocity limit. Three times that is enough to wind up, and
    not too long for a spline of few intervals.
    """
    needed = float(np.max(np.abs(way) / robot.velocity_limit))
    slow = [float(f"{factor * needed:.2g}") for factor in DURATION_FACTORS]
    usual = {"swing": SWING, "follow": FOLLOW}
    return {name: (max(low, slow[0]), max(high, slow[1])) for name, (low, high) in usual.items()}


def _candidates(
    robot: Robot,
    arm: Arm,
    impacts: list[EstimatedImpact],
    given: Mapping[str, Any],
    *,
    clipped: bool = False,
) -> Iterator[tuple[ImpactProblem, EstimatedImpact]]:
    """Feasible problems of the best estimated impacts, with different hit points or normals.

    clipped : joints with less range than their run-up begin at its end, as those of telescopes.
    """
    highest = max((float(impact.point[2]) for impact in impacts), default=0.0)
    impacts = [impact for impact in impacts if impact.point[2] > _floor(highest)]
    reach = max((float(np.linalg.norm(impact.point)) for impact in impacts), default=0.0)
    taken: list[EstimatedImpact] = []
    for impact in impacts[:MAX_CANDIDATES]:
        near = [b for b in taken if b.normal @ impact.normal > ALIKE]
        if any(np.linalg.norm(b.point - impact.point) < MIN_DISTANCE * reach for b in near):
            continue
        behind = min(BEHIND[0], BEHIND[1] * reach)
        problem = strike_problem(robot, arm.name, impact, behind=behind, given=given, clipped=clipped)
        if problem is None:
            continue
        taken.append(impact)
        yield problem, impact
        if len(taken) == MAX_STRIKES:
            return


def _floor(height: float) -> float:
    """Least height [m] of a striking point that has to reach a height: an arm may move in a low plane."""
    return min(LOWEST / 2, max(height, 0.0)) - LEVEL


def strike_problem(
    robot: Robot,
    striker: str,
    impact: EstimatedImpact,
    *,
    behind: float,
    given: Mapping[str, Any],
    clipped: bool = False,
) -> ImpactProblem | None:
    """Problem of an estimated impact, with a start posture from which a swing leads to it; None if no start
    posture is feasible.

    behind : least distance [m] of the start behind the target's plane.  given : other arguments of
    `ImpactProblem`.  clipped : joints with less range than their run-up begin at its end.
    """
    point = rounded_point(robot, striker, impact.point)
    floor = _floor(float(impact.point[2]))
    size = float(np.abs(impact.v).max())
    way = impact.v / size * float(np.clip(RUN_UP * size, *TRAVEL))
    for factor in TRAVEL_FACTORS:
        start = np.array(pin.integrate(robot.model, impact.q, -factor * way))
        angles = robot.joint_positions(start)
        edge = 0.02 * np.minimum(robot.upper - robot.lower, 1.0)
        within = np.clip(angles, robot.lower + edge, robot.upper - edge)
        start = np.array(pin.integrate(robot.model, start, within - angles)) if clipped else start
        inside = clipped or np.array_equal(angles, within)
        at = striking_point(robot, striker, start)
        if not inside or impact.normal @ (point - at) < behind or at[2] < floor:
            continue
        try:
            problem = ImpactProblem(
                robot=robot,
                striker=striker,
                point=point,
                normal=impact.normal,
                stance=FixedBase(),
                start=start,
                near_contact=impact.q,
                **given,
            )
            if problem.bodies.overlaps or touches(problem, start, impact.q):
                continue
            if _hits_base(problem, impact):
                return None  # whatever the start
        except InputError:
            continue
        if not hopeless(problem):
            return problem
    return None


def _hits_base(problem: ImpactProblem, impact: EstimatedImpact) -> bool:
    """True if the target, as fast as estimated, flies into a link that no joint moves."""
    if not isinstance(problem.target, FreeMass):
        return False
    travel = np.arange(0.0, AFTER * impact.impulse / problem.target.mass, AFTER_STEP)
    after, moved = np.full(len(travel), 2), np.outer(travel, problem.normal)
    at = Places.of(problem.robot, np.tile(impact.q, (len(travel), 1)), after, moved)
    fixed = {piece.link for piece in bodies_of(problem.robot).pieces if piece.joint == 0}
    found = problem.bodies.touches(travel, at)
    return any("target" in (touch.one, touch.other) and {touch.one, touch.other} & fixed for touch in found)
