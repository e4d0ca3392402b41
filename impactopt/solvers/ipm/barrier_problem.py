"""Barrier problem of the interior-point method: its iterate, error, Newton step and trial points; the filter.

The barrier problem is the program with logarithmic barriers, of weight mu, in place of bounds. An inequality
g becomes g - s = 0 with a bounded slack s. Its constraints are those that `Condenser` leaves. The line search
and the elastic phase, which decide on steps and on violations, are in `interior_point`.

An elastic constraint is g - s = p - n with p, n >= 0 under the barrier, and price (p + n) in the objective.

Source: Waechter and Biegler, On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming, Mathematical Programming 106, 2006; equation numbers are that paper's.
Elastic constraints: section 3.3.1, whose restoration phase has them without the objective; the filter:
section 2.3.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from impactopt.solvers.ipm.newton import acquire, release
from impactopt.solvers.options import IPMOptions
from impactopt.solvers.program import Determined, Matrix, Point, TimedProgram, Vector, scaled_residual
from impactopt.solvers.run import BarrierState

_KAPPA_SIGMA = 1e10  # multipliers of bounds stay within this factor of mu / distance (eq. 16)


class Bounded:
    """Values v (k,) strictly between bounds, which may be infinite, and the multipliers of these bounds.

    Attributes
    ----------
    values : v.
    below, above : multipliers of the lower and the upper bound, >= 0; 0 if there is no bound.
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
        """values : moved inside by `push`, relative to the bound and to the distance of both (section 3.6).

        multipliers (k,) : positive at the upper bound, negative at the lower; each gets mu / distance at
        least.  kept : only if it is zero there.
        """
        # 1 where there is a bound, else 0; and the bound, else 0: arithmetic instead of masks
        self._has_lower, self._has_upper = np.isfinite(lower).astype(float), np.isfinite(upper).astype(float)
        self._lower = np.where(self._has_lower > 0, lower, 0.0)
        self._upper = np.where(self._has_upper > 0, upper, 0.0)
        self._set(self._pushed_inside(values, push))
        # Given multipliers are those of both bounds together, so one side of each value has none: it gets mu
        # / distance, the value on the central path, as a multiplier of 0 would leave the barrier (eq. 15b).
        low, high = mu / self._to_lower, mu / self._to_upper
        if kept:
            low, high = np.where(multipliers < 0, 0.0, low), np.where(multipliers > 0, 0.0, high)
        self.below = self._has_lower * np.maximum(-multipliers, low)
        self.above = self._has_upper * np.maximum(multipliers, high)

    def _set(self, values: Vector) -> None:
        self.values = values
        self._to_lower, self._to_upper = self._distances(values)

    def _pushed_inside(self, values: Vector, push: float) -> Vector:
        has_lower, has_upper, low, high = self._has_lower > 0, self._has_upper > 0, self._lower, self._upper
        # min(kappa_1 max(1, |bound|), kappa_2 (upper - lower)) of section 3.6, with kappa_1 = kappa_2 = push;
        # but kappa_2 is one half at most, as both limits would else cross.
        room = np.where(has_lower & has_upper, min(push, 0.5) * (high - low), np.inf)
        least = low + np.minimum(push * np.maximum(1.0, np.abs(low)), room)
        most = high - np.minimum(push * np.maximum(1.0, np.abs(high)), room)
        return np.clip(values, np.where(has_lower, least, -np.inf), np.where(has_upper, most, np.inf))

    def _distances(self, values: Vector) -> tuple[Vector, Vector]:
        """Distances to both bounds; 1 where there is none, whose logarithm is 0."""
        return (
            self._has_lower * (values - self._lower) + (1.0 - self._has_lower),
            self._has_upper * (self._upper - values) + (1.0 - self._has_upper),
        )

    @property
    def multiplier(self) -> Vector:
        """Multipliers of both bounds together: positive if the upper one is active."""
        return self.above - self.below

    @property
    def bounds(self) -> int:
        """Number of finite bounds."""
        return int(self._has_lower.sum() + self._has_upper.sum())

    def total(self) -> float:
        """Sum of the multipliers."""
        return float(self.below.sum() + self.above.sum())

    def barrier(self, values: Vector) -> float:
        """- sum of the logarithms of the distances to the bounds; inf outside."""
        low, high = self._distances(values)
        if low.min(initial=1.0) <= 0.0 or high.min(initial=1.0) <= 0.0:
            return np.inf
        return -float(np.log(low).sum() + np.log(high).sum())

    def barrier_gradient(self, mu: float) -> Vector:
        """Gradient of mu times the barrier."""
        out: Vector = mu * (self._has_upper / self._to_upper - self._has_lower / self._to_lower)
        return out

    def hessian_diagonal(self) -> Vector:
        """Sigma of eq. 13, multiplier over distance: the diagonal that the bounds add to the Hessian."""
        return self.below / self._to_lower + self.above / self._to_upper

    def complementarity_error(self, mu: float) -> float:
        """Largest |multiplier x distance - mu|."""
        gaps = (
            self.below * self._to_lower - mu * self._has_lower,
            self.above * self._to_upper - mu * self._has_upper,
        )
        return max(float(np.abs(g).max(initial=0.0)) for g in gaps)

    def max_length(self, step: Vector, tau: float) -> float:
        """Largest step length <= 1 that leaves 1 - tau of every distance (eq. 15a)."""
        return min(
            # Where there is no bound the step counts as 0, which shortens nothing.
            fraction_to_boundary(self._to_lower, self._has_lower * step, tau),
            fraction_to_boundary(self._to_upper, -self._has_upper * step, tau),
        )

    def clipped(self, values: Vector, fraction: float) -> Vector:
        """New values, each clipped so that it uses at most a fraction of its present distance to a bound."""
        least = np.where(self._has_lower > 0, self.values - fraction * self._to_lower, -np.inf)
        most = np.where(self._has_upper > 0, self.values + fraction * self._to_upper, np.inf)
        return np.clip(values, least, most)

    def dual_step(self, step: Vector, mu: float, tau: float) -> tuple[Vector, Vector, float]:
        """Steps of both multipliers for a step of the values (eq. 12), and their largest length (eq. 15b)."""
        # multiplier x distance = mu, linearized; a step adds to the distance below and takes from that above.
        below = (mu * self._has_lower - self.below * step) / self._to_lower - self.below
        above = (mu * self._has_upper + self.above * step) / self._to_upper - self.above
        length = min(
            fraction_to_boundary(self.below, below, tau), fraction_to_boundary(self.above, above, tau)
        )
        return below, above, length

    def move(self, values: Vector, below: Vector, above: Vector, mu: float) -> None:
        """Take new values and multipliers; these are kept near mu / distance (eq. 16)."""
        self._set(values)
        # Otherwise Sigma could be arbitrarily far from the barrier's own Hessian, mu / distance^2, on which
        # the paper's proof of convergence rests.
        low, high = mu / self._to_lower, mu / self._to_upper
        self.below = self._has_lower * np.clip(below, low / _KAPPA_SIGMA, low * _KAPPA_SIGMA)
        self.above = self._has_upper * np.clip(above, high / _KAPPA_SIGMA, high * _KAPPA_SIGMA)


