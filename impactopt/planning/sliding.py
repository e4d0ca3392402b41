"""How far a blow's striking point slides across the target, which has no friction and a face of some size."""

from __future__ import annotations

import numpy as np

from impactopt.kinematics.striking_point import striking_point
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.struck import FACE
from impactopt.transcription.plan import Plan

FAR = 0.1  # [m] across the target's face: a plan that slides so far is told so
INSTANTS = 9  # of the contact


def slide(problem: ImpactProblem, plan: Plan) -> float:
    """[m] across the normal that the striking point goes while the contact lasts, as planned."""
    if len(plan.collision.time) < 2 or plan.collision.time[-1] <= 0:
        return 0.0
    postures = plan.closed(plan.through_contact(np.linspace(0.0, 1.0, INSTANTS)))
    places = np.array([striking_point(problem.robot, problem.striker, q) for q in postures])
    way = places - places[0]
    across = way - np.outer(way @ problem.normal, problem.normal)
    return float(np.linalg.norm(across, axis=1).max())


def slide_caution(length: float) -> str:
    """What is to be said of a slide [m]; "" if it is short."""
    if length <= FAR:
        return ""
    return (
        f"The striking point slides {1e3 * length:.0f} mm across the target: contact has no friction. "
        f"In replays the face ends {1e3 * FACE:.0f} mm from the hit point; [terms.slide] keeps it there."
    )
