"""Primal-dual interior-point method that takes one Newton step on each quadratic model.

The QPs of a whole motion have thousands of constraints; solving each of them exactly costs more than
evaluating the program. So the barrier is kept from one QP to the next, and every QP gets one Newton step: the
method of Waechter and Biegler (Mathematical Programming 106, 2006), with its filter line search (sections 2.3
and 2.4), second-order corrections and inertia control. Two parts are ours: steps are bent at slacks
(`_bent_step`), and the Newton system (`newton`) is condensed, as equalities that determine variables are
eliminated first (`condense`).

If no step makes progress, the constraints become elastic: they may be violated at a price (Nocedal and Wright
2006, section 18.5). Once they are met they are hard again, and the price is higher the next time. If the
price does not achieve that, the violation is minimized without the objective. So the method ends at a point
of least violation if the program is infeasible.

`BarrierProblem` has the iterate and its Newton step, `LineSearch` selects the step length, and `ElasticPhase`
decides when constraints are hard, when elastic, and when only the violation is minimized.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from impactopt.solvers.ipm.barrier_problem import BarrierProblem, Filter, SearchStart, Step, Trial
from impactopt.solvers.options import IPMOptions
from impactopt.solvers.program import (
    Callback,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    bound_violations,
    complementarity,
    is_stationary_violation,
    stationarity,
)
from impactopt.solvers.run import BarrierState, Run, Watch

_MAX_CORRECTIONS = 4  # p_max of Waechter and Biegler, step: second-order corrections of a step
_KAPPA_SOC = 0.99  # a correction that leaves more than this fraction of the violation is the last
# The first two of these change no plan, and iterations little: gains of 1 to 2 and fractions of 0.5 to
# 0.99 were tried on seven problems. With ten times the violation arm7 takes 175 iterations for 142,
# and punch_standin 66 for 42.
_MIN_BENT_GAIN = 1.2  # a step is bent only if that makes it this many times as long
_BENT_SLACK_FRACTION = 0.9  # of its distance to the bound, that each slack may take in a bent step
_MAX_BENT_VIOLATION = 1.0  # of any constraint, before and after a bent step
_SHORT_STEP = 1e-2  # a shorter step length hardly is progress ...
_MAX_SHORT_STEPS = 20  # ... and more short steps than this in a row count as none
_HELD_BACK = 0.2  # a step is held back if the watch permits less than this fraction of its length


class AcceptedStep(NamedTuple):
    """A step that makes progress, the trial point at a step length, and remarks for the history."""

    step: Step
    trial: Trial
    length: float
    remarks: list[str]


class LineSearch:
    """Filter line search, which also counts short steps.

    Attributes
    ----------
    held_back : whether the watch shortened the last step much.
    """

    def __init__(self, watch: Watch | None = None, max_growth: float = 1e4) -> None:
        """watch : limits the length of steps.  max_growth : see `Filter.from_violation`."""
        self._watch, self._max_growth = watch, max_growth
        self._filter: Filter | None = None
        self._short_steps = 0  # in a row
        self.held_back = False

    def reset_filter(self) -> None:
        """Discard the filter: its pairs are of another barrier, objective or set of constraints."""
        self._filter = None

    def find(self, problem: BarrierProblem, step: Step, residual: Vector) -> AcceptedStep | None:
        """Search along a step for an acceptable point.

        Returns None if there is none, or if steps have been short for too long.
        """
        # Slacks and variables limit `longest`; the watch may permit more, which only a bent step can use.
        longest = problem.max_length(step)
        limit = self._limit(problem, step, problem.x.max_length(step.free, problem.tau))
        self.held_back = limit < _HELD_BACK * longest
        longest = min(longest, limit)
        start = problem.search_start(step, residual)
        if self._filter is None:
            # Its theta_min and theta_max are relative to the violation where it begins.
            self._filter = Filter.from_violation(start.theta, self._max_growth)
        pairs = self._filter
        # A bent step is longer than all that backtracking can find, so it is tried first.
        accepted = _bent_step(problem, pairs, step, start, longest, limit)
        if accepted is None:
            accepted = self._backtrack(problem, pairs, step, start, longest, residual)
        short = accepted is None or accepted.length < _SHORT_STEP
        self._short_steps = self._short_steps + 1 if short else 0
        if accepted is None or self._short_steps > _MAX_SHORT_STEPS:
            self._short_steps = 0
            return None
        pairs.augment(start, accepted.length, accepted.trial.phi)
        return accepted

    def _limit(self, problem: BarrierProblem, step: Step, most: float) -> float:
        """Largest length of a step, ``most`` at most, that the watch permits."""
        return most if self._watch is None else self._watch.limit(problem.point.x, step.d, most)

    def _backtrack(
        self,
        problem: BarrierProblem,
        pairs: Filter,
        step: Step,
        start: SearchStart,
        longest: float,
        residual: Vector,
    ) -> AcceptedStep | None:
        """Halve the step length until the filter accepts the point; None below the least length."""
        # Each halving costs an evaluation of f and g, no derivatives and no factorization.
        length, trials = longest, 0
        while True:
            trials += 1
            trial = problem.trial(step, length)
            if _is_acceptable(pairs, start, length, trial):
                return AcceptedStep(step, trial, length, [])
            # only a first trial with more violation is corrected (step ): a shorter one is nearly linear
            if trials == 1 and trial.theta >= start.theta and problem.options.second_order_correction:
                accepted = self._second_order_correction(problem, pairs, start, residual, trial, longest)
                if accepted is not None:
                    return accepted
            length *= 0.5
            if length < pairs.min_length(start):
                return None

    def _second_order_correction(
        self,
        problem: BarrierProblem,
        pairs: Filter,
        start: SearchStart,
        residual: Vector,
        trial: Trial,
        longest: float,
    ) -> AcceptedStep | None:
        """Steps for the residual that a refused trial point leaves, while they reduce it (section 2.4)."""
        # p and n take up what the linearization misses (`Elastic.move`).
        if problem.elastic is not None:
            return None
        corrected_residual, theta = residual, trial.theta
        for k in range(_MAX_CORRECTIONS):
            if not trial.point.finite:
                break
            # c_soc = alpha c(x) + c(x + alpha d) (section 2.4): the same matrix, another right-hand side. The
            # paper has the alpha of the correction before, ours that of the first trial; on 60 random
            # programs of four variables the one took 867 iterations, the other 856.
            corrected_residual = longest * corrected_residual + problem.residual(trial.point, trial.slack)
            step = problem.step_for(corrected_residual)
            trial = problem.trial(step, self._limit(problem, step, problem.max_length(step)))
            # As for a first trial: by its length, from the same start.
            if _is_acceptable(pairs, start, longest, trial):
                return AcceptedStep(step, trial, longest, [f"{k + 1} corrections"])
            if trial.theta > _KAPPA_SOC * theta:
                break
            theta = trial.theta
        return None


def _bent_step(
    problem: BarrierProblem, pairs: Filter, step: Step, start: SearchStart, longest: float, limit: float
) -> AcceptedStep | None:
    """Step of the length ``limit``, in which every slack stops by itself short of its bound.

    Of thousands of slacks one is always close to its bound and would stop all variables and slacks (TALOS's
    punch takes 60 iterations with bent steps, 75 without). The constraints whose slacks stopped are violated
    then; the next steps correct that, which works while the linearization is good, so none may be violated by
    more than `_MAX_BENT_VIOLATION`.
    """
    if problem.elastic is not None or problem.point.max_violation > _MAX_BENT_VIOLATION:
        return None
    if limit <= _MIN_BENT_GAIN * longest:
        return None
    slack = problem.s.clipped(problem.s.values + limit * step.slack, _BENT_SLACK_FRACTION)
    trial = problem.trial(step, limit, slack)
    within = trial.point.finite and trial.point.max_violation <= _MAX_BENT_VIOLATION
    if not within or not _is_acceptable(pairs, start, limit, trial):
        return None
    # The multipliers go the whole length, though some slacks stopped.
    return AcceptedStep(step, trial, limit, ["bent"])


def _is_acceptable(pairs: Filter, start: SearchStart, length: float, trial: Trial) -> bool:
    # derivatives are the dearer test, and are needed at the next iterate only
    return pairs.accepts(start, length, trial.theta, trial.phi) and trial.point.differentiable


# Elastic constraints that stall are made hard again if the violation is below this, or below this fraction of
# the violation at which its minimization began: all but met, hard constraints often get there.
_HARD_VIOLATION, _HARD_FRACTION = 1e-2, 1e-2
_RESTORED_VIOLATION = 1e-3  # ends a minimization of the violation: from there hard constraints are faster
_MAX_CHANGES = 12  # of the aim
_MIN_CHANGED_BARRIER = 1e-4  # after a change of the aim
# Iterations with elastic constraints that are met. Without this limit, three of two hundred nails ended at
# the iteration limit.
_MAX_MET_ITERATIONS = 20


class ElasticPhase:
    """Aim of the method: hard constraints, elastic constraints, or the violation alone.

    hard: `problem.elastic` is None. elastic: objective plus price times violation. violation alone: elastic,
    and `problem.sigma`, the weight of the objective, is 0.

    A method that changes the aim makes the pairs of the line search's filter invalid.
    """

    def __init__(self, options: IPMOptions):
        self._options = options
        self._price = options.price  # of elastic constraints
        self._met_iterations = 0  # in a row, with elastic constraints that are met
        self._initial_violation = 0.0  # where the minimization of the violation alone began
        self._changes = 0

    def begin(self) -> None:
        """Begin an attempt from another point, with the price that the last one ended with."""
        self._changes = 0

    def conclude(self, problem: BarrierProblem) -> Status | None:
        """Status at a solution of the present aim; None if the aim has changed and the method has to go on.

        SOLVED only if the constraints are met and the objective was minimized.
        """
        elastic = problem.elastic
        # With p - n = 0 the elastic program's solution is one of the hard program: the penalty is exact.
        met = elastic is None or elastic.max_violation() <= self._options.violation_tolerance
        if met and problem.sigma:
            return Status.SOLVED
        # with the objective, a small violation may only mean that the price was too low
        near = _HARD_VIOLATION if problem.sigma else _RESTORED_VIOLATION
        return self.change_aim(problem, met=met or problem.point.max_violation <= near)

    def is_restored(self, problem: BarrierProblem) -> bool:
        """True if the violation is minimized alone and is small enough for hard constraints."""
        elastic = problem.elastic
        # At the largest price `change_aim` has no way back to hard constraints.
        if elastic is None or problem.sigma or elastic.price >= self._options.price_max:
            return False
        return problem.point.max_violation <= _RESTORED_VIOLATION

    def is_met_for_long(self, problem: BarrierProblem) -> bool:
        """True if elastic constraints have been met for many iterations, which hard ones would not take."""
        met = problem.elastic is not None and problem.point.max_violation <= self._options.violation_tolerance
        self._met_iterations = self._met_iterations + 1 if met and problem.sigma else 0
        return self._met_iterations > _MAX_MET_ITERATIONS and self._price < self._options.price_max

    def change_aim(self, problem: BarrierProblem, *, met: bool) -> Status | None:
        """Leave elastic constraints that stall, or end.

        met : whether the constraints are met, or nearly so. They become hard then, while the price can
            rise; else the violation is minimized alone; if it already was, it is least, which is the end.
        """
        assert problem.elastic is not None
        self._changes += 1
        if self._changes > _MAX_CHANGES:
            return Status.FAILED
        price = problem.elastic.price
        if met and price < self._options.price_max:
            problem.elastic, problem.sigma = None, 1.0
            self._price = min(10.0 * price, self._options.price_max)
        elif problem.sigma:
            problem.sigma, self._initial_violation = 0.0, problem.point.max_violation
        else:
            return self._least_violation(problem)
        # The iterate is not near the central path of the new aim.
        problem.mu = max(problem.mu, _MIN_CHANGED_BARRIER)
        return None

    def leave_stall(self, problem: BarrierProblem, residual: Vector) -> str | Status:
        """Next aim if no step makes progress: a remark for the history, or the status that ends the solve."""
        # Near a solution rounding may refuse all steps.
        if problem.error(0.0, residual) <= self._options.acceptable_tolerance:
            if problem.elastic is None:
                return Status.ACCEPTABLE
            if not problem.sigma:  # the violation is least, but for rounding
                return self.conclude(problem) or "constraints are hard again"
        point = problem.point
        if problem.elastic is None:
            problem.make_elastic(residual, self._price)
            return "constraints become elastic"
        near = point.max_violation <= max(_HARD_VIOLATION, _HARD_FRACTION * self._initial_violation)
        if problem.sigma or near:
            end = self.change_aim(problem, met=near)
            if end is not None:
                return end
            return "constraints are hard again" if problem.elastic is None else "violation alone"
        # That steps stall proves nothing: the violation has to be stationary.
        if is_stationary_violation(problem.program, point.x, point.g, point.jacobian):
            return self._least_violation(problem)
        return Status.FAILED

    def _least_violation(self, problem: BarrierProblem) -> Status:
        """Status at a point of least violation: not infeasible if all constraints are met there."""
        met = problem.point.max_violation <= self._options.violation_tolerance
        return Status.FAILED if met else Status.INFEASIBLE


MAX_MULTIPLIER = 1e12  # larger ones mean that none exist at the iterate
# From the best iterate, after a failure: with them a strike of the seven-joint arm is solved from all of 20
# initial guesses.
_MAX_RESTARTS = 2
# Of the violation at a point of least violation, that of an iterate which shows that it is not the least. For
# arms that hit 3.6 and 3.8 kg it is 0.03, and at least 1 for problems that are infeasible.
_NEARER = 0.1
# Of the Hessian, tried in turn where the search along a step finds no point, before constraints become
# elastic. For one of five targets of `push_two_hands` that differ by 1e-10 m the search fails by rounding: 78
# iterations without these shifts, 49 with them, 46 for the others.
_SHIFTS = (1e-4, 1e-2, 1.0)


def solve_ipm(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: IPMOptions | None = None,
    callback: Callback | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
    watch: Watch | None = None,
    state: BarrierState | None = None,
) -> SolverResult:
    """Solve a nonlinear program by the interior-point method.

    Parameters
    ----------
    program : the program; its constraints and variables should be of order one.
    x0 : initial guess (n,); moved into the variables' bounds, where every iterate stays, but for variables
        that equalities determine: their bounds are constraints.
    options : see `IPMOptions`.
    callback : progress, once an iteration; True or KeyboardInterrupt stops with the best iterate.
    multipliers, bound_multipliers : initial guess of the multipliers (m,), (n,), from a similar program.
    watch : may end the solve at an iterate, with the status `ACCEPTABLE`, because the program lacks
        constraints there; may limit the length of steps.
    state : the state in which an earlier solve ended at x0 with these multipliers; this one continues it.

    Returns
    -------
    The result; infeasible programs, interruption (Ctrl-C) and limits are statuses, not exceptions.

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds.
    """
    given = program, x0, options or IPMOptions(), callback, multipliers, bound_multipliers
    return InteriorRun(*given, watch=watch, state=state).solve()


class InteriorRun(Run[IPMOptions]):
    """One solve: the loop over `BarrierProblem`, `LineSearch`, `ElasticPhase`."""

    def __init__(self, *given: Any, watch: Watch | None, state: BarrierState | None):
        super().__init__(*given)
        self._watch, self._state = watch, state
        self._search, self._phase = LineSearch(watch), ElasticPhase(self.options)

    def iterate(self) -> Status:
        self.point = self.program.point(self.point.x)
        if not self.point.differentiable:
            return Status.FAILED
        if self._initial_guess_is_solution():
            self.report.iteration(self.point, self._kkt, "initial guess")
            return Status.SOLVED
        remark, restarts = "initial guess", 0
        while True:
            self._begin()
            try:
                status = self._iterate(remark)
            finally:
                self._problem.release()
            if status is Status.INFEASIBLE and self._was_nearer():
                status = Status.FAILED
            # An infeasible program, a limit or an interruption is an outcome; only a
            # failure is worth another attempt.
            if status is not Status.FAILED or restarts == _MAX_RESTARTS or not self._back_to_best():
                return status
            remark, restarts = "again from the best iterate", restarts + 1

    @property
    def _warm(self) -> bool:
        """True if multipliers were given."""
        return bool(np.any(self.y) or np.any(self.z))

    def _initial_guess_is_solution(self) -> bool:
        """True if the initial guess with the given multipliers meets all tolerances."""
        options, point = self.options, self.point
        self._kkt = stationarity(point.gradient, point.jacobian, self.y, self.z)
        return (
            self._warm
            and self._kkt <= options.kkt_tolerance
            and point.max_violation <= options.violation_tolerance
            and complementarity(self.program, point.x, point.g, self.y, self.z)
            <= options.complementarity_tolerance
        )

    def _begin(self) -> None:
        """Make the barrier problem at the present point and multipliers, with hard constraints."""
        self._problem = BarrierProblem(
            self.program,
            self.options,
            self.point,
            self.y,
            self.z,
            warm=self._warm,
            state=self._state,
            determined=self.determined,
        )
        # The barrier problem may have moved the point; the state is of the first attempt's point only.
        self.point, self._state = self._problem.point, None
        self._phase.begin()
        self._search.reset_filter()

    def _was_nearer(self) -> bool:
        """True if the best iterate has far less violation: that of the present point is not the least."""
        if self.report.best.x is None:
            return False
        # The sum is what was minimized. Where it is least, one constraint may well be violated more.
        best, present = (
            point.violation + float(bound_violations(self.program, point.x).sum())
            for point in (self.program.point(self.report.best.x), self.point)
        )
        return best < _NEARER * present

    def _back_to_best(self) -> bool:
        """Move to the best iterate, without multipliers, as these may have led to the failure.

        False if the present point is the best.
        """
        x = self.report.best.x
        if x is None or np.array_equal(x, self.point.x):
            return False
        self.point = self.program.point(x)
        self.y, self.z = np.zeros_like(self.y), np.zeros_like(self.z)
        return self.point.differentiable

    def _iterate(self, remark: str) -> Status:
        problem, phase = self._problem, self._phase
        while self.report.iterations <= self.options.max_iterations:
            residual = problem.residual(self.point, problem.s.values)
            problem.update_multipliers()
            # Kept at each iterate, so that an interrupted solve returns its multipliers, too.
            self.y, self.z = problem.constraint_multipliers, problem.bound_multipliers
            error = problem.error(0.0, residual)
            if self.report.iteration(self.point, problem.kkt, remark):
                return Status.INTERRUPTED
            # Before the test of convergence: a solution without these constraints is none.
            if self._lacks_constraints():
                return Status.ACCEPTABLE
            solved = error <= self.options.kkt_tolerance or phase.is_restored(problem)
            if solved or phase.is_met_for_long(problem):
                status = phase.conclude(problem) if solved else phase.change_aim(problem, met=True)
                if status is not None:
                    return status
                # The same point is recorded once more, under its new aim.
                self._search.reset_filter()
                continue
            if self._out_of_time():
                return Status.TIME_LIMIT
            # phi depends on mu, so pairs of another mu mean nothing (step A-3).
            if problem.lower_barrier(residual):
                self._search.reset_filter()
            outcome = self._advance(residual)
            if isinstance(outcome, Status):
                return outcome
            remark = outcome
        return Status.ITERATION_LIMIT

    def _lacks_constraints(self) -> bool:
        """True if the watch finds that the program lacks constraints at the iterate.

        While constraints are elastic, it is asked only if it held the last step back: the iterates would
        otherwise crawl towards a constraint that they do not know of.
        """
        if self._watch is None or (self._problem.elastic is not None and not self._search.held_back):
            return False
        if not self._watch.lacks(self.point.x):
            return False
        self._watch.leave(self._problem.state())
        return True

    def _advance(self, residual: Vector) -> str | Status:
        """Move to the next iterate: a remark for the history, or the status that ends the solve."""
        problem, step = self._problem, self._step(residual)
        if step is None:
            return self._leave_stall(residual)
        accepted = self._search.find(problem, step, residual)
        if accepted is None and problem.elastic is None:
            accepted = self._shifted(residual)
        if accepted is None:
            return self._leave_stall(residual)
        return self._move(accepted)

    def _step(self, residual: Vector, least_shift: float = 0.0) -> Step | None:
        """Newton step; None if there is none, or its multipliers are too large."""
        begin = self.report.elapsed()
        step = self._problem.step(residual, least_shift)
        self.report.seconds_qp += self.report.elapsed() - begin
        # Multipliers grow without bound where active gradients become dependent; the
        # price bounds elastic ones.
        return None if step is None or np.abs(step.y).max(initial=0.0) > MAX_MULTIPLIER else step

    def _shifted(self, residual: Vector) -> AcceptedStep | None:
        """Step with a larger shift of the Hessian; None if all of them lead to short steps or none."""
        for shift in _SHIFTS:
            step = self._step(residual, shift)
            if step is None:
                break
            accepted = self._search.find(self._problem, step, residual)
            if accepted is not None and accepted.length >= _SHORT_STEP:
                return accepted
        return None

    def _move(self, accepted: AcceptedStep, *more: str) -> str:
        """Move to an accepted point; a remark for the history."""
        problem = self._problem
        problem.move(accepted.step, accepted.trial, accepted.length)
        self.point = problem.point
        remarks = [f"barrier {problem.mu:.0e}, step {accepted.length:.2g}", *more, *accepted.remarks]
        if problem.newton.shift:
            remarks.append(f"shift {problem.newton.shift:.0e}")
        if problem.elastic is not None:
            remarks.append(f"constraints elastic at {problem.elastic.price:g}")
        return ", ".join(remarks)

    def _leave_stall(self, residual: Vector) -> str | Status:
        self._search.reset_filter()
        return self._phase.leave_stall(self._problem, residual)