def fraction_to_boundary(distance: Vector, step: Vector, tau: float) -> float:
    """Largest step length <= 1 that uses at most the fraction tau of each distance (eq. 15)."""
    shrinks = step < 0.0
    return min(1.0, float((tau * distance[shrinks] / -step[shrinks]).min(initial=1.0)))


_MIN_PRICE_DISTANCE = 1e-14  # relative to the price; multipliers this near to it differ by rounding only


class Elastic:
    """Excess p and shortfall n of all constraints (k,); the Newton system does not contain them.

    Attributes
    ----------
    price : of a unit of violation; multipliers y stay below it.
    """

    def __init__(self, residual: Vector, price: float, mu: float):
        """residual (k,) of the constraints: p - n."""
        self.price = price
        # The multipliers of p >= 0 and n >= 0 are price - y and price + y
        # (stationarity), so they are not stored.
        # p and n minimize the barrier problem for p - n = residual (eq. 33)
        half = (mu - self.price * residual) / (2.0 * self.price)
        root = np.sqrt(half**2 + mu * residual / (2.0 * self.price))
        with np.errstate(divide="ignore", invalid="ignore"):  # two forms, each where it does not cancel
            low = np.where(half > 0, half + root, -mu * residual / (2.0 * self.price) / (half - root))
        # n (price + y) = mu with y < price makes n > mu / (2 price): a thousandth of
        # that only catches rounding.
        self._n = np.maximum(low, mu / (2e3 * self.price))
        self._p = np.maximum(residual + self._n, mu / (2e3 * self.price))

    def clip(self, y: Vector) -> Vector:
        """Multipliers moved strictly inside (-price, price)."""
        # At +-price p or n would be infinite: their products with price -+ y are mu.
        return np.clip(y, -0.9 * self.price, 0.9 * self.price)

    def residual(self, residual: Vector) -> Vector:
        """Residual of the elastic constraints: that of the hard ones without p - n."""
        return residual - self._p + self._n

    def max_violation(self) -> float:
        """Largest violation of a constraint."""
        return float(np.abs(self._p - self._n).max(initial=0.0))

    def compliance(self, y: Vector, mu: float) -> tuple[Vector, Vector]:
        """Compliance of each constraint, per unit of multiplier, and the offset that goes with it."""
        # p (price - y) = mu and n (price + y) = mu, linearized, give the steps of p and n as in `set_step`.
        # Put into J d + r = (p + dp) - (n + dn), they leave J d + (r - p + n) + offset = compliance y_new.
        zp, zn = self._price_distances(y)
        compliance = self._p / zp + self._n / zn
        return compliance, compliance * y - (mu / zp - self._p) + (mu / zn - self._n)

    def _price_distances(self, y: Vector) -> tuple[Vector, Vector]:
        """Distance of the multipliers from the price and from -price; more than rounding."""
        least = _MIN_PRICE_DISTANCE * self.price
        return np.maximum(self.price - y, least), np.maximum(self.price + y, least)

    def set_step(self, y_new: Vector, y: Vector, mu: float) -> None:
        """Compute the steps of p and n for new multipliers."""
        dy, (zp, zn) = y_new - y, self._price_distances(y)
        self._dp = (mu - self._p * zp + self._p * dy) / zp
        self._dn = (mu - self._n * zn - self._n * dy) / zn

    def max_length(self, tau: float) -> float:
        """Largest length <= 1 of the steps of p and n that keeps them positive."""
        return min(fraction_to_boundary(self._p, self._dp, tau), fraction_to_boundary(self._n, self._dn, tau))

    def max_dual_length(self, y_new: Vector, y: Vector, tau: float) -> float:
        """Largest length <= 1 of the multipliers' step that keeps them below the price."""
        return min(
            fraction_to_boundary(self.price - y, y - y_new, tau),
            fraction_to_boundary(self.price + y, y_new - y, tau),
        )

    def after(self, length: float) -> tuple[Vector, Vector]:
        """p and n after a step of this length."""
        return self._p + length * self._dp, self._n + length * self._dn

    def cost(self, p: Vector, n: Vector, mu: float) -> float:
        """Contribution of p and n to the barrier function."""
        return float(self.price * (p + n).sum() - mu * (np.log(p).sum() + np.log(n).sum()))

    def current_cost(self, mu: float) -> float:
        """`cost` of the present p and n."""
        return self.cost(self._p, self._n, mu)

    def cost_slope(self, mu: float) -> float:
        """Slope of `cost` along the steps."""
        return float((self.price - mu / self._p) @ self._dp + (self.price - mu / self._n) @ self._dn)

    def move(self, length: float, residual: Vector) -> None:
        """Move p and n; the larger of the two then takes up the rest of the new residual."""
        # The new residual is not the linearized one. If p - n took up none of the rest, it would count as a
        # residual, and a step would be spent on it; the smaller of the two stays, as its barrier is steep.
        p, n = self.after(length)
        rest = residual - (p - n)
        least = 1e-3 * np.minimum(p, n)
        self._p = np.where(p >= n, np.maximum(p + rest, least), p)
        self._n = np.where(p >= n, n, np.maximum(n - rest, least))

    def complementarity_error(self, y: Vector, mu: float) -> float:
        """Largest |p (price - y) - mu| or |n (price + y) - mu|."""
        gaps = np.abs(self._p * (self.price - y) - mu), np.abs(self._n * (self.price + y) - mu)
        return max(float(g.max(initial=0.0)) for g in gaps)


