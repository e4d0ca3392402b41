"""Reduced QPs of the SQP: elimination of equalities, model of the Lagrangian, QPs with a working set.

Equalities that determine variables (`Determined`) give x_D as a function of the free variables x_F, to first
order; a shooting method has the same by integration. Of the free variables' steps only those remain that keep
the other equalities. A QP of thousands of variables becomes a dense one of some dozens, with the same
solution. Nocedal and Wright 2006, section 15.3.

A step is d = d0 + T t: the normal step d0 meets the equalities, and the QP has the variables t.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from impactopt.solvers.elimination.condense import Condenser, Elimination, find_eliminations
from impactopt.solvers.elimination.kernels import kernels
from impactopt.solvers.options import SQPOptions
from impactopt.solvers.program import (
    Determined,
    Matrix,
    Point,
    TimedProgram,
    Vector,
    constraint_violations,
    row_norms,
)
from impactopt.solvers.qp.quadratic_program import QPSolution, QPSolver, QPStatus, QuadraticProgram

Index = npt.NDArray[np.intp]
_CACHE_SIZE = 4  # structures
_MIN_RELATIVE_NORM = 1e-6  # of a gradient by the free variables, relative to that by all: less is rounding
_RANK_TOLERANCE = 1e-9  # relative: an equality with a smaller pivot depends on the others


class Reduction:
    """Elimination of equalities, for Jacobians with a fixed pattern.

    Attributes
    ----------
    eliminated, variables : equalities that are eliminated, and the variables that they determine.
    free : the other variables.
    equalities : those that remain.  others : the inequalities.
    bounded : variables with a bound, free or not.
    T : (n, r) a basis, as columns, of the steps of all variables that keep the equalities; r is the number of
        variables of the QPs.
    """

    def __init__(self, program: TimedProgram, jacobian: Matrix, determined: Sequence[Determined]):
        """jacobian : (m, n) csc, at any point."""
        equal = program.g_lower == program.g_upper
        self._equations, all_equal = np.flatnonzero(equal), np.ones(int(equal.sum()), dtype=bool)
        # The condenser sees equalities only; the QP has the inequalities, and the Hessian is projected by T.
        equations = self._of_equations(jacobian.tocsr())
        self._empty = sp.csc_array((program.n, program.n))
        self._key = _key(equations, determined)
        if self._key not in _structures:
            eliminations = find_eliminations(equations, all_equal, determined)
            none_bounded = np.zeros(program.n, dtype=bool)
            condenser = Condenser(equations, self._empty, eliminations, all_equal, none_bounded, kernels())
            _structures[self._key] = eliminations, condenser
        self._eliminations, self._condenser = _structures.pop(self._key)
        none = np.zeros(0, dtype=np.intp)
        self.eliminated: Index = self._equations[
            np.concatenate([none, *[e.constraints.ravel() for e in self._eliminations]])
        ]
        self.variables: Index = np.concatenate([none, *[e.variables.ravel() for e in self._eliminations]])
        self._place = np.argsort(np.argsort(self.eliminated))  # the condenser lists them in ascending order
        self._level = program.g_lower
        self.free = np.setdiff1d(np.arange(program.n), self.variables)
        remaining = np.ones(program.m, dtype=bool)
        remaining[self.eliminated] = False
        self.equalities = np.flatnonzero(remaining & equal)
        self.others = np.flatnonzero(~equal)
        self.bounded = np.flatnonzero(np.isfinite(program.x_lower) | np.isfinite(program.x_upper))
        self._n = program.n

    def release(self) -> None:
        """Put the structure into the cache, for the next program that has it."""
        _structures[self._key] = self._eliminations, self._condenser
        while len(_structures) > _CACHE_SIZE:
            _structures.popitem(last=False)

    def load(self, point: Point) -> None:
        """Compute the basis T at a point, with the interior-point method's elimination.

        Raises
        ------
        LinAlgError : constraints do not determine their variables there.
        """
        equations = self._of_equations(point.jacobian_csr)
        self._A = point.jacobian_csr[self.equalities]
        self._condenser.load(equations, self._empty)
        Z = self._Z = np.zeros((self._n, self.free.size))
        # The identity for free variables; the rows of the determined ones become -A_D^-1 A_F.
        Z[self.free, np.arange(self.free.size)] = 1.0
        self._condenser.expand_basis(Z)
        A = self._A @ Z
        if not self.equalities.size:
            self._Y, self._R, self._order = np.zeros((self.free.size, 0)), np.zeros((0, 0)), self.equalities
            self.T, self._null_space = Z, None
            return
        # A' P = Q R: the first columns of Q span the range of A', the others its null space
        Q, R, self._order = la.qr(A.T, pivoting=True, check_finite=False)
        sizes = np.abs(np.diagonal(R))
        rank = int((sizes > _RANK_TOLERANCE * max(float(sizes.max(initial=0.0)), 1e-300)).sum())
        self._Y, self._R = Q[:, :rank], R[:rank]
        self._null_space = Q[:, rank:]
        self.T = Z @ self._null_space

    def _of_equations(self, rows: Matrix) -> Matrix:
        return rows[self._equations].tocsc()

    def normal(self, g: Vector) -> Vector:
        """Normal step (n,): meets the linearized equalities, as well as possible, for values g (m,).

        The free variables' part that the remaining equalities need is the shortest.
        """
        d = self._condenser.particular((g - self._level)[self._equations])
        if self.equalities.size:
            off = -(g[self.equalities] - self._level[self.equalities] + self._A @ d)
            # R' has full column rank; dependent equalities are met as well as possible, by least squares.
            along = np.linalg.lstsq(self._R.T, off[self._order], rcond=None)[0]
            d = d + self._Z @ (self._Y @ along)
        return d

    def add_multipliers(self, y: Vector, dual: Vector) -> Vector:
        """y (m,) with the equalities' multipliers that make grad f + J'y + z as small as these can.

        y : of the other constraints, 0 for equalities.  dual (n,) : grad f + J'y + z with this y.
        """
        y = y.copy()
        if self.equalities.size:
            of_equalities = np.zeros(self.equalities.size)
            # Stationarity along Y, the directions that the equalities fix: R y = -Y' Z' dual.
            target = -(self._Y.T @ (self._Z.T @ dual))
            of_equalities[self._order] = np.linalg.lstsq(self._R, target, rcond=None)[0]
            y[self.equalities] = of_equalities
            dual = dual + self._A.T @ of_equalities
        of_eliminated = self._condenser.multipliers(dual, np.zeros(len(self._condenser.remaining_equalities)))
        y[self.eliminated] = of_eliminated[self._place]
        return y

    @property
    def basis(self) -> Any:
        """Z (n, f): step of all variables for a unit step of each free one."""
        return self._Z

    def reduced_jacobian(self, point: Point) -> tuple[Any, Vector]:
        """Jacobian of `others` along the columns of `T` (k, r), and norms (k,) of the gradients by `free`.

        These gradients are total: the determined variables move too. A gradient by all variables may be
        thousands of times as long. The norm is 1 for constraints that no free variable changes.
        """
        own = point.jacobian_csr[self.others]
        by_free = own @ self._Z
        norms, whole = row_norms(by_free), row_norms(own)
        # A gradient that cancels along Z is rounding; over its own norm it would be a constraint of noise.
        norms = np.maximum(norms, _MIN_RELATIVE_NORM * whole)
        along = by_free if self._null_space is None else by_free @ self._null_space
        return along, np.where(norms > 1e-12, norms, 1.0)

    def gradient(self, dual: Vector) -> Vector:
        """Total gradient (f,) by the free variables, for a gradient by all variables (n,)."""
        return np.asarray(self._Z.T @ dual)


_structures: OrderedDict[bytes, tuple[list[Elimination], Condenser]] = OrderedDict()


def _key(equations: Matrix, determined: Sequence[Determined]) -> bytes:
    digest = hashlib.sha256(repr([(rank, v.size) for rank, v in determined]).encode())
    for array in (equations.indptr, equations.indices, *[variables for _, variables in determined]):
        digest.update(np.ascontiguousarray(array, dtype=np.int64).tobytes())
    return digest.digest()


_MIN_EIGENVALUE = 1e-5  # of a convex Hessian
# Weights of active constraints that are tried to make the Hessian convex: they change no step along these
# constraints, while lifted eigenvalues do.
_ACTIVE_WEIGHTS = (0.0, 10.0, 1e2, 1e3, 1e4)
_INITIAL_CURVATURE = 1e-2  # of BFGS
_MIN_BFGS_EIGENVALUE = 1e-3
_MAX_CURVATURE = 1e4  # that BFGS learns: more is a kink between two points
_RESTORATION_CURVATURE = 0.1  # of the model whose QP reduces the violation alone
Active = Callable[[], np.ndarray]


@dataclass(frozen=True)
class ReducedModel:
    """Model gradient . d + 1/2 t'Bt of a step d = d0 + T t, with B (r, r) positive definite.

    T (n, r), TH (r, n) : T and T'H with the Hessian H; None: H is zero.
    has_objective : False if it is for the violation alone.
    """

    B: np.ndarray
    gradient: Vector
    T: np.ndarray
    TH: np.ndarray | None
    has_objective: bool = True

    def slope(self, d0: Vector) -> Vector:
        """Gradient (r,) by t at t = 0, after the step d0."""
        out = self.T.T @ self.gradient
        return np.asarray(out if self.TH is None else out + self.TH @ d0)


class ExactModel:
    """Exact reduced Hessian, made convex by a weight of active constraints or lifted eigenvalues."""

    def __init__(self, program: TimedProgram, reduction: Reduction):
        self._program, self._reduction = program, reduction

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        """Model, at a point, of the Lagrangian with multipliers y (m,).

        active : gives the gradients (a, r), along T and of norm 1, of the active constraints.
        objective : False for a model of the violation alone.
        """
        T = self._reduction.T
        if not objective:
            return _restoration_model(point, T)
        TH = T.T @ self._program.hessian(point.x, 1.0, y)
        B = TH @ T
        return ReducedModel(_convex(0.5 * (B + B.T), active()), point.gradient, T, TH)

    def forget(self) -> None:
        """Discard the information of earlier points: nothing here."""


class BFGSModel:
    """Powell's damped BFGS approximation of the reduced Hessian (Nocedal, Wright 2006, section 18.3)."""

    def __init__(self, reduction: Reduction):
        self._reduction = reduction
        self.forget()

    def forget(self) -> None:
        self._B = _INITIAL_CURVATURE * np.eye(self._reduction.free.size)
        self._last: tuple[Point, np.ndarray] | None = None

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        reduction = self._reduction
        if not objective:
            return _restoration_model(point, reduction.T)
        # A point may be asked for again, with a smaller radius: then there is nothing to learn.
        if self._last is None or self._last[0] is not point:
            if self._last is not None:
                self._update(point, y)
            self._last = point, reduction.basis
        free = reduction.T[reduction.free]
        TH = np.zeros((free.shape[1], reduction.T.shape[0]))
        TH[:, reduction.free] = free.T @ self._B
        B = TH @ reduction.T
        values, vectors = la.eigh(0.5 * (B + B.T), check_finite=False)
        B = (vectors * np.maximum(values, _MIN_BFGS_EIGENVALUE)) @ vectors.T
        return ReducedModel(B, point.gradient, reduction.T, TH)

    def _update(self, point: Point, y: Vector) -> None:
        """Update from the change of the Lagrangian's gradient since the last point, for fixed multipliers.

        The eliminated equalities have none: their curvature is in the total gradients by the free variables.
        """
        assert self._last is not None
        before, basis = self._last
        reduction = self._reduction
        own_y = y.copy()
        own_y[reduction.eliminated] = 0.0
        step = (point.x - before.x)[reduction.free]
        change = reduction.gradient(point.gradient + point.jacobian.T @ own_y)
        # Each gradient is reduced with the basis of its own point.
        change = change - basis.T @ (before.gradient + before.jacobian.T @ own_y)
        Bs = self._B @ step
        sBs, sy = float(step @ Bs), float(step @ change)
        # The free variables have not moved: nothing to learn.
        if sBs < 1e-16:
            return
        # procedure 18.2: a change of the gradient that shows too little curvature is mixed with Bs until
        # s'r is 0.2 s'Bs, so that B stays positive definite
        theta = 1.0 if sy >= 0.2 * sBs else 0.8 * sBs / (sBs - sy)
        r = theta * change + (1.0 - theta) * Bs
        # r'r / s'r is the curvature that the update would add along r.
        if float(r @ r) > _MAX_CURVATURE * float(step @ r):
            return
        self._B = self._B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / float(step @ r)


