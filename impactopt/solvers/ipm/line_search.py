"""The line search of the interior-point method: which part of a step is progress, by the filter.

Source: Waechter and Biegler 2006, sections 2.3 and 2.4. Bending a step at its slacks is ours.
"""

from __future__ import annotations

from typing import NamedTuple

from impactopt.solvers.ipm.barrier_problem import BarrierProblem, Step, Trial
from impactopt.solvers.ipm.filter import Filter, SearchStart
from impactopt.solvers.program import Vector
from impactopt.solvers.run import Watch

_CORRECTIONS = 4  # second-order corrections a step, at most
_WORSE = 0.99  # a correction that leaves more than this part of the violation ends them
# a step is bent where it gets so many times as far, a slack giving so much of its distance to a bound, and
# where no row is off, or will be, by more than this
_LONGER, _SHORT, _BENT = 1.2, 0.9, 1.0
_CRAWL, _PATIENCE = 1e-2, 20  # so many steps shorter than this, one after the other, are no progress either


class Found(NamedTuple):
    """A step that is progress, the point that a part of it leads to, and what to note about it."""

    step: Step
    trial: Trial
    length: float
    note: list[str]


class LineSearch:
    """The filter, and how long steps have been short."""

    def __init__(self, watch: Watch | None = None) -> None:
        """watch : who says how far a step may go."""
        self._watch = watch
        self._filter: Filter | None = None
        self._crawled = 0  # iterations of short steps

    def forget(self) -> None:
        """Forget what has been, as the problem is another from here on: its barrier, objective or rows."""
        self._filter = None

    def find(self, problem: BarrierProblem, step: Step, residual: Vector) -> Found | None:
        """The part of a step that is progress; None where there is none, or has hardly been any for long."""
        longest = problem.longest(step)
        most = self._most(problem, step, longest)
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