# Constants of the line search: the paper's names, IPOPT's default values.
_GAMMA_THETA, _GAMMA_PHI = 1e-5, 1e-8  # eq. 18: sufficient progress in violation, in the barrier function
_ETA_PHI, _DELTA, _S_THETA, _S_PHI = 1e-8, 1.0, 1.1, 2.3  # eq. 19 and 20
_GAMMA_ALPHA = 0.05  # eq. 23


@dataclass(frozen=True, kw_only=True)
class SearchStart:
    """Violation theta, barrier function phi, and its slope along the step, where a line search starts."""

    theta: float
    phi: float
    slope: float

    def favors_objective(self, length: float) -> bool:
        """Switching condition, eq. 19: a step of this length is to reduce phi rather than theta."""
        return self.slope < 0.0 and length * (-self.slope) ** _S_PHI > _DELTA * self.theta**_S_THETA

    def is_sufficient_decrease(self, length: float, phi: float) -> bool:
        """Armijo's condition, eq. 20, with an allowance for rounding."""
        return phi <= self.phi + _ETA_PHI * length * self.slope + 1e-13 * abs(self.phi)


@dataclass
class Filter:
    """Pairs (theta, phi); a later point has to be better than each of them in one of the two.

    theta_min : largest violation of an iterate from which a step may be for the objective.
    theta_max : largest violation of a point.
    """

    theta_min: float
    theta_max: float
    pairs: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def from_violation(cls, theta: float, max_growth: float) -> Filter:
        """Empty filter for iterates from a point with this violation (section 3.3).

        max_growth : largest violation of a point, relative to that of the first, or to 1; the paper's: 1e4.
        """
        return cls(theta_min=1e-4 * max(1.0, theta), theta_max=max_growth * max(1.0, theta))

    def min_length(self, start: SearchStart) -> float:
        """Step length below which no acceptable point is expected (eq. 23)."""
        # From a feasible start eq. 23 gives 0, with which halving would not end: 1e-14 at least.
        length = _GAMMA_THETA
        if start.slope < 0.0:
            length = min(length, _GAMMA_PHI * start.theta / -start.slope)
            if start.theta <= self.theta_min:
                length = min(length, _DELTA * start.theta**_S_THETA / (-start.slope) ** _S_PHI)
        return max(_GAMMA_ALPHA * length, 1e-14)

    def accepts(self, start: SearchStart, length: float, theta: float, phi: float) -> bool:
        """True if a trial point is acceptable (steps A-5.3 and A-5.4)."""
        # theta_max is what the paper's filter initially contains (eq. 21). The pairs have
        # their margins (`augment`).
        if not (np.isfinite(theta) and np.isfinite(phi)) or theta > self.theta_max:
            return False
        if any(theta >= t and phi >= p for t, p in self.pairs):
            return False
        # If a step is to reduce phi, a little less violation is not enough: the iterates could converge to a
        # feasible point that is no optimum.
        if start.theta <= self.theta_min and start.favors_objective(length):
            return start.is_sufficient_decrease(length, phi)
        return theta <= (1.0 - _GAMMA_THETA) * start.theta or phi <= start.phi - _GAMMA_PHI * start.theta

    def augment(self, start: SearchStart, length: float, phi: float) -> None:
        """Add the pair of a search's start, unless its step reduced the objective (eq. 22)."""
        if start.favors_objective(length) and start.is_sufficient_decrease(length, phi):
            return
        pair = (1.0 - _GAMMA_THETA) * start.theta, start.phi - _GAMMA_PHI * start.theta
        self.pairs = [(t, p) for t, p in self.pairs if t < pair[0] or p < pair[1]] + [pair]


