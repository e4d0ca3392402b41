"""Strike optimization: the state at contact with the hardest impact, without a motion that reaches it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from impactopt.errors import InputError, check_array
from impactopt.planning.budget import Budget, touching
from impactopt.planning.clearance_constraints import (
    Margins,
    deepest_penetration,
    same_bodies,
    solve_with_clearance,
)
from impactopt.planning.diagnosis import with_reason
from impactopt.planning.gain_selection import chosen_gains, with_gains_fixed, with_room_for_gains
from impactopt.planning.lazy_constraints import (
    LazyTerms,
    gear_caution,
    lazy_terms_of,
    nail_caution,
    with_lazy_constraints,
)
from impactopt.planning.models import carried_start, check_start, with_order, with_order_of
from impactopt.planning.multistart import Guesses, best_of, best_of_starts, check_starts, drawn_guesses
from impactopt.planning.refinement import Additions, Guess, Outcome, carried, program_for, refine
from impactopt.planning.solution import Solved, impact_summary, versions
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Callback, Status
from impactopt.transcription.initial_guess import strike_iterate
from impactopt.transcription.mesh import Elements, Shares, contact_elements
from impactopt.transcription.plan import PlannedStrike
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import block_functions

BARRIER_WARM = 1e-2  # first barrier of a warm start with other constraints
_STUCK = (Status.FAILED, Status.INFEASIBLE, Status.ITERATION_LIMIT)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class StrikeSolution(Solved):
    """Solution of a strike program.

    strike : posture and velocity at contact, and the impact; those of the best iterate if the status is not
    usable.  Its other attributes are those of :class:`impactopt.planning.solution.Solved`.
    """

    strike: PlannedStrike

    @property
    def impulse(self) -> float:
        """Planned impulse to the target [N s]: an upper bound for motions near this local optimum."""
        return self.strike.impulse

    def summary(self) -> dict[str, Any]:
        """Entries of ``summary.json``."""
        hit = self.strike
        loads, names = hit.loads(), self.problem.robot.joint_names
        angles = self.problem.robot.joint_positions(hit.posture)
        caution = " ".join(filter(None, [self.caution, nail_caution(self.problem, hit)]))
        return {
            **self.outcome(),
            **({"caution": caution} if caution else {}),
            **impact_summary(hit, hit.collision, self.contact_replay),
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
    solver: str = "ipm",
    starts: int = 1,
    seed: int = 0,
    start: ArrayLike | StrikeSolution | None = None,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    workers: int = 1,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> StrikeSolution:
    """Find the state at contact with the hardest impact within the problem's terms, without a motion that
    leads to it.

    The motions before and after are free. So the impulse of the strike is an upper bound on that of motions
    whose state at contact is near. There are local optima: the impulses of different postures can differ by a
    factor. The gear loads stay within `GearLoad`, by default too.

    method : "collocation", the only one: the full equations of motion during contact.
    solver, options, time_limit, report, callback : as of :func:`impactopt.solve`.
    starts : number of initial guesses; all but the first one have other postures and speeds, drawn
        by ``seed``. The best strike is kept; ``StrikeSolution.attempts`` has all.
    workers : number of processes that solve these; with more than one, ``callback`` is not allowed.
    start : initial guess instead: solver variables (n,), or the solution of a similar problem.

    Raises
    ------
    InputError : an unknown method, solver or option; a start of the wrong length; several `starts` with a
        given start; objectives of a whole motion only.
    """
    if method != "collocation":
        gone = "is no longer supported" if method == "shooting" else "is unknown"
        raise InputError(f'method {method!r} {gone}: give "collocation", or leave it out')
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback, report=report)
    check_starts(starts, seed, workers, callback, given=start is not None)
    if problem.floats:
        raise InputError(
            f"robot {problem.robot.name!r} floats freely: its state at contact depends on the swing, so "
            "there is no strike by itself; solve the whole motion, from a reach"
        )
    if all(o.whole_motion for o in problem.objectives):
        raise InputError("no objective of this problem is one of a strike; add what it is for: Impulse()")
    one = partial(_optimized, seed)
    return best_of_starts(one, problem, start, budget, starts=starts, workers=workers)


def _optimized(
    seed: int,
    problem: ImpactProblem,
    start: ArrayLike | StrikeSolution | None,
    budget: Budget,
    which: range,
    _last: int,
) -> StrikeSolution:
    """Best strike from the starts of these numbers, or from the given initial guess."""
    began, problem = time.perf_counter(), with_room_for_gains(problem)
    if isinstance(start, StrikeSolution):
        check_start(start, problem, motion=False)
        problem = with_lazy_constraints(problem, lazy_terms_of(start.problem))
        problem = with_order_of(start, problem)
    else:
        problem = with_order(problem, budget.say)
    mesh = (start.elements, start.shares) if isinstance(start, StrikeSolution) else ((), ())
    t = _program_on(problem, *mesh, budget.report)
    budget = budget.started()
    if isinstance(start, StrikeSolution):
        # Only its variables: clearance constraints enter by themselves.
        old = partial(_program_on, start.problem, *mesh)
        apart = start.clearance_constraints if same_bodies(problem, start.problem) else {}
        start = carried_start(t, old, start, apart).x
    budget.say(f"program of {t.program.n} variables and {t.program.m} constraints; {budget.solver} starts")
    solve = partial(_clean_strike, budget, Margins(problem) if problem.keeps_apart else None)

    def with_lazy_terms(guess: Guess[StrikeTranscription]) -> Outcome[StrikeTranscription]:
        return refine(solve(guess), [LazyTerms(budget.report)], solve, budget)

    def reach(draw: dict[str, Any]) -> Guess[StrikeTranscription]:
        return Guess(program=t, start=strike_iterate(t, **draw))

    built = time.perf_counter()
    guesses: Guesses[StrikeTranscription] = drawn_guesses("reach", reach, which, seed)
    if start is not None:
        guesses = [("given", partial(Guess, program=t, start=check_array("start", start, (t.program.n,))))]
    outcome = best_of(guesses, with_lazy_terms, budget, len(which))
    gains = chosen_gains(outcome.program, outcome.result.x)
    outcome = with_gains_fixed(outcome, gains, budget)
    t, at, solved = outcome.program, outcome.at, time.perf_counter()
    outcome = replace(outcome, result=with_reason(t, outcome.result)).checked()
    return StrikeSolution(
        problem=t.problem,
        result=outcome.result,
        solver=budget.solver,
        build_seconds=built - began,
        solve_seconds=solved - built,
        violations=outcome.violations,
        objectives=t.achieved(at.x),
        attempts=outcome.attempts,
        gains=gains,
        strike=at.planned,
        contact=at.contact if outcome.usable else None,
        elements=t.hit.elements if t.hit.guarded else (),
        shares=t.hit.shares,
        clearance_constraints=t.clearance_constraints,
    )


def _program_on(
    problem: ImpactProblem, elements: Elements, shares: Shares, report: Callable[[str], None] | None = None
) -> StrikeTranscription:
    """Program of a strike on a given mesh of the contact, without clearance constraints."""
    functions = block_functions(problem, report, elements)
    return StrikeTranscription(problem, functions, elements, shares)


def clear_strike(
    budget: Budget, margins: Margins | None, guess: Guess[StrikeTranscription]
) -> Outcome[StrikeTranscription]:
    """Strike with clearance constraints, and freezes at the right times.

    guess : a warm start is tried first; if that fails, the solve begins without its multipliers and clearance
    constraints.
    """
    t = guess.program

    def solve(guess: Guess[StrikeTranscription]) -> Outcome[StrikeTranscription]:
        return refine(
            solve_with_clearance(budget, margins, guess),
            [Freezes()],
            partial(solve_with_clearance, budget, margins),
            budget,
        )

    outcome = solve(replace(guess, barrier=BARRIER_WARM))
    if guess.warm is not None and outcome.result.status in _STUCK and not budget.is_over():
        outcome = outcome.then(solve(Guess(program=t.with_clearance({}), start=guess.x)))
    return outcome


def _clean_strike(
    budget: Budget, margins: Margins | None, guess: Guess[StrikeTranscription]
) -> Outcome[StrikeTranscription]:
    """Strike without penetration (`clear_strike`); a failed outcome if bodies still penetrate."""
    outcome = clear_strike(budget, margins, guess)
    if margins is None or not outcome.usable:
        return outcome
    depth, pairs = deepest_penetration(outcome.program, outcome.result.x, margins)
    # deepest_penetration is negative without one.
    if depth <= 0:
        return outcome
    names = (" and ".join(margins.bodies.names(pair)) for pair in pairs)
    return replace(outcome, result=touching(outcome.result, depth, names, "strike"))


class Freezes:
    """Oracle for the instants at which a model freezes during contact: they are fractions of the contact's
    duration, and change with the durations of its phases.
    """

    most = 10
    of_refused = False

    def missing(self, outcome: Outcome[StrikeTranscription]) -> Additions[StrikeTranscription] | None:
        """Program whose phases have the fractions of the contact that the solution has."""
        t, x = outcome.program, outcome.result.x
        # None while the freezes are where the program has them.
        shares = t.hit.drifted(x)
        if shares is None:
            return None

        def guesses() -> Iterator[Guess[StrikeTranscription]]:
            finer = program_for(t, elements=contact_elements(t.problem, shares), shares=shares)
            yield Guess(program=finer, start=carried(finer, t, outcome.result).x)

        why = "freezes come at other times"
        return Additions(name="freezes", why=why, guesses=guesses(), without="")
