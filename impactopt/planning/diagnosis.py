"""Diagnosis of a failed solve: a second solver's result, and the cause of infeasibility."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.planning.budget import VIOLATED, Budget
from impactopt.planning.causes import Cause
from impactopt.planning.solution import Solution
from impactopt.problem.checks import met_once
from impactopt.problem.feasibility import too_weak
from impactopt.robots.loads import shortfalls
from impactopt.solvers.program import NonlinearProgram, SolverResult, Status, max_violation
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import Parting, fastest_at_contact, parting
from impactopt.transcription.contact_program import ContactProgram

Array = NDArray[np.float64]
TOLD = 3  # margins at most, in a message


def second_look(budget: Budget, program: NonlinearProgram, start: Array, old: SolverResult) -> SolverResult:
    """The result that IPOPT comes to from the same start, where ours gave up, if it says more.

    It scales constraints, and restores them by another way, so it rarely fails on the same programs. A limit
    that the caller has set is an answer, and stays one.
    """
    open_end = old.status is Status.FAILED or (old.status is Status.ITERATION_LIMIT and not budget.options)
    if budget.solver == "ipopt" or not open_end or budget.left == 0:
        return old
    rows = max_violation(program, old.x, program.constraints(old.x))
    if old.status is Status.FAILED and rows <= VIOLATED < old.max_violation:
        return old  # it has been refused for what is no constraint
    budget.say("our solver ends without a diagnosis: IPOPT tries once, from the same start")
    new = replace(budget, solver="ipopt", options=None).run(program, start)
    if new.status is Status.INTERRUPTED or _rank(new) < _rank(old):
        return new
    return old


def _rank(result: SolverResult) -> tuple[bool, bool, float]:
    """Solutions first, then what has a diagnosis, then what is least violated."""
    return not result.status.usable, result.status is not Status.INFEASIBLE, result.max_violation


def lacks_rows(t: ContactProgram, result: SolverResult) -> bool:
    """True if a solver has ended by itself with violated constraints."""
    if result.status not in (Status.FAILED, Status.INFEASIBLE, Status.ITERATION_LIMIT):
        return False
    return max_violation(t.program, result.x, t.program.constraints(result.x)) > VIOLATED


def with_reason(
    t: ContactProgram, result: SolverResult, causes: Sequence[Cause] = (), *, known: Sequence[str] = ()
) -> SolverResult:
    """A result without a solution, and why there is none: what is ``known`` of the problem anyway, a bound
    that would have to move, or what a blow of point masses says.

    Such a program is infeasible, whatever its solver ended with.
    """
    if not lacks_rows(t, result):
        return result
    would_do = [cause for cause in causes if cause.problem is not None]
    weak = too_weak(t.problem)
    if known:
        why = f"Infeasible: {'; '.join(known)}."
    elif would_do:
        first, *others = would_do
        why = f"Infeasible: {first.first}. {first.text} would do, with all else as it is"
        why += "".join(f"; or {other.text}" for other in others) + "."
        # what point masses say is of the contact alone, and not always of what keeps a plan from being
        masses = (_too_stiff(t) or _too_long(t)) if "contact" in first.first else ""
        why += "".join(f" Besides, {text}." for text in (weak, masses) if text)
    else:
        beyond = [f"{cause.first}: {cause.text}, which may not be" for cause in causes]
        found = weak or _too_stiff(t) or _too_long(t) or "".join(beyond[:1])
        if not found:
            return result
        why = f"Infeasible: {found}."
    rest = result.message.partition(". ")[2] or result.message
    return replace(result, status=Status.INFEASIBLE, message=f"{why} {rest}")


def with_soles_kept(solution: Solution) -> Solution:
    """A solution whose soles keep at least half of each margin between its program's nodes, too; one of which
    some keeps less is acceptable at best, and says so.
    """
    if solution.status is not Status.SOLVED:
        return solution
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        if short := shortfalls(solution.sole_margins()):
            message = f"A sole keeps less than half of a margin between nodes: {'; '.join(short[:TOLD])}."
            result = replace(solution.result, status=Status.ACCEPTABLE, message=message)
            return replace(solution, result=result)
    return solution


def _too_stiff(t: ContactProgram) -> str:
    """The target's last event does not happen in one contact, however fast the robot is."""
    p = t.problem
    if not isinstance(t.expected, Collision) or not p.target.guards or p.planned_touches > 1:
        return ""
    limit = fastest_at_contact(p)
    found = parting(p.law, p.target, t.hit.mass, limit)
    return "" if found is None else _told(found, limit, fixed=bool(met_once(p)))


def _told(found: Parting, limit: float, *, fixed: bool) -> str:
    """fixed : whether a plan can have one touch only."""
    words = (
        f"one contact is not enough: even at {limit:.2g} m/s, the most that the joints allow, point masses "
        f"as heavy as striker and target separate {1e3 * found.time:.2g} ms after they touch, before the "
        f"target's {found.event!r}"
    )
    if found.touches is not None and not fixed:
        words += f"; `[collision] touches = {found.touches}` plans them"
    if found.needed is not None:
        words += f"; {found.needed:.2g} m/s would be enough"
    if found.stiffness is not None:
        words += f"; a contact stiffness of {found.stiffness:.1g} would do"
    return words


def _too_long(t: ContactProgram) -> str:
    """A blow of point masses takes longer than the contact may last."""
    longest = t.problem.contact_duration[1]
    if not isinstance(t.expected, Collision) or t.expected.natural <= longest:
        return ""
    return (
        f"this contact is soft: between point masses as heavy as striker and target one phase of it takes "
        f"{1e3 * t.expected.natural:.2g} ms, and `[collision] duration_s` allows {1e3 * longest:.2g} ms at "
        "most"
    )
