"""The barrier problem: what a program is while mu keeps its variables and slacks off their bounds.

Rows are those that `Condenser` leaves; g - s = 0 for an inequality row with its slack s. Here are its
residual, its error, its barrier function, the Newton step and what a part of that leads to. Which step is
taken is the line search's business (`line_search`), when rows may be violated that of `elastic_phase`.

Source: Waechter and Biegler 2006; equation numbers are that paper's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impactopt.solvers.ipm.barrier import Bounded
from impactopt.solvers.ipm.elastic_constraints import Elastic
from impactopt.solvers.ipm.filter import SearchStart
from impactopt.solvers.ipm.newton import acquire, release
from impactopt.solvers.options import SQPOptions
from impactopt.solvers.point import Point, TimedProgram
from impactopt.solvers.program import Determined, Vector, scaled_residual
from impactopt.solvers.run import Path

_FASTER = 0.2  # mu becomes min(0.2 mu, mu^power) (eq. 7)
# the barrier problem is solved to so many mu (kappa_epsilon); then mu falls with this power: gently and
# loosely. From multipliers given it falls at once, as the point is near and there is no path to keep to, but
# from a first barrier so high. Where elastic rows have to show that no point meets them, as in the paper.
_CLOSE, _POWER, _CLOSE_WARM, _HIGH = 30.0, 1.3, 1e4, 5e-3
_CLOSE_ELASTIC, _POWER_ELASTIC = 10.0, 1.5
_FINE, _FINEST = 0.6, 0.3  # times the tolerance: a mu that is small enough, and the least
_PROXIMAL = 1.0  # times mu: weight of a step's own length, so that what nothing decides does not wander
_LEFT = 0.1  # times mu: what a step may leave of the equations for it
_PUSH = 1e-9  # into bounds, of an iterate that was left
_NEW = 1e-3  # the least distance to its bound of a new row's slack
_LARGE = 100.0  # mean multiplier from which on residuals are scaled (s_max)


@dataclass
class Step:
    """A Newton step: of all variables, the free ones, the slacks; new multipliers of rows left and gone."""

    d: Vector
    free: Vector
    slack: Vector
    y: Vector
    gone: Vector


@dataclass
class Trial:
    """A point to try, with its slacks, violation theta and barrier function phi."""

    point: Point
    slack: Vector
    theta: float
    phi: float


class BarrierProblem:
    """An iterate of the barrier problem, and the steps from it.

    Attributes
    ----------
    point : the iterate.  mu : weight of the barrier.  sigma : of the objective; 0 where only the violation
        counts.
    x, s : its free variables and its slacks, each with the multipliers of its bounds.
    y, gone_y : multipliers of the rows left, and of those that are eliminated.
    elastic : what rows may be violated by; None: they are hard.
    row_multipliers (m,), bound_multipliers (n,), kkt : of the program, as of the last `take_multipliers`.
    """

    def __init__(
        self,
        program: TimedProgram,
        options: SQPOptions,
        point: Point,
        y: Vector,
        z: Vector,
        *,
        warm: bool,
        path: Path | None = None,
        determined: Sequence[Determined],
    ):
        """point : moved inside its bounds.  y (m,), z (n,) : multipliers to start from, if it is ``warm``.

        path : where they were left.
        """
        self.program, self.options, self.warm = program, options, warm
        self._at_once = warm and path is None and options.barrier_warm < _HIGH
        self.sigma = 1.0
        self.mu = options.barrier_warm if warm else options.barrier
        self.mu = self.mu if path is None else path.barrier
        self.elastic: Elastic | None = None
        p, x = program, point.x
        moves = p.x_upper - p.x_lower > 1e-12
        bounded = (np.isfinite(p.x_lower) | np.isfinite(p.x_upper)) & moves
        self.newton = acquire(
            point.jacobian,
            p.hessian(x, 1.0, np.zeros(p.m)),
            determined=determined,
            equal=p.g_lower == p.g_upper,
            bounded=bounded,
            moves=moves,
        )
        self._condenser = c = self.newton.condenser
        lower = np.concatenate([p.g_lower, p.x_lower[c.bounded]])
        upper = np.concatenate([p.g_upper, p.x_upper[c.bounded]])
        self._gone, everywhere = lower[c.eliminated], lower
        lower, upper = lower[c.rows], upper[c.rows]
        self._unequal, self._level = np.flatnonzero(lower < upper), lower[c.equal]
        push = options.push if path is None else _PUSH
        free = np.where(moves, p.x_lower, -np.inf)[c.free], np.where(moves, p.x_upper, np.inf)[c.free]
        kept = path is not None
        self.x = Bounded(x[c.free], *free, push=push, multipliers=z[c.free], mu=self.mu, kept=kept)
        x = x.copy()
        x[c.free] = self.x.values
        self.point = point = point if np.array_equal(x, point.x) else p.point(x)
        multipliers = np.concatenate([y, z[c.bounded]])
        self.y = multipliers[c.rows]
        self.gone_y = multipliers[c.eliminated]
        self.row_multipliers, self.bound_multipliers = y, z
        rows = self._unequal
        slacks = self._all(point)
        if path is not None:
            left = np.concatenate([path.rows, path.bounds[c.bounded]])
            least = np.where(np.isfinite(everywhere), everywhere, -np.inf) + _NEW
            slacks = np.where(np.isnan(left), np.maximum(slacks, least), left)
        self.s = Bounded(
            slacks[c.rows][rows],
            lower[rows],
            upper[rows],
            push=push,
            multipliers=self.y[rows],
            mu=self.mu,
            kept=kept,
        )
        if not warm:
            # without multipliers from before: one for each bound (section 3.6)
            for values in (self.x, self.s):
                values.below, values.above = np.sign(values.below), np.sign(values.above)

    def release(self) -> None:
        """Give the Newton system's structure back, for the next program that has it."""
        release(self.newton)

    def path(self) -> Path:
        """State, for a solve that goes on from there."""
        c, slacks, n = self._condenser, self._all(self.point), self.point.x.copy()
        slacks[c.rows[self._unequal]] = self.s.values
        m = self.program.m
        n[c.bounded] = slacks[m:]
        return Path(self.mu, slacks[:m], n)

    def _all(self, point: Point) -> Vector:
        """Values of the program's rows, and of the bounded eliminated variables."""
        return np.concatenate([point.g, point.x[self._condenser.bounded]])

    # ------------------------------------------------------------------ how far off it is
    def residual(self, point: Point, slack: Vector) -> Vector:
        """Residuals of the rows (m,): eliminated ones and equalities, and inequalities against their
        slacks."""
        out, c = self._all(point), self._condenser
        out[c.eliminated] -= self._gone
        out[c.rows[c.equal]] -= self._level
        out[c.rows[self._unequal]] -= slack
        return out

    def take_multipliers(self) -> None:
        """Multipliers of the program's rows and bounds, and the dual residual."""
        p, c, point = self.program, self._condenser, self.point
        everything = np.zeros(c.m)
        everything[c.rows], everything[c.eliminated] = self.y, self.gone_y
        y, z = everything[: p.m], np.zeros(p.n)
        z[c.free] = self.x.multiplier
        z[c.bounded] = everything[p.m :]
        dual = self.sigma * point.gradient + point.jacobian.T @ y + z
        # what does not move is stationary with whatever multiplier of its bound makes it so
        held = c.free[self.newton.held]
        z[held] -= dual[held]
        dual[held] = 0.0
        self.row_multipliers, self.bound_multipliers = y, z
        self._dual = float(np.abs(dual).max(initial=0.0))
        self.kkt = scaled_residual(dual + (1.0 - self.sigma) * point.gradient, y, z)

    def error(self, mu: float, residual: Vector) -> float:
        """The scaled error of the barrier problem (eq. 5), of the multipliers taken."""
        x, s, c = self.x, self.s, self._condenser
        bounds, count = x.total() + s.total(), max(1, x.bounds + s.bounds)
        if self.elastic is not None:  # two more bounds a row, whose multipliers add up to twice the price
            bounds, count = bounds + 2 * self.elastic.price * self.y.size, count + 2 * self.y.size
        rows = float(np.abs(self.y).sum() + np.abs(self.gone_y).sum())
        scale = max(_LARGE, (rows + bounds) / (c.m + count)) / _LARGE
        slack = float(np.abs(self.y[self._unequal] - s.multiplier).max(initial=0.0))
        off, left = max(x.off(mu), s.off(mu)), residual[c.rows]
        if self.elastic is not None:
            off, left = max(off, self.elastic.off(self.y, mu)), self.elastic.residual(left)
        violation = max(float(np.abs(v).max(initial=0.0)) for v in (left, residual[c.eliminated]))
        off /= max(_LARGE, bounds / count) / _LARGE  # s_c of eq. 6; `scale` is its s_d
        if not mu:  # in units of the one tolerance that all is compared with
            off *= self.options.kkt_tolerance / self.options.complementarity_tolerance
        return max(max(self._dual, slack) / scale, violation, off)

    def lower_barrier(self, residual: Vector) -> bool:
        """Let mu fall as far as the iterate is good enough for; whether it has."""
        tolerance, hard, before = self.options.complementarity_tolerance, self.elastic is None, self.mu
        close, power = (_CLOSE, _POWER) if hard else (_CLOSE_ELASTIC, _POWER_ELASTIC)
        if hard and self._at_once:
            close = _CLOSE_WARM
        while self.mu > _FINE * tolerance and self.error(self.mu, residual) <= close * self.mu:
            self.mu = max(_FINEST * tolerance, min(_FASTER * self.mu, self.mu**power))
        return self.mu != before

    def soften(self, residual: Vector, price: float) -> None:
        """Let rows be violated at a price, from now on."""
        self.elastic = Elastic(residual[self._condenser.rows], price, self.mu)
        self.y, self.gone_y = self.elastic.clip(self.y), np.zeros_like(self.gone_y)

    # ------------------------------------------------------------------ the Newton step
    def step(self, residual: Vector) -> Step | None:
        """The Newton step; None where its matrix cannot be factored."""
        point, hard = self.point, self.elastic is None
        found = self.newton.factor(
            point.jacobian,
            self.program.hessian(point.x, self.sigma, self.row_multipliers),
            self.x.stiffness(),
            self._weights,
            hard=hard,
            proximal=_PROXIMAL * self.mu if hard else 0.0,
        )
        return self.step_again(residual) if found else None

    def _weights(self, more: float) -> Vector:
        """Weights of the rows (k,), and their offsets: of the slacks' barrier, with more curvature, and of
        elastic rows.
        """
        soft, self._offsets = np.zeros(self._condenser.rows.size), np.zeros(self._condenser.rows.size)
        self._stiffness = self.s.stiffness() + more
        soft[self._unequal] = 1.0 / self._stiffness
        self._offsets[self._unequal] = self.s.slope(self.mu) / self._stiffness
        if self.elastic is not None:
            give, offset = self.elastic.compliance(self.y, self.mu)
            soft, self._offsets = soft + give, self._offsets + offset
        return np.divide(1.0, soft, out=np.zeros_like(soft), where=soft > 0.0)

    def step_again(self, residual: Vector) -> Step:
        """The step for another residual of the rows (m,); the matrix stays."""
        c = self._condenser
        q, r = self.sigma * self.point.gradient, residual.copy()
        q[c.free] += self.x.slope(self.mu)
        if self.elastic is not None:
            r[c.rows] = self.elastic.residual(r[c.rows])
        # A slack's own equation y = slope + stiffness ds, put into its constraint J d + r = ds, leaves
        # y = stiffness (J d + r + slope / stiffness): a weight and an offset, and no slack in the matrix.
        r[c.rows] += self._offsets
        d, everything = self.newton.solve(q, r, _LEFT * self.mu)
        y = everything[c.rows]
        slack = (y[self._unequal] - self.s.slope(self.mu)) / self._stiffness
        if self.elastic is not None:
            self.elastic.step(y, self.y, self.mu)
        return Step(d, d[c.free], slack, y, everything[c.eliminated])

    # ------------------------------------------------------------------ along a step
    @property
    def keep(self) -> float:
        """The part of a distance to a bound that a step may take, at most (tau, eq. 8)."""
        return max(0.99, 1.0 - self.mu)

    def longest(self, step: Step) -> float:
        """The longest part of a step, 1 at most, that `keep` allows."""
        keep = self.keep
        length = min(self.x.longest(step.free, keep), self.s.longest(step.slack, keep))
        return length if self.elastic is None else min(length, self.elastic.longest(keep))

    def progress(self, step: Step, residual: Vector) -> SearchStart:
        """Start of a search along a step."""
        mu, point = self.mu, self.point
        slope = float(
            self.sigma * (point.gradient @ step.d)
            + self.x.slope(mu) @ step.free
            + self.s.slope(mu) @ step.slack
        )
        phi = self._phi(point, self.s.values)
        if self.elastic is not None:
            slope, phi = slope + self.elastic.slope(mu), phi + self.elastic.now(mu)
        return SearchStart(theta=self._theta(residual), phi=phi, slope=slope)

    def _phi(self, point: Point, slack: Vector) -> float:
        """The barrier function, without what elastic rows add."""
        barriers = self.x.barrier(point.x[self._condenser.free]) + self.s.barrier(slack)
        return self.sigma * point.objective + self.mu * barriers

    def _theta(self, residual: Vector, excess: Vector | None = None) -> float:
        c = self._condenser
        rows = residual[c.rows]
        if self.elastic is not None:
            rows = self.elastic.residual(rows) if excess is None else rows - excess
        return float(np.abs(residual[c.eliminated]).sum() + np.abs(rows).sum())

    def trial(self, step: Step, length: float, slack: Vector | None = None) -> Trial:
        """The point after a part of a step; slack: those there, if not the step's."""
        point, mu = self.program.point(self.point.x + length * step.d), self.mu
        slack = self.s.values + length * step.slack if slack is None else slack
        if not point.finite:
            return Trial(point, slack, np.inf, np.inf)
        phi = self._phi(point, slack)
        excess = None
        if self.elastic is not None:
            p, n = self.elastic.moved(length)
            phi, excess = phi + self.elastic.cost(p, n, mu), p - n
        return Trial(point, slack, self._theta(self.residual(point, slack), excess), phi)

    def move(self, step: Step, trial: Trial, length: float) -> None:
        """Move to a trial point, and as far along the multipliers' steps as these allow."""
        x, s, mu, keep = self.x, self.s, self.mu, self.keep
        below_x, above_x, dual_x = x.dual_step(step.free, mu, keep)
        below_s, above_s, dual_s = s.dual_step(step.slack, mu, keep)
        # multipliers of constraints go as far as the variables do, those of bounds as they may (eq. 14)
        dual, part = min(dual_x, dual_s), length
        if self.elastic is not None:
            part = dual = min(dual, self.elastic.longest_dual(step.y, self.y, keep))
            self.elastic.take(length, self.residual(trial.point, trial.slack)[self._condenser.rows])
        self.y = self.y + part * (step.y - self.y)
        self.gone_y = self.gone_y + part * (step.gone - self.gone_y)
        x.move(trial.point.x[self._condenser.free], x.below + dual * below_x, x.above + dual * above_x, mu)
        s.move(trial.slack, s.below + dual * below_s, s.above + dual * above_s, mu)
        self.point = trial.point
