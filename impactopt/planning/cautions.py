"""Warnings about what a plan permits: gear loads, slip on the target, a contact cut short by its bound."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from impactopt.kinematics.operational_space import across, striking_point
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Slide
from impactopt.robots.loads import DriveLoads
from impactopt.simulation.target_dynamics import FACE
from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import Collision
from impactopt.transcription.mesh_refinement import GEAR
from impactopt.transcription.plan import Plan
from impactopt.transcription.transcription import Transcription

__all__ = ["gear_caution", "gears_beyond", "slide", "slide_caution", "slides_beyond", "window_caution"]

REPLAYED = 0.1  # beyond what gears may bear: replays of a plan that keeps to it stay within this
FAR = 0.15  # [m] across the target's face: a plan that slides so far is reported so
INSTANTS = 9  # of the contact
MORE = 0.03  # of what it may be: no more than a mesh leaves it
_AT = 1e-3  # of the bound: so near is at it
_COSTLY = 0.1  # of the objective, for a window twice as long and to first order: what is said


def gears_beyond(problem: ImpactProblem, found: Iterable[DriveLoads], more: float = GEAR) -> str:
    """The gear that bears most beyond what a problem lets it, in words; "" if none does.

    more : by so much at least, of what it may bear. Rows would keep it within 3 % between the program's
    points.
    """
    most = problem.gear_load.most(problem.robot)
    worst, said = 1.0 + more, ""
    for loads in found:
        share = np.nan_to_num(loads.gear / most)
        k = int(share.argmax())
        if share[k] > worst:
            of_limit = f"{loads.gear[k]:.3g} times its torque limit, which may be {most[k]:.3g}"
            worst, said = share[k], f"gear of {loads.joints[k]}: {of_limit}"
    return said


def gear_caution(problem: ImpactProblem, found: Sequence[DriveLoads | None]) -> dict[str, str]:
    """Warning about overloaded gears, for a plan that permits them or for replays; {} if there are none."""
    loads = [one for one in found if one is not None]
    if problem.gear_load.active:
        text = gears_beyond(problem, loads, more=REPLAYED)
        return {"gear_caution": f"{text}, more than it may"} if text else {}
    beyond = [text for one in loads if (text := one.beyond_peak())]
    return {"gear_caution": beyond[0]} if beyond else {}


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


def window_caution(t: Transcription, result: SolverResult) -> str:
    """Warning about a contact that ends because it may not last longer; "" if none does.

    The price is the multiplier of the bound times the bound.
    """
    longest = t.problem.contact_duration[1]
    objective = abs(
        float(sum(o.weight * t.achieved(result.x).get(o.name, 0.0) for o in t.problem.objectives))
    )
    price, named = 0.0, list[str]()
    for hit in t.hit.collisions:
        if not isinstance(hit, Collision):
            continue
        for phase, group in zip(t.problem.target.phases, hit.T, strict=True):
            j = group.offset
            if result.x[j] * group.scale[0] >= (1 - _AT) * longest:
                # multiplier: slope of the objective by the bound; a window twice as long moves it by itself
                price += max(float(result.bound_multipliers[j]), 0.0) * float(result.x[j])
                named.append(phase)
    if not named or objective <= 0 or price < _COSTLY * objective:
        return ""
    share = 100 * min(price / objective, 9.99)
    return (
        f"The contact's {' and '.join(dict.fromkeys(named))} takes all the time that [collision] duration_s "
        f"leaves it, {1e3 * longest:.3g} ms, and that bound is costly: twice as long gains {share:.0f} % of "
        "the objective, to first order. The contact is softer than that: give it longer."
    )