# The barrier is lowered as soon as the barrier problem's error is below kappa_epsilon mu, to
# min(kappa_mu mu, mu^theta_mu) (eq. 7). The paper has 0.2, 10, 1.5. Ours lets mu fall more gently, from
# barrier problems that are solved more loosely (fewer iterations, with the proximal term below): nailing
# takes 89, and 207 to another optimum with the paper's values; six other plans take 368 and 367 together.
_KAPPA_MU, _KAPPA_EPSILON, _THETA_MU = 0.2, 30.0, 1.3
# With given multipliers the iterate is near a solution, so mu falls at once. It is not as near if the initial
# barrier is at least this; then the iterates follow the central path as usual.
_KAPPA_EPSILON_WARM, _MIN_BARRIER_OF_PATH = 1e4, 5e-3
# The paper's values: elastic constraints have to show that no point meets them.
_KAPPA_EPSILON_ELASTIC, _THETA_MU_ELASTIC = 10.0, 1.5
# Times complementarity_tolerance: mu is lowered while it is above the first, and to the second at least.
_SUFFICIENT_BARRIER, _MIN_BARRIER = 0.6, 0.3
# Times mu: weight of the step's own square, |d|^2 / 2. Without it, directions that the objective does not
# determine (an idle arm) wander towards bounds: seven plans take a seventh less iterations, but two of them
# end in worse optima (punch: 13.75 for 13.86 N s). With ten times the weight nailing takes 214 for 89.
_PROXIMAL = 1.0
_NEWTON_TOLERANCE = 0.1  # times mu: largest residual of a Newton step's equations
_PUSH_CONTINUED = 1e-9  # into bounds, if an earlier solve is continued: its iterate is inside them already
_MIN_NEW_SLACK = 1e-3  # distance to the lower bound, of a constraint that the earlier solve did not have
_MIN_STIFFNESS = 1e-300  # of slacks without bounds, which would have none while constraints are elastic
_S_MAX = 100.0  # mean multiplier beyond which errors are scaled (eq. 5 and 6)


@dataclass
class Step:
    """Step d (n,) of all variables, with the free (f,) and the slacks' (i,) parts.

    y : new multipliers of the constraints that remain.  eliminated_y : of the eliminated ones.
    end : free variables and slacks at the step's end, with the multipliers of their bounds, if it leads to a
        QP's solution; None for a Newton step, along which these multipliers follow linearly.
    """

    d: Vector
    free: Vector
    slack: Vector
    y: Vector
    eliminated_y: Vector
    end: tuple[Bounded, Bounded] | None = None


