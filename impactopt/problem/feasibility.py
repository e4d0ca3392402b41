"""Plausibility checks: valid problems that cannot be solved, found before anything is planned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import linprog

from impactopt.kinematics.inverse_kinematics import Reach, reach
from impactopt.kinematics.operational_space import striking_point
from impactopt.kinematics.support import support_polygon
from impactopt.problem.plausibility import giant_soles
from impactopt.problem.terms import TorqueLimit
from impactopt.problem.terms.first_touch import face_of

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

__all__ = ["hopeless", "sticks_out", "too_weak"]

Array = NDArray[np.float64]
LEANS = 0.05  # [m] a motion may take the centre of mass so far out of the soles, and back in time
AHEAD = 2e-3  # [m] that a link may stick out beyond its striking point without a word
OFF = 0.005  # [m] of a posture that counts as one
_ROUNDED = 1e-6
PAST = 1e-3  # [m] beyond the target's plane, for rounded numbers
DRAWN = 3  # postures that are tried beside the two there are


def hopeless(problem: ImpactProblem) -> list[str]:
    """Reasons why no solve can succeed, most basic first: soles of a giant, a start beyond the target, a
    point out of balance.
    """
    found = list(giant_soles(problem.robot)) or [_beyond(problem), _out_of_balance(problem)]
    return [text for text in found if text]


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


def too_weak(problem: ImpactProblem) -> str:
    """Message if no wrenches on the constrained frames let the torques hold the robot at rest at its
    start; "" otherwise. A motion that falls from there at once may be planned all the same.
    """
    robot, c, limit = problem.robot, problem.coordinates, problem.term(TorqueLimit).fraction
    q = problem.start_posture
    weight = robot.generalized_gravity(robot.model.createData(), q)
    held = c.sole_jacobians(q)[0].T if c.legs else np.zeros((robot.nv, 0))
    base = robot.nv - robot.n
    driven = np.flatnonzero(~(robot.passive | robot.hinges))
    rows, most = base + driven, robot.torque_limit[driven]
    # the least largest share of a limit: a linear program in the wrenches and that share
    each = held[rows] / most[:, None]
    asked = weight[rows] / most
    ones = np.ones((len(rows), 1))
    found = linprog(
        np.append(np.zeros(held.shape[1]), 1.0),
        A_ub=np.vstack([np.hstack([-each, -ones]), np.hstack([each, -ones])]),
        b_ub=np.concatenate([-asked, asked]),
        A_eq=np.hstack([held[c.undriven], np.zeros((len(c.undriven), 1))]) if len(c.undriven) else None,
        b_eq=weight[c.undriven] if len(c.undriven) else None,
        bounds=(None, None),
    )
    if found.status != 0 or found.fun <= limit + _ROUNDED:
        return ""
    share = np.abs(asked - each @ found.x[:-1])
    joint = robot.joint_names[int(driven[int(share.argmax())])]
    return (
        f"the torque limits do not hold the robot's own weight: at rest at its start {joint} bears "
        f"{share.max():.3g} of its limit, and [terms.torque_limit] fraction lets it bear {limit:.3g}; "
        "raise the limits or the fraction, or start from another posture"
    )


def sticks_out(problem: ImpactProblem) -> list[str]:
    """Messages about strikers whose link sticks out beyond the striking point, and so touches first."""
    faces = {striker: face_of(problem, striker) for striker in problem.strikers}
    return [
        f"the link of the striker {striker!r} sticks out {1e3 * face.ahead:.0f} mm beyond it, and touches "
        "first: contact begins earlier than planned; move the striking point to the link's outermost part"
        for striker, face in faces.items()
        if face is not None and face.ahead > AHEAD
    ]


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
