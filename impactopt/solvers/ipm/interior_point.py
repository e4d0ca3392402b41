"""Interior-point method: each quadratic model is taken one Newton step towards its solution.

The QPs of a whole motion have thousands of rows; solving each of them exactly costs more than the functions.
So the barrier of the rows is kept from one QP to the next, and every QP gets one Newton step: the primal-dual
interior-point method of Waechter and Biegler (Mathematical Programming 106, 2006), with its filter line
search, second-order correction and inertia control. What is ours is the Newton system (`newton`): rows that
determine variables of their own are eliminated first (`condense`), and what is left gets a Cholesky factor.

Where no step is progress any more the rows become elastic: they may be violated at a price (Nocedal and
Wright 2006, section 18.5), so that an infeasible program ends at a point of least violation.

The loop is here. What it moves is a `BarrierProblem`, how far along a step a `LineSearch` says, and what is
aimed at where that finds nothing an `ElasticPhase`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from impactopt.solvers.ipm.barrier_problem import BarrierProblem
from impactopt.solvers.ipm.elastic_phase import ElasticPhase
from impactopt.solvers.ipm.line_search import LineSearch
from impactopt.solvers.options import IPMOptions
from impactopt.solvers.program import (
    Callback,
    NonlinearProgram,
    SolverResult,
    Status,
    Vector,
    complementarity,
    stationarity,
)
from impactopt.solvers.run import Path, Run, Watch

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
        """True if the program lacks constraints at the iterate."""
        if self._watch is None or self._problem.elastic is not None:
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