@dataclass
class Trial:
    """A trial point, with its slacks, violation theta and barrier function phi."""

    point: Point
    slack: Vector
    theta: float
    phi: float


class QuadraticModel:
    """QP of a program at a point, as a `NonlinearProgram` with the same variables and patterns.

    The Hessian is that of the Lagrangian, and the constraints are linearized.
    """

    def __init__(self, program: TimedProgram, at: Point, hessian: Matrix):
        """hessian (n, n) : of the Lagrangian at the point."""
        self.n, self.m = program.n, program.m
        self.x_lower, self.x_upper = program.x_lower, program.x_upper
        self.g_lower, self.g_upper = program.g_lower, program.g_upper
        self.constraint_name, self.variable_name = program.constraint_name, program.variable_name
        self._at, self._hessian = at, hessian

    def objective(self, x: Vector) -> float:
        d = x - self._at.x
        return self._at.objective + float(self._at.gradient @ d + 0.5 * d @ (self._hessian @ d))

    def gradient(self, x: Vector) -> Vector:
        return np.asarray(self._at.gradient + self._hessian @ (x - self._at.x))

    def constraints(self, x: Vector) -> Vector:
        return np.asarray(self._at.g + self._at.jacobian @ (x - self._at.x))

    def jacobian(self, _x: Vector) -> Matrix:
        return self._at.jacobian

    def hessian(self, _x: Vector, sigma: float, _multipliers: Vector) -> Matrix:
        return sigma * self._hessian


