"""Sequential quadratic programming in few variables: reduced QPs, solved exactly, and a filter line search.

Variables that constraints determine are eliminated from every QP (`reduced_qp`); further constraints are
added to a QP as its solution violates them, and constraints that it cannot meet are elastic. The step of a QP
is shortened until a filter accepts the point (Waechter and Biegler 2006, section 2.3, with a QP's step in
place of a barrier problem's).

If no step is accepted and constraints are violated, a restoration phase minimizes the violation alone. Local
minima of the violation differ with the step sizes, so the whole method is run in several attempts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from impactopt.solvers.options import SQPOptions, make_qp_solver
from impactopt.solvers.program import (
    Point,
    Status,
    Vector,
    complementarity,
    constraint_violations,
    stationarity,
)
from impactopt.solvers.run import Run
from impactopt.solvers.sqp.reduced_qp import QPStep, ReducedModel, ReducedQP, Reduction, make_model

# Attempts: radius of the QPs over the option's, and whether steps towards the equalities are shortened to it.
# Wide steps far from the constraints went astray, so the first radius is small.
_ATTEMPTS = (0.15, False), (0.5, False), (0.15, True), (0.5, True)
_FEASIBLE_GUESS = 0.1  # an initial guess with less violation gets the first attempt only
# Largest violation of an iterate: times that of the initial guess, and at least this. With multipliers the
# initial guess is a solution but for new constraints, so the first attempt stays closer: the objective may
# otherwise lead to violations that are not restored.
_MAX_VIOLATION, _MAX_VIOLATION_WARM = (1.5, 1.0), (3.0, 0.05)

_MAX_HALVINGS = 12  # of a step; then the radius shrinks
_RADIUS_SHRINK, _MIN_RADIUS = 0.2, 1e-4  # after a refused step; the least, relative to the option
_RADIUS_OVER_STEP = 2.0  # radius after a shortened step, over the step's length
_GOOD_REDUCTION = 0.7  # of the violation, relative to the QP's prediction: the radius may grow
_MAX_RETURNS = 3  # steps back to the equalities, of a trial point
_ROUNDING = 1e-11  # of violations, and of the objective, relative

# Acceptance of a trial point
_ARMIJO = 1e-4
_OBJECTIVE_VIOLATION = 1e-2  # below this violation a step may be for the objective
_OBJECTIVE_MARGIN = 0.1  # by how much the objective has to be less for each unit of a point's violation

_PATIENCE = 40  # iterations without progress
# Progress: violation over the least so far; decrease of the objective, relative.
_LESS_VIOLATION, _LESS_OBJECTIVE = 0.97, 1e-3
_RESTORED = 0.1  # fraction of the violation at which a restoration phase began, at which it ends
_STATIONARY = 1e-3  # relative slope of the violation below which no step reduces it
_PRICE_DELAY = 3  # iterations after which constraints that stay elastic get twice the price


class Pair(NamedTuple):
    """Violation and objective; a later point has to be better in one of the two."""

    violation: float
    objective: float


@dataclass(frozen=True)
class Accepted:
    """Point that the line search accepts, at a fraction of the QP's step.

    for_objective : whether it was accepted for less objective, not less violation.
    predicted : whether the violation fell about as the QP predicted.
    """

    point: Point
    length: float
    for_objective: bool
    qp_step: QPStep
    label: str
    predicted: bool = False


class ReducedRun(Run[SQPOptions]):
    """One solve. State between iterations: point, multipliers, filter, radius of the QPs, price."""

    def __init__(self, *given: Any):
        super().__init__(*given)
        self._filter = list[Pair]()
        self._radius = self._widest = self.options.radius
        self._price, self._price_iteration = self.options.price, 0
        self._unlimited_patience = self._stalls = self._qp_solved = False
        self._restoration: float | None = None  # violation where it began; None: no restoration phase

    def iterate(self) -> Status:
        """Run attempt after attempt from the initial guess, until one finds a solution."""
        self.point = self.program.point(self.point.x)
        if not self.point.differentiable:
            return Status.FAILED
        guess, y, z = self.point, self.y.copy(), self.z.copy()
        self._reduction = Reduction(self.program, guess.jacobian, self.determined)
        self._model = make_model(self.program, self.options, self._reduction)
        name = "osqp" if self.options.qp_solver == "auto" else self.options.qp_solver
        self._qp = ReducedQP(self.program, self._reduction, make_qp_solver(name))
        try:
            try:
                self._reduction.load(guess)
            except np.linalg.LinAlgError:  # constraints do not determine their variables there
                return Status.FAILED
            # Once a solve: the filter compares violations of different iterates, which need the same weights.
            self._qp.weigh(guess, y, self.options.price)
            return self._attempts(guess, y, z)
        finally:
            self._reduction.release()

    def _attempts(self, guess: Point, y: Vector, z: Vector) -> Status:
        status = Status.INFEASIBLE
        far, warm = guess.violation > _FEASIBLE_GUESS, bool(np.any(y) or np.any(z))
        attempts = [(*each, _MAX_VIOLATION) for each in (_ATTEMPTS if far else _ATTEMPTS[:1])]
        if warm:
            attempts = [(*_ATTEMPTS[0], _MAX_VIOLATION_WARM), *attempts]
        for radius, careful, (times, least) in attempts:
            self._max_violation = max(times * guess.violation, least)
            self.point, self.y, self.z, self._filter = guess, y.copy(), z.copy(), []
            self._qp.guess_active_set(y, z)
            self._unlimited_patience = (radius, careful) == _ATTEMPTS[-1]  # there is no other one to try
            self._qp.careful, self._widest = careful, radius * self.options.radius
            self._price, self._price_iteration = self.options.price, self.report.iterations
            self._end_restoration()
            status = self._iterate()
            if status not in (Status.INFEASIBLE, Status.FAILED):
                break
        return status

    def _iterate(self) -> Status:
        remark, least, best, last_progress = "initial guess", np.inf, np.inf, self.report.iterations
        while True:
            try:
                self._reduction.load(self.point)
            except np.linalg.LinAlgError:
                return Status.FAILED
            self._complete_multipliers()
            stop = self.report.iteration(self.point, self._kkt(), remark)
            if self._is_optimal(self.options.kkt_tolerance):
                return Status.SOLVED
            if stop:
                return Status.INTERRUPTED
            if self.report.iterations > self.options.max_iterations:
                return Status.ITERATION_LIMIT
            f, h = self.point.objective, self.point.violation
            # In a restoration phase the objective is not aimed at, so it is no progress.
            lower = self._restoration is None and f < best - _LESS_OBJECTIVE * (1.0 + abs(best))
            if h < _LESS_VIOLATION * least or lower or not self._is_violated():
                # At less violation the objective may have to rise: what it is there is the new reference.
                best = f if h < _LESS_VIOLATION * least else min(best, f)
                least, last_progress = min(least, h), self.report.iterations
            elif self.report.iterations > last_progress + _PATIENCE and not self._unlimited_patience:
                if self._leave_stall() is not None:
                    return Status.FAILED
                least, best, last_progress = np.inf, np.inf, self.report.iterations
            self._stalls = self.report.iterations > last_progress + _PATIENCE
            outcome = self._advance(self.report.iterations)
            if isinstance(outcome, Status):
                return outcome
            remark = outcome

    # ------------------------------------------------------------------ one iteration
    def _advance(self, k: int) -> str | Status:
        """Move to the next iterate: a remark for the history, or the status that ends the attempt."""
        while True:
            if self._out_of_time():
                return Status.TIME_LIMIT
            active = partial(self._qp.active, self.point)
            model = self._model.at(self.point, self.y, active, self._restoration is None)
            qp_step = self._solve(model, self.point.g)
            self._qp_solved = qp_step is not None
            if qp_step is not None and self._stalls and self._is_stationary(qp_step):
                return Status.INFEASIBLE
            if qp_step is None:
                self._radius *= _RADIUS_SHRINK
            else:
                self.y, self.z = qp_step.y.copy(), qp_step.z.copy()
                self._complete_multipliers()
                # With the QP's multipliers the iterate itself may be the solution, without another step.
                if self._is_optimal(self.options.kkt_tolerance):
                    return Status.SOLVED
                self._update_price(k, qp_step)
                accepted = self._search(model, qp_step)
                if accepted is not None:
                    return self._move(accepted)
                self._radius *= _RADIUS_SHRINK
            if self._radius < _MIN_RADIUS * self.options.radius:
                end = self._leave_stall()
                if end is not None:
                    return end

    def _solve(self, model: ReducedModel, g: Vector) -> QPStep | None:
        begin, limit = self.report.elapsed(), self.options.time_limit
        left = None if limit is None else limit - begin
        try:
            return self._qp.solve(
                self.point, model, g, radius=self._radius, price=self._price, time_limit=left
            )
        finally:
            self.report.seconds_qp += self.report.elapsed() - begin

    def _search(self, model: ReducedModel, qp_step: QPStep) -> Accepted | None:
        """Halve the step until a point is accepted; a refused full step gets a second-order correction."""
        length = 1.0
        for attempt in range(_MAX_HALVINGS):
            trial = self._return_to_equalities(
                self.program.point(self._clipped(self.point.x + length * qp_step.d))
            )
            for_objective = self._acceptance(trial, length, qp_step)
            if for_objective is not None:
                reduction = self.point.violation - trial.violation
                predicted = self.point.violation - qp_step.linear_violation
                return Accepted(
                    trial, length, for_objective, qp_step, "", reduction > _GOOD_REDUCTION * predicted
                )
            if attempt == 0 and trial.finite and self.options.second_order_correction:
                # a QP whose linearization has the trial point's values
                # Nocedal and Wright 2006, section 15.6: J d + g = 0 with the curvature
                # that the trial point shows.
                g = trial.g - self.point.jacobian @ (trial.x - self.point.x)
                corrected = self._solve(model, g)
                if corrected is not None:
                    trial = self._return_to_equalities(
                        self.program.point(self._clipped(self.point.x + corrected.d))
                    )
                    for_objective = self._acceptance(trial, 1.0, qp_step)
                    if for_objective is not None:
                        return Accepted(trial, 1.0, for_objective, corrected, ", corrected")
            length *= 0.5
        return None

    def _return_to_equalities(self, trial: Point) -> Point:
        """Trial point after steps back to the equalities, with the iterate's Jacobian, while they help.

        Determined variables then follow the curve of their equalities and not its tangent: longer steps are
        accepted.
        """
        for _ in range(_MAX_RETURNS):
            if not trial.finite or trial.violation < _ROUNDING:
                break
            # A chord iteration: the elimination of the iterate's Jacobian serves all trial points.
            other = self.program.point(self._clipped(trial.x + self._reduction.normal(trial.g)))
            if not other.violation < trial.violation:
                break
            slow, trial = other.violation > 0.5 * trial.violation, other
            if slow:
                break
        return trial

    def _acceptance(self, trial: Point, length: float, qp_step: QPStep) -> bool | None:
        """True if a point is accepted for its objective, False if for its violation, None if refused."""
        for_objective = self._acceptance_of_values(trial, length, qp_step) if trial.finite else None
        return for_objective if for_objective is not None and trial.differentiable else None

    def _acceptance_of_values(self, trial: Point, length: float, qp_step: QPStep) -> bool | None:
        """`_acceptance` by objective and constraints alone; derivatives take longer to compute."""
        h, f, before = trial.violation, trial.objective, self.point
        if self._restoration is not None:
            predicted = before.violation - qp_step.linear_violation
            # Armijo's condition for the violation, with the decrease that the QP predicts.
            enough = (
                predicted > 1e-10 * before.violation and h <= before.violation - _ARMIJO * length * predicted
            )
            return False if enough else None
        # margins about the filter: iterates that creep along it would never become feasible
        if h > self._max_violation or any(
            h > 0.999 * p.violation and f > p.objective - _OBJECTIVE_MARGIN * h for p in self._filter
        ):
            return None
        slope = float(before.gradient @ qp_step.d)
        rounding = _ROUNDING * (1.0 + abs(before.objective))
        # The switching condition (Waechter and Biegler 2006, eq. 19) with a QP's slope: near the feasible
        # set a step has to reduce the objective.
        near = before.violation < _OBJECTIVE_VIOLATION
        if slope < 0 and near and -length * slope > 1e-2 * before.violation**1.2:
            return True if f <= before.objective + _ARMIJO * length * slope + rounding else None
        # The QP trades objective for violation at the price, so the exact penalty function must not increase.
        merit = f <= before.objective + self._price * (before.violation - h)
        less = (merit and h <= (1 - 1e-5) * before.violation) or f <= before.objective - _OBJECTIVE_MARGIN * h
        met = h <= self.options.violation_tolerance and f <= before.objective + rounding
        return False if less or met else None

    def _move(self, accepted: Accepted) -> str:
        """Move to an accepted point; a remark for the history."""
        h, before = accepted.point.violation, self.point
        if not accepted.for_objective and self._restoration is None:
            pair = Pair(before.violation, before.objective)
            kept = [p for p in self._filter if p.violation < pair.violation or p.objective < pair.objective]
            self._filter = [*kept, pair]
        self.point = accepted.point
        if self._restoration is None:  # the equalities' multipliers follow once the new Jacobian is loaded
            self.y, self.z = accepted.qp_step.y.copy(), accepted.qp_step.z.copy()
        else:
            # The QP's multipliers are of the violation, not of the objective.
            self.y, self.z = np.zeros_like(self.y), np.zeros_like(self.z)
            acceptable = all(
                h <= 0.999 * p.violation or accepted.point.objective <= p.objective for p in self._filter
            )
            if h <= max(_RESTORED * self._restoration, self.options.violation_tolerance) and acceptable:
                self._end_restoration()
            # Feasible, but a pair refuses it: the filter begins anew.
            elif accepted.point.max_violation <= self.options.violation_tolerance:
                self._filter = []
                self._end_restoration()
        self._update_radius(accepted)
        qp = accepted.qp_step
        constraints = f"constraints {qp.constraints} ({qp.elastic} elastic)"
        remark = f"step {accepted.length:.2g}, {constraints}, QP {qp.iterations}{accepted.label}"
        return remark if self._restoration is None else f"{remark}, violation alone"

    def _update_radius(self, accepted: Accepted) -> None:
        """Double the radius after a full step; after a shortened one, set it to little more than that step.

        It grows beyond the attempt's radius, to the option's, if the constraints are nearly met or, in a
        restoration phase, if the violation falls as predicted.
        """
        if accepted.length == 1.0:
            near = self.point.violation < _OBJECTIVE_VIOLATION
            wide = near if self._restoration is None else accepted.predicted
            widest = self.options.radius if wide else self._widest
            self._radius = min(2.0 * self._radius, max(widest, self._radius))
        else:
            taken_length = accepted.length * accepted.qp_step.longest
            self._radius = min(max(_RADIUS_OVER_STEP * taken_length, 1e-3), self._radius)

    def _leave_stall(self) -> Status | None:
        """Begin a restoration phase if no step is accepted; or the status that ends the attempt."""
        if not self._is_violated():
            return Status.ACCEPTABLE if self._is_optimal(self.options.acceptable_tolerance) else Status.FAILED
        if self._restoration is not None:  # a failed QP proves nothing
            return Status.INFEASIBLE if self._qp_solved else Status.FAILED
        self._restoration = self.point.violation
        # So that the iterates do not return to where the search stalled (Waechter and Biegler, step A-9).
        self._filter.append(Pair(self.point.violation, self.point.objective))
        self._radius, self._price = self._widest, self.options.price
        return None

    def _end_restoration(self) -> None:
        self._restoration = None
        # BFGS has learnt where the phase began, far from here.
        self._model.forget()
        self._radius = self._widest

    # ------------------------------------------------------------------ multipliers
    def _complete_multipliers(self) -> None:
        """Compute the equalities' multipliers from those of the other constraints and the bounds."""
        self._clear_equalities(self.y)
        dual = self.point.gradient + self.point.jacobian.T @ self.y + self.z
        self.y = self._reduction.add_multipliers(self.y, dual)

    def _clear_equalities(self, y: Vector) -> None:
        y[self._reduction.eliminated] = y[self._reduction.equalities] = 0.0

    def _update_price(self, k: int, qp_step: QPStep) -> None:
        """Double the price if constraints stay elastic although their multipliers are at the price.

        Not if the radius is too small to meet them: then no price suffices.
        """
        others = self._reduction.others
        largest = float(np.max(np.abs(qp_step.y[others]) / self.program.weights[others], initial=0.0))
        narrow = qp_step.longest > 0.99 * self._radius and self._radius < self.options.radius
        due = k >= self._price_iteration + _PRICE_DELAY
        if self._is_violated() and not narrow and self._price < 1.5 * largest and due:
            self._price, self._price_iteration = min(2.0 * self._price, self.options.price_max), k

    # ------------------------------------------------------------------ optimality
    def _is_optimal(self, tolerance: float) -> bool:
        if self._is_violated() or self._restoration is not None or self._kkt() > tolerance:
            return False
        # |multiplier| x distance of an equality is rounding, times a multiplier that may be large.
        y = self.y.copy()
        self._clear_equalities(y)
        gap = complementarity(self.program, self.point.x, self.point.g, y, self.z)
        return gap <= tolerance * max(1.0, float(np.abs(self.y).mean()) if self.y.size else 0.0)

    def _kkt(self) -> float:
        return stationarity(self.point.gradient, self.point.jacobian, self.y, self.z)

    def _is_violated(self) -> bool:
        return self.point.max_violation > self.options.violation_tolerance

    def _is_stationary(self, qp_step: QPStep) -> bool:
        """True in a restoration phase if the QP's step hardly reduces the violation.

        Relative to the reduction if all violated constraints fell along their gradients.
        """
        if self._restoration is None:
            return False
        violated = constraint_violations(self.program, self.point.g) > self.options.violation_tolerance
        steepest = float((self.program.weights * self.point.row_norms)[violated].sum())
        reduction = self.point.violation - qp_step.linear_violation
        return reduction <= _STATIONARY * qp_step.longest * steepest

    def _clipped(self, x: Vector) -> Vector:
        return np.clip(x, self.program.x_lower, self.program.x_upper)
