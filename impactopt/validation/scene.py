"""The scene of a problem, as an engine gets it."""

from __future__ import annotations

from impactopt.problem import ImpactProblem
from impactopt.support import support_polygon
from impactopt.validation.result import Scene


def scene_of(problem: ImpactProblem) -> Scene:
    """Target, contact and held soles of ``problem``."""
    p = problem
    return Scene(
        point=p.point,
        normal=p.normal,
        law=p.law,
        target=p.target,
        striker=p.robot.striker(p.striker).model_frame,
        soles=p.stance.constraint_frames(p.robot),
        corners=tuple(sole.polygon for sole in p.stance.soles(p.robot)),
        polygon=support_polygon(p.robot, p.coordinates),
    )
