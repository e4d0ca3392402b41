"""Slip of the striking point across the target, whose contact is frictionless and whose face has a finite
size.
"""

from __future__ import annotations

import numpy as np

from impactopt.kinematics.directions import across
from impactopt.kinematics.striking_point import striking_point
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Slide
from impactopt.simulation.target_dynamics import FACE
from impactopt.transcription.plan import Plan

FAR = 0.15  # [m] across the target's face: a plan that slides so far is reported so
INSTANTS = 9  # of the contact
MORE = 0.03  # of what it may be: no more than a mesh leaves it


def slide(problem: ImpactProblem, plan: Plan) -> float:
    """[m] across the normal that the striking point goes while the contact lasts, as planned."""
    if len(plan.collision.time) < 2 or plan.collision.time[-1] <= 0:
        return 0.0
    postures = plan.closed(plan.through_contact(np.linspace(0.0, 1.0, INSTANTS)))
    places = np.array([striking_point(problem.robot, problem.striker, q) for q in postures])
    way = places - places[0]
    aside = way @ across(problem.normal).T
    return float(np.linalg.norm(aside, axis=1).max())


def slides_beyond(term: Slide, plan: Plan) -> str:
    """Message with the striking point's offset from the hit point as contact ends; "" if it is within the
    limit along each tangent, but for a tolerance.
    """
    problem = plan.problem
    after = plan.closed(plan.through_contact(np.ones(1)))[0]
    away = striking_point(problem.robot, problem.striker, after) - problem.point
    far = float(np.abs(across(problem.normal) @ away).max())
    if far <= (1 + MORE) * term.most:
        return ""
    most = f"which may be {1e3 * term.most:.0f} mm"
    return f"the striking point slides {1e3 * far:.0f} mm across the target, {most}"


def slide_caution(length: float) -> str:
    """Warning about a slide of this length [m]; "" if it is short."""
    if length <= FAR:
        return ""
    return (
        f"The striking point slides {1e3 * length:.0f} mm across the target: contact has no friction. "
        f"In replays the face ends {1e3 * FACE:.0f} mm from the hit point; [terms.slide] keeps it there."
    )