def _convex(B: np.ndarray, active: np.ndarray) -> np.ndarray:
    """B made convex by the least sufficient weight of active constraints, or by lifted eigenvalues."""
    square, least = active.T @ active, _MIN_EIGENVALUE * np.eye(len(B))
    for weight in _ACTIVE_WEIGHTS if len(active) else _ACTIVE_WEIGHTS[:1]:
        weighted = B + weight * square
        with contextlib.suppress(la.LinAlgError):
            la.cholesky(weighted - least, check_finite=False)
            return np.asarray(weighted)
    values, vectors = la.eigh(B + _ACTIVE_WEIGHTS[1] * square, check_finite=False)
    # Lifted to the least, not reflected: the radius bounds the long steps that follow.
    return np.asarray((vectors * np.maximum(values, _MIN_EIGENVALUE)) @ vectors.T)


def _restoration_model(point: Point, T: np.ndarray) -> ReducedModel:
    # Without curvature the QP may have many solutions; the dual method needs a positive definite P.
    B = _RESTORATION_CURVATURE * np.eye(T.shape[1])
    return ReducedModel(B, np.zeros_like(point.gradient), T, None, has_objective=False)


def make_model(program: TimedProgram, options: SQPOptions, reduction: Reduction) -> ExactModel | BFGSModel:
    """The rule that the options name."""
    return ExactModel(program, reduction) if options.hessian == "exact" else BFGSModel(reduction)


