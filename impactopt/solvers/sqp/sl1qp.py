"""Sequential quadratic programming: a trust region, an l1 merit function, exact second derivatives.

The method is Fletcher's Sl1QP with a second-order correction (Nocedal and Wright, Numerical Optimization,
2006, chapter 18).
"""

from __future__ import annotations

import numpy as np

from impactopt.solvers.program import (
    Status,
    Vector,
    complementarity,
    is_stationary_violation,
    stationarity,
)
from impactopt.solvers.sqp.hessian import QuadraticModel, make_hessian
from impactopt.solvers.sqp.merit import Filter, Merit
from impactopt.solvers.sqp.point import Point
from impactopt.solvers.sqp.qp_solvers import make_qp_solver
from impactopt.solvers.sqp.run import Run, Task
from impactopt.solvers.sqp.subproblem import Step, Subproblem
from impactopt.solvers.sqp.trust_region import TrustRegion

_ROUNDING = 1e-13  # changes of the merit function below this, relatively, are noise


class Sl1QPRun(Run):
    """One solve. Between iterations: the point, its multipliers, the trust region, the merit function."""

    def __init__(self, task: Task):
        super().__init__(task)
        options = self.options
        self.hessian = make_hessian(self.program, options)
        self.subproblem = Subproblem(self.program, make_qp_solver(options.qp_solver))
        self.subproblem.start_from(self.y, self.z)
        self.merit = Merit(price=options.price, price_max=options.price_max)
        self.filter = Filter()
        self.region = TrustRegion(options.radius, options.radius_max, options.levenberg, options.levenberg)

    def iterate(self) -> Status:
        self.point = self.program.point(self.point.x)
        if not self.point.differentiable:
            return Status.FAILED
        self.program.weigh(self.point)
        note = "start"
        for _ in range(self.options.max_iterations):
            self._settle_price()
            if self.report.iteration(self.point, self._kkt(self.point), note):
                return Status.INTERRUPTED
            if self._optimal(self.options.kkt_tolerance):
                return Status.SOLVED
            found = self._advance()
            if isinstance(found, Status):
                return found
            self.point, note = found
        stop = self.report.iteration(self.point, self._kkt(self.point), note)
        if self._optimal(self.options.kkt_tolerance):
            return Status.SOLVED
        return Status.INTERRUPTED if stop else Status.ITERATION_LIMIT

    def _advance(self) -> tuple[Point, str] | Status:
        """The next point, by shrinking the trust region until a step is accepted; or why there is none."""
        point, model = self.point, self._model()
        while not self.region.exhausted:
            if self._out_of_time():
                return Status.TIME_LIMIT
            step = self._solve(model, None)
            if step is None:
                self.region.after_failure()
                continue
            self.y, self.z = step.y, step.z
            if self._optimal(self.options.kkt_tolerance):
                return Status.SOLVED
            change, relief = model.change(step.d), point.violation - step.linear_violation
            self.merit.pay_for(change, relief)
            predicted = -change + self.merit.price * relief
            found: tuple[Point, str] | Status | None
            if predicted > max(self._noise(), 1e-9 * self.merit.price * self._excess()):
                found = self._try(model, step, predicted)
            else:
                found = self._at_minimum(step)
                model = self._model()
            if found is not None:
                return found
        return self._standstill()

    def _try(self, model: QuadraticModel, step: Step, predicted: float) -> tuple[Point, str] | None:
        """The point that the step leads to, corrected if need be; None where it is refused."""
        point, phi = self.point, self.merit.value(self.point)
        trial = self.program.point(self._inside(point.x + step.d))
        actual, label = phi - self.merit.value(trial), ""
        if actual < 0.5 * predicted and trial.finite and self.options.second_order_correction:
            corrected = self._corrected(model, step, trial)
            if corrected is not None and phi - self.merit.value(corrected) > actual:
                trial, actual, label = corrected, phi - self.merit.value(corrected), ", corrected"
        noise = self._noise()
        ratio = 1.0 if predicted <= 10.0 * noise and actual > -10.0 * noise else actual / predicted
        accepted = ratio > 1e-4
        if not accepted and self._passes_filter(trial):
            accepted, label = True, label + ", filter"
        accepted = accepted and trial.differentiable
        length = float(np.max(np.abs(trial.x - point.x), initial=0.0))
        self.region.after_step(ratio, length, accepted=accepted, hard=step.hard)
        if not accepted:
            return None
        self.filter.add(point)
        rows = f"rows {step.rows} ({step.elastic} elastic)"
        return trial, f"radius {self.region.radius:.1e}, {rows}, QP {step.qp_iterations}{label}"

    def _corrected(self, model: QuadraticModel, step: Step, trial: Point) -> Point | None:
        """The second-order correction: the step again, with the rows' curvature along it (eq. 18.54)."""
        again = self._solve(model, trial.g - self.point.g - self.point.jacobian @ step.d)
        return None if again is None else self.program.point(self._inside(self.point.x + again.d))

    def _at_minimum(self, step: Step) -> tuple[Point, str] | Status | None:
        """At a minimum of the merit function.

        The end if the rows are met. Else the price rises, and at last only the violation counts; None: go on
        with that.
        """
        merit, price_max = self.merit, self.options.price_max
        if not self._excess():
            if merit.sigma:
                return self._finish(step) or self._standstill()
            merit.sigma, merit.price = 1.0, price_max  # the rows are met again
        elif merit.sigma and merit.price < price_max:
            merit.price = min(10.0 * merit.price, price_max)
        elif merit.sigma:
            merit.sigma, merit.price = 0.0, 1.0
        else:
            # Not even the violation alone can be lessened; but an inaccurate QP proves nothing.
            return self._standstill() if step.hard else Status.INFEASIBLE
        self.region.widen(min(self.options.radius, 0.1))
        return None

    def _finish(self, step: Step) -> tuple[Point, str] | None:
        """The full step, where the merit function is too coarse to judge it but the KKT residual falls."""
        trial = self.program.point(self._inside(self.point.x + step.d))
        allowed = max(self.point.max_violation, self.options.violation_tolerance)
        if not trial.differentiable or trial.max_violation > allowed:
            return None
        return (trial, "by KKT residual") if self._kkt(trial) < 0.5 * self._kkt(self.point) else None

    def _standstill(self) -> Status:
        """The status where no step is progress any more."""
        point = self.point
        if self._optimal(self.options.acceptable_tolerance):
            return Status.ACCEPTABLE
        if self._excess() and is_stationary_violation(self.program, point.x, point.g, point.jacobian):
            return Status.INFEASIBLE
        return Status.FAILED

    def _solve(self, model: QuadraticModel, correction: Vector | None) -> Step | None:
        begin, limit = self.report.elapsed(), self.options.time_limit
        try:
            return self.subproblem.solve(
                self.point,
                model,
                radius=self.region.radius,
                price=self.merit.price,
                levenberg=self.region.levenberg,
                correction=correction,
                time_limit=None if limit is None else limit - begin,
            )
        finally:
            self.report.seconds_qp += self.report.elapsed() - begin

    def _model(self) -> QuadraticModel:
        # Far from a solution the QP's multipliers may be anything; beyond the price they mean nothing.
        limit = 3.0 * self.merit.price * self.program.weights
        y = np.clip(self.y, -limit, limit)
        return self.hessian.model(self.point, self.merit.sigma, y, self.subproblem.active_rows(self.point))

    def _settle_price(self) -> None:
        """Keep the price above the multipliers, and not far above, where they explain the gradient."""
        point = self.point
        residual = point.gradient + point.jacobian.T @ self.y + self.z
        largest = float(np.max(np.abs(self.y) / self.program.weights, initial=0.0))
        explained = np.linalg.norm(residual) <= 0.1 * np.linalg.norm(point.gradient)
        if self.merit.sigma and explained and largest > 0.0:
            self.merit.settle(largest, self.options.price, lower=not self._excess())

    def _optimal(self, tolerance: float) -> bool:
        """Whether the point and the latest multipliers meet the KKT conditions."""
        point, y, z = self.point, self.y, self.z
        if self._excess() or self._kkt(point) > tolerance:
            return False
        scale = max(1.0, float(np.abs(y).mean()) if y.size else 0.0)
        return complementarity(self.program, point.x, point.g, y, z) <= tolerance * scale

    def _kkt(self, point: Point) -> float:
        return stationarity(point.gradient, point.jacobian, self.y, self.z)

    def _excess(self) -> float:
        """The violation, 0 where the rows are met to the tolerance."""
        met = self.point.max_violation <= self.options.violation_tolerance
        return 0.0 if met else self.point.violation

    def _noise(self) -> float:
        """Changes of the merit function that mean nothing."""
        objective = abs(self.merit.sigma * self.point.objective)
        return _ROUNDING * (1.0 + objective + self.merit.price * self.point.violation)

    def _passes_filter(self, trial: Point) -> bool:
        """Whether a refused step is taken: the rows are not met here, and it beats all points so far."""
        v, f = self.point.violation, self.point.objective
        if not self._excess() or trial.violation > 10.0 * max(v, 1e-2):
            return False
        beats = trial.violation < 0.9 * v or trial.objective < f - 0.1 * trial.violation
        return beats and self.filter.passes(trial)

    def _inside(self, x: Vector) -> Vector:
        return np.clip(x, self.program.x_lower, self.program.x_upper)
