"""The hardest blow by itself: the state at contact that no motion need reach."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError, check_array
from impactopt.planning.chosen_gains import roomy, settled
from impactopt.planning.contact_replay import checked
from impactopt.planning.gears import gear_caution
from impactopt.planning.keeping_apart import Margins, solved_apart
from impactopt.planning.models import carried_start, climbed, planned_contact
from impactopt.planning.multistart import (
    Budget,
    Starts,
    carried,
    check_starts,
    drawn,
    one_after_the_other,
    solve_from,
    touching,
)
from impactopt.planning.on_demand import kept_on_demand, rows_on_demand, with_rows
from impactopt.planning.side_by_side import best_side_by_side, check_workers
from impactopt.planning.solution import Solved, impact_summary, versions
from impactopt.planning.too_near import deepest_penetration
from impactopt.planning.verdict import with_reason
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Callback, SolverResult, Status
from impactopt.transcription.initial_guess import strike_iterate
from impactopt.transcription.mesh import contact_elements
from impactopt.transcription.planned_strike import PlannedStrike
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import block_functions

Array = NDArray[np.float64]
ROUNDS = 10  # of freezes that come when they are to
# first barriers: of an arm's start, which ends sooner and more surely from there (humanoids do not); and of a
# solve that goes on with other constraints
BARRIER_ARM, BARRIER_ON = 0.03, 1e-2
_STUCK = (Status.FAILED, Status.INFEASIBLE, Status.ITERATION_LIMIT)
Work = Callable[[StrikeTranscription, Array | SolverResult], tuple[StrikeTranscription, SolverResult]]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class StrikeSolution(Solved):
    """A solved (or stopped) strike.

    strike : posture and velocity at contact, and the blow; for a status that is not usable, of the best
    iterate.  Its other attributes are those of :class:`impactopt.planning.solution.Solved`.
    """

    strike: PlannedStrike

    @property
    def impulse(self) -> float:
        """Planned impulse to the target [N s]: no motion from this local optimum brings more."""
        return self.strike.impulse

    def summary(self) -> dict[str, Any]:
        """The numbers of ``summary.json``."""
        hit = self.strike
        loads, names = hit.loads(), self.problem.robot.joint_names
        angles = self.problem.robot.joint_positions(hit.posture)
        return {
            **self.outcome(),
            **impact_summary(hit, hit.collision),
            "objectives": dict(self.objectives),
            **hit.margins(),
            **loads.summary(),
            **gear_caution(self.problem, [loads]),
            "posture_rad": {name: float(a) for name, a in zip(names, angles, strict=True)},
            "velocity_rad_s": {
                name: float(v) for name, v in zip(names, hit.velocity[-len(names) :], strict=True)
            },
            "versions": versions(),
        }


def optimize_strike(
    problem: ImpactProblem,
    *,
    method: str = "collocation",
    solver: str = "sqp",
    starts: int = 1,
    seed: int = 0,
    start: ArrayLike | StrikeSolution | None = None,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    workers: int = 1,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> StrikeSolution:
    """Find the state at contact that hits hardest within the problem's terms, without a motion that leads to
    it.

    The motion before and after is free. So near the state at contact of a motion, the impulse of the strike
    is an upper bound on that of the motion. There are local optima: different postures can differ by a
    factor. Gears bear what `GearLoad` lets them, by default too.

    method : "collocation", the only one: the whole equation of motion while the contact lasts.
    solver, options, time_limit, report, callback : as of :func:`impactopt.solve`.
    starts : reaches to start from, the first one plain, the others with perturbed postures and other speeds,
        drawn by ``seed``; the best strike is kept. ``StrikeSolution.attempts`` has all.
    workers : processes that these starts are solved on, side by side; then no callback is asked.
    start : to start from instead: solver variables (n,), or the solution of a neighbouring problem.

    Raises
    ------
    InputError : an unknown method, solver or option; a start of the wrong length; `starts` beside a given
        start; objectives of a whole motion only.
    """
    if method != "collocation":
        gone = "is no longer supported" if method == "shooting" else "is unknown"
        raise InputError(f'method {method!r} {gone}: give "collocation", or leave it out')
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback)
    check_starts(starts, seed, given=start is not None)
    check_workers(workers, callback)
    if all(o.whole_motion for o in problem.objectives):
        raise InputError("no objective of this problem is one of a strike; add what it is for: Impulse()")
    if problem.collision == "auto":
        common: dict[str, Any] = {
            "solver": solver,
            "options": options,
            "workers": workers,
            "report": report,
            "callback": callback,
        }

        def run(chosen: ImpactProblem, other: StrikeSolution | None, left: float | None) -> StrikeSolution:
            if other is not None:
                return optimize_strike(chosen, start=other, time_limit=left, **common)
            return optimize_strike(chosen, start=start, starts=starts, seed=seed, time_limit=left, **common)

        return climbed(problem, run, time_limit=time_limit, report=report)
    if workers > 1 and starts > 1:
        block_functions(roomy(problem), problem.coordinates, report)  # compiled here, not by each
        run = partial(_optimized, problem, None, seed)
        return best_side_by_side(run, budget, starts=starts, workers=workers, report=report)
    return _optimized(problem, start, seed, budget, range(starts), report)


def _optimized(
    problem: ImpactProblem,
    start: ArrayLike | StrikeSolution | None,
    seed: int,
    budget: Budget,
    which: range,
    report: Callable[[str], None] | None,
) -> StrikeSolution:
    """The best strike from these starts, or from the given one."""
    began, problem = time.perf_counter(), roomy(problem)
    if isinstance(start, StrikeSolution):
        problem = with_rows(problem, rows_on_demand(start.problem))
    mesh = (start.elements, start.shares) if isinstance(start, StrikeSolution) else ()
    functions = block_functions(problem, problem.coordinates, report, *mesh[:1])
    budget = budget.started()
    t = StrikeTranscription(problem, problem.coordinates, functions, *mesh)
    if isinstance(start, StrikeSolution):
        same = partial(_program_of, start)
        start = carried_start(t, same, start, start.apart).x
    given = None if start is None else check_array("start", start, (t.program.n,))
    if report is not None:
        report(f"program of {t.program.n} variables and {t.program.m} constraints; {budget.solver} starts")
    margins = Margins(problem) if problem.keeps_apart else None
    work = partial(_bounded_strike, partial(_clean_strike, budget, margins), report)
    t, fields = solve_from(t, _starts(t, given, which, seed), budget, began, work)
    t, fields = settled(t, fields, budget, report)
    result = fields["result"] = with_reason(t, fields["result"])
    problem = fields["problem"]
    strike, contact = t.decode(result.x), None
    if result.status.usable:
        contact = planned_contact(t, result.x, strike, problem)
        fields["result"] = checked(result, contact.replay)
    return StrikeSolution(
        strike=strike,
        contact=contact,
        elements=t.hit.elements if t.hit.guarded else (),
        shares=t.hit.shares,
        apart=t.apart_rows,
        **fields,
    )


def _program_of(solution: StrikeSolution) -> StrikeTranscription:
    """The program of a solution, without clearance constraints."""
    p, elements = solution.problem, solution.elements
    functions = block_functions(p, p.coordinates, None, elements)
    return StrikeTranscription(p, p.coordinates, functions, elements, solution.shares)


def clear_strike(
    budget: Budget, margins: Margins | None, t: StrikeTranscription, start: Array | SolverResult
) -> tuple[StrikeTranscription, SolverResult]:
    """A strike whose bodies keep apart; its result has the effort of all.

    start : variables (n,); or a result of this program but for other constraints, such as those on demand:
        then it goes on from there, and begins anew only where that fails.
    """
    x0 = start.x if isinstance(start, SolverResult) else start
    goes_on = isinstance(start, SolverResult) and len(start.multipliers) == t.program.m
    if budget.interior and not t.coordinates.soles:
        budget = replace(budget, options={"barrier": BARRIER_ARM, **(budget.options or {})})
    found, result = solved_apart(budget, margins, t, start if goes_on else x0, BARRIER_ON)
    found, result = _settled(budget, margins, found, result)
    if goes_on and result.status in _STUCK and budget.left != 0:
        before = result
        found, result = _settled(budget, margins, *solved_apart(budget, margins, t.with_apart({}), x0))
        result = one_after_the_other(before, result)
    return found, result


def _clean_strike(
    budget: Budget, margins: Margins | None, t: StrikeTranscription, start: Array | SolverResult
) -> tuple[StrikeTranscription, SolverResult]:
    """Strike without penetration (`clear_strike`); a result that still has some is no solution."""
    t, result = clear_strike(budget, margins, t, start)
    if margins is None or not result.status.usable:
        return t, result
    depth, pairs = deepest_penetration(t, result.x, margins)
    if depth <= 0:
        return t, result
    names = (" and ".join(margins.bodies.names(pair)) for pair in pairs)
    return t, touching(result, depth, names, "strike")


def _bounded_strike(
    work: Work, report: Callable[[str], None] | None, t: StrikeTranscription, start: Array | SolverResult
) -> tuple[StrikeTranscription, SolverResult]:
    """Solves a strike from one initial guess, adding the lazy constraints that it needs."""
    found, result = work(t, start)
    return kept_on_demand(found, result, (t, start), work, lambda *_: (), report)


def _settled(
    budget: Budget, margins: Margins | None, t: StrikeTranscription, result: SolverResult
) -> tuple[StrikeTranscription, SolverResult]:
    """A strike whose freezes on the way come when they are to, by the time that its contact takes."""
    for _ in range(ROUNDS):
        shares = t.hit.drifted(result.x) if result.status.usable and budget.left != 0 else None
        if shares is None:
            break
        elements = contact_elements(t.problem, shares)
        functions = block_functions(t.problem, t.coordinates, None, elements)
        finer = StrikeTranscription(t.problem, t.coordinates, functions, elements, shares)
        finer = finer.with_apart(t.apart_rows)
        finer, new = solved_apart(budget, margins, finer, carried(finer, t, result).x)
        if not new.status.usable:
            break
        t, result = finer, one_after_the_other(result, new)
    return t, result


def _starts(t: StrikeTranscription, given: Array | None, which: range, seed: int) -> Starts:
    """Names of the starts, and what makes them."""
    if given is not None:
        yield "given", lambda: given
        return
    draws = drawn(which.stop, seed)
    for k in which:
        yield f"reach {k + 1}", partial(strike_iterate, t, **draws[k])