# The reach of a constraint is how much a step inside the radius can change it. A QP begins with the
# constraints within this fraction of their reach of being violated, the worst two for each of its variables.
_NEAR_FRACTION, _MAX_NEAR = 0.1, 2
# Constraints of which a QP's solution violates more than this are added, in so many rounds, so many at least.
_MISSED_VIOLATION, _MAX_ROUNDS, _MIN_ADDED = 1e-7, 12, 15
_ELASTIC_VIOLATION = 1e-9  # violation at t = 0 from which a constraint is elastic
_GIVE_UP = 0.5  # fraction of the reach; a constraint that is violated by more is given up (see `solve`)
_SLACK_CURVATURE = 1e-4  # relative to the price: the dual active-set method needs a positive definite P
_PRICE_MARGIN = 2.0  # price over a known multiplier
_ACTIVE_MULTIPLIER = 1e-4  # of a normalized constraint that counts as active
# Longest normal step, relative to the radius: only careful ones, and those of a restoration phase, are
# shortened.
_MAX_NORMAL, _MAX_CAREFUL_NORMAL = 1e4, 0.8


@dataclass(frozen=True)
class QPStep:
    """Solution of a reduced QP.

    d (n,) : step.  y (m,), z (n,) : multipliers, 0 for equalities.
    linear_violation : weighted violation of the linearized constraints.
    constraints, elastic : number of constraints in the QP, and of elastic ones among them.
    iterations : of the QP solver.  longest : largest entry of t.
    """

    d: Vector
    y: Vector
    z: Vector
    linear_violation: float
    constraints: int
    elastic: int
    iterations: int
    longest: float


