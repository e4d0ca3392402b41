"""Lazy constraints of gear loads, slide and servo reference, which enter once a solution violates them; and
warnings about such violations.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Generic

import numpy as np
from scipy.integrate import solve_ivp

from impactopt.arrays import Array
from impactopt.contact.targets import Nail
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import across, striking_point
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import Additions, Guess, Outcome, Program, program_for, start_of
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ON_DEMAND_TERMS, GearLoad, ReferenceRange, Slide, TargetSpeed, Term
from impactopt.robots.loads import DriveLoads
from impactopt.robots.robot import Robot
from impactopt.simulation.result import FACE
from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_refinement import finest
from impactopt.transcription.plan import Plan, PlannedCollision, PlannedStrike, plan_loads, strike_loads
from impactopt.transcription.transcription import Transcription

# Tolerances beyond a limit. In replays of a plan that keeps its gear limits, loads stay within the first one
# (of the limit). The second is rounding: a plan without constraints keeps its limit or gets them. The others
# are what a plan with constraints exceeds between its nodes.
REPLAY_GEAR_TOLERANCE = 0.1
_GEAR = 1e-3
REFERENCE_TOLERANCE = 1e-3  # [rad]
SLIDE_TOLERANCE = 0.03  # of the limit
FAR = 0.15  # [m] across the target's face: a longer slide gets a warning
CONTACT_SAMPLES = 9  # instants of the contact at which the slide is measured
_MET = 1e-3  # [m] beyond the target's plane after contact: a striking point meets the target again
_DRIVEN = 1e-5  # [m] into the wood: a nail that goes less deep gets a warning
_AT_BOUND = 1e-3  # of a duration's bound: nearer ones are at it
# A contact window gets a warning if twice its length gains this part of the objective, to first order.
_COSTLY = 0.1


def gears_beyond(problem: ImpactProblem, found: Iterable[DriveLoads], more: float) -> str:
    """Message with the gear whose load is farthest beyond its limit; "" if none is beyond by `more`, a
    fraction of the limit.
    """
    most = problem.gear_load.most(problem.robot)
    worst, message = 1.0 + more, ""
    for loads in found:
        # nan: a joint without a drive (`DriveLoads`).
        ratio = np.nan_to_num(loads.gear / most)
        k = int(ratio.argmax())
        if ratio[k] > worst:
            of_limit = f"{loads.gear[k]:.3g} times its torque limit, at most {most[k]:.3g} allowed"
            worst, message = ratio[k], f"gear of {loads.joints[k]}: {of_limit}"
    return message


def gear_caution(problem: ImpactProblem, found: Sequence[DriveLoads | None]) -> dict[str, str]:
    """Warning about overloaded gears, for a plan that permits them or for replays; {} if there are none."""
    loads = [one for one in found if one is not None]
    if problem.gear_load.active:
        text = gears_beyond(problem, loads, more=REPLAY_GEAR_TOLERANCE)
        return {"gear_caution": text} if text else {}
    beyond = [text for one in loads if (text := one.beyond_peak())]
    return {"gear_caution": beyond[0]} if beyond else {}


def slide(problem: ImpactProblem, plan: Plan) -> float:
    """Largest distance [m] of the striking point from where it meets the target, across the normal."""
    # An impact without duration: nothing slides.
    if len(plan.collision.time) < 2 or plan.collision.time[-1] <= 0:
        return 0.0
    moved = plan.collision.aside(np.linspace(0.0, plan.collision.time[-1], CONTACT_SAMPLES))
    on_target = _offsets(plan) - moved @ across(problem.normal).T
    return float(np.linalg.norm(on_target, axis=1).max())


def _offsets(plan: Plan) -> Array:
    """Offsets (CONTACT_SAMPLES, 2) [m] of the striking point from the hit point along two tangents, during
    contact.
    """
    problem = plan.problem
    postures = plan.closed(plan.through_contact(np.linspace(0.0, 1.0, CONTACT_SAMPLES)))
    points = striking_point(problem.robot, problem.striker, postures)
    return (points - points[0]) @ across(problem.normal).T


def slides_beyond(term: Slide, plan: Plan) -> str:
    """Message with the striking point's slide; "" if it is within the limit along each tangent, but for a
    tolerance.
    """
    # The constraint bounds the offset along each tangent, so it is a square, not a circle.
    far = float(np.abs(_offsets(plan)).max())
    if far <= (1 + SLIDE_TOLERANCE) * term.most:
        return ""
    most = f"at most {1e3 * term.most:.3g} mm allowed"
    return f"the striking point slides {1e3 * far:.3g} mm across the target, {most}"


def reference_beyond(term: ReferenceRange, plan: Plan) -> str:
    """Message with the joint whose reference is farthest beyond its range in contact; "" if none is by more
    than a tolerance.
    """
    reference, robot = plan.coarse_reference, plan.problem.robot
    # it coasts at constant rates during contact, so it is farthest at the end
    angles = robot.joint_positions(reference.q[reference.phase == 1][-1:])
    lower, upper = term.limits(robot)
    beyond = np.maximum(lower - angles, angles - upper).max(axis=0)
    k = int(beyond.argmax())
    if beyond[k] <= REFERENCE_TOLERANCE:
        return ""
    return f"the servo's reference of {robot.joint_names[k]} coasts {beyond[k]:.3f} rad beyond its range"


def slide_caution(problem: ImpactProblem, length: float) -> str:
    """Warning about a slide of this length [m]; "" if it is short."""
    if length <= FAR:
        return ""
    remedy = "a smaller most_m" if problem.term(Slide).enabled else "enabled = true"
    return (
        f"The striking point slides {1e3 * length:.0f} mm across the target. "
        f"In replays the face ends {1e3 * FACE:.0f} mm from the hit point"
        # Two strikers have no such term.
        + (f"; {remedy} in [terms.slide] keeps it nearer." if problem.second is None else ".")
    )


def nail_caution(problem: ImpactProblem, plan: Plan | PlannedStrike) -> str:
    """Warning about a nail that hardly moves; "" of other targets, and of one that does."""
    # A nail that just starts to move takes no energy, and a little more speed does not change that to first
    # order: it can be a local optimum.
    if not isinstance(problem.target, Nail) or plan.collision.outcome["depth_m"] > _DRIVEN:
        return ""
    guess = "the initial guess 'strike' (`--start strike`)" if isinstance(plan, Plan) else "another `--seed`"
    return (
        f"The nail is not driven into the wood. With the objective target_energy, {guess} may find a harder "
        "blow; else take a smaller resistance."
    )


def touch_caution(problem: ImpactProblem, plan: Plan, replayed: float | None = None) -> str:
    """Warning about a striking point that meets the target again in the follow-through, such as a slow target
    or one on a spring; "" without. Constraints keep it off a target that stays, or, with `TargetSpeed`, keeps
    its speed.

    replayed : impulse [N s] of all touches in a replay, if there is one.
    """
    if problem.target.stays or not problem.lasts:
        return ""
    reference = plan.coarse_reference
    after = reference.phase == 2
    time, postures = reference.time[after], reference.q[after]
    travel, remedy = _travel_after(problem, plan, time), "a replay has all touches"
    if np.abs(travel - plan.travel(time)).max() < _MET:
        if problem.extra(TargetSpeed) is not None:
            return ""
        remedy = "[terms.target_speed] keeps it off, with least_m_s = -inf and most_m_s = inf at any speed"
    plane = travel[:, None] * problem.normal + plan.aside(time)
    for striker, point in problem.contacts:
        offset = striking_point(problem.robot, striker, postures) - point - plane
        beyond = offset @ problem.normal
        over_face = np.linalg.norm(offset @ across(problem.normal).T, axis=1) < FACE
        again = np.flatnonzero(over_face & (beyond > max(beyond[0], 0.0) + _MET))
        if again.size:
            share = f": {replayed:.3g} N s in a replay, {plan.impulse:.3g} N s as planned" if replayed else ""
            return (
                f"{striker} meets the target again {time[again[0]] - plan.contact_start:.2g} s after contact "
                f"began, which the planned impulse leaves out{share}; {remedy}."
            )
    return ""


def _travel_after(problem: ImpactProblem, plan: Plan, time: Array) -> Array:
    """Travel (k,) [m] of the target by its own motion, such as on a spring, at times (k,) [s] after contact.

    `Plan.travel` takes its speed for constant.
    """
    target, known = problem.target, plan.travel(time)

    def rates(_: float, y: Array) -> list[float]:
        return [float(rate) for rate in (target.velocity(y[1:]), *target.derivative(y[1:], 0.0))]

    begin = [known[0], *plan.collision.target_state]
    found = solve_ivp(rates, (time[0], time[-1]), begin, t_eval=time, rtol=1e-6, atol=1e-9)
    return np.asarray(found.y[0]) if found.success else known


def window_caution(t: Transcription, result: SolverResult) -> str:
    """Warning about a contact whose duration is at its bound, if the bound limits the objective; else "".

    The gain of a window twice as long is, to first order, the multiplier of the bound times the bound.
    """
    longest = t.problem.contact_duration[1]
    objective = abs(t.objective_sum(result.x))
    price, named = 0.0, list[str]()
    for hit in t.hit.collisions:
        if not isinstance(hit, Collision):
            continue
        for phase, group in zip(t.problem.contact_phases, hit.T, strict=True):
            j = group.offset
            if result.x[j] * group.scale[0] >= (1 - _AT_BOUND) * longest:
                # A gain of the minimized objective per unit of the bound, times the bound:
                # scales of variables cancel.
                price += max(float(result.bound_multipliers[j]), 0.0) * float(result.x[j])
                named.append(phase.name)
    if not named or objective <= 0 or price < _COSTLY * objective:
        return ""
    share = 100 * min(price / objective, 9.99)
    return (
        f"The contact's {' and '.join(dict.fromkeys(named))} takes all the time that [collision] duration_s "
        f"allows, {1e3 * longest:.3g} ms, and that bound is costly: twice as long gains {share:.0f} % of "
        "the objective, to first order. Give it longer, unless this is to be a blow and not a push."
    )


# First barrier after lazy constraints have entered: the new solution is far, and progress towards it is slow
# at a low barrier.
_BARRIER = 1e-2
# Excess over a gear limit (of it) from which the initial guess is tried before the warm start: the motion
# within the limit is a different one.
_FAR_BEYOND = 0.5
_KINDS: dict[str, type[Term]] = {term.section: type(term) for term in ON_DEMAND_TERMS}


def lazy_terms_of(problem: ImpactProblem) -> tuple[str, ...]:
    """Names, as in files, of the lazy terms whose constraints a problem's programs have from the start."""
    own = {type(term) for term in problem.active_terms}
    return tuple(name for name, kind in _KINDS.items() if kind in own)


