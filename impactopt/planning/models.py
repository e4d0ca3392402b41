"""Models of the collision for a plan: how far each is from full dynamics; the cheapest that is good enough.

That is asked of models alone, at the plan's state at contact: collisions of the compiled SDC, which take
microseconds. Full dynamics are there the SDC that is frozen so often that it makes no difference.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque
from impactopt.planning.budget import Budget
from impactopt.planning.contact_replay import ModelError, collision_error
from impactopt.planning.gain_selection import with_factors_of
from impactopt.planning.lazy_constraints import rows_on_demand
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import carried
from impactopt.planning.solution import Solved
from impactopt.problem.checks import met_once
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import SolverResult
from impactopt.transcription.contact_guess import (
    can_meet,
    fastest_at_contact,
    mass_at_contact,
    touches_needed,
)
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.initial_guess import strike_rates

Array = NDArray[np.float64]
AnySolution = TypeVar("AnySolution", bound=Solved)
_MODELS = ("sdc", "full")  # of "auto"; in a program a freeze on the way costs as much as full dynamics
# of the fastest blow, or [m/s] where there is none: how the first model is chosen
_SHARE, _GUESSED = 0.5, 1.0


def carried_start(
    t: ContactProgram, old: Callable[[], ContactProgram], start: Solved, rows: Any
) -> SolverResult:
    """Maps a solution to the initial guess of a program with another collision model, lazy constraints or
    gains.

    old : makes the solution's program.  rows : between bodies, of the new one.
    """
    was, now = ((p.collision, p.freezes, rows_on_demand(p), p.gains) for p in (start.problem, t.problem))
    if was == now:
        return start.result
    new = t.with_apart(rows)
    found = carried(new, old().with_apart(start.apart), start.result)
    return with_factors_of(new, start.problem.robot, found) if now[-1] else found


def with_touches(problem: ImpactProblem, say: Callable[[str], None]) -> ImpactProblem:
    """The same with as many touches as point masses need, where it leaves their number open.

    Raises
    ------
    InputError : it gives a number of them that point masses do not meet in.
    """
    if met_once(problem) or problem.touches == 1 or (problem.scenarios and problem.touches is None):
        return problem
    mass, most = mass_at_contact(problem), fastest_at_contact(problem)
    if not np.isfinite(most):
        return problem
    event = problem.target.guards[-1]
    if problem.touches is not None:
        if can_meet(problem.law, problem.target, mass, most, problem.touches):
            return problem
        raise InputError(
            f"touches is {problem.touches}, but at no speed that the joints allow do point masses as heavy "
            f"as striker and target meet so often until the target's {event!r}: leave it out"
        )
    needed = touches_needed(problem.law, problem.target, mass, most)
    if needed in (None, 1):
        return problem
    say(f"point masses part before the target's {event!r}: planned with {needed} touches")
    return changed(problem, touches=needed)


def with_touches_of(start: Solved, problem: ImpactProblem) -> ImpactProblem:
    """The same with the touches of a solution that it starts from.

    Raises
    ------
    InputError : it has others.
    """
    own, its = problem.planned_touches, start.problem.planned_touches
    if own == its:
        return problem
    if problem.touches is None and not met_once(problem):
        return changed(problem, touches=its)
    raise InputError(
        f"start: the solution meets its target {its} times in the blow, and this problem's is met {own} "
        "times: leave start out"
    )


def climbed(
    problem: ImpactProblem,
    run: Callable[[ImpactProblem, AnySolution | None, Budget], AnySolution],
    budget: Budget,
) -> AnySolution:
    """The solution of a problem by the cheapest model of the collision that is good enough for it.

    run : solves a problem, from a solution by another model, or None: from the start asked for.
    """
    began, limit = time.perf_counter(), budget.time_limit
    models = _MODELS[1:] if _skips_first(problem, budget.say) else _MODELS
    done: AnySolution | None = None
    for model in models:
        left = None if limit is None else max(limit - (time.perf_counter() - began), 1e-3)
        new = run(replace(problem, collision=model), done, replace(budget, time_limit=left))
        done = new if done is None else _both(done, new)
        error = done.model_error
        if (
            not done.status.usable
            or model == models[-1]
            or (error is not None and good_enough(problem, error))
        ):
            break
        # none: a contact that does not end by one of the models, so the plan's says nothing
        budget.say(
            f"{model}: {error or 'no estimate of its error'}, not what was asked for: on with full dynamics"
        )
    assert done is not None
    return done


def good_enough(problem: ImpactProblem, error: ModelError) -> bool:
    """True if a model's error is within what the problem's "auto" tolerates."""
    return abs(error.impulse_pct) <= problem.auto_impulse_pct and (error.zmp_mm or 0.0) <= problem.auto_zmp_mm


def _skips_first(problem: ImpactProblem, say: Callable[[str], None]) -> bool:
    """True if the coarsest model is not accurate enough in the posture of the initial guess.

    Of a blow half as fast as the joints allow: a fast one moves the robot far while it lasts.
    """
    first, c = replace(problem, collision=_MODELS[0]), problem.coordinates
    y, legs = c.split(problem.contact_posture)
    most = fastest_at_contact(problem)
    speed = _SHARE * most if np.isfinite(most) else _GUESSED
    try:
        legs = c.solve_legs(y, legs)
        rates = strike_rates(c, problem.strikers, y, legs, speed * problem.normal)
        q, v, _ = c.complete_motion(y, rates, np.zeros(c.ny), legs)
        torque = holding_torque(problem.robot, q, v, stance=problem.stance)
    except InputError:
        return False
    error = collision_error(first, q, v, torque, 0.05)
    if error is not None and good_enough(problem, error):
        return False
    told = error or "no estimate of its error"
    say(f"{_MODELS[0]} at {speed:.2g} m/s: {told}, not what was asked for: {_MODELS[1]} at once")
    return True


def _both(old: AnySolution, new: AnySolution) -> AnySolution:
    """The new solution, with the time and the attempts of both."""
    attempts = [*(replace(a, kept=False) for a in old.attempts), *new.attempts]
    return replace(
        new,
        build_seconds=old.build_seconds + new.build_seconds,
        solve_seconds=old.solve_seconds + new.solve_seconds,
        attempts=tuple(attempts),
    )
