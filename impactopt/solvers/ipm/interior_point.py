"""Interior-point method: each quadratic model is taken one Newton step towards its solution.

The QPs of a whole motion have thousands of rows; solving each of them exactly costs more than the functions.
So the barrier of the rows is kept from one QP to the next, and every QP gets one Newton step: the primal-dual
interior-point method of Waechter and Biegler (Mathematical Programming 106, 2006), with its filter line
search (sections 2.3 and 2.4), second-order correction and inertia control. What is ours is that steps are
bent at slacks, and the Newton system (`newton`): rows that determine variables of their own are eliminated
first (`condense`), and what is left gets a Cholesky factor.

Where no step is progress any more the rows become elastic: they may be violated at a price (Nocedal and
Wright 2006, section 18.5). Where rows are met again they are hard again, at a higher price the next time;
where the price does not bring that about the objective is left out, until the violation is gone or least. So
an infeasible program ends at a point of least violation.

A `BarrierProblem` is what the loop moves, `LineSearch` says how far along a step, and `ElasticPhase` what is
aimed at where that finds nothing.
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
    complementarity,
    is_stationary_violation,
    stationarity,
)
from impactopt.solvers.run import Path, Run, Watch

_CORRECTIONS = 4  # second-order corrections a step, at most
_WORSE = 0.99  # a correction that leaves more than this part of the violation ends them
# a step is bent where it gets so many times as far, a slack giving so much of its distance to a bound, and
# where no row is off, or will be, by more than this
_LONGER, _SHORT, _BENT = 1.2, 0.9, 1.0
_CRAWL, _PATIENCE = 1e-2, 20  # so many steps shorter than this, one after the other, are no progress either
_HELD = 0.2  # a step of which who watches lets less than this part be taken is held back


class Found(NamedTuple):
    """A step that is progress, the point that a part of it leads to, and what to note about it."""

    step: Step
    trial: Trial
    length: float
    note: list[str]


class LineSearch:
    """The filter, and how long steps have been short.

    Attributes
    ----------
    held : whether who watches has held the last step back.
    """

    def __init__(self, watch: Watch | None = None) -> None:
        """watch : who says how far a step may go."""
        self._watch = watch
        self._filter: Filter | None = None
        self._crawled = 0  # iterations of short steps
        self.held = False

    def forget(self) -> None:
        """Forget what has been, as the problem is another from here on: its barrier, objective or rows."""
        self._filter = None

    def find(self, problem: BarrierProblem, step: Step, residual: Vector) -> Found | None:
        """The part of a step that is progress; None where there is none, or has hardly been any for long."""
        longest = problem.longest(step)
        most = self._most(problem, step, longest)
        self.held = most < _HELD * longest
        longest = min(longest, most)
        at = problem.progress(step, residual)
        if self._filter is None:
            self._filter = Filter.around(at.theta)
        among = self._filter
        found = _bent(problem, among, step, at, longest, most) or _searched(
            problem, among, step, at, longest, residual
        )
        crawls = found is None or found.length < _CRAWL
        self._crawled = self._crawled + 1 if crawls else 0
        if found is None or self._crawled > _PATIENCE:
            self._crawled = 0
            return None
        among.remember(at, found.length, found.trial.phi)
        return found

    def _most(self, problem: BarrierProblem, step: Step, longest: float) -> float:
        """The part of a step that who watches lets it take, bent or not."""
        most = max(longest, problem.x.longest(step.free, problem.keep))
        return most if self._watch is None else self._watch.limit(problem.point.x, step.d, most)


def _bent(
    problem: BarrierProblem, among: Filter, step: Step, at: SearchStart, longest: float, most: float
) -> Found | None:
    """The step as far as the bounds of variables let it, where it is slacks that stop it: each of them
    stops by itself short of its own bound, and what its row is then off by is the next step's to mend.

    Else one slack of thousands stops all others. Only while no row is far off: it is worth nothing where
    rows are not about as linear as the step takes them to be.
    """
    if problem.elastic is not None or problem.point.max_violation > _BENT:
        return None
    length = min(most, problem.x.longest(step.free, problem.keep))
    if length <= _LONGER * longest:
        return None
    slack = problem.s.short_of_bounds(problem.s.values + length * step.slack, _SHORT)
    trial = problem.trial(step, length, slack)
    fine = trial.point.finite and trial.point.max_violation <= _BENT
    if not fine or not _accepts(among, at, length, trial):
        return None
    return Found(step, trial, length, ["bent"])


def _searched(
    problem: BarrierProblem, among: Filter, step: Step, at: SearchStart, longest: float, residual: Vector
) -> Found | None:
    """Along the step, backwards from its longest part; None: no part of it is progress."""
    length, trials = longest, 0
    while True:
        trials += 1
        trial = problem.trial(step, length)
        if _accepts(among, at, length, trial):
            return Found(step, trial, length, [])
        # only a first trial with more violation is corrected (step ): a shorter one is nearly linear
        if trials == 1 and trial.theta >= at.theta and problem.options.second_order_correction:
            found = _corrected(problem, among, at, residual, trial, longest)
            if found is not None:
                return found
        length *= 0.5
        if length < among.shortest(at):
            return None


def _corrected(
    problem: BarrierProblem, among: Filter, at: SearchStart, residual: Vector, trial: Trial, longest: float
) -> Found | None:
    """Second-order corrections: the step again, with what it left of the rows (section 2.4)."""
    if problem.elastic is not None:
        return None
    left, theta = residual, trial.theta
    for k in range(_CORRECTIONS):
        if not trial.point.finite:
            break
        # c_soc = alpha c(x) + c(x + alpha d): the same matrix, another right-hand side (section 2.4)
        left = longest * left + problem.residual(trial.point, trial.slack)
        step = problem.step_again(left)
        trial = problem.trial(step, problem.longest(step))
        if _accepts(among, at, longest, trial):
            return Found(step, trial, longest, [f"{k + 1} corrections"])
        if trial.theta > _WORSE * theta:
            break
        theta = trial.theta
    return None


def _accepts(among: Filter, at: SearchStart, length: float, trial: Trial) -> bool:
    return among.accepts(at, length, trial.theta, trial.phi) and trial.point.differentiable


# violation from which on elastic rows are made hard again where they do not get further, or this part of what
# it was when nothing else began to count
_NEAR, _LESS = 1e-2, 1e-2
_RESTORED = 1e-3  # violation from which on they are where nothing else counted
_CHANGES = 12  # of what is aimed at, at most
_AGAIN = 1e-4  # the least barrier after such a change
_LINGERS = 20  # so many iterations with elastic rows that are met are enough


class ElasticPhase:
    """Aim of the method, and how long it lasts.

    Where one of its methods changes that, a line search has to forget what it knows.
    """

    def __init__(self, options: IPMOptions):
        self._options = options
        self._price = options.price  # of elastic rows
        self._met = 0  # iterations of elastic rows that are met
        self._began = 0.0  # violation where only that began to count
        self._changes = 0

    def begin(self) -> None:
        """Begin an attempt from a point of its own: the price stays what it has come to."""
        self._changes = 0

    def verdict(self, problem: BarrierProblem) -> Status | None:
        """Decide at a solution, or where rows are restored: the end, unless rows are violated, or only the
        violation counted.
        """
        elastic = problem.elastic
        met = elastic is None or elastic.largest() <= self._options.violation_tolerance
        if met and problem.sigma:
            return Status.SOLVED
        near = _NEAR if problem.sigma else _RESTORED  # the price may only have been too low
        return self.change_aim(problem, met=met or problem.point.max_violation <= near)

    def restored(self, problem: BarrierProblem) -> bool:
        """True if the violation, which alone counts, is so small that hard rows get further with it."""
        elastic = problem.elastic
        if elastic is None or problem.sigma or elastic.price >= self._options.price_max:
            return False
        return problem.point.max_violation <= _RESTORED

    def lingers(self, problem: BarrierProblem) -> bool:
        """True if elastic rows have been met for long, and the rest is left to do: hard rows do it sooner."""
        met = problem.elastic is not None and problem.point.max_violation <= self._options.violation_tolerance
        self._met = self._met + 1 if met and problem.sigma else 0
        return self._met > _LINGERS and self._price < self._options.price_max

    def change_aim(self, problem: BarrierProblem, *, met: bool) -> Status | None:
        """Go on where elastic rows stall: let only the violation count, until it is gone or least."""
        assert problem.elastic is not None
        self._changes += 1
        if self._changes > _CHANGES:
            return Status.FAILED
        price = problem.elastic.price
        if met and price < self._options.price_max:
            problem.elastic, problem.sigma = None, 1.0  # from where rows are met, as if nothing had been
            self._price = min(10.0 * price, self._options.price_max)
        elif problem.sigma:
            problem.sigma, self._began = 0.0, problem.point.max_violation
        else:
            return self._least(problem)
        problem.mu = max(problem.mu, _AGAIN)
        return None

    def give_way(self, problem: BarrierProblem, residual: Vector) -> str | Status:
        """Next aim where no step is progress: let rows be violated at a price, or end.

        Text: what has been changed.
        """
        if problem.error(0.0, residual) <= self._options.acceptable_tolerance:
            if problem.elastic is None:
                return Status.ACCEPTABLE
            if not problem.sigma:  # the violation is least, but for rounding
                return self.verdict(problem) or "rows are hard again"
        point = problem.point
        if problem.elastic is None:
            problem.soften(residual, self._price)
            return "rows become elastic"
        near = point.max_violation <= max(_NEAR, _LESS * self._began)
        if problem.sigma or near:
            end = self.change_aim(problem, met=near)
            if end is not None:
                return end
            return "rows are hard again" if problem.elastic is None else "only the violation counts"
        if is_stationary_violation(problem.program, point.x, point.g, point.jacobian):
            return self._least(problem)
        return Status.FAILED

    def _least(self, problem: BarrierProblem) -> Status:
        """The end where the violation is least: a program whose rows are met there is not infeasible."""
        met = problem.point.max_violation <= self._options.violation_tolerance
        return Status.FAILED if met else Status.INFEASIBLE


_ABSURD = 1e12  # multipliers beyond this come from rows that have none
_RESTARTS = 2  # where nothing is progress any more


def solve_ipm(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: IPMOptions | None = None,
    callback: Callback | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
    watch: Watch | None = None,
    path: Path | None = None,
) -> SolverResult:
    """Solve a nonlinear program by the interior-point method.

    Parameters
    ----------
    program : the program; its constraints and variables should be of order one.
    x0 : initial guess (n,); moved into the variables' bounds, where every iterate stays.
    options : see `IPMOptions`.
    callback : progress, once an iteration; True or KeyboardInterrupt stops with the best iterate.
    multipliers, bound_multipliers : guess of the multipliers (m,), (n,), from a similar program.
    watch : asked at every iterate whether the program lacks constraints there, which ends the solve with the
        status `ACCEPTABLE`, and before every step how far it may go.
    path : where a solve was left that x0 and the multipliers are of: it goes on as that would have.

    Returns
    -------
    The result; infeasible programs, interruption (Ctrl-C) and limits are statuses, not exceptions.

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds.
    """
    given = program, x0, options or IPMOptions(), callback, multipliers, bound_multipliers
    return InteriorRun(*given, watch=watch, path=path).solve()


class InteriorRun(Run[IPMOptions]):
    """One solve: the loop over `BarrierProblem`, `LineSearch`, `ElasticPhase`."""

    def __init__(self, *given: Any, watch: Watch | None, path: Path | None):
        super().__init__(*given)
        self._watch, self._path = watch, path
        self._search, self._phase = LineSearch(watch), ElasticPhase(self.options)

    def iterate(self) -> Status:
        self.point = self.program.point(self.point.x)
        if not self.point.differentiable:
            return Status.FAILED
        if self._start_is_solution():
            self.report.iteration(self.point, self._kkt, "start")
            return Status.SOLVED
        note, restarts = "start", 0
        while True:
            self._begin()
            try:
                status = self._iterate(note)
            finally:
                self._problem.release()
            if status is not Status.FAILED or restarts == _RESTARTS or not self._back_to_best():
                return status
            note, restarts = "again from the best iterate", restarts + 1

    @property
    def _warm(self) -> bool:
        """True if multipliers were given to start from."""
        return bool(np.any(self.y) or np.any(self.z))

    def _start_is_solution(self) -> bool:
        """True if the start with the multipliers given meets all tolerances."""
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
        """Aim at the objective, from the point and the multipliers that there are."""
        self._problem = BarrierProblem(
            self.program,
            self.options,
            self.point,
            self.y,
            self.z,
            warm=self._warm,
            path=self._path,
            determined=self.determined,
        )
        self.point, self._path = self._problem.point, None
        self._phase.begin()
        self._search.forget()

    def _back_to_best(self) -> bool:
        """True if there is another point to begin at anew: the best so far, with multipliers and a barrier
        of its own, as what failed may be the way there.
        """
        x = self.report.best.x
        if x is None or np.array_equal(x, self.point.x):
            return False
        self.point = self.program.point(x)
        self.y, self.z = np.zeros_like(self.y), np.zeros_like(self.z)
        return self.point.differentiable

    def _iterate(self, note: str) -> Status:
        problem, phase = self._problem, self._phase
        while self.report.iterations <= self.options.max_iterations:
            residual = problem.residual(self.point, problem.s.values)
            problem.take_multipliers()
            self.y, self.z = problem.row_multipliers, problem.bound_multipliers
            error = problem.error(0.0, residual)
            if self.report.iteration(self.point, problem.kkt, note):
                return Status.INTERRUPTED
            if self._lacks():
                return Status.ACCEPTABLE
            if error <= self.options.kkt_tolerance or phase.restored(problem):
                verdict = phase.verdict(problem)
                if verdict is not None:
                    return verdict
                self._search.forget()
                continue
            if phase.lingers(problem):
                phase.change_aim(problem, met=True)
                self._search.forget()
                continue
            if self._out_of_time():
                return Status.TIME_LIMIT
            if problem.lower_barrier(residual):
                self._search.forget()
            found = self._advance(residual)
            if isinstance(found, Status):
                return found
            note = found
        return Status.ITERATION_LIMIT

    def _lacks(self) -> bool:
        """True if the program lacks constraints at the iterate.

        While rows are elastic only those count that hold steps back.
        """
        if self._watch is None or (self._problem.elastic is not None and not self._search.held):
            return False
        if not self._watch.lacks(self.point.x):
            return False
        self._watch.leave(self._problem.path())
        return True

    def _advance(self, residual: Vector) -> str | Status:
        """Move to the next point; what to note about it, or why there is none."""
        problem, begin = self._problem, self.report.elapsed()
        step = problem.step(residual)
        self.report.seconds_qp += self.report.elapsed() - begin
        if step is None or np.abs(step.y).max(initial=0.0) > _ABSURD:
            return self._give_way(residual)
        found = self._search.find(problem, step, residual)
        if found is None:
            return self._give_way(residual)
        problem.move(found.step, found.trial, found.length)
        self.point = problem.point
        words = [f"barrier {problem.mu:.0e}, step {found.length:.2g}", *found.note]
        if problem.newton.shift:
            words.append(f"shift {problem.newton.shift:.0e}")
        if problem.elastic is not None:
            words.append(f"rows elastic at {problem.elastic.price:g}")
        return ", ".join(words)

    def _give_way(self, residual: Vector) -> str | Status:
        self._search.forget()
        return self._phase.give_way(self._problem, residual)