def with_lazy_constraints(problem: ImpactProblem, names: Iterable[str]) -> ImpactProblem:
    """Problem with the constraints of these lazy terms from the start; itself if it has them, or has switched
    them off.
    """
    # `extra` also finds a term that is switched off, which stays so.
    kinds = [_KINDS[name] for name in names if name in _KINDS and problem.extra(_KINDS[name]) is None]
    if not kinds:
        return problem
    return changed(problem, terms=(*problem.terms, *(problem.term(kind) for kind in kinds)))


class LazyTerms(Generic[Program]):
    """Oracle for the terms of every problem that get constraints once a solution violates them.

    report : called with a line of text.  finer : check gears on the finer contact of the error estimate,
    where there is one.
    """

    most = len(_KINDS)  # rounds: the constraints of one term may lead to a violation of another
    of_refused = True  # a push that slides off its target is refused for its replay

    def __init__(self, report: Callable[[str], None] | None = None, *, finer: bool = True) -> None:
        self._report, self._finer = report, finer

    def missing(self, outcome: Outcome[Program]) -> Additions[Program] | None:
        """Constraints of the lazy terms that a solution violates."""
        violated = self._violated(outcome)
        if not violated:
            return None
        t, origin = outcome.program, outcome.origin
        bounded, violations = with_lazy_constraints(t.problem, violated), "; ".join(violated.values())

        def warm() -> Guess[Program]:
            new = program_for(t, bounded, report=self._report)
            return Guess.mapped(new, t, outcome.result, barrier=_BARRIER)

        def cold() -> Guess[Program]:
            # From the first guess: clearance constraints of the old motion would not suit the new one.
            new = program_for(origin.program, bounded, constraints={}, report=self._report)
            return Guess(program=new, start=start_of(new, origin.program, origin.x))

        far = "gear_load" in violated and gears_beyond(t.problem, self._gears(outcome), more=_FAR_BEYOND)
        sections = ", ".join(f"[terms.{name}]" for name in violated)
        return Additions(
            name="lazy constraints",
            why=f"{violations}: solving again with constraints of "
            f"{', '.join(_KINDS[name].name for name in violated)}",
            guesses=(guess() for guess in ((cold, warm) if far else (warm, cold))),
            without=f"Without {sections} there is a plan, but {violations}.",
        )

    def _violated(self, outcome: Outcome[Program]) -> dict[str, str]:
        """Messages of the violated lazy terms that have no constraints yet, by name of the term."""
        problem, planned = outcome.program.problem, outcome.at.planned
        has, out = lazy_terms_of(problem), dict[str, str]()
        for name, kind in _KINDS.items():
            term = problem.term(kind)
            if name in has or term not in problem.on_demand:
                continue
            message = ""
            if isinstance(term, GearLoad):
                message = gears_beyond(problem, self._gears(outcome), more=_GEAR)
            elif isinstance(term, Slide) and isinstance(planned, Plan):
                message = slides_beyond(term, planned)
            elif isinstance(term, ReferenceRange) and isinstance(planned, Plan):
                with contextlib.suppress(InputError):  # legs out of reach
                    message = reference_beyond(term, planned)
            if message:
                out[name] = message
        return out

    def _gears(self, outcome: Outcome[Program]) -> list[DriveLoads]:
        """Gear loads of a solution."""
        planned, error = outcome.at.planned, outcome.at.contact_error if self._finer else None
        return _loads(outcome.program.robot, planned, finest(planned, error))


def _loads(
    robot: Robot, planned: Plan | PlannedStrike, collisions: list[PlannedCollision]
) -> list[DriveLoads]:
    """Gear and motor loads of all motions and all collisions."""
    if isinstance(planned, PlannedStrike):
        # Gear loads do not depend on the jump of velocities.
        zero = np.zeros(robot.nv)
        return [strike_loads(robot, zero, zero, collision) for collision in collisions]
    with contextlib.suppress(InputError):  # legs out of reach: completing the motion reports it
        return plan_loads(robot, planned, collisions)
    return []
