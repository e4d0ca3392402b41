"""Barrier problem: a program while mu keeps its variables off their bounds; elastic rows; the filter.

Rows are those that `Condenser` leaves; g - s = 0 for an inequality row with its slack s. Here are its
residual, its error, its barrier function, the Newton step and what a part of that leads to. Which step is
taken is the line search's business, when rows may be violated that of the elastic phase (`interior_point`).
An elastic row = p - n with p, n >= 0 under the barrier, and price (p + n) in the objective.

Source: Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, Mathematical Programming 106, 2006; equation numbers are that paper's.
Elastic rows: section 3.3.1, whose restoration phase does this without the objective; the filter: section 2.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from impactopt.solvers.ipm.newton import acquire, release
from impactopt.solvers.options import IPMOptions
from impactopt.solvers.program import Determined, Point, TimedProgram, Vector, scaled_residual
from impactopt.solvers.run import Path

_SAFEGUARD = 1e10  # multipliers stay within this factor of mu / distance (eq. 16)


class Bounded:
    """Values v (k,) strictly between bounds, which may be infinite.

    Attributes
    ----------
    values : v.
    below, above : multipliers of the lower and the upper bound, 0 where there is none.
    """

    def __init__(
        self,
        values: Vector,
        lower: Vector,
        upper: Vector,
        *,
        push: float,
        multipliers: Vector,
        mu: float,
        kept: bool = False,
    ):
        """values : moved inside by `push`, relative to the bound and to the room between both (section 3.6).

        multipliers (k,) : positive at the upper bound, negative at the lower; each gets mu / distance at
        least.  kept : only where it has none.
        """
        # 1 where there is a bound, else 0; and the bound, else 0
        self._has_lower, self._has_upper = np.isfinite(lower).astype(float), np.isfinite(upper).astype(float)
        self._lower = np.where(self._has_lower > 0, lower, 0.0)
        self._upper = np.where(self._has_upper > 0, upper, 0.0)
        self._take(self._inside(values, push))
        low, high = mu / self._to_lower, mu / self._to_upper
        if kept:
            low, high = np.where(multipliers < 0, 0.0, low), np.where(multipliers > 0, 0.0, high)
        self.below = self._has_lower * np.maximum(-multipliers, low)
        self.above = self._has_upper * np.maximum(multipliers, high)

    def _take(self, values: Vector) -> None:
        self.values = values
        self._to_lower, self._to_upper = self._distances(values)

    def _inside(self, values: Vector, push: float) -> Vector:
        has_lower, has_upper, low, high = self._has_lower > 0, self._has_upper > 0, self._lower, self._upper
        room = np.where(has_lower & has_upper, push * (high - low), np.inf)
        least = low + np.minimum(push * np.maximum(1.0, np.abs(low)), room)
        most = high - np.minimum(push * np.maximum(1.0, np.abs(high)), room)
        return np.clip(values, np.where(has_lower, least, -np.inf), np.where(has_upper, most, np.inf))

    def _distances(self, values: Vector) -> tuple[Vector, Vector]:
        """Distances to both bounds; 1 where there is none."""
        return (
            self._has_lower * (values - self._lower) + (1.0 - self._has_lower),
            self._has_upper * (self._upper - values) + (1.0 - self._has_upper),
        )

    @property
    def multiplier(self) -> Vector:
        """Multipliers of both bounds together: positive where the upper one holds."""
        return self.above - self.below

    @property
    def bounds(self) -> int:
        """Number of finite bounds."""
        return int(self._has_lower.sum() + self._has_upper.sum())

    def total(self) -> float:
        """Sum of the multipliers."""
        return float(self.below.sum() + self.above.sum())

    def barrier(self, values: Vector) -> float:
        """- sum of the logarithms of the distances to the bounds."""
        low, high = self._distances(values)
        if low.min(initial=1.0) <= 0.0 or high.min(initial=1.0) <= 0.0:
            return np.inf
        return -float(np.log(low).sum() + np.log(high).sum())

    def slope(self, mu: float) -> Vector:
        """Gradient of mu times the barrier."""
        out: Vector = mu * (self._has_upper / self._to_upper - self._has_lower / self._to_lower)
        return out

    def stiffness(self) -> Vector:
        """Part that the multipliers add to the Hessian's diagonal (eq. 13)."""
        return self.below / self._to_lower + self.above / self._to_upper

    def off(self, mu: float) -> float:
        """Largest |multiplier x distance - mu|."""
        gaps = (
            self.below * self._to_lower - mu * self._has_lower,
            self.above * self._to_upper - mu * self._has_upper,
        )
        return max(float(np.abs(g).max(initial=0.0)) for g in gaps)

    def longest(self, step: Vector, keep: float) -> float:
        """The longest part <= 1 of a step that leaves 1 - keep of every distance (eq. 15a)."""
        return min(
            longest(self._to_lower, self._has_lower * step, keep),
            longest(self._to_upper, -self._has_upper * step, keep),
        )

    def short_of_bounds(self, values: Vector, keep: float) -> Vector:
        """New values, each moved to where it takes no more than a part `keep` of its distance to a bound."""
        least = np.where(self._has_lower > 0, self.values - keep * self._to_lower, -np.inf)
        most = np.where(self._has_upper > 0, self.values + keep * self._to_upper, np.inf)
        return np.clip(values, least, most)

    def dual_step(self, step: Vector, mu: float, keep: float) -> tuple[Vector, Vector, float]:
        """Both multipliers' steps for a step of the values, eq. 12, and the longest part of them, eq. 15b."""
        below = (mu * self._has_lower - self.below * step) / self._to_lower - self.below
        above = (mu * self._has_upper + self.above * step) / self._to_upper - self.above
        return below, above, min(longest(self.below, below, keep), longest(self.above, above, keep))

    def move(self, values: Vector, below: Vector, above: Vector, mu: float) -> None:
        """Take new values, and multipliers kept near mu / distance."""
        self._take(values)
        low, high = mu / self._to_lower, mu / self._to_upper
        self.below = self._has_lower * np.clip(below, low / _SAFEGUARD, low * _SAFEGUARD)
        self.above = self._has_upper * np.clip(above, high / _SAFEGUARD, high * _SAFEGUARD)