class ReducedQP:
    """Reduced QPs, each solved by a `QPSolver` from the active set of the last one.

    careful : whether normal steps are shortened to the radius, too.
    """

    careful = False

    def __init__(self, program: TimedProgram, reduction: Reduction, solver: QPSolver):
        self._program, self._reduction, self._solver = program, reduction, solver
        self._at: Point | None = None
        self.guess_active_set(np.zeros(program.m), np.zeros(program.n))

    def guess_active_set(self, y: Vector, z: Vector) -> None:
        """Take multipliers from elsewhere as the guess of the active set."""
        reduction = self._reduction
        # multipliers of the normalized constraints; of a guess, whose scale is unknown, those of the program
        self._unit = np.concatenate([y[reduction.others], z[reduction.bounded]])

    def active(self, point: Point) -> np.ndarray:
        """Gradients (a, r), along T, of the constraints that were active in the last QP.

        Their norms by all variables are 1: along T they may be small, so that the model's curvature does not
        hold on to constraints that cease to be active.
        """
        every, which = self._gradients(point), np.flatnonzero(np.abs(self._unit) > _ACTIVE_MULTIPLIER)
        # Rows of `every` have norm 1 by the free variables; times this, 1 by all variables.
        own = self._norms / point.row_norms[self._reduction.others]
        return np.append(own, np.ones(len(every) - own.size))[which, None] * every[which]

    def weigh(self, point: Point, y: Vector, price: float) -> None:
        """Set the weights of constraints in the merit function, so that one price suits all.

        A constraint weighs by its change with the free variables if that is less than with all: gear
        constraints change ten thousand times as fast with accelerations, which other constraints determine.
        And by its known multiplier in y (m,), which the price has to exceed.
        """
        self._gradients(point)
        self._program.weigh(point)
        weights, others = self._program.weights, self._reduction.others
        by_free = 1.0 / np.clip(self._norms, 1.0, 1e6)
        # price x weight > |multiplier|, the condition for an exact penalty (Nocedal and
        # Wright 2006, theorem 17.3).
        known = _PRICE_MARGIN * np.abs(y[others]) / price
        weights[others] = np.maximum(np.maximum(weights[others], by_free), known)

    def _gradients(self, point: Point) -> np.ndarray:
        """Gradients (k, r) along T of the normalized constraints: `others`, then the bounds."""
        if self._at is not point:
            reduction = self._reduction
            own, self._norms = reduction.reduced_jacobian(point)
            bounds, self._at = reduction.T[reduction.bounded], point
            self._every = np.vstack([own / self._norms[:, None], bounds])
        return self._every

    def solve(
        self,
        point: Point,
        model: ReducedModel,
        g: Vector,
        *,
        radius: float,
        price: float,
        time_limit: float | None,
    ) -> QPStep | None:
        """Step for constraints with values g (m,) and the point's Jacobian; None if the QP solver fails.

        Each round solves a QP with a working set of constraints, then adds those that its solution violates.
        A constraint that no step inside the radius can meet, or whose multiplier was at its price, is given
        up: its violation is linear in t then, so that its price is a part of the gradient, without a slack.
        """
        p, reduction, every = self._program, self._reduction, self._gradients(point)
        others, bounded, T = reduction.others, reduction.bounded, reduction.T
        d0 = reduction.normal(g)
        shortened = self.careful or not model.has_objective
        longest = (_MAX_CAREFUL_NORMAL if shortened else _MAX_NORMAL) * radius
        # A shortened normal step leaves a part of every equality's residual, the same fraction of all.
        d0 *= min(1.0, longest / max(float(np.abs(d0).max(initial=0.0)), 1e-300))
        # bounds of the normalized constraints on t, and the price of violating them
        after, scale = g + point.jacobian @ d0, self._norms
        x = point.x + d0
        lower = np.concatenate([(p.g_lower - after)[others] / scale, (p.x_lower - x)[bounded]])
        upper = np.concatenate([(p.g_upper - after)[others] / scale, (p.x_upper - x)[bounded]])
        # Of the normalized constraints, whose unit of violation is `scale` units of the program's.
        prices = price * np.concatenate([p.weights[others] * scale, np.ones(bounded.size)])
        # The largest change of a linear function in a box: radius times the 1-norm of its gradient.
        reach = radius * abs(every).sum(axis=1)
        off = np.maximum(lower, -upper)  # violation at t = 0; negative: distance to the bound
        given_up = (off > _ELASTIC_VIOLATION) & (
            (off > _GIVE_UP * reach) | (np.abs(self._unit) > 0.99 * prices)
        )
        # working set: the most violated, relative to the reach, and those of the last QP
        less_urgent = np.argsort(-off / np.maximum(reach, 1e-12))[_MAX_NEAR * T.shape[1] :]
        working = off > -_NEAR_FRACTION * reach
        working[less_urgent] = False
        working |= np.abs(self._unit) > 1e-9
        slope0, unit, iterations = model.slope(d0), self._unit, 0
        guess = np.zeros(T.shape[1])
        for _ in range(_MAX_ROUNDS):
            which, lost = np.flatnonzero(working & ~given_up), np.flatnonzero(given_up)
            # A violated lower bound pulls up: its multiplier is negative, as `NonlinearProgram` has signs.
            lost_multipliers = np.where(lower > 0, -prices, prices)[lost]
            slope = slope0 + every[lost].T @ lost_multipliers
            qp = _elastic_qp(model.B, slope, every[which], lower[which], upper[which], radius, prices[which])
            # Initial guess. A slack is stationary: its constraint's |multiplier| plus that of its own bound
            # is the price; the latter is 0, and the slack positive, if the former has reached the price.
            elastic = np.concatenate(
                [which[lower[which] > _ELASTIC_VIOLATION], which[upper[which] < -_ELASTIC_VIOLATION]]
            )
            of_slacks = np.minimum(np.abs(unit[elastic]) - prices[elastic], 0.0)
            x0 = np.concatenate([guess, np.zeros(elastic.size)])
            start = x0, unit[which], np.concatenate([np.zeros(guess.size), of_slacks])
            found = self._solver.solve(qp, start=start, time_limit=time_limit) if qp.n else _no_variables(qp)
            iterations += found.iterations
            if not found.usable:
                return None
            guess = found.x[: T.shape[1]]
            step = T @ guess
            unit = np.zeros(lower.size)
            unit[which], unit[lost] = found.y, lost_multipliers
            values = np.concatenate([(point.jacobian @ step)[others] / scale, step[bounded]])
            beyond = np.maximum(lower - values, values - upper)
            # a given-up constraint that is met strictly goes back into the working set
            # Its price as a constant gradient would go on pushing it beyond its bound.
            met = given_up & (np.where(lower > 0, lower - values, values - upper) < -_MISSED_VIOLATION)
            missed = np.where(working | given_up, 0.0, beyond)
            if missed.max(initial=0.0) <= _MISSED_VIOLATION and not met.any():
                break
            given_up &= ~met
            working |= met
            worst = np.argsort(-missed)[: max(_MIN_ADDED, missed.size // 10)]
            working[worst[missed[worst] > 0]] = True
        self._unit = unit
        d, y, z = d0 + step, np.zeros(p.m), np.zeros(p.n)
        # A normalized multiplier is of g / scale.
        y[others], z[bounded] = unit[: others.size] / scale, unit[others.size :]
        return QPStep(
            d,
            y,
            z,
            linear_violation=float(p.weights @ constraint_violations(p, g + point.jacobian @ d)),
            constraints=which.size,
            elastic=qp.n - guess.size,
            iterations=iterations,
            longest=float(np.abs(guess).max(initial=0.0)),
        )


def _no_variables(qp: QuadraticProgram) -> QPSolution:
    """Solution of a QP without variables: the equalities leave no direction."""
    return QPSolution(x=qp.q, y=np.zeros(qp.m), z=qp.q, status=QPStatus.SOLVED, iterations=0)


def _elastic_qp(
    B: np.ndarray, c: Vector, A: np.ndarray, lower: Vector, upper: Vector, radius: float, prices: Vector
) -> QuadraticProgram:
    """QP in (t, s), |t| <= radius: A t + s >= lower where t = 0 is below, A t - s <= upper where it is above.

    The slacks s >= 0 of the constraints violated at t = 0 cost their price.
    """
    below, above = np.flatnonzero(lower > _ELASTIC_VIOLATION), np.flatnonzero(upper < -_ELASTIC_VIOLATION)
    elastic = np.concatenate([below, above])
    k, n = elastic.size, c.size
    box = np.full(n, radius)
    if k:
        sign = np.where(np.arange(k) < below.size, 1.0, -1.0)
        curvature = _SLACK_CURVATURE * prices[elastic]
        c = np.concatenate([c, prices[elastic]])
        S = np.zeros((lower.size, k))
        S[elastic, np.arange(k)] = sign
        A, B = np.hstack([A, S]), la.block_diag(B, np.diag(curvature))
    return QuadraticProgram(
        P=B,
        q=c,
        A=A,
        lower=lower,
        upper=upper,
        x_lower=np.concatenate([-box, np.zeros(k)]),
        x_upper=np.concatenate([box, np.full(k, np.inf)]),
    )
