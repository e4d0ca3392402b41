"""The scene of a problem, as numbers for an engine."""

from __future__ import annotations

from impactopt.contact.laws import SpringDamper
from impactopt.contact.targets import FreeMass
from impactopt.errors import InputError
from impactopt.problem import ImpactProblem
from impactopt.support import support_polygon
from impactopt.validation.result import Scene


def scene_of(problem: ImpactProblem) -> Scene:
    """Target, contact and held soles of ``problem``.

    Raises
    ------
    InputError : a contact law that the engines do not have.
    """
    p = problem
    if not isinstance(p.law, SpringDamper):
        raise InputError(
            f"the validation knows the contact law SpringDamper only, not {type(p.law).__name__}"
        )
    if not isinstance(p.target, FreeMass):
        raise InputError(f"the validation knows the target FreeMass only, not {type(p.target).__name__}")
    return Scene(
        point=p.point,
        normal=p.normal,
        stiffness=p.law.stiffness,
        damping=p.law.damping,
        mass=p.target.mass,
        striker=p.robot.striker(p.striker).model_frame,
        soles=p.stance.constraint_frames(p.robot),
        corners=tuple(sole.polygon for sole in p.stance.soles(p.robot)),
        polygon=support_polygon(p.robot, p.coordinates),
    )