def longest(room: Vector, step: Vector, keep: float) -> float:
    """The longest part <= 1 of a step that leaves 1 - keep of the room that it shrinks."""
    shrinks = step < 0.0
    return min(1.0, float((keep * room[shrinks] / -step[shrinks]).min(initial=1.0)))


_LEAST = 1e-14  # of the price: no multiplier is nearer to it


class Elastic:
    """Excess p and lack n of all rows (k,), eliminated from the Newton system.

    Attributes
    ----------
    price : of a unit of violation; multipliers y stay below it.
    """

    def __init__(self, residual: Vector, price: float, mu: float):
        """residual (k,) of the rows."""
        self.price = price
        # on the central path for p - n = residual (eq. 33)
        half = (mu - self.price * residual) / (2.0 * self.price)
        root = np.sqrt(half**2 + mu * residual / (2.0 * self.price))
        with np.errstate(divide="ignore", invalid="ignore"):  # two forms, each where it does not cancel
            low = np.where(half > 0, half + root, -mu * residual / (2.0 * self.price) / (half - root))
        self._n = np.maximum(low, mu / (2e3 * self.price))
        self._p = np.maximum(residual + self._n, mu / (2e3 * self.price))

    def clip(self, y: Vector) -> Vector:
        """Multipliers moved strictly inside the price."""
        return np.clip(y, -0.9 * self.price, 0.9 * self.price)

    def residual(self, residual: Vector) -> Vector:
        """Part of a residual that is neither excess nor lack."""
        return residual - self._p + self._n

    def largest(self) -> float:
        """The largest violation of a row."""
        return float(np.abs(self._p - self._n).max(initial=0.0))

    def compliance(self, y: Vector, mu: float) -> tuple[Vector, Vector]:
        """Compliance of a row per unit of multiplier, and the offset that goes with it."""
        # p (price - y) = mu and n (price + y) = mu, linearized, give the steps of p and n as in `step`. Put
        # into J d + r = (p + dp) - (n + dn), they leave J d + (r - p + n) + offset = give y_new.
        zp, zn = self._below_price(y)
        give = self._p / zp + self._n / zn
        return give, give * y - (mu / zp - self._p) + (mu / zn - self._n)

    def _below_price(self, y: Vector) -> tuple[Vector, Vector]:
        """Distance of the multipliers below the price, and above its opposite: more than rounding."""
        least = _LEAST * self.price
        return np.maximum(self.price - y, least), np.maximum(self.price + y, least)

    def step(self, new: Vector, y: Vector, mu: float) -> None:
        """Find the steps of p and n for new multipliers."""
        dy, (zp, zn) = new - y, self._below_price(y)
        self._dp = (mu - self._p * zp + self._p * dy) / zp
        self._dn = (mu - self._n * zn - self._n * dy) / zn

    def longest(self, keep: float) -> float:
        """The longest part <= 1 of the steps of p and n that keeps them positive."""
        return min(longest(self._p, self._dp, keep), longest(self._n, self._dn, keep))

    def longest_dual(self, new: Vector, y: Vector, keep: float) -> float:
        """The longest part <= 1 of the multipliers' step that keeps them below the price."""
        return min(longest(self.price - y, y - new, keep), longest(self.price + y, new - y, keep))

    def moved(self, length: float) -> tuple[Vector, Vector]:
        """p and n after a part of their steps."""
        return self._p + length * self._dp, self._n + length * self._dn

    def cost(self, p: Vector, n: Vector, mu: float) -> float:
        """Part that p and n add to the barrier function."""
        return float(self.price * (p + n).sum() - mu * (np.log(p).sum() + np.log(n).sum()))

    def now(self, mu: float) -> float:
        """Part that they add now."""
        return self.cost(self._p, self._n, mu)

    def slope(self, mu: float) -> float:
        """Its slope along the steps."""
        return float((self.price - mu / self._p) @ self._dp + (self.price - mu / self._n) @ self._dn)

    def take(self, length: float, residual: Vector) -> None:
        """Move p and n; the larger of the two makes up for what is left of the residual there."""
        p, n = self.moved(length)
        left = residual - (p - n)
        least = 1e-3 * np.minimum(p, n)
        self._p = np.where(p >= n, np.maximum(p + left, least), p)
        self._n = np.where(p >= n, n, np.maximum(n - left, least))

    def off(self, y: Vector, mu: float) -> float:
        """Largest |multiplier x p - mu|, and likewise of n."""
        gaps = np.abs(self._p * (self.price - y) - mu), np.abs(self._n * (self.price + y) - mu)
        return max(float(g.max(initial=0.0)) for g in gaps)