class BarrierProblem:
    """Barrier problem at an iterate, and its Newton step.

    Attributes
    ----------
    point : the iterate.  mu : weight of the barrier.  sigma : of the objective; 0 if the violation is
        minimized alone.
    x, s : free variables and slacks, each with the multipliers of its bounds.
    y, eliminated_y : multipliers of the constraints that remain, and of the eliminated ones.
    elastic : excess and shortfall of the constraints; None if they are hard.
    constraint_multipliers (m,), bound_multipliers (n,), kkt : of the program, as of the last
        `update_multipliers`.
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
        state: BarrierState | None = None,
        determined: Sequence[Determined],
    ):
        """point : is moved inside its bounds.  y (m,), z (n,) : initial multipliers, if it is ``warm``.

        state : the state of an earlier solve, to be continued.
        """
        self.program, self.options = program, options
        self._lower_at_once = warm and state is None and options.barrier_warm < _MIN_BARRIER_OF_PATH
        self.sigma = 1.0
        self.mu = options.barrier_warm if warm else options.barrier
        self.mu = self.mu if state is None else state.barrier
        self.elastic: Elastic | None = None
        p, x = program, point.x
        # Between equal bounds there is no interior, and no barrier; such variables are
        # fixed in the Newton system.
        moves = p.x_upper - p.x_lower > 1e-12
        bounded = (np.isfinite(p.x_lower) | np.isfinite(p.x_upper)) & moves
        self.newton = acquire(
            point.jacobian,
            # Only its pattern matters here.
            p.hessian(x, 1.0, np.zeros(p.m)),
            determined=determined,
            equal=p.g_lower == p.g_upper,
            bounded=bounded,
            moves=moves,
        )
        self._condenser = c = self.newton.condenser
        # all constraints of the condensed problem: the program's (m,), then bounds of eliminated variables
        all_lower = np.concatenate([p.g_lower, p.x_lower[c.bounded]])
        all_upper = np.concatenate([p.g_upper, p.x_upper[c.bounded]])
        lower, upper = all_lower[c.remaining], all_upper[c.remaining]
        self._eliminated_level, self._equal_level = all_lower[c.eliminated], lower[c.equal]
        self._unequal = np.flatnonzero(lower < upper)  # into c.remaining: those with a slack
        push = options.push if state is None else _PUSH_CONTINUED
        if warm and state is None:
            # mu is the slack of a bound whose multiplier is one: moving farther violates constraints
            push = min(push, options.push_warm * self.mu)
        free = np.where(moves, p.x_lower, -np.inf)[c.free], np.where(moves, p.x_upper, np.inf)[c.free]
        kept = state is not None
        self.x = Bounded(x[c.free], *free, push=push, multipliers=z[c.free], mu=self.mu, kept=kept)
        x = x.copy()
        x[c.free] = self.x.values
        # Moving inside the bounds costs an evaluation; a continued solve is inside already.
        self.point = point = point if np.array_equal(x, point.x) else p.point(x)
        multipliers = np.concatenate([y, z[c.bounded]])
        self.y = multipliers[c.remaining]
        self.eliminated_y = multipliers[c.eliminated]
        self.constraint_multipliers, self.bound_multipliers = y, z
        # Slacks begin at the constraints' values, so that g - s = 0 but for those
        # that have to be moved inside.
        slacks = self._values(point)
        if state is not None:
            saved = np.concatenate([state.constraints, state.variables[c.bounded]])
            slacks = np.where(np.isnan(saved), np.maximum(slacks, all_lower + _MIN_NEW_SLACK), saved)
        self.s = Bounded(
            slacks[c.remaining][self._unequal],
            lower[self._unequal],
            upper[self._unequal],
            push=push,
            multipliers=self.y[self._unequal],
            mu=self.mu,
            kept=kept,
        )
        if not warm:
            # no multipliers are known: one for each bound (section 3.6)
            for values in (self.x, self.s):
                values.below, values.above = np.sign(values.below), np.sign(values.above)

    def release(self) -> None:
        """Return the Newton system to the cache, for the next program of the same structure."""
        release(self.newton)

    def state(self) -> BarrierState:
        """State of this solve, for one that continues it."""
        c, slacks, of_variables = self._condenser, self._values(self.point), self.point.x.copy()
        slacks[c.remaining[self._unequal]] = self.s.values
        m = self.program.m
        of_variables[c.bounded] = slacks[m:]
        return BarrierState(self.mu, slacks[:m], of_variables)

    def _values(self, point: Point) -> Vector:
        """Values of all constraints: the program's, then the bounded eliminated variables."""
        return np.concatenate([point.g, point.x[self._condenser.bounded]])

    # ------------------------------------------------------------------ residuals and errors
    def residual(self, point: Point, slack: Vector) -> Vector:
        """Residuals of all constraints (c.m,): g - level of equalities, g - s of inequalities."""
        out, c = self._values(point), self._condenser
        out[c.eliminated] -= self._eliminated_level
        out[c.remaining[c.equal]] -= self._equal_level
        out[c.remaining[self._unequal]] -= slack
        return out

    def update_multipliers(self) -> None:
        """Compute the multipliers of the program's constraints and bounds, and the dual residual."""
        p, c, point = self.program, self._condenser, self.point
        of_all = np.zeros(c.m)
        of_all[c.remaining], of_all[c.eliminated] = self.y, self.eliminated_y
        y, z = of_all[: p.m], np.zeros(p.n)
        z[c.free] = self.x.multiplier
        z[c.bounded] = of_all[p.m :]
        # Eliminated variables have no barrier: their bounds are constraints
        # (`c.bounded`), with multipliers in y.
        dual = self.sigma * point.gradient + point.jacobian.T @ y + z
        # a fixed variable is stationary: the multiplier of its bounds is whatever it takes
        fixed = c.free[self.newton.fixed]
        z[fixed] -= dual[fixed]
        dual[fixed] = 0.0
        self.constraint_multipliers, self.bound_multipliers = y, z
        self._dual = float(np.abs(dual).max(initial=0.0))
        # Reports are of the program with its objective, also while the violation is minimized alone.
        self.kkt = scaled_residual(dual + (1.0 - self.sigma) * point.gradient, y, z)

    def error(self, mu: float, residual: Vector) -> float:
        """Scaled error of the barrier problem (eq. 5), with the multipliers of `update_multipliers`.

        mu = 0 : of the program; its complementarity is in units of kkt_tolerance, with which all is compared.
        """
        x, s, c = self.x, self.s, self._condenser
        bounds, count = x.total() + s.total(), max(1, x.bounds + s.bounds)
        if self.elastic is not None:
            # p and n have two more bounds a constraint, whose multipliers add up to twice the price
            bounds, count = bounds + 2 * self.elastic.price * self.y.size, count + 2 * self.y.size
        of_constraints = float(np.abs(self.y).sum() + np.abs(self.eliminated_y).sum())
        s_d = max(_S_MAX, (of_constraints + bounds) / (c.m + count)) / _S_MAX  # eq. 6, as s_c below
        # dL/ds = 0 with y (g - s) and the multiplier z_s of the slack's bounds: y = z_s.
        slack_dual = float(np.abs(self.y[self._unequal] - s.multiplier).max(initial=0.0))
        off, remaining = max(x.complementarity_error(mu), s.complementarity_error(mu)), residual[c.remaining]
        if self.elastic is not None:
            off = max(off, self.elastic.complementarity_error(self.y, mu))
            remaining = self.elastic.residual(remaining)
        violation = max(float(np.abs(v).max(initial=0.0)) for v in (remaining, residual[c.eliminated]))
        off /= max(_S_MAX, bounds / count) / _S_MAX  # s_c
        if not mu:
            off *= self.options.kkt_tolerance / self.options.complementarity_tolerance
            violation *= max(1.0, self.options.kkt_tolerance / self.options.violation_tolerance)
        return max(max(self._dual, slack_dual) / s_d, violation, off)

    def lower_barrier(self, residual: Vector) -> bool:
        """Lower mu as often as the iterate solves the barrier problem well enough; True if mu changed."""
        tolerance, hard, before = self.options.complementarity_tolerance, self.elastic is None, self.mu
        kappa, theta = (_KAPPA_EPSILON, _THETA_MU) if hard else (_KAPPA_EPSILON_ELASTIC, _THETA_MU_ELASTIC)
        if hard and self._lower_at_once:
            kappa = _KAPPA_EPSILON_WARM
        # The error depends on mu by complementarity only, so mu may fall by several steps at one iterate.
        while self.mu > _SUFFICIENT_BARRIER * tolerance and self.error(self.mu, residual) <= kappa * self.mu:
            self.mu = max(_MIN_BARRIER * tolerance, min(_KAPPA_MU * self.mu, self.mu**theta))
        return self.mu != before

    def make_elastic(self, residual: Vector, price: float) -> None:
        """Permit violations of the constraints at a price, from this iterate on."""
        self.elastic = Elastic(residual[self._condenser.remaining], price, self.mu)
        # Eliminated equalities stay hard: the Newton system needs them to express their variables. Their
        # multipliers follow from the next step.
        self.y, self.eliminated_y = self.elastic.clip(self.y), np.zeros_like(self.eliminated_y)

    def _hessian(self, sigma: float) -> Matrix | None:
        """Hessian of the Lagrangian at the iterate; None if it cannot be computed."""
        try:
            return self.program.hessian(self.point.x, sigma, self.constraint_multipliers)
        except (ArithmeticError, np.linalg.LinAlgError):
            return None

    # ------------------------------------------------------------------ Newton step
    def step(self, residual: Vector, least_shift: float = 0.0) -> Step | None:
        """Newton step; None if the Hessian cannot be computed, or the matrix not be factored.

        least_shift : of the Hessian.
        """
        point, hard = self.point, self.elastic is None
        hessian = self._hessian(self.sigma)
        if hessian is None:
            return None
        factored = self.newton.factor(
            point.jacobian,
            hessian,
            self.x.hessian_diagonal(),
            self._weights,
            hard=hard,
            proximal=_PROXIMAL * self.mu if hard else 0.0,
            least=least_shift,
        )
        return self.step_for(residual) if factored else None

    def _weights(self, shift: float) -> Vector:
        """Weights w (k,) of the constraints that remain, y = w (J d + r + offset); sets the offsets (k,).

        shift : added to the slacks' diagonal, as to that of the variables.  0 : weight of a hard equality,
        which has no weight.
        """
        compliance, self._offsets = np.zeros((2, self._condenser.remaining.size))
        # A slack's own equation is y = gradient + stiffness ds. With J d + r = ds it becomes
        # y = stiffness (J d + r + gradient / stiffness): a weight and an offset, and no slack in the matrix.
        self._stiffness = np.maximum(self.s.hessian_diagonal() + shift, _MIN_STIFFNESS)
        compliance[self._unequal] = 1.0 / self._stiffness
        self._offsets[self._unequal] = self.s.barrier_gradient(self.mu) / self._stiffness
        if self.elastic is not None:
            more, offsets = self.elastic.compliance(self.y, self.mu)
            compliance, self._offsets = compliance + more, self._offsets + offsets
        return np.divide(1.0, compliance, out=np.zeros_like(compliance), where=compliance > 0.0)

    def step_for(self, residual: Vector) -> Step:
        """Step for a residual of all constraints (c.m,), with the factored matrix."""
        c = self._condenser
        q, r = self.sigma * self.point.gradient, residual.copy()
        q[c.free] += self.x.barrier_gradient(self.mu)
        if self.elastic is not None:
            r[c.remaining] = self.elastic.residual(r[c.remaining])
        r[c.remaining] += self._offsets
        d, of_all = self.newton.solve(q, r, _NEWTON_TOLERANCE * self.mu)
        y = of_all[c.remaining]
        # The slack's own equation, see `_weights`.
        slack = (y[self._unequal] - self.s.barrier_gradient(self.mu)) / self._stiffness
        if self.elastic is not None:
            self.elastic.set_step(y, self.y, self.mu)
        return Step(d, d[c.free], slack, y, of_all[c.eliminated])

    # ------------------------------------------------------------------ quadratic model
    def quadratic(self) -> BarrierProblem | None:
        """Barrier problem of the QP at the iterate: the program's quadratic model, linearized constraints.

        It begins at the iterate, and shares the Newton system. None if the Hessian cannot be computed.
        """
        hessian = self._hessian(1.0)
        if hessian is None:
            return None
        out = copy.copy(self)
        out.program = TimedProgram(QuadraticModel(self.program, self.point, hessian))
        out.point = out.program.point(self.point.x)
        out.x, out.s = copy.copy(self.x), copy.copy(self.s)
        return out

    def step_to(self, end: BarrierProblem) -> Step:
        """Step to the iterate of the QP's barrier problem (`quadratic`)."""
        d = end.point.x - self.point.x
        slack = end.s.values - self.s.values
        return Step(d, d[self._condenser.free], slack, end.y, end.eliminated_y, (end.x, end.s))

    # ------------------------------------------------------------------ along a step
    @property
    def tau(self) -> float:
        """Fraction of the distance to a bound that a step may use (eq. 8)."""
        return max(0.99, 1.0 - self.mu)

    def max_length(self, step: Step) -> float:
        """Largest step length <= 1 that the fraction-to-the-boundary rule permits."""
        if step.end is not None:  # inside the bounds
            return 1.0
        tau = self.tau
        length = min(self.x.max_length(step.free, tau), self.s.max_length(step.slack, tau))
        return length if self.elastic is None else min(length, self.elastic.max_length(tau))

    def search_start(self, step: Step, residual: Vector) -> SearchStart:
        """Violation, barrier function and slope from which a search along a step starts."""
        mu, point = self.mu, self.point
        slope = float(
            self.sigma * (point.gradient @ step.d)
            + self.x.barrier_gradient(mu) @ step.free
            + self.s.barrier_gradient(mu) @ step.slack
        )
        phi = self._phi(point, self.s.values)
        if self.elastic is not None:
            slope, phi = slope + self.elastic.cost_slope(mu), phi + self.elastic.current_cost(mu)
        return SearchStart(theta=self._theta(residual), phi=phi, slope=slope)

    def _phi(self, point: Point, slack: Vector) -> float:
        """Barrier function, without the cost of elastic constraints."""
        barriers = self.x.barrier(point.x[self._condenser.free]) + self.s.barrier(slack)
        return self.sigma * point.objective + self.mu * barriers

    def _theta(self, residual: Vector, violation: Vector | None = None) -> float:
        """Sum of the residuals' sizes; violation (k,) : p - n of elastic constraints, default the present."""
        c = self._condenser
        remaining = residual[c.remaining]
        if self.elastic is not None:
            remaining = self.elastic.residual(remaining) if violation is None else remaining - violation
        return float(np.abs(residual[c.eliminated]).sum() + np.abs(remaining).sum())

    def trial(self, step: Step, length: float, slack: Vector | None = None) -> Trial:
        """Trial point at a step length; slack : the slacks there, if not those of the step."""
        point, mu = self.program.point(self.point.x + length * step.d), self.mu
        slack = self.s.values + length * step.slack if slack is None else slack
        # Functions may be undefined at a trial point; inf is refused by the filter, so the step is halved.
        if not point.finite:
            return Trial(point, slack, np.inf, np.inf)
        phi = self._phi(point, slack)
        violation = None
        if self.elastic is not None:
            p, n = self.elastic.after(length)
            phi, violation = phi + self.elastic.cost(p, n, mu), p - n
        return Trial(point, slack, self._theta(self.residual(point, slack), violation), phi)

    def move(self, step: Step, trial: Trial, length: float) -> None:
        """Move to a trial point, and the multipliers along their steps."""
        x, s, mu, tau = self.x, self.s, self.mu, self.tau
        if step.end is None:
            below_x, above_x, dual_x = x.dual_step(step.free, mu, tau)
            below_s, above_s, dual_s = s.dual_step(step.slack, mu, tau)
        else:
            # A QP's multipliers belong to its solution: they move as far as the variables.
            end_x, end_s = step.end
            below_x, above_x = end_x.below - x.below, end_x.above - x.above
            below_s, above_s = end_s.below - s.below, end_s.above - s.above
            dual_x = dual_s = length
        # the constraints' multipliers move as far as the variables, those of bounds as far as they can (eq.
        # 14)
        dual_length, y_length = min(dual_x, dual_s), length
        if self.elastic is not None:
            dual_length = min(dual_length, self.elastic.max_dual_length(step.y, self.y, tau))
            # Here y is bounded by the price, as are the multipliers of p and n by 0: it moves with them.
            y_length = dual_length
            self.elastic.move(length, self.residual(trial.point, trial.slack)[self._condenser.remaining])
        self.y = self.y + y_length * (step.y - self.y)
        self.eliminated_y = self.eliminated_y + y_length * (step.eliminated_y - self.eliminated_y)
        free = trial.point.x[self._condenser.free]
        x.move(free, x.below + dual_length * below_x, x.above + dual_length * above_x, mu)
        s.move(trial.slack, s.below + dual_length * below_s, s.above + dual_length * above_s, mu)
        self.point = trial.point
