"""What is sound by itself and will not work all the same: found before anything is planned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.balanced import Reach, reach
from impactopt.kinematics.holding import least_holding_share
from impactopt.kinematics.striking_point import striking_point
from impactopt.kinematics.support import support_polygon
from impactopt.problem.plausibility import giant_soles
from impactopt.problem.terms import TorqueLimit

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

__all__ = ["hopeless"]

Array = NDArray[np.float64]
LEANS = 0.05  # [m] a motion may take the centre of mass so far out of the soles, and back in time
OFF = 0.005  # [m] of a posture that counts as one
SLACK = 1e-6  # of a torque limit, for rounded numbers
PAST = 1e-3  # [m] beyond the target's plane, for rounded numbers
DRAWN = 3  # postures that are tried beside the two there are


def hopeless(problem: ImpactProblem) -> list[str]:
    """What no solve can mend, first what to mend first: soles of a giant, torque that does not hold the start
    posture, a start beyond the target, a point out of balance.
    """
    found = [*giant_soles(problem.robot), _too_weak(problem)]
    found += [] if any(found) else [_beyond(problem), _out_of_balance(problem)]
    return [text for text in found if text]


def _too_weak(problem: ImpactProblem) -> str:
    """A start posture that torque limits cannot hold at rest, whatever soles and hands bear."""
    robot, q = problem.robot, problem.start_posture
    frames = problem.stance.constraint_frames(robot)
    limit = robot.torque_limit * problem.term(TorqueLimit).fraction
    needed = least_holding_share(robot, q, frames, limit)
    if needed is None or needed.share <= 1 + SLACK:
        return ""
    joint = needed.joint
    return (
        f"the start posture cannot be held at rest: gravity asks {needed.torque:.3g} N m of joint "
        f"{robot.joint_names[joint]!r}, and {limit[joint]:.3g} N m is the most that the problem allows it; "
        "correct the torque limits, or start from another posture"
    )


def _beyond(problem: ImpactProblem) -> str:
    at = striking_point(problem.robot, problem.striker, problem.start_posture)
    past = float(problem.normal @ (at - problem.point))
    if past <= PAST:
        return ""
    return (
        f"the motion starts beyond the target: the start posture has {problem.striker!r} at "
        f"{np.round(at, 3).tolist()} m, {1e3 * past:.0f} mm past the target's plane along the normal; start "
        "from a posture behind it, move the point further along the normal, or turn the normal round"
    )


def _out_of_balance(problem: ImpactProblem) -> str:
    c = problem.coordinates
    polygon = support_polygon(problem.robot, c)
    if not len(polygon):
        return ""
    found = _nearest(problem, polygon)
    if found.off <= OFF:
        return ""
    names = ", ".join(sole.name for sole in c.soles)
    return (
        f"the point {np.round(problem.point, 3).tolist()} m is out of balance's reach: the best posture "
        f"found is {1e3 * found.off:.0f} mm off it with the centre of mass "
        f"{1e3 * max(found.outside, 0):.0f} mm outside the support polygon of {names}; move the point nearer "
        "to the feet"
    )


def _nearest(problem: ImpactProblem, polygon: Array) -> Reach:
    c, robot = problem.coordinates, problem.robot
    held = [(leg.frame, leg.placement) for leg in c.legs]
    rng = np.random.default_rng(0)
    guesses = [problem.contact_posture, problem.start_posture]
    for _ in range(DRAWN):
        step = np.concatenate([np.zeros(robot.nv - robot.n), 0.3 * rng.standard_normal(robot.n)])
        guesses.append(pin.integrate(robot.model, problem.start_posture, step))
    best = None
    for guess in guesses:
        found = reach(robot, held, polygon, problem.striker, problem.point, guess, lean=LEANS)
        best = found if best is None or found.off < best.off else best
        if best.off <= OFF:
            break
    assert best is not None
    return best
