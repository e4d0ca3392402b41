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

from impactopt.collision.frozen_models import frozen_model
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque
from impactopt.planning.chosen_gains import with_factors_of
from impactopt.planning.contact_replay import ModelError, PlannedContact
from impactopt.planning.multistart import carried
from impactopt.planning.on_demand import rows_on_demand
from impactopt.planning.solution import Solved
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import VelocityLimit
from impactopt.simulation.cases import errors_against
from impactopt.simulation.reference.coasting import coasting_reference
from impactopt.solvers.program import SolverResult
from impactopt.transcription.contact_guess import fastest
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.initial_guess import strike_rates
from impactopt.transcription.plan import Plan
from impactopt.transcription.planned_strike import PlannedStrike

Array = NDArray[np.float64]
AnySolution = TypeVar("AnySolution", bound=Solved)
# freezes of the SDC that stands for full dynamics
_OFTEN, _MOST = 8, 64
_MODELS = ("sdc", "full")  # of "auto"; in a program a freeze on the way costs as much as full dynamics
_HORIZON = 0.2  # [s] at least
# of the fastest blow, or [m/s] where there is none: how the first model is chosen
_SHARE, _GUESSED = 0.5, 1.0


def model_error(t: ContactProgram, x: Array, problem: ImpactProblem | None = None) -> ModelError | None:
    """Error of a program's collision model against full dynamics, for solver variables (n,).

    problem : whose model it is, if not the program's problem's.
    None where nothing is frozen; for an impact with a given restitution; and where a contact has no end.
    """
    problem, c = problem or t.problem, t.coordinates
    if problem.collision in ("full", "auto", "rigid"):
        return None
    y, legs = t.contact_state[0].evaluate(x), t.contact_legs.evaluate(x)
    q, v, _ = c.complete_motion(y, t.u0.read(x)[0], np.zeros(c.ny), legs)
    torque = t.feedforward.read(x)[0] * problem.robot.torque_limit
    return _error(problem, q, v, torque, max(sum(t.expected.durations(x)), 1e-2))


def planned_contact(
    t: ContactProgram, x: Array, planned: Plan | PlannedStrike, problem: ImpactProblem | None = None
) -> PlannedContact:
    """The contact that a program plans at solver variables (n,); ``problem``: as of `model_error`."""
    error = model_error(t, x, problem)
    return PlannedContact(problem=problem or t.problem, planned=planned, model_error=error)


def _error(problem: ImpactProblem, q: Array, v: Array, torque: Array, duration: float) -> ModelError | None:
    """Model error for a collision of about this duration [s]."""
    names = ("robot", "striker", "normal", "law", "target", "stance")
    scene: dict[str, Any] = {name: getattr(problem, name) for name in names}
    scene["horizon"] = max(_HORIZON, 4 * duration)
    own = frozen_model(problem.collision, problem.freezes, **scene)
    often = min(max(_OFTEN, 4 * problem.freezes), _MOST)
    try:
        bend: dict[str, Any] = {**coasting_reference(problem.coordinates, q, v, until=2 * duration)}
        known = {name: x for name, x in bend.items() if name in own.settings}
        alone = own.collide(q, v, torque, **known)
        full = frozen_model("sdc", often, **scene).collide(q, v, torque, **bend)
    except InputError:  # a contact that does not end
        return None
    told = errors_against(alone, full)
    return ModelError(impulse_pct=float(told["impulse_error_pct"] or 0.0), zmp_mm=told["zmp_error_mm"])


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


def climbed(
    problem: ImpactProblem,
    run: Callable[[ImpactProblem, AnySolution | None, float | None], AnySolution],
    *,
    time_limit: float | None,
    report: Callable[[str], None] | None,
) -> AnySolution:
    """The solution of a problem by the cheapest model of the collision that is good enough for it.

    run : solves a problem, from a solution by another model, or None: from the start asked for; within a time
    [s].
    """
    began = time.perf_counter()
    say = report if report is not None else _silent
    models = _MODELS[1:] if _skips_first(problem, say) else _MODELS
    done: AnySolution | None = None
    for model in models:
        left = None if time_limit is None else max(time_limit - (time.perf_counter() - began), 1e-3)
        new = run(replace(problem, collision=model), done, left)
        done = new if done is None else _both(done, new)
        error = done.model_error
        if (
            not done.status.usable
            or model == models[-1]
            or (error is not None and good_enough(problem, error))
        ):
            break
        # none: a contact that does not end by one of the models, so the plan's says nothing
        say(f"{model}: {error or 'no estimate of its error'}, not what was asked for: on with full dynamics")
    assert done is not None
    return done


def good_enough(problem: ImpactProblem, error: ModelError) -> bool:
    """True if a model's error is within what the problem's "auto" tolerates."""
    return abs(error.impulse_pct) <= problem.auto_impulse_pct and (error.zmp_mm or 0.0) <= problem.auto_zmp_mm


def _silent(_: str) -> None:
    pass


def _skips_first(problem: ImpactProblem, say: Callable[[str], None]) -> bool:
    """True if the coarsest model is not accurate enough in the posture of the initial guess.

    Of a blow half as fast as the joints allow: a fast one moves the robot far while it lasts.
    """
    first, c = replace(problem, collision=_MODELS[0]), problem.coordinates
    y, legs = c.split(problem.contact_posture)
    limit = problem.term(VelocityLimit).fraction * problem.robot.velocity_limit
    most = fastest(c, problem.striker, problem.normal, problem.contact_posture, limit)
    speed = _SHARE * most if np.isfinite(most) else _GUESSED
    try:
        legs = c.solve_legs(y, legs)
        rates = strike_rates(c, problem.strikers, y, legs, speed * problem.normal)
        q, v, _ = c.complete_motion(y, rates, np.zeros(c.ny), legs)
        torque = holding_torque(problem.robot, q, v, stance=problem.stance)
    except InputError:
        return False
    error = _error(first, q, v, torque, 0.05)
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
