"""Sequential quadratic programming in few variables: reduced QPs, solved to their end, and a filter.

What rows determine is eliminated from every QP (`reduced_qp`), the rows that a QP needs are added to it when
they are missed, and what cannot be met is elastic. Its step is shortened until a filter takes it (Waechter
and Biegler 2006, section 2.3, with a QP's step in the place of a barrier problem's); where none is taken, and
rows are violated, only these count for a while.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from impactopt.solvers.options import SQPOptions
from impactopt.solvers.program import (
    Callback,
    NonlinearProgram,
    Point,
    SolverResult,
    Status,
    Vector,
    complementarity,
    row_violations,
    stationarity,
)
from impactopt.solvers.qp.registry import make_qp_solver
from impactopt.solvers.run import Run
from impactopt.solvers.sqp.reduced_qp import ReducedModel, ReducedQP, Reduction, Solved, make_model

_HALVINGS = 12  # of a step
_ARMIJO = 1e-4
_NEAR = 1e-2  # violation below which the objective may lead
_SHORTER, _LEAST = 0.2, 1e-4  # of the radius after a refused step; its least
_REACHED = 2.0  # times the step that was taken, after a shortened one: the radius
_FORESEEN = 0.7  # of the relief that a QP promises: the radius may grow
_MET, _AGAIN = 0.1, 0.2  # of a violation when the objective counts again; of a radius
_ROUNDING = 1e-11
# radius of the QPs over the option's, and whether steps towards the equalities are shortened to it: local
# solutions of the violation alone differ, so where one way ends in such a point the next is tried
_ATTEMPTS = (0.15, False), (0.5, False), (0.15, True), (0.5, True)
_CLOSE = 0.1  # violation of a start from which there is one way only
# most violation of a point: times that of the start, and at least; near a start with multipliers, which is a
# solution but for new rows, first: beyond them the objective leads where nothing leads back
_MOST, _MOST_WARM = (1.5, 1.0), (3.0, 0.05)
_PATIENCE = 40  # iterations without less violation, or a better objective
_STATIONARY = 1e-3  # slope of the violation over the largest that there could be: no step lessens it
_LESS, _BETTER = 0.97, 1e-3  # of a violation, of an objective
_GAIN = 0.1  # less of the objective for each unit of violation of a point that the filter takes
_BACK = 3  # steps back to the equalities, of a trial point
_DEARER = 3  # iterations after which rows that stay elastic cost twice as much


class Pair(NamedTuple):
    """A violation and an objective that points have to beat in one of the two."""

    violation: float
    objective: float


@dataclass(frozen=True)
class Taken:
    """A point that the search took: after which part of the step; whether for the objective's sake; whether
    the violation fell as the QP foresaw."""

    point: Point
    length: float
    for_objective: bool
    solved: Solved
    label: str
    foreseen: bool = False


def solve_sqp(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: SQPOptions | None = None,
    callback: Callback | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
) -> SolverResult:
    """Solve a nonlinear program by SQP, whose QPs are solved to their end.

    Parameters, result and errors are those of :func:`impactopt.solvers.ipm.solve_ipm`.
    options : see `SQPOptions`.
    """
    given = program, x0, options or SQPOptions(), callback, multipliers, bound_multipliers
    return ReducedRun(*given).solve()


class ReducedRun(Run[SQPOptions]):
    """One solve. Between iterations: the point, its multipliers, the filter, the radius of the QPs."""

    def __init__(self, *given: Any):
        super().__init__(*given)
        self._filter = list[Pair]()
        self._radius = self._widest = self.options.radius
        self._price, self._raised = self.options.price, 0
        self._patient = self._creeps = self._proved = False
        self._start: float | None = None  # of a phase in which only the violation counts: where it began

    def iterate(self) -> Status:
        """Run from the initial guess, in one way after the other until one of them leads to a solution."""
        self.point = self.program.point(self.point.x)
        if not self.point.differentiable:
            return Status.FAILED
        start, y, z = self.point, self.y.copy(), self.z.copy()
        dense = self.options.hessian == "bfgs"
        self._reduction = Reduction(self.program, start.jacobian, self.determined, dense=dense)
        self._model = make_model(self.program, self.options, self._reduction)
        self._qp = ReducedQP(self.program, self._reduction, make_qp_solver(self.options.qp_solver))
        try:
            return self._attempts(start, y, z) if self._weighed(start, y) else Status.FAILED
        finally:
            self._reduction.release()

    def _weighed(self, start: Point, y: Vector) -> bool:
        """Weigh the rows at the start; False: they do not determine their variables there."""
        try:
            self._reduction.load(start)
        except np.linalg.LinAlgError:
            return False
        self._qp.weigh(start, y, self.options.price)
        return True

    def _attempts(self, start: Point, y: Vector, z: Vector) -> Status:
        status = Status.INFEASIBLE
        far, warm = start.violation > _CLOSE, bool(np.any(y) or np.any(z))
        ways = [(*way, _MOST) for way in (_ATTEMPTS if far else _ATTEMPTS[:1])]
        for wide, careful, (times, least) in [(*_ATTEMPTS[0], _MOST_WARM), *ways] if warm else ways:
            self._most = max(times * start.violation, least)
            self.point, self.y, self.z, self._filter = start, y.copy(), z.copy(), []
            self._qp.start_from(y, z)
            self._patient = (wide, careful) == _ATTEMPTS[-1]  # the last way may creep
            self._qp.careful, self._widest = careful, wide * self.options.radius
            self._price, self._raised = self.options.price, self.report.iterations
            self._begin_anew()
            status = self._iterate()
            if status not in (Status.INFEASIBLE, Status.FAILED):
                break
        return status

    def _iterate(self) -> Status:
        note, least, best, since = "start", np.inf, np.inf, self.report.iterations
        while True:
            try:
                self._reduction.load(self.point)
            except np.linalg.LinAlgError:
                return Status.FAILED
            self._complete(self.point.gradient)
            stop = self.report.iteration(self.point, self._kkt(), note)
            if self._optimal(self.options.kkt_tolerance):
                return Status.SOLVED
            if stop:
                return Status.INTERRUPTED
            if self.report.iterations > self.options.max_iterations:
                return Status.ITERATION_LIMIT
            f, h = self.point.objective, self.point.violation
            lower = self._start is None and f < best - _BETTER * (1.0 + abs(best))
            if h < _LESS * least or lower or not self._excess():
                best = f if h < _LESS * least else min(best, f)
                least, since = min(least, h), self.report.iterations
            elif self.report.iterations > since + _PATIENCE and not self._patient:
                if self._give_way() is not None:
                    return Status.FAILED
                least, best, since = np.inf, np.inf, self.report.iterations
            self._creeps = self.report.iterations > since + _PATIENCE
            found = self._advance(self.report.iterations)
            if isinstance(found, Status):
                return found
            note = found

    # ------------------------------------------------------------------ one iteration
    def _advance(self, k: int) -> str | Status:
        """Go to the next point; or why there is none."""
        while True:
            if self._out_of_time():
                return Status.TIME_LIMIT
            held = partial(self._qp.active, self.point)
            model = self._model.at(self.point, self.y, held, self._start is None)
            solved = self._solve(model, self.point.g)
            self._proved = solved is not None
            if solved is not None and self._creeps and self._is_stationary(solved):
                return Status.INFEASIBLE
            if solved is None:
                self._radius *= _SHORTER
            else:
                self._take_multipliers(solved)
                if self._optimal(self.options.kkt_tolerance):
                    return Status.SOLVED
                self._settle_price(k, solved)
                taken = self._search(model, solved)
                if taken is not None:
                    return self._move(taken)
                self._radius *= _SHORTER
            if self._radius < _LEAST * self.options.radius:
                end = self._give_way()
                if end is not None:
                    return end

    def _solve(self, model: ReducedModel, g: Vector) -> Solved | None:
        begin, limit = self.report.elapsed(), self.options.time_limit
        left = None if limit is None else limit - begin
        try:
            return self._qp.solve(
                self.point, model, g, radius=self._radius, price=self._price, time_limit=left
            )
        finally:
            self.report.seconds_qp += self.report.elapsed() - begin

    def _search(self, model: ReducedModel, solved: Solved) -> Taken | None:
        """Shorten the step until it is taken; a full one is corrected for the rows' curvature first."""
        length = 1.0
        for attempt in range(_HALVINGS):  # then the radius shrinks
            trial = self._back(self.program.point(self._inside(self.point.x + length * solved.d)))
            verdict = self._judge(trial, length, solved)
            if verdict is not None:
                relief = self.point.violation - trial.violation
                hoped = self.point.violation - solved.linear_violation
                return Taken(trial, length, verdict, solved, "", relief > _FORESEEN * hoped)
            if attempt == 0 and trial.finite and self.options.second_order_correction:
                bent = trial.g - self.point.jacobian @ (trial.x - self.point.x)
                again = self._solve(model, bent)
                if again is not None:
                    other = self._back(self.program.point(self._inside(self.point.x + again.d)))
                    verdict = self._judge(other, 1.0, solved)
                    if verdict is not None:
                        return Taken(other, 1.0, verdict, again, ", corrected")
            length *= 0.5
        return None

    def _back(self, trial: Point) -> Point:
        """The trial point after steps back to the equalities, with the slopes of the point, while they help:
        what rows determine is followed on its curve, and not along its tangent.
        """
        for _ in range(_BACK):
            if not trial.finite or trial.violation < _ROUNDING:
                break
            other = self.program.point(self._inside(trial.x + self._reduction.normal(trial.g)))
            if not other.violation < trial.violation:
                break
            enough, trial = other.violation > 0.5 * trial.violation, other
            if enough:
                break
        return trial

    def _judge(self, trial: Point, length: float, solved: Solved) -> bool | None:
        """True if a point is taken for the objective's sake, False if for less violation; None: it is not."""
        verdict = self._verdict(trial, length, solved) if trial.finite else None
        return verdict if verdict is not None and trial.differentiable else None

    def _verdict(self, trial: Point, length: float, solved: Solved) -> bool | None:
        """The same of a point where rows are finite, whatever their slopes, which take longer."""
        h, f, before = trial.violation, trial.objective, self.point
        if self._start is not None:
            relief = before.violation - solved.linear_violation
            enough = relief > 1e-10 * before.violation and h <= before.violation - _ARMIJO * length * relief
            return False if enough else None
        # margins about the filter: iterates that creep along it would never have to become feasible
        if h > self._most or any(
            h > 0.999 * p.violation and f > p.objective - _GAIN * h for p in self._filter
        ):
            return None
        slope = float(before.gradient @ solved.d)
        noise = _ROUNDING * (1.0 + abs(before.objective))
        # The switching condition (Waechter and Biegler 2006, eq. 19) with a QP's slope: near the feasible
        # set a step has to lower the objective.
        leads = slope < 0 and before.violation < _NEAR and -length * slope > 1e-2 * before.violation**1.2
        if leads:
            return True if f <= before.objective + _ARMIJO * length * slope + noise else None
        # a QP trades the objective for violations at the price; what its steps bring is not to cost more
        worth = f <= before.objective + self._price * (before.violation - h)
        less = (worth and h <= (1 - 1e-5) * before.violation) or f <= before.objective - _GAIN * h
        met = h <= self.options.violation_tolerance and f <= before.objective + noise
        return False if less or met else None

    def _move(self, taken: Taken) -> str:
        """Move to a point that is taken."""
        h, before = taken.point.violation, self.point
        if not taken.for_objective and self._start is None:
            pair = Pair(before.violation, before.objective)
            kept = [p for p in self._filter if p.violation < pair.violation or p.objective < pair.objective]
            self._filter = [*kept, pair]
        self.point = taken.point
        if self._start is None:  # those of the equalities follow when its slopes are there
            self.y, self.z = taken.solved.y.copy(), taken.solved.z.copy()
        else:
            self.y, self.z = np.zeros_like(self.y), np.zeros_like(self.z)
            beats = all(
                h <= 0.999 * p.violation or taken.point.objective <= p.objective for p in self._filter
            )
            if h <= max(_MET * self._start, self.options.violation_tolerance) and beats:
                self._begin_anew()
            elif taken.point.max_violation <= self.options.violation_tolerance:
                self._filter = []
                self._begin_anew()
        self._trust(taken)
        rows = f"rows {taken.solved.rows} ({taken.solved.elastic} elastic)"
        words = f"step {taken.length:.2g}, {rows}, QP {taken.solved.iterations}{taken.label}"
        return words if self._start is None else f"{words}, violation only"

    def _trust(self, taken: Taken) -> None:
        """Longer steps where full ones are taken, beyond the widest where the rows are nearly met or do as
        foreseen; after a shortened step little more than what was taken.
        """
        if taken.length == 1.0:
            wide = self.point.violation < _NEAR if self._start is None else taken.foreseen
            widest = self.options.radius if wide else self._widest
            self._radius = min(2.0 * self._radius, max(widest, self._radius))
        else:
            taken_length = taken.length * taken.solved.longest
            self._radius = min(max(_REACHED * taken_length, 1e-3), self._radius)

    def _give_way(self) -> Status | None:
        """Give way where no step is taken: only the violation counts from now on; or it is the end."""
        if not self._excess():
            return Status.ACCEPTABLE if self._optimal(self.options.acceptable_tolerance) else Status.FAILED
        if self._start is not None:  # where QPs have failed nothing is proved
            return Status.INFEASIBLE if self._proved else Status.FAILED
        self._start = self.point.violation
        self._filter.append(Pair(self.point.violation, self.point.objective))
        self._radius, self._price = self._widest, self.options.price
        return None

    def _begin_anew(self) -> None:
        self._start = None
        self._model.forget()
        self._radius = self._widest

    # ------------------------------------------------------------------ multipliers
    def _take_multipliers(self, solved: Solved) -> None:
        self.y, self.z = solved.y.copy(), solved.z.copy()
        self._complete(self.point.gradient)

    def _complete(self, gradient: Vector) -> None:
        """Multipliers of the equalities from those of the other rows and of the bounds."""
        self.y[self._reduction.gone] = self.y[self._reduction.left] = 0.0
        dual = gradient + self.point.jacobian.T @ self.y + self.z
        self.y = self._reduction.add_multipliers(self.y, dual)

    def _settle_price(self, k: int, solved: Solved) -> None:
        """Rows that stay elastic, and cost all that they can, cost more: not where the radius is too small to
        meet them, as there they would at any price."""
        rows = self._reduction.rows
        largest = float(np.max(np.abs(solved.y[rows]) / self.program.weights[rows], initial=0.0))
        narrow = solved.longest > 0.99 * self._radius and self._radius < self.options.radius
        if self._excess() and not narrow and self._price < 1.5 * largest and k >= self._raised + _DEARER:
            self._price, self._raised = min(2.0 * self._price, self.options.price_max), k

    # ------------------------------------------------------------------ how good it is
    def _optimal(self, tolerance: float) -> bool:
        if self._excess() or self._start is not None or self._kkt() > tolerance:
            return False
        y = self.y.copy()
        y[self._reduction.gone] = y[self._reduction.left] = 0.0
        gap = complementarity(self.program, self.point.x, self.point.g, y, self.z)
        return gap <= tolerance * max(1.0, float(np.abs(self.y).mean()) if self.y.size else 0.0)

    def _kkt(self) -> float:
        return stationarity(self.point.gradient, self.point.jacobian, self.y, self.z)

    def _excess(self) -> bool:
        return self.point.max_violation > self.options.violation_tolerance

    def _is_stationary(self, solved: Solved) -> bool:
        """True if the violation, where only that counts, falls by next to nothing along a QP's step, beside
        the slopes of the rows that are violated."""
        if self._start is None:
            return False
        violated = row_violations(self.program, self.point.g) > self.options.violation_tolerance
        steepest = float((self.program.weights * self.point.row_norms)[violated].sum())
        return self.point.violation - solved.linear_violation <= _STATIONARY * solved.longest * steepest

    def _inside(self, x: Vector) -> Vector:
        return np.clip(x, self.program.x_lower, self.program.x_upper)
