"""Diagnosis of a failed solve: a second solver's result, and the cause of infeasibility."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.planning.bounds import Cause
from impactopt.planning.budget import VIOLATED, Budget
from impactopt.problem.checks import met_once
from impactopt.problem.feasibility import too_weak
from impactopt.robots.loads import shortfalls
from impactopt.robots.robot import Robot
from impactopt.solvers.program import NonlinearProgram, SolverResult, Status, max_violation
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import Parting, fastest_at_contact, parting
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.plan import Plan, PlannedCollision

Array = NDArray[np.float64]
MAX_NAMED = 3  # margins in a message


def ipopt_retry(budget: Budget, program: NonlinearProgram, start: Array, old: SolverResult) -> SolverResult:
    """Result of IPOPT from the same initial guess, if our solver has failed without a diagnosis and IPOPT's
    result is better; else the old result.

    IPOPT has another restoration phase, so it rarely fails on the same programs. A limit that the caller has
    set is a diagnosis.
    """
    limited = "max_iterations" in (budget.options or {})
    undiagnosed = old.status is Status.FAILED or (old.status is Status.ITERATION_LIMIT and not limited)
    if budget.solver == "ipopt" or not undiagnosed or budget.is_over():
        return old
    violation = max_violation(program, old.x, program.constraints(old.x))
    if old.status is Status.FAILED and violation <= VIOLATED < old.max_violation:
        return old  # its constraints are met: it was refused for a penetration or its replay
    budget.say("our solver ends without a diagnosis: IPOPT tries once, from the same initial guess")
    # Options are those of our solver.
    new = replace(budget, solver="ipopt", options=None).run(program, start)
    if new.status is Status.INTERRUPTED or _rank(new) < _rank(old):
        return new
    return old


def _rank(result: SolverResult) -> tuple[bool, bool, float]:
    """Sorting key: solutions first, then diagnosed results, then by the violation."""
    # A program that is known to be infeasible is worth more than one that failed with less violation.
    return not result.status.usable, result.status is not Status.INFEASIBLE, result.max_violation


def ended_with_violations(t: ContactProgram, result: SolverResult) -> bool:
    """True if a solver has ended by itself with violated constraints."""
    if result.status not in (Status.FAILED, Status.INFEASIBLE, Status.ITERATION_LIMIT):
        return False
    return max_violation(t.program, result.x, t.program.constraints(result.x)) > VIOLATED


def with_reason(
    t: ContactProgram, result: SolverResult, causes: Sequence[Cause] = (), *, known: Sequence[str] = ()
) -> SolverResult:
    """A failed result, with the reason that the problem is infeasible in its message and status: reasons
    ``known`` beforehand, a bound that would have to change, or an estimate by colliding point masses.

    Results that end otherwise, and those without a reason, are returned as they are.
    """
    if not ended_with_violations(t, result):
        return result
    would_do = [cause for cause in causes if cause.problem is not None]
    weak = too_weak(t.problem)
    # By falling certainty: what cannot be, a bound whose change was tried, an estimate by point masses.
    if known:
        why = f"Infeasible: {'; '.join(known)}."
    elif would_do:
        first, *others = would_do
        why = f"Infeasible: {first.kind}. {first.text} would do, with all else as it is"
        why += "".join(f"; or {other.text}" for other in others) + "."
        # the point masses explain the contact only, which need not be what makes the problem infeasible
        masses = (_too_stiff(t) or _too_soft(t)) if "contact" in first.kind else ""
        why += "".join(f" Besides, {text}." for text in (weak, masses) if text)
    else:
        not_allowed = [f"{cause.kind}: {cause.text}, which is not allowed" for cause in causes]
        found = weak or _too_stiff(t) or _too_soft(t) or "".join(not_allowed[:1])
        if not found:
            return result
        why = f"Infeasible: {found}."
    # the solver's first sentence says how it ended, which the reason replaces
    rest = result.message.partition(". ")[2] or result.message
    return replace(result, status=Status.INFEASIBLE, message=f"{why} {rest}")


def with_limits_kept(
    result: SolverResult, plan: Plan, collision: PlannedCollision, robot: Robot
) -> SolverResult:
    """A solved result itself if its plan keeps at least half of each sole's margin between nodes, too, and no
    joint is beyond the robot's limits; else with the status acceptable, and a message that names them.

    collision : of the plan, on a finer mesh if there is one.
    """
    with contextlib.suppress(InputError):  # legs out of reach: completing the motion reports it
        if short := shortfalls(plan.sole_margins(collision)):
            message = (
                f"A sole keeps less than half of a margin between nodes: {'; '.join(short[:MAX_NAMED])}."
            )
        elif beyond := _joints_beyond(plan, robot):
            message = f"Between nodes {beyond}; give more `intervals`, or more time."
        else:
            return result
        return replace(result, status=Status.ACCEPTABLE, message=message)
    return result


def _joints_beyond(plan: Plan, robot: Robot) -> str:
    """Message with the joint that is farthest beyond the robot's limit of velocity or torque; "" if none."""
    worst, message = 1 + VIOLATED, ""
    for t in (plan.reference, *([plan.missed_reference] if plan.abort is not None else [])):
        for what, used in (
            ("velocity", t.v[:, -robot.n :] / robot.velocity_limit),
            ("torque", t.torque / robot.torque_limit),
        ):
            most = np.abs(used).max(axis=0)
            k = int(most.argmax())
            if most[k] > worst:
                worst, message = most[k], f"{robot.joint_names[k]} has {most[k]:.3g} times its {what} limit"
    return message


def _too_stiff(t: ContactProgram) -> str:
    """Message that the target's last event does not happen in one contact, even at the largest speed that the
    joints allow; "" if it may.
    """
    p = t.problem
    # With several touches planned, parting before the event is what is planned.
    if not isinstance(t.expected, Collision) or not p.target.guards or p.order:
        return ""
    limit = fastest_at_contact(p)
    found = parting(p.law, p.target, t.hit.mass, limit)
    return "" if found is None else _parting_message(found, limit, one_touch=bool(met_once(p)))


def _parting_message(found: Parting, limit: float, *, one_touch: bool) -> str:
    """limit [m/s] : largest speed.  one_touch : whether a plan can have one touch only."""
    message = (
        f"one contact is not enough: even at {limit:.2g} m/s, the most that the joints allow, point masses "
        f"as heavy as striker and target separate {1e3 * found.time:.2g} ms after they touch, before the "
        f"target's {found.event!r}"
    )
    if found.order is not None and not one_touch:
        message += f"; `[collision] touches = {list(found.order)}` plans them"
    if found.needed is not None:
        message += f"; {found.needed:.2g} m/s would be enough"
    if found.stiffness is not None:
        message += f"; a contact stiffness of {found.stiffness:.1g} would do"
    return message


def _too_soft(t: ContactProgram) -> str:
    """Message that an impact of point masses takes longer than the contact may last; "" if it does not."""
    longest = t.problem.contact_duration[1]
    if not isinstance(t.expected, Collision) or t.expected.natural <= longest:
        return ""
    return (
        f"this contact is soft: between point masses as heavy as striker and target one phase of it takes "
        f"{1e3 * t.expected.natural:.2g} ms, and `[collision] duration_s` allows {1e3 * longest:.2g} ms at "
        "most"
    )
