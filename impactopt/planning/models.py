"""Collision model and order of contact events of a plan: the cheapest model that is accurate enough, and warm
starts between models.

A model's error is estimated without solving a program, by collisions of the compiled SDC from the plan's
state at contact, which take microseconds. The often frozen SDC stands for full dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from impactopt.arrays import Array
from impactopt.collision.sdc import frozen_model
from impactopt.contact.laws import KelvinVoigt
from impactopt.contact.targets.base import is_order
from impactopt.errors import InputError, shortened
from impactopt.kinematics.operational_space import holding_torque
from impactopt.planning.budget import Budget
from impactopt.planning.contact_replay import ModelError, collision_error
from impactopt.planning.gain_selection import with_factors_of
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import carried
from impactopt.planning.solution import Solved
from impactopt.problem.checks import met_once
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import gear_torque
from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import jump_at_contact
from impactopt.transcription.contact_guess import contact_order, fastest_at_contact, gentlest, mass_at_contact
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.initial_guess import strike_rates

AnySolution = TypeVar("AnySolution", bound=Solved)
# Models that "auto" tries. Not the SDC with more freezes: in a program a freeze during contact costs as much
# as full dynamics.
_MODELS = ("sdc", "full")
# Least force over what gears bear, from which on a problem is infeasible: both are of point masses, in the
# posture of the initial guess.
_FAR_BEYOND = 2.0
# Speed at which a model is tested: part of the fastest impact's; and [m/s] of that one if it is unbounded.
_TEST_FRACTION, _USUAL_SPEED = 0.5, 2.0
_ENDLESS = 5.0  # [s] after which a contact does not end


def check_start(start: Solved, problem: ImpactProblem, *, motion: bool) -> None:
    """Check that a problem's program can start from a solution.

    motion : whether it is the program of a whole motion, which has an abort motion for missed targets.

    Raises
    ------
    InputError : the solution is of another robot, stance or number of intervals, or its program has
        collisions or an abort motion for other scenarios.
    """
    old = start.problem
    if old.robot.joint_names != problem.robot.joint_names:
        differ = ", ".join(sorted({*old.robot.joint_names} ^ {*problem.robot.joint_names}))
        raise InputError(
            f"start: a solution of the robot {old.robot.name!r}, and the problem's is "
            f"{problem.robot.name!r}, with other joints ({shortened(differ) or 'in their order'}); "
            "give one of the same robot with the same joints locked"
        )
    # Numbers of a scenario's target and law are parameters of the program: they may differ.
    parts = [
        (sum(not s.missing for s in p.scenarios), motion and p.abort_after is not None)
        for p in (old, problem)
    ]
    if parts[0] != parts[1]:
        has, wanted = (", ".join(s.name for s in p.scenarios) or "none" for p in (old, problem))
        raise InputError(
            f"start: the scenarios of the solution are {has}, those of the problem {wanted}, and each has "
            "variables of its own: give a solution with as many scenarios, or leave start out"
        )
    of_old, of_new = (_unmapped(p, motion=motion) for p in (old, problem))
    for what, has in of_old.items():
        if of_new[what] != has:
            raise InputError(
                f"start: {what} of the solution: {has or 'none'}, of the problem: {of_new[what] or 'none'}; "
                "give a solution with the same, or leave start out"
            )


def _unmapped(problem: ImpactProblem, *, motion: bool) -> dict[str, str]:
    """Parts of a program whose variables `warm_start` does not map to other ones, by their names."""
    stance, robot, stances = problem.stance, problem.robot, problem.stances
    fixed = " and ".join([*stance.sole_names(robot), *(hand.name for hand in stance.held_hands(robot))])
    if not motion:
        return {"soles and hands that are fixed": fixed}
    splines = [problem.swing, problem.follow, *(s.phase for s in stances if s.phase is not None)]
    phases = [" and ".join(s.soles) + " (impact)" * (s.phase is None) for s in stances]
    return {
        "soles and hands that are fixed": ", then ".join(phases) or fixed,
        "intervals of swing, follow-through and stance phases": ", ".join(str(s.intervals) for s in splines),
    }


def carried_start(
    t: ContactProgram, old: Callable[[], ContactProgram], start: Solved, constraints: Any
) -> SolverResult:
    """Solution mapped to a program with another collision model, friction, lazy constraints or gains.

    old : makes the solution's program.  constraints : clearance constraints of the new one.
    """
    before, now = (
        (
            p.collision,
            p.freezes,
            p.friction,
            [type(part) for part in (*p.active_terms, *p.objectives)],
            p.gains,
        )
        for p in (start.problem, t.problem)
    )
    # Same variables and constraints: the result fits as it is.
    if before == now and len(start.result.x) == t.program.n:
        return start.result
    new = t.with_clearance(constraints)
    found = carried(new, old().with_clearance(start.clearance_constraints), start.result)
    return with_factors_of(new, start.problem.robot, found) if now[-1] else found


def with_order(problem: ImpactProblem, say: Callable[[str], None]) -> ImpactProblem:
    """Problem with the order of contact events that point masses have, if it leaves that open; else itself.

    Raises
    ------
    InputError : point masses never touch as often as it says.
    """
    touches = problem.touches
    if met_once(problem) or isinstance(touches, tuple) or (problem.scenarios and touches is None):
        return problem
    mass, most = mass_at_contact(problem), fastest_at_contact(problem)
    # Without limits of velocity point masses say nothing.
    if not np.isfinite(most):
        return problem
    event = problem.target.guards[-1]
    force = largest_force(problem)[0]
    order = contact_order(problem.law, problem.target, mass, most, touches, force)
    if order is None and touches not in (None, 1):
        raise InputError(
            f"touches is {touches}, but at no speed that the joints allow do point masses as heavy "
            f"as striker and target meet so often until the target's {event!r}: leave it out"
        )
    if not order:
        return problem
    say(f"point masses part before the target's {event!r}: the contact is planned as {', '.join(order)}")
    return changed(problem, touches=order)


def largest_force(problem: ImpactProblem) -> tuple[float, str]:
    """Largest contact force [N] that the gears bear in the posture of the initial guess, and the name of the
    joint whose gear bears least; inf without limits.
    """
    robot, c = problem.robot, problem.coordinates
    if not problem.gear_load.active:
        return np.inf, ""
    y, legs = c.split(problem.contact_posture)
    rates = strike_rates(c, problem.strikers, y, legs, problem.normal)
    laws = [KelvinVoigt(stiffness=1.0, damping=damping) for damping in (0.0, 1.0)]
    (_, _, _, before), (force, _, _, after) = (
        jump_at_contact(problem, c, law, y, rates, legs) for law in laws
    )
    load = np.abs(gear_torque(robot, np.zeros(robot.n), after - before) / robot.torque_limit)
    share = load / problem.gear_load.most(robot) / abs(force)
    k = int(np.argmax(share))
    return (1 / float(share[k]) if share[k] > 0 else np.inf), robot.joint_names[k]


def overloaded(problem: ImpactProblem) -> list[str]:
    """Message that gears bear far less than the least force with which point masses bring about all events of
    a target; none if they may bear it, or nothing is known.
    """
    if met_once(problem) or not problem.order:
        return []
    mass, fastest = mass_at_contact(problem), fastest_at_contact(problem)
    (most, joint), found = largest_force(problem), None
    if np.isfinite(fastest) and np.isfinite(most):
        found = gentlest(problem.law, problem.target, mass, fastest)
    if found is None or found[1] <= _FAR_BEYOND * most:
        return []
    speed, force = found
    limit = float(problem.gear_load.most(problem.robot)[problem.robot.joint_names.index(joint)])
    return [
        f"gears. Point masses have the target's {problem.target.guards[-1]!r} from {speed:.2g} m/s on, with "
        f"{force:.2g} N, which load the gear of {joint} with {force / most * limit:.2g} times its torque "
        f"limit, at most {limit:.3g} allowed ([terms.gear_load] limit); take a softer contact"
    ]


def endless(problem: ImpactProblem) -> list[str]:
    """Message that a contact does not end by the paper's model, in the posture of the initial guess; none if
    it does, or nothing is known.

    That model has no feed-forward, servo stiffness or gravity, so nothing takes the hand back from a heavy
    target on a contact that damps more than it springs.
    """
    if problem.collision != "sdc-paper" or problem.target.guards:
        return []
    try:
        model = frozen_model(problem.collision, **problem.scene, horizon=_ENDLESS)
        tested = [_state_at_contact(problem, part) for part in (_TEST_FRACTION, _TEST_FRACTION / 5)]
        ends = [model.collide(*state, require_separation=False).separated for _, state in tested]
    except InputError:  # no posture to test in
        return []
    if any(ends):
        return []
    return [
        f"contact. By the collision model {problem.collision!r} it has not ended after {_ENDLESS:g} s, in "
        f"the posture of the initial guess at {tested[0][0]:.2g} and {tested[1][0]:.2g} m/s; plan with "
        'collision.model = "full"'
    ]


def _state_at_contact(problem: ImpactProblem, part: float) -> tuple[float, tuple[Array, Array, Array]]:
    """Part of the fastest impact's speed [m/s], or of `_USUAL_SPEED` if that is unbounded; and a state at
    contact in the posture of the initial guess with it: q (nq,), v (nv,) and the torque that holds it (n,).

    Raises
    ------
    InputError : legs out of reach.
    """
    c, fastest = problem.coordinates, fastest_at_contact(problem)
    speed = part * (fastest if np.isfinite(fastest) else _USUAL_SPEED)
    y, legs = c.split(problem.contact_posture)
    legs = c.solve_legs(y, legs)
    rates = strike_rates(c, problem.strikers, y, legs, speed * problem.normal)
    q, v, _ = c.complete_motion(y, rates, np.zeros(c.ny), legs)
    return speed, (q, v, holding_torque(problem.robot, q, v, stance=problem.stance))


def with_order_of(start: Solved, problem: ImpactProblem) -> ImpactProblem:
    """Problem with the order of contact events of the solution that it starts from.

    Raises
    ------
    InputError : the problem gives another number of touches, or another order; or its law or its target
        does not allow that of the solution.
    """
    order, touches = start.problem.order, start.problem.planned_touches
    if problem.order == order:
        return problem
    possible = not met_once(problem) and is_order(problem.law, problem.target, order)
    if possible and problem.touches in (None, touches):
        return changed(problem, touches=order)
    raise InputError(
        f"start: the contact of the solution is planned as {', '.join(order) or 'one touch'}, and not so in "
        "this problem: leave start out"
    )


def climbed(
    problem: ImpactProblem,
    run: Callable[[ImpactProblem, AnySolution | None, Budget], AnySolution],
    budget: Budget,
) -> AnySolution:
    """Solution of a problem with the cheapest collision model that is accurate enough.

    run : solves a problem from a solution with another model; None: from the user's initial guess.
    """
    limit = budget.time_limit
    models = _MODELS[1:] if _skips_first(problem, budget.say) else _MODELS
    done: AnySolution | None = None
    for model in models:
        new = run(replace(problem, collision=model), done, replace(budget, time_limit=limit))
        done = new if done is None else _both(done, new)
        # One time limit for both models, of which compiling takes nothing; 0 would be refused.
        limit = None if limit is None else max(limit - new.solve_seconds, 1e-3)
        error = done.model_error
        if (
            not done.status.usable
            or model == models[-1]
            or (error is not None and good_enough(problem, error))
        ):
            break
        # without an estimate, a contact does not end with one of the models
        budget.say(
            f"{model}: {error or 'no estimate of its error'}, less accurate than required: solving again "
            "with full dynamics"
        )
    assert done is not None
    return done


def good_enough(problem: ImpactProblem, error: ModelError) -> bool:
    """True if a model's error is within what the problem's "auto" tolerates."""
    return abs(error.impulse_pct) <= problem.auto_impulse_pct and (error.zmp_mm or 0.0) <= problem.auto_zmp_mm


def _skips_first(problem: ImpactProblem, say: Callable[[str], None]) -> bool:
    """True if the coarsest model lacks the order of contact events that point masses have, or is not accurate
    enough in the posture of the initial guess, for an impact half as fast as the joints allow.

    A faster impact moves the robot farther during contact, so the frozen model's error grows with the speed.
    """
    if with_order(replace(problem, collision=_MODELS[1]), lambda _: None).order:
        say(f"{_MODELS[0]} has one contact, in which point masses part too early: {_MODELS[1]} at once")
        return True
    try:
        speed, state = _state_at_contact(problem, _TEST_FRACTION)
    # No posture to test in: the model is tried in a program.
    except InputError:
        return False
    error = collision_error(replace(problem, collision=_MODELS[0]), *state, 0.05)
    if error is not None and good_enough(problem, error):
        return False
    estimate = error or "no estimate of its error"
    say(f"{_MODELS[0]} at {speed:.2g} m/s: {estimate}, less accurate than required: {_MODELS[1]} at once")
    return True


def _both(old: AnySolution, new: AnySolution) -> AnySolution:
    """New solution with the time and the attempts of both."""
    attempts = [*(replace(a, kept=False) for a in old.attempts), *new.attempts]
    return replace(
        new,
        build_seconds=old.build_seconds + new.build_seconds,
        solve_seconds=old.solve_seconds + new.solve_seconds,
        attempts=tuple(attempts),
    )
