"""Planner: solution of an impact problem.

`solve` checks its arguments. `_planned` makes the nonlinear program (`_program`) and its initial guesses
(`_guesses`), solves these and keeps the best (`_best`), refines it (`PlanSolver`), diagnoses a failure
(`_diagnosed`), and makes the `Solution`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.planning.bounds import Cause
from impactopt.planning.budget import VIOLATED, Budget, with_effort_of
from impactopt.planning.clearance_constraints import Margins, same_bodies, solve_with_clearance
from impactopt.planning.diagnosis import (
    ended_with_violations,
    ipopt_retry,
    search,
    with_limits_kept,
    with_reason,
)
from impactopt.planning.gain_selection import chosen_gains, with_gains_fixed, with_room_for_gains
from impactopt.planning.lazy_constraints import (
    LazyTerms,
    lazy_terms_of,
    with_lazy_constraints,
)
from impactopt.planning.models import (
    carried_start,
    check_start,
    endless,
    overloaded,
    with_order,
    with_order_of,
)
from impactopt.planning.multistart import Guesses, best_of, best_of_starts, check_starts, drawn_guesses
from impactopt.planning.oracles import BetweenNodes, MotionPrice, with_first_scale
from impactopt.planning.refinement import Guess, Oracle, Outcome, refine
from impactopt.planning.solution import Solution, program_of, program_on, solution_of
from impactopt.planning.strike import clear_strike
from impactopt.problem.feasibility import blocked, hopeless
from impactopt.problem.objectives import MotionPrices
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import drawn_posture
from impactopt.solvers.program import Callback, SolverResult, Status
from impactopt.transcription.contact_refinement import finest
from impactopt.transcription.initial_guess import first_iterate, iterate_from_strike, strike_iterate
from impactopt.transcription.mesh import NO_MORE
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, statement_of

STARTS = ("reach", "strike")
_HOPELESS_ITERATIONS = 100  # of each program of a problem that is unlikely to have a solution
_SAME_POSTURE = 1e-6  # [rad], [m] largest difference of a coordinate
_STUCK = (Status.INFEASIBLE, Status.FAILED)


def solve(
    problem: ImpactProblem,
    *,
    solver: str = "ipm",
    start: str | ArrayLike | Solution = "reach",
    starts: int = 1,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
    workers: int = 1,
    refine: bool = True,
    report: Callable[[str], None] | None = None,
    callback: Callback | None = None,
) -> Solution:
    """Plan the motion that maximizes the problem's objectives, by default the impulse, within its terms.

    An infeasible problem is a status with named constraints, not an exception.

    Parameters
    ----------
    problem : ImpactProblem
        Robot, striker, target and contact law, limits and objectives. :func:`impactopt.solve` also takes
        the path of a problem file, or the name of one that comes with the package (`impactopt problems`);
        its [solver] section then holds where nothing else is given.
    solver : {"ipm", "sqp", "ipopt"}
        "ipm" is our primal-dual interior-point method; "sqp" our SQP, which solves each QP to its end: by
        OSQP if the program is small, else by the interior-point method.
    start : str, array_like (n,) or Solution
        Initial guess. "reach": a plain reach to the target; "strike": the same with the state at contact of
        the hardest impact near by, which is a program of its own (:func:`impactopt.optimize_strike`); solver
        variables; or the solution of a similar problem, such as the same with its target moved by a few
        centimetres.
    starts : int
        Number of initial guesses. All but the first one have other postures at contact, perturbed, and other
        speeds, drawn by `seed`. The best motion is kept; ``Solution.attempts`` has all. If bodies penetrate
        each other in all solutions, up to two more guesses are tried, unless two have ended alike. If an arm
        has no motion from any, one more guess has another posture.
    seed : int
        Seed of the drawn initial guesses.
    options : mapping, optional
        Options of the solver: those of :class:`impactopt.solvers.ipm.IPMOptions`,
        :class:`impactopt.solvers.sqp.SQPOptions`, or IPOPT's. A given `max_iterations` is the limit of all
        programs of a start together: those of its refinement, too.
    time_limit : float, optional
        Time [s] for all starts together, without compiling functions.
    workers : int
        Number of processes that solve the starts. With more than one, `callback` is not allowed, and no
        starts are added.
    refine : bool
        Refine the mesh. Nodes are added where a motion loses more than half of a margin between two nodes,
        and the problem is solved again from the solution, at most three times (``Solution.nodes``). The
        contact gets finer elements while their error is more than half a per cent of the impulse
        (``Solution.elements``, ``Solution.contact_error``).
    report : callable, optional
        Called with a line of text while functions are built; by default the lines go to the logger
        "impactopt" with level INFO.
    callback : callable, optional
        Called with every iteration's record; if it returns True, or on Ctrl-C, the solve stops with the best
        iterate.

    Returns
    -------
    Solution
        Plan with the solver's result and status.

    Raises
    ------
    InputError
        An unknown solver, option or start; a start of the wrong length; several starts from a given one.
    """
    budget = Budget(solver=solver, options=options, time_limit=time_limit, callback=callback, report=report)
    check_starts(starts, seed, workers, callback, given=not isinstance(start, str))
    if isinstance(start, str) and start not in STARTS:
        near = did_you_mean(start, STARTS)
        raise InputError(
            f"unknown start {start!r}{near}: give 'reach', 'strike', solver variables (n,) or a Solution"
        )
    if problem.floats and isinstance(start, str) and start == "strike":
        raise InputError(f"robot {problem.robot.name!r} floats freely, and has no strike: start from 'reach'")
    one = partial(_planned, seed, refine)
    return best_of_starts(one, problem, start, budget, starts=starts, workers=workers)


def _planned(
    seed: int,
    refined: bool,
    problem: ImpactProblem,
    start: str | ArrayLike | Solution,
    budget: Budget,
    which: range,
    last: int,
) -> Solution:
    """Solution from the given initial guess, or the best from the starts of these numbers.

    last : number that further starts end before, if the solutions of all are refused.
    """
    began = time.perf_counter()
    t, given = _program(problem, start, budget)
    # From here on the time limit counts: a first run compiles for longer than it solves.
    budget = budget.started()
    if isinstance(given, SolverResult) and Outcome.of(t, given).own_violation <= VIOLATED:
        budget = budget.near_by()  # a feasible warm start may be the optimum
    budget.say(f"program of {t.program.n} variables and {t.program.m} constraints; {budget.solver} starts")
    margins = Margins(t.problem) if t.problem.keeps_apart else None
    # Solutions of different guesses compare only once they keep their clearances and gear limits, so each is
    # refined. Without clearance constraints only the best one is.
    solver = PlanSolver(budget=budget, margins=margins, refined=refined and margins is not None)
    if isinstance(start, Solution) and same_bodies(t.problem, start.problem):
        t = t.with_clearance(start.clearance_constraints)
    doubts, built = overloaded(t.problem) + endless(t.problem), time.perf_counter()
    # A start's draw depends on seed and number only, so further ones continue the sequence.
    guesses = partial(_guesses, t, given, range(which.start, last), seed)
    # A solution of a similar problem is more than an estimate, so with one all iterations are allowed.
    outcome = _best(guesses, len(which), solver, doubted=bool(doubts) and not isinstance(given, SolverResult))
    violated = ended_with_violations(outcome.program, outcome.result)
    reach = isinstance(given, str) and given == "reach" and not doubts
    # Of starts on several processes, the first alone tries it: it is the same posture for all.
    if reach and violated and which.start == 0 and not budget.is_over():
        outcome = _else_from_other_posture(t, outcome, solver)
    if refined and margins is None:
        outcome = solver.on(outcome)
    # Reasons that need no search come first.
    failed = ended_with_violations(outcome.program, outcome.result)
    known = (hopeless(t.problem) or doubts or blocked(t.problem)) if failed else []
    outcome, causes = (outcome, ()) if known else _diagnosed(outcome, solver)
    gains = chosen_gains(outcome.program, outcome.result.x)
    # Before the replay, which needs a robot with gains of its own.
    outcome = with_gains_fixed(outcome, gains, budget)
    t, solved = outcome.program, time.perf_counter()
    # The replay is last, and of usable outcomes only.
    outcome = replace(outcome, result=with_reason(t, outcome.result, causes, known=known))
    # Fixing the gains has solved again, at the nodes alone.
    again = margins if gains and refined else None
    outcome = BetweenNodes(budget, again).checked(outcome)
    outcome = _with_limits_kept(outcome) if refined else outcome
    return solution_of(
        outcome,
        solver=budget.solver,
        seconds=(built - began, solved - built),
        statement=statement_of(t),
        gains=gains,
        causes=tuple(cause for cause in causes if cause.problem is not None),
        contact_error=outcome.at.contact_error if outcome.usable else None,
    )


def _program(
    problem: ImpactProblem, start: str | ArrayLike | Solution, budget: Budget
) -> tuple[Transcription, str | Array | SolverResult]:
    """Nonlinear program of a problem, on the mesh of a given solution, and the initial guess for it."""
    if not isinstance(start, Solution):
        problem = with_order(problem, budget.say)
        t = program_on(with_room_for_gains(problem), NO_MORE, (), (), budget.report)
        # The scale of prices is taken from the plain reach, so a vector of variables gets none.
        if isinstance(start, str):
            return with_first_scale(t), start
        return t, check_array("start", start, (t.program.n,))
    check_start(start, problem, motion=True)
    # a similar problem is likely to need the same lazy constraints and prices
    problem = with_lazy_constraints(problem, lazy_terms_of(start.problem))
    if problem.style == start.problem.style:
        problem = replace(problem, price_scale=start.problem.price_scale)
    problem = with_order_of(start, problem)
    t = program_on(with_room_for_gains(problem), start.nodes, start.elements, start.shares, budget.report)
    apart = start.clearance_constraints if same_bodies(problem, start.problem) else {}
    given = carried_start(t, partial(program_of, start), start, apart)
    check_array("start", given.x, (t.program.n,))
    return t, given


@dataclass(frozen=True, kw_only=True)
class PlanSolver:
    """Solves plans from their initial guesses.

    margins : required clearances; None if there are no clearance constraints.  refined : whether each
    solution is refined between its nodes.
    """

    budget: Budget
    margins: Margins | None
    refined: bool

    def from_guess(self, guess: Guess[Transcription]) -> Outcome[Transcription]:
        """Outcome of an initial guess, with the lazy constraints and the prices of motion that it needs."""
        # Prices last: each reduction changes the motion, and the lazy terms are checked again.
        oracles: list[Oracle[Transcription]] = [LazyTerms(self.budget.report), MotionPrice()]
        outcome = refine(self._solved(guess), oracles, self._solved, self.budget)
        # before starts are compared
        return _with_limits_kept(outcome) if self.refined else outcome

    def on(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Solution refined between its nodes, which `from_guess` has not done without clearance
        constraints.
        """
        refining = replace(self, refined=True)

        def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
            return solve_with_clearance(self.budget, self.margins, guess)

        # The lazy terms were checked on the coarse mesh; what refinement has changed is checked again below.
        outcome = refine(outcome, [BetweenNodes(self.budget, self.margins)], solve, self.budget)
        return refine(outcome, [LazyTerms(self.budget.report)], refining._solved, self.budget)

    def _solved(self, guess: Guess[Transcription]) -> Outcome[Transcription]:
        """Outcome of an initial guess, refined between nodes; by IPOPT if our solver fails without a
        diagnosis.
        """
        outcome = solve_with_clearance(self.budget, self.margins, guess)
        # Without clearance constraints the best start alone is refined later, by `on`.
        if not self.refined:
            return outcome if self.margins is not None else self._retried(outcome)
        # A program without clearance constraints would be solved again as it is.
        stuck = self._stuck(outcome.result) and not self.budget.is_over()
        if stuck and outcome.program.clearance_constraints:
            outcome = self._solved_without_clearance(outcome)
        else:
            outcome = self._between(outcome)
        retried = self._retried(outcome)
        return retried if retried is outcome or not retried.usable else self._between(retried)

    def _between(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        return BetweenNodes(self.budget, self.margins).refined(outcome)

    def _retried(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome of IPOPT from the same guess, if the old one has no diagnosis; else the old one."""
        t, old = outcome.program, outcome.result
        new = ipopt_retry(self.budget, t.program, outcome.origin.x, old)
        return outcome if new is old else outcome.then(Outcome.of(t, new))

    def _stuck(self, result: SolverResult) -> bool:
        """True if the solver has ended without a solution, and not at a limit that the user has set."""
        if result.status is Status.ITERATION_LIMIT:
            return "max_iterations" not in (self.budget.options or {})
        return result.status in _STUCK

    def _solved_without_clearance(self, stuck: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome of an initial guess from which no motion was found with clearance constraints.

        That does not show that there is none, as the constraints are linearized at the guess. So the program
        is first solved without them, and its solution moved out of penetration. If that fails too, the
        violated constraints of the first solve name the obstacle.
        """
        self.budget.say("no motion was found with clearance constraints: solving without them first")
        free = stuck.program.with_clearance({})
        found = self._between(Outcome.of(free, self.budget.run(free.program, stuck.origin.x), stuck.origin))
        # Either way the result has the effort of both.
        return stuck.then(found) if found.usable else found.then(stuck)


def _with_limits_kept(outcome: Outcome[Transcription]) -> Outcome[Transcription]:
    """Outcome whose status is acceptable if its plan loses limits between nodes (`with_limits_kept`)."""
    t, at = outcome.program, outcome.at
    # the robot's own gains are not those of the plan while these are open
    if outcome.result.status is not Status.SOLVED or t.problem.gains:
        return outcome
    hit, *_ = finest(at.planned, at.contact_error)
    return replace(outcome, result=with_limits_kept(outcome.result, at.planned, hit, t.problem.robot))


def _best(
    guesses: Callable[[PlanSolver], Guesses[Transcription]], count: int, solver: PlanSolver, *, doubted: bool
) -> Outcome[Transcription]:
    """Best outcome of `count` initial guesses, and of more while all are refused (`best_of`).

    doubted : an estimate has the problem infeasible, so each solve ends after few iterations.
    """
    budget, options = solver.budget, solver.budget.options or {}
    if not doubted or budget.solver == "ipopt" or "max_iterations" in options:
        return best_of(guesses(solver), solver.from_guess, budget, count)
    few = replace(budget, options={**options, "max_iterations": _HOPELESS_ITERATIONS}, together=False)
    quick = replace(solver, budget=few)
    outcome = best_of(guesses(quick), quick.from_guess, few, count)
    program, result = outcome.program, outcome.result
    if result.status is not Status.ITERATION_LIMIT or ended_with_violations(program, result):
        return outcome
    # A motion within all bounds refutes the estimate: it gets the iterations that are left.
    more = solver.from_guess(Guess(program=program, start=result))
    return outcome.else_then(more, "more iterations")


def _else_from_other_posture(
    t: Transcription, outcome: Outcome[Transcription], solver: PlanSolver
) -> Outcome[Transcription]:
    """Outcome of a guess with another posture at contact, after guesses that failed; the old one if there is
    none.

    From the strongest posture there may be no motion, such as to a soft board that breaks; nor from the one
    nearest to the start, where an arm bends the other way.
    """
    p, used = t.problem, t.postures[0]  # of the first start
    posture = p.contact_posture
    # Postures come of iterations: equal ones differ in their last digits.
    if np.allclose(posture, used, atol=_SAME_POSTURE):
        posture = drawn_posture(p)
    if np.allclose(posture, used, atol=_SAME_POSTURE):
        return outcome
    solver.budget.say("no motion was found: solving again from another posture at contact")
    guess = Guess(program=t, start=first_iterate(t, posture=posture))
    return outcome.else_then(solver.from_guess(guess), "other posture")


def _diagnosed(
    outcome: Outcome[Transcription], solver: PlanSolver
) -> tuple[Outcome[Transcription], tuple[Cause, ...]]:
    """Outcome and causes of infeasibility after a failed solve: the outcome is a solution if the diagnosis
    has found a feasible point and a motion from there.

    A solve that ended at a limit that the user has set is returned as it is.
    """
    budget, old = solver.budget, outcome.result
    limited = old.status is Status.ITERATION_LIMIT and "max_iterations" in (budget.options or {})
    if limited or not ended_with_violations(outcome.program, old) or budget.is_over():
        return outcome, ()
    # Prices exclude no motion, but with them the solver may stall on the way to one.
    if outcome.origin.program.problem.style_prices != MotionPrices():
        budget.say("no motion was found: solving again without prices on motion")
        free = outcome.origin.program.repriced(0.0)
        both = outcome.then(
            solver.from_guess(Guess(program=free, start=outcome.origin.x)), "no prices on motion"
        )
        if both.usable:
            return both, ()
        outcome = replace(outcome, result=with_effort_of(old, both.result))
        if budget.is_over():
            return outcome, ()
    budget.say("no motion meets all bounds: searching for the bound that would have to change")
    found = search(outcome.program, old, budget)
    if found.met is None or budget.is_over():
        return outcome, found.causes
    budget.say("a motion that meets all bounds was found: solving from it")
    program, x = found.met
    new = solver.from_guess(Guess(program=program, start=x))
    return (outcome.then(new, "a motion within all bounds"), ()) if new.usable else (outcome, found.causes)


def _guesses(
    t: Transcription, start: str | Array | SolverResult, which: range, seed: int, solver: PlanSolver
) -> Guesses[Transcription]:
    """Named initial guesses: the given one, or drawn reaches, or those with the states of optimized
    strikes.
    """
    if not isinstance(start, str):
        return [("given", partial(Guess, program=t, start=start))]
    strike = StrikeTranscription(t.problem, t.functions) if start == "strike" else None

    def guess(draw: dict[str, Any]) -> Guess[Transcription]:
        if strike is None:
            return Guess(program=t, start=first_iterate(t, **draw))
        reach = Guess(program=strike, start=strike_iterate(strike, **draw))
        found = clear_strike(solver.budget, solver.margins, reach)
        return Guess(program=t, start=iterate_from_strike(t, found.program, found.result.x))

    return drawn_guesses(start, guess, which, seed)