_VIOLATION, _OBJECTIVE = 1e-5, 1e-8  # gamma_theta, gamma_phi of eq. 18
_ARMIJO, _SWITCH, _VIOLATION_POWER, _SLOPE_POWER = 1e-8, 1.0, 1.1, 2.3  # eta, delta, s_theta, s_phi
_SHORTEST = 0.05  # gamma_alpha of eq. 23


@dataclass(frozen=True, kw_only=True)
class SearchStart:
    """Start of a line search: violation theta, barrier function phi and its slope along the step."""

    theta: float
    phi: float
    slope: float

    def switches(self, length: float) -> bool:
        """True if a step of that length is to lessen phi rather than theta (eq. 19)."""
        return (
            self.slope < 0.0
            and length * (-self.slope) ** _SLOPE_POWER > _SWITCH * self.theta**_VIOLATION_POWER
        )

    def falls(self, length: float, phi: float) -> bool:
        """True if phi falls as its slope lets expect: Armijo's condition, eq. 20, but for rounding."""
        return phi <= self.phi + _ARMIJO * length * self.slope + 1e-13 * abs(self.phi)


@dataclass
class Filter:
    """Pairs (theta, phi) that no later point may be worse than in both."""

    least: float
    most: float
    pairs: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def around(cls, theta: float) -> Filter:
        """A filter for a run that starts with this violation (section 3.3)."""
        return cls(least=1e-4 * max(1.0, theta), most=1e4 * max(1.0, theta))

    def shortest(self, at: SearchStart) -> float:
        """The length below which no step will do (eq. 23)."""
        length = _VIOLATION
        if at.slope < 0.0:
            length = min(length, _OBJECTIVE * at.theta / -at.slope)
            if at.theta <= self.least:
                length = min(length, _SWITCH * at.theta**_VIOLATION_POWER / (-at.slope) ** _SLOPE_POWER)
        return max(_SHORTEST * length, 1e-14)

    def accepts(self, at: SearchStart, length: float, theta: float, phi: float) -> bool:
        """True if a trial point is taken (steps A-5.3 and A-5.4)."""
        if not (np.isfinite(theta) and np.isfinite(phi)) or theta > self.most:
            return False
        if any(theta >= t and phi >= p for t, p in self.pairs):
            return False
        # Where a step is to lessen phi, a little less violation is not enough: the iterates would go to a
        # feasible point that is no optimum.
        if at.theta <= self.least and at.switches(length):
            return at.falls(length, phi)
        return theta <= (1.0 - _VIOLATION) * at.theta or phi <= at.phi - _OBJECTIVE * at.theta

    def remember(self, at: SearchStart, length: float, phi: float) -> None:
        """Augment the filter, but after a step for phi's sake (eq. 22)."""
        if at.switches(length) and at.falls(length, phi):
            return
        pair = (1.0 - _VIOLATION) * at.theta, at.phi - _OBJECTIVE * at.theta
        self.pairs = [(t, p) for t, p in self.pairs if t < pair[0] or p < pair[1]] + [pair]


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
        options: IPMOptions,
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
        if warm and path is None:  # where multipliers of order one have it
            push = min(push, self.mu)
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
