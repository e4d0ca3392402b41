"""Lazy constraints of gear loads, slide and reference, where a plan without them breaks them; cautions."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Generic

import numpy as np

from impactopt.contact.fields import snake_case
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import across, striking_point
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import Additions, Guess, Outcome, Program, program_for, start_of
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ON_DEMAND_TERMS, GearLoad, ReferenceRange, Slide, Term
from impactopt.robots.loads import DriveLoads
from impactopt.robots.robot import Robot
from impactopt.simulation.target_dynamics import FACE
from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import Collision
from impactopt.transcription.mesh import GEAR
from impactopt.transcription.plan import Plan, PlannedCollision, PlannedStrike, plan_loads, strike_loads
from impactopt.transcription.transcription import Transcription

__all__ = [
    "FAR",
    "LazyTerms",
    "gear_caution",
    "gears_beyond",
    "reference_beyond",
    "rows_on_demand",
    "slide",
    "slide_caution",
    "slides_beyond",
    "window_caution",
    "with_rows",
]

REPLAYED = 0.1  # beyond what gears may bear: replays of a plan that keeps to it stay within this
FAR = 0.15  # [m] across the target's face: a plan that slides so far is reported so
INSTANTS = 9  # of the contact
BEYOND = 1e-3  # [rad] of a reference out of its range: no more than a mesh leaves it
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


def reference_beyond(term: ReferenceRange, plan: Plan) -> str:
    """Message with the joint whose reference is farthest beyond its range in contact; "" if none is by more
    than a tolerance.
    """
    reference, robot = plan.reference, plan.problem.robot
    angles = robot.joint_positions(reference.q[reference.phase == 1][-1:])  # where it has gone farthest
    lower, upper = term.limits(robot)
    beyond = np.maximum(lower - angles, angles - upper).max(axis=0)
    k = int(beyond.argmax())
    if beyond[k] <= BEYOND:
        return ""
    return f"the servo's reference of {robot.joint_names[k]} coasts {beyond[k]:.3f} rad beyond its range"


def slide_caution(length: float) -> str:
    """Warning about a slide of this length [m]; "" if it is short."""
    if length <= FAR:
        return ""
    return (
        f"The striking point slides {1e3 * length:.0f} mm across the target. "
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
        for phase, group in zip(t.problem.contact_phases, hit.T, strict=True):
            j = group.offset
            if result.x[j] * group.scale[0] >= (1 - _AT) * longest:
                # multiplier: slope of the objective by the bound; a window twice as long moves it by itself
                price += max(float(result.bound_multipliers[j]), 0.0) * float(result.x[j])
                named.append(phase.name)
    if not named or objective <= 0 or price < _COSTLY * objective:
        return ""
    share = 100 * min(price / objective, 9.99)
    return (
        f"The contact's {' and '.join(dict.fromkeys(named))} takes all the time that [collision] duration_s "
        f"leaves it, {1e3 * longest:.3g} ms, and that bound is costly: twice as long gains {share:.0f} % of "
        "the objective, to first order. Give it longer, unless this is to be a blow and not a push."
    )


_BARRIER = 1e-2  # a plan within such limits is another one: at a low barrier the way there is a crawl
_OTHER = 0.5  # beyond what a gear may bear: the motion within it is another one, and a warm start a detour
_KINDS: dict[str, type[Term]] = {snake_case(type(term).__name__): type(term) for term in ON_DEMAND_TERMS}


def rows_on_demand(problem: ImpactProblem) -> tuple[str, ...]:
    """Names, as in files, of the lazy terms whose constraints a problem's programs have from the start."""
    own = {type(term) for term in problem.active_terms}
    return tuple(name for name, kind in _KINDS.items() if kind in own)


def with_rows(problem: ImpactProblem, names: Iterable[str]) -> ImpactProblem:
    """The same with the constraints of these lazy terms from the start; itself if it has them, or has
    switched them off.
    """
    kinds = [_KINDS[name] for name in names if name in _KINDS and problem.extra(_KINDS[name]) is None]
    if not kinds:
        return problem
    return changed(problem, terms=(*problem.terms, *(problem.term(kind) for kind in kinds)))


class LazyTerms(Generic[Program]):
    """Oracle for terms that hold in every problem and get constraints once a solution breaks them.

    report : called with a line of text.  finer : whether gears are checked at more instants of the contact
    than the program's, where these are known.
    """

    most = len(_KINDS)  # constraints of one may break another

    def __init__(self, report: Callable[[str], None] | None = None, *, finer: bool = True) -> None:
        self._report, self._finer = report, finer

    def missing(self, outcome: Outcome[Program]) -> Additions[Program] | None:
        """Constraints of the lazy terms that a solution breaks."""
        broken = self._broken(outcome)
        if not broken:
            return None
        t, origin = outcome.program, outcome.origin
        bounded, said = with_rows(t.problem, broken), "; ".join(broken.values())

        def warm() -> Guess[Program]:
            new = program_for(t, bounded, report=self._report)
            return Guess.mapped(new, t, outcome.result, barrier=_BARRIER)

        def cold() -> Guess[Program]:
            new = program_for(origin.program, bounded, constraints={}, report=self._report)
            return Guess(program=new, start=start_of(new, origin.program, origin.x))

        far = "gear_load" in broken and gears_beyond(t.problem, self._gears(outcome), more=_OTHER)

        return Additions(
            name="lazy constraints",
            why=f"{said}: on with constraints of {', '.join(_KINDS[name].name for name in broken)}",
            guesses=(guess() for guess in ((cold, warm) if far else (warm, cold))),
            without=f"Without {', '.join(f'[terms.{name}]' for name in broken)} there is a plan, but {said}.",
        )

    def _broken(self, outcome: Outcome[Program]) -> dict[str, str]:
        """Violations of lazy terms that have no constraints yet: message by name of the term."""
        problem, planned = outcome.program.problem, outcome.at.planned
        has, out = rows_on_demand(problem), dict[str, str]()
        for name, kind in _KINDS.items():
            term = problem.term(kind)
            if name in has or term not in problem.on_demand:
                continue
            words = ""
            if isinstance(term, GearLoad):
                words = gears_beyond(problem, self._gears(outcome))
            elif isinstance(term, Slide) and isinstance(planned, Plan):
                words = slides_beyond(term, planned)
            elif isinstance(term, ReferenceRange) and isinstance(planned, Plan):
                with contextlib.suppress(InputError):  # legs that do not reach
                    words = reference_beyond(term, planned)
            if words:
                out[name] = words
        return out

    def _gears(self, outcome: Outcome[Program]) -> list[DriveLoads]:
        """Gear loads of a solution."""
        error = outcome.at.contact_error if self._finer else None
        finer = () if error is None or error.missed else error.finer
        return _loads(outcome.program.robot, outcome.at.planned, finer)


def _loads(
    robot: Robot, planned: Plan | PlannedStrike, finer: tuple[PlannedCollision, ...]
) -> list[DriveLoads]:
    """Gear and motor loads of all motions and all collisions."""
    hits = finer or [planned.collision, *(scenario.collision for scenario in planned.scenarios)]
    if isinstance(planned, PlannedStrike):
        still = np.zeros(robot.nv)
        return [strike_loads(robot, still, still, hit) for hit in hits]
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        return plan_loads(robot, planned, hits)
    return []
