"""Sequential quadratic programming where each QP is taken one interior-point step towards its solution.

The QPs of a whole motion have thousands of rows; solving each of them exactly costs more than the functions.
So the barrier of the rows is kept from one QP to the next, and every QP gets one Newton step: the primal-dual
interior-point method of Waechter and Biegler (Mathematical Programming 106, 2006), with its filter line
search, second-order correction and inertia control. What is ours is the Newton system (`newton`): rows that
determine variables of their own are eliminated first (`condense`), and what is left gets a Cholesky factor.

Where no step is progress any more the rows become elastic: they may be violated at a price, as in Sl1QP
(Nocedal and Wright 2006, section 18.5), so that an infeasible program ends at a point of least violation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impactopt.solvers.program import (
    Status,
    Vector,
    complementarity,
    is_stationary_violation,
    scaled_residual,
    stationarity,
)
from impactopt.solvers.sqp.barrier import Bounded
from impactopt.solvers.sqp.condense import Determined
from impactopt.solvers.sqp.elastic import Elastic
from impactopt.solvers.sqp.linesearch import Filter, Progress
from impactopt.solvers.sqp.newton import borrow, give_back
from impactopt.solvers.sqp.point import Point
from impactopt.solvers.sqp.run import Run, Task

_CORRECTIONS = 4  # second-order corrections a step, at most
_WORSE = 0.99  # a correction that leaves more than this part of the violation ends them
_FASTER = 0.2  # mu becomes min(0.2 mu, mu^power) (eq. 7)
# the barrier problem is solved to so many mu (kappa_epsilon); then mu falls with this power: gently and
# loosely. From multipliers given it falls at once: the point is near, and there is no path to keep to. Where
# elastic rows have to show that no point meets them, as in the paper.
_CLOSE, _POWER, _CLOSE_WARM = 30.0, 1.3, 1e4
_CLOSE_ELASTIC, _POWER_ELASTIC = 10.0, 1.5
_FINE, _FINEST = 0.6, 0.3  # times the tolerance: a mu that is small enough, and the least
_PROXIMAL = 1.0  # times mu: weight of a step's own length, so that what nothing decides does not wander
# a step is bent where it gets so many times as far, a slack giving so much of its distance to a bound, and
# where no row is off, or will be, by more than this
_LONGER, _SHORT, _BENT = 1.2, 0.9, 1.0
_CRAWL, _PATIENCE = 1e-2, 20  # so many steps shorter than this, one after the other, are no progress either
_LEFT = 0.1  # times mu: what a step may leave of the equations for it
_LARGE = 100.0  # mean multiplier from which on residuals are scaled (s_max)
_ABSURD = 1e12  # multipliers beyond this come from rows that have none
# violation from which on elastic rows are made hard again where they do not get further, or this part of what
# it was when nothing else began to count
_NEAR, _LESS = 1e-2, 1e-2
_RESTORED = 1e-3  # violation from which on they are where nothing else counted
_CHANGES = 12  # of what is aimed at, at most
_AGAIN = 1e-4  # the least barrier after such a change
_RESTARTS = 2  # where nothing is progress any more


@dataclass
class _Step:
    """A Newton step: of all variables, the free ones, the slacks; new multipliers of rows left and gone."""

    d: Vector
    free: Vector
    slack: Vector
    y: Vector
    gone: Vector


class InteriorRun(Run):
    """One solve with `qp_solver="interior"`.

    Rows are those that `Condenser` leaves; g - s = 0 for an inequality row with its slack s.
    """

    def __init__(self, task: Task):
        super().__init__(task)
        self._determined: Sequence[Determined] = getattr(task.program, "determined", ())
        self._price = self.options.price  # of elastic rows
        self._crawled = self._met = 0  # iterations: of short steps, and of elastic rows that are met
        self._began = 0.0  # violation where only that began to count
        self._aim()

    # ------------------------------------------------------------------ start
    def _aim(self) -> None:
        """At the objective, from the multipliers given."""
        self._sigma, self._changes = 1.0, 0  # weight of the objective
        self._warm = bool(np.any(self.y) or np.any(self.z))
        self._mu = self.options.barrier_warm if self._warm else self.options.barrier

    def _begin(self) -> None:
        p, y, z, point = self.program, self.y, self.z, self.point
        x = point.x
        moves = p.x_upper - p.x_lower > 1e-12
        bounded = (np.isfinite(p.x_lower) | np.isfinite(p.x_upper)) & moves
        hessian = p.hessian(x, 1.0, np.zeros(p.m))
        self._newton = borrow(
            point.jacobian,
            hessian,
            determined=self._determined,
            equal=p.g_lower == p.g_upper,
            bounded=bounded,
            moves=moves,
        )
        self._condenser = c = self._newton.condenser
        lower = np.concatenate([p.g_lower, p.x_lower[c.bounded]])
        upper = np.concatenate([p.g_upper, p.x_upper[c.bounded]])
        self._gone = lower[c.eliminated]
        lower, upper = lower[c.rows], upper[c.rows]
        self._unequal, self._level = np.flatnonzero(lower < upper), lower[c.equal]
        push = self.options.push
        free = np.where(moves, p.x_lower, -np.inf)[c.free], np.where(moves, p.x_upper, np.inf)[c.free]
        self._x = Bounded(x[c.free], *free, push=push, multipliers=z[c.free], mu=self._mu)
        x = x.copy()
        x[c.free] = self._x.values
        self.point = point = p.point(x)
        multipliers = np.concatenate([y, z[c.bounded]])
        self._y = multipliers[c.rows]
        self._gone_y = multipliers[c.eliminated]
        rows = self._unequal
        self._s = Bounded(
            self._values(point)[rows],
            lower[rows],
            upper[rows],
            push=push,
            multipliers=self._y[rows],
            mu=self._mu,
        )
        if not self._warm:
            for values in (self._x, self._s):
                values.below, values.above = np.sign(values.below), np.sign(values.above)
        self._elastic: Elastic | None = None
        self._filter: Filter | None = None

    def _all(self, point: Point) -> Vector:
        """Values of the program's rows, and of the bounded eliminated variables."""
        return np.concatenate([point.g, point.x[self._condenser.bounded]])

    def _values(self, point: Point) -> Vector:
        return self._all(point)[self._condenser.rows]

    # ------------------------------------------------------------------ the loop
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
                give_back(self._newton)
            if status is not Status.FAILED or restarts == _RESTARTS or not self._back_to_best():
                return status
            note, restarts = "again from the best iterate", restarts + 1

    def _back_to_best(self) -> bool:
        """Whether there is another point to begin at anew: the best so far, with multipliers and a barrier
        of its own, as what failed may be the way there.
        """
        x = self.report.best.x
        if x is None or np.array_equal(x, self.point.x):
            return False
        self.point = self.program.point(x)
        self.y, self.z = np.zeros_like(self.y), np.zeros_like(self.z)
        self._aim()
        return self.point.differentiable

    def _iterate(self, note: str) -> Status:
        while self.report.iterations <= self.options.max_iterations:
            residual = self._residual(self.point, self._s.values)
            self._take_multipliers()
            error = self._error(0.0, residual)
            if self.report.iteration(self.point, self._kkt, note):
                return Status.INTERRUPTED
            if error <= self.options.kkt_tolerance or self._restored():
                verdict = self._verdict()
                if verdict is not None:
                    return verdict
                continue
            if self._lingers():
                self._change_aim(met=True)
                continue
            if self._out_of_time():
                return Status.TIME_LIMIT
            self._lower_barrier(residual)
            found = self._advance(residual)
            if isinstance(found, Status):
                return found
            note = found
        return Status.ITERATION_LIMIT

    def _verdict(self) -> Status | None:
        """At a solution, or where rows are restored: the end, unless rows are violated, or only the violation
        counted.
        """
        elastic = self._elastic
        met = elastic is None or elastic.largest() <= self.options.violation_tolerance
        if met and self._sigma:
            return Status.SOLVED
        near = _NEAR if self._sigma else _RESTORED  # the price may only have been too low
        return self._change_aim(met=met or self.point.max_violation <= near)

    def _restored(self) -> bool:
        """Whether the violation, which alone counts, is so small that hard rows get further with it."""
        elastic = self._elastic
        if elastic is None or self._sigma or elastic.price >= self.options.price_max:
            return False
        return self.point.max_violation <= _RESTORED

    def _lingers(self) -> bool:
        """Whether elastic rows have been met for long, and the rest is left to do: hard rows do it sooner."""
        met = self._elastic is not None and self.point.max_violation <= self.options.violation_tolerance
        self._met = self._met + 1 if met and self._sigma else 0
        return self._met > _PATIENCE and self._price < self.options.price_max

    def _start_is_solution(self) -> bool:
        """Whether the start with the multipliers given meets all tolerances."""
        options, point = self.options, self.point
        self._kkt = stationarity(point.gradient, point.jacobian, self.y, self.z)
        return (
            self._warm
            and self._kkt <= options.kkt_tolerance
            and point.max_violation <= options.violation_tolerance
            and complementarity(self.program, point.x, point.g, self.y, self.z)
            <= options.complementarity_tolerance
        )

    def _change_aim(self, *, met: bool) -> Status | None:
        """Where elastic rows do not get further: let only the violation count, until it is gone or least."""
        assert self._elastic is not None
        self._changes += 1
        if self._changes > _CHANGES:
            return Status.FAILED
        price = self._elastic.price
        if met and price < self.options.price_max:
            self._elastic, self._sigma = None, 1.0  # from where the rows are met, as if nothing had been
            self._price = min(10.0 * price, self.options.price_max)
        elif self._sigma:
            self._sigma, self._began = 0.0, self.point.max_violation
        else:
            return Status.INFEASIBLE
        self._mu = max(self._mu, _AGAIN)
        self._filter = None
        return None

    def _advance(self, residual: Vector) -> str | Status:
        """Move to the next point; what to note about it, or why there is none."""
        begin = self.report.elapsed()
        step = self._step(residual)
        self.report.seconds_qp += self.report.elapsed() - begin
        if step is None or np.abs(step.y).max(initial=0.0) > _ABSURD:
            return self._give_way(residual)
        longest = self._longest(step)
        at = self._start_of(step, residual)
        if self._filter is None:
            self._filter = Filter.around(at.theta)
        found = self._bent(step, at, longest) or self._searched(step, at, longest, residual)
        crawls = found is None or found.length < _CRAWL
        self._crawled = self._crawled + 1 if crawls else 0
        if found is None or self._crawled > _PATIENCE:
            self._crawled = 0
            return self._give_way(residual)
        step, trial, length, note = found
        self._filter.remember(at, length, trial.phi)
        self._move(step, trial, length)
        words = [f"barrier {self._mu:.0e}, step {length:.2g}", *note]
        if self._newton.shift:
            words.append(f"shift {self._newton.shift:.0e}")
        if self._elastic is not None:
            words.append(f"rows elastic at {self._elastic.price:g}")
        return ", ".join(words)

    def _bent(self, step: _Step, at: Progress, longest: float) -> _Found | None:
        """The step as far as the bounds of variables let it, where it is slacks that stop it: each of them
        stops by itself short of its own bound, and what its row is then off by is the next step's to mend.

        Else one slack of thousands stops all others. Only while no row is far off: it is worth nothing where
        rows are not about as linear as the step takes them to be.
        """
        if self._elastic is not None or self.point.max_violation > _BENT:
            return None
        length = self._x.longest(step.free, self._keep)
        if length <= _LONGER * longest:
            return None
        slack = self._s.short_of_bounds(self._s.values + length * step.slack, _SHORT)
        trial = self._trial(step, length, slack)
        fine = trial.point.finite and trial.point.max_violation <= _BENT
        if not fine or not self._accepts(at, length, trial):
            return None
        return _Found(step, trial, length, ["bent"])

    def _searched(self, step: _Step, at: Progress, longest: float, residual: Vector) -> _Found | None:
        """Along the step, backwards from its longest part; None: no part of it is progress."""
        assert self._filter is not None
        length, trials = longest, 0
        while True:
            trials += 1
            trial = self._trial(step, length)
            if self._accepts(at, length, trial):
                return _Found(step, trial, length, [])
            if trials == 1 and trial.theta >= at.theta and self.options.second_order_correction:
                found = self._corrected(at, residual, trial, longest)
                if found is not None:
                    return found
            length *= 0.5
            if length < self._filter.shortest(at):
                return None

    def _move(self, step: _Step, trial: _Trial, length: float) -> None:
        x, s, mu, keep = self._x, self._s, self._mu, self._keep
        below_x, above_x, dual_x = x.dual_step(step.free, mu, keep)
        below_s, above_s, dual_s = s.dual_step(step.slack, mu, keep)
        dual, part = min(dual_x, dual_s), length
        if self._elastic is not None:
            part = dual = min(dual, self._elastic.longest_dual(step.y, self._y, keep))
            self._elastic.take(length, self._residual(trial.point, trial.slack)[self._condenser.rows])
        self._y = self._y + part * (step.y - self._y)
        self._gone_y = self._gone_y + part * (step.gone - self._gone_y)
        x.move(trial.point.x[self._condenser.free], x.below + dual * below_x, x.above + dual * above_x, mu)
        s.move(trial.slack, s.below + dual * below_s, s.above + dual * above_s, mu)
        self.point = trial.point

    # ------------------------------------------------------------------ the Newton system
    def _residual(self, point: Point, slack: Vector) -> Vector:
        """What the rows (m,) are off by: eliminated ones and equalities, and inequalities against their
        slacks."""
        out, c = self._all(point), self._condenser
        out[c.eliminated] -= self._gone
        out[c.rows[c.equal]] -= self._level
        out[c.rows[self._unequal]] -= slack
        return out

    def _step(self, residual: Vector) -> _Step | None:
        point = self.point
        hessian = self.program.hessian(point.x, self._sigma, self.y)
        hard = self._elastic is None
        found = self._newton.factor(
            point.jacobian,
            hessian,
            self._x.stiffness(),
            self._weights,
            hard=hard,
            proximal=_PROXIMAL * self._mu if hard else 0.0,
        )
        return self._solve(residual) if found else None

    def _weights(self, more: float) -> Vector:
        """Of the rows (k,), and their offsets: of the slacks' barrier, with more curvature, and of elastic
        rows."""
        soft, self._offsets = np.zeros(self._condenser.rows.size), np.zeros(self._condenser.rows.size)
        self._stiffness = self._s.stiffness() + more
        soft[self._unequal] = 1.0 / self._stiffness
        self._offsets[self._unequal] = self._s.slope(self._mu) / self._stiffness
        if self._elastic is not None:
            give, offset = self._elastic.compliance(self._y, self._mu)
            soft, self._offsets = soft + give, self._offsets + offset
        return np.divide(1.0, soft, out=np.zeros_like(soft), where=soft > 0.0)

    def _solve(self, residual: Vector) -> _Step:
        """The step for the rows' residual (m,); the matrix stays."""
        c = self._condenser
        q, r = self._sigma * self.point.gradient, residual.copy()
        q[c.free] += self._x.slope(self._mu)
        if self._elastic is not None:
            r[c.rows] = self._elastic.residual(r[c.rows])
        r[c.rows] += self._offsets
        d, everything = self._newton.solve(q, r, _LEFT * self._mu)
        y = everything[c.rows]
        slack = (y[self._unequal] - self._s.slope(self._mu)) / self._stiffness
        if self._elastic is not None:
            self._elastic.step(y, self._y, self._mu)
        return _Step(d, d[c.free], slack, y, everything[c.eliminated])

    # ------------------------------------------------------------------ the line search
    @property
    def _keep(self) -> float:
        """The part of a distance to a bound that a step may take, at most (tau, eq. 8)."""
        return max(0.99, 1.0 - self._mu)

    def _longest(self, step: _Step) -> float:
        keep = self._keep
        length = min(self._x.longest(step.free, keep), self._s.longest(step.slack, keep))
        return length if self._elastic is None else min(length, self._elastic.longest(keep))

    def _start_of(self, step: _Step, residual: Vector) -> Progress:
        mu, point = self._mu, self.point
        slope = float(
            self._sigma * (point.gradient @ step.d)
            + self._x.slope(mu) @ step.free
            + self._s.slope(mu) @ step.slack
        )
        phi = self._phi(point, self._s.values)
        if self._elastic is not None:
            slope, phi = slope + self._elastic.slope(mu), phi + self._elastic.now(mu)
        return Progress(theta=self._theta(residual), phi=phi, slope=slope)

    def _phi(self, point: Point, slack: Vector) -> float:
        """The barrier function, without what elastic rows add."""
        barriers = self._x.barrier(point.x[self._condenser.free]) + self._s.barrier(slack)
        return self._sigma * point.objective + self._mu * barriers

    def _theta(self, residual: Vector, excess: Vector | None = None) -> float:
        c = self._condenser
        rows = residual[c.rows]
        if self._elastic is not None:
            rows = self._elastic.residual(rows) if excess is None else rows - excess
        return float(np.abs(residual[c.eliminated]).sum() + np.abs(rows).sum())

    def _trial(self, step: _Step, length: float, slack: Vector | None = None) -> _Trial:
        """The point after a part of a step; slack: those there, if not the step's."""
        point, mu = self.program.point(self.point.x + length * step.d), self._mu
        slack = self._s.values + length * step.slack if slack is None else slack
        if not point.finite:
            return _Trial(point, slack, np.inf, np.inf)
        phi = self._phi(point, slack)
        excess = None
        if self._elastic is not None:
            p, n = self._elastic.moved(length)
            phi, excess = phi + self._elastic.cost(p, n, mu), p - n
        return _Trial(point, slack, self._theta(self._residual(point, slack), excess), phi)

    def _accepts(self, at: Progress, length: float, trial: _Trial) -> bool:
        assert self._filter is not None
        return self._filter.accepts(at, length, trial.theta, trial.phi) and trial.point.differentiable

    def _corrected(self, at: Progress, residual: Vector, trial: _Trial, longest: float) -> _Found | None:
        """Second-order corrections: the step again, with what it left of the rows (section 2.4)."""
        if self._elastic is not None:
            return None
        left, theta = residual, trial.theta
        for k in range(_CORRECTIONS):
            if not trial.point.finite:
                break
            left = longest * left + self._residual(trial.point, trial.slack)
            step = self._solve(left)
            trial = self._trial(step, self._longest(step))
            if self._accepts(at, longest, trial):
                return _Found(step, trial, longest, [f"{k + 1} corrections"])
            if trial.theta > _WORSE * theta:
                break
            theta = trial.theta
        return None

    def _give_way(self, residual: Vector) -> str | Status:
        """What to do where no step is progress: let rows be violated at a price, or end."""
        if self._error(0.0, residual) <= self.options.acceptable_tolerance:
            if self._elastic is None:
                return Status.ACCEPTABLE
            if not self._sigma:  # the violation is least, but for rounding
                return self._verdict() or "rows are hard again"
        point = self.point
        if self._elastic is None:
            self._elastic = Elastic(residual[self._condenser.rows], self._price, self._mu)
            self._y, self._gone_y = self._elastic.clip(self._y), np.zeros_like(self._gone_y)
            self._filter = None
            return "rows become elastic"
        near = point.max_violation <= max(_NEAR, _LESS * self._began)
        if self._sigma or near:
            end = self._change_aim(met=near)
            if end is not None:
                return end
            return "rows are hard again" if self._elastic is None else "only the violation counts"
        if is_stationary_violation(self.program, point.x, point.g, point.jacobian):
            return Status.INFEASIBLE
        return Status.FAILED

    # ------------------------------------------------------------------ errors
    def _take_multipliers(self) -> None:
        """Multipliers of the program's rows and bounds, and the dual residual."""
        p, c, point = self.program, self._condenser, self.point
        everything = np.zeros(c.m)
        everything[c.rows], everything[c.eliminated] = self._y, self._gone_y
        self.y, self.z = everything[: p.m], np.zeros(p.n)
        self.z[c.free] = self._x.multiplier
        self.z[c.bounded] = everything[p.m :]
        dual = self._sigma * point.gradient + point.jacobian.T @ self.y + self.z
        held = c.free[self._newton.held]
        self.z[held] -= dual[held]
        dual[held] = 0.0
        self._dual = float(np.abs(dual).max(initial=0.0))
        self._kkt = scaled_residual(dual + (1.0 - self._sigma) * point.gradient, self.y, self.z)

    def _error(self, mu: float, residual: Vector) -> float:
        """The scaled error of the barrier problem (eq. 5)."""
        x, s, c = self._x, self._s, self._condenser
        bounds, count = x.total() + s.total(), max(1, x.bounds + s.bounds)
        if self._elastic is not None:  # two more bounds a row, whose multipliers add up to twice the price
            bounds, count = bounds + 2 * self._elastic.price * self._y.size, count + 2 * self._y.size
        rows = float(np.abs(self._y).sum() + np.abs(self._gone_y).sum())
        scale = max(_LARGE, (rows + bounds) / (c.m + count)) / _LARGE
        slack = float(np.abs(self._y[self._unequal] - s.multiplier).max(initial=0.0))
        off, left = max(x.off(mu), s.off(mu)), residual[c.rows]
        if self._elastic is not None:
            off, left = max(off, self._elastic.off(self._y, mu)), self._elastic.residual(left)
        violation = max(float(np.abs(v).max(initial=0.0)) for v in (left, residual[c.eliminated]))
        off /= max(_LARGE, bounds / count) / _LARGE
        if not mu:  # in units of the one tolerance that all is compared with
            off *= self.options.kkt_tolerance / self.options.complementarity_tolerance
        return max(max(self._dual, slack) / scale, violation, off)

    def _lower_barrier(self, residual: Vector) -> None:
        tolerance, hard = self.options.complementarity_tolerance, self._elastic is None
        close, power = (_CLOSE, _POWER) if hard else (_CLOSE_ELASTIC, _POWER_ELASTIC)
        if hard and self._warm:
            close = _CLOSE_WARM
        while self._mu > _FINE * tolerance and self._error(self._mu, residual) <= close * self._mu:
            self._mu = max(_FINEST * tolerance, min(_FASTER * self._mu, self._mu**power))
            self._filter = None


@dataclass
class _Trial:
    """A point to try, with its slacks, violation theta and barrier function phi."""

    point: Point
    slack: Vector
    theta: float
    phi: float


class _Found(NamedTuple):
    """A step that is progress, the point that a part of it leads to, and what to note about it."""

    step: _Step
    trial: _Trial
    length: float
    note: list[str]
