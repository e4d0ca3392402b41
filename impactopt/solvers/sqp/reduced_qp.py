"""QPs of the reduced SQP: elimination of what rows determine, Hessian of the rest, a step with rows it needs.

Rows that determine variables of their own (`Determined`) give x_D = x_D(x_F) to first order, as a shooting
method has by integration; of the free variables x_F only those directions are left that keep the other
equalities. A QP of thousands of variables becomes one of some dozens, dense, with the same solution.
Nocedal and Wright 2006, section 15.3.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from impactopt.solvers.elimination.condense import Condenser, Elimination, find_eliminations
from impactopt.solvers.elimination.kernels import kernels
from impactopt.solvers.options import SQPOptions
from impactopt.solvers.program import Determined, Matrix, Point, TimedProgram, Vector, row_violations
from impactopt.solvers.qp.quadratic_program import QPSolution, QPSolver, QPStatus, QuadraticProgram

Index = npt.NDArray[np.intp]
_KEPT = 4  # structures
_LARGE = 300  # free variables: beyond, QPs stay sparse, with the equalities that are left as rows
_NOTHING = 1e-13  # what rounding leaves of a zero
_SHORT = 1e-6  # of a row's length: what rounding may leave of it by the free variables
_RANK = 1e-9  # of the equalities left: what is this much smaller than the largest depends on the others


class Reduction:
    """Eliminates, for Jacobians whose pattern does not change.

    Attributes
    ----------
    gone, variables : rows that are eliminated, and the variables that they determine.
    free : the other variables.  sparse : whether they are many.
    left : equalities that are left, none where it is sparse.  rows : all others that are not gone.
    bounded : variables with a bound, whichever they are.
    T : (n, r) steps of all variables, one a column, that keep the equalities but those in `rows`; r is the
        size of the QPs; sparse or dense.
    """

    def __init__(
        self,
        program: TimedProgram,
        jacobian: Matrix,
        determined: Sequence[Determined],
        *,
        dense: bool = False,
    ):
        """jacobian : (m, n) csc, at any point.  dense : never sparse, however many variables are free."""
        equal = program.g_lower == program.g_upper
        self._equations, every = np.flatnonzero(equal), np.ones(int(equal.sum()), dtype=bool)
        equations = self._of_equations(jacobian.tocsr())
        self._empty = sp.csc_array((program.n, program.n))
        self._key = _key(equations, determined)
        if self._key not in _structures:
            _structures[self._key] = _structure(equations, self._empty, every, determined)
        self._found, self._condenser = _structures.pop(self._key)
        found = self._found
        none = np.zeros(0, dtype=np.intp)
        self.gone: Index = self._equations[np.concatenate([none, *[e.constraints.ravel() for e in found]])]
        self.variables: Index = np.concatenate([none, *[e.variables.ravel() for e in found]])
        self._place = np.argsort(np.argsort(self.gone))
        self._level = program.g_lower
        self.free = np.setdiff1d(np.arange(program.n), self.variables)
        here = np.ones(program.m, dtype=bool)
        here[self.gone] = False
        self.sparse = not dense and self.free.size > _LARGE
        apart = here & equal & (not self.sparse)
        self.left, self.rows = np.flatnonzero(apart), np.flatnonzero(here & ~apart)
        self.bounded = np.flatnonzero(np.isfinite(program.x_lower) | np.isfinite(program.x_upper))
        self._n = program.n

    def release(self) -> None:
        """Keep the structure for the next program that has it."""
        _structures[self._key] = self._found, self._condenser
        while len(_structures) > _KEPT:
            _structures.popitem(last=False)

    def load(self, point: Point) -> None:
        """Take the Jacobian at a point, by the interior-point method's elimination.

        Raises
        ------
        LinAlgError : rows do not determine their variables there.
        """
        equations = self._of_equations(point.rows)
        self._of_left = point.rows[self.left]
        self._condenser.load(equations, self._empty)
        Z = np.zeros((self._n, self.free.size))
        Z[self.free, np.arange(self.free.size)] = 1.0
        self._condenser.expand_basis(Z)
        Z = self._Z = _without_zeros(Z) if self.sparse else Z
        A = self._of_left @ Z
        if not self.left.size:
            self._Y, self._R, self._order = np.zeros((self.free.size, 0)), np.zeros((0, 0)), self.left
            self.T, self._within = Z, None
            return
        Q, R, self._order = la.qr(A.T, pivoting=True, check_finite=False)
        sizes = np.abs(np.diagonal(R))
        rank = int((sizes > _RANK * max(float(sizes.max(initial=0.0)), 1e-300)).sum())
        self._Y, self._R = Q[:, :rank], R[:rank]
        self._within = Q[:, rank:]
        self.T = Z @ self._within

    def _of_equations(self, rows: Matrix) -> Matrix:
        return rows[self._equations].tocsc()

    def normal(self, g: Vector) -> Vector:
        """The step (n,) that meets the linearized equalities, as well as they can be, whose values are g
        (m,); the shortest of the free variables."""
        d = self._condenser.particular((g - self._level)[self._equations])
        if self.left.size:
            off = -(g[self.left] - self._level[self.left] + self._of_left @ d)
            along = np.linalg.lstsq(self._R.T, off[self._order], rcond=None)[0]
            d = d + self._Z @ (self._Y @ along)
        return d

    def add_multipliers(self, y: Vector, dual: Vector) -> Vector:
        """y (m,) with those of the equalities that make grad f + J'y + z zero where equalities can.

        y : of the other rows.  dual (n,) : grad f + J'y + z of these.
        """
        y = y.copy()
        if self.left.size:
            of_left = np.zeros(self.left.size)
            target = -(self._Y.T @ (self._Z.T @ dual))
            of_left[self._order] = np.linalg.lstsq(self._R, target, rcond=None)[0]
            y[self.left] = of_left
            dual = dual + self._of_left.T @ of_left
        of_gone = self._condenser.multipliers(dual, np.zeros(len(self._condenser.remaining_equalities)))
        y[self.gone] = of_gone[self._place]
        return y

    @property
    def basis(self) -> Any:
        """(n, f) what all variables do with each of the free ones."""
        return self._Z

    def rows_by_free(self, point: Point) -> tuple[Any, Vector]:
        """`rows` along the columns of `T` (k, r), and their norms (k,) by the free variables: what a row
        changes with these, those that they determine with them. Its gradient by all variables may be
        thousands of times as long. 1 for rows that nothing changes.
        """
        own = point.rows[self.rows]
        by_free = own @ self._Z
        norms, whole = _norms(by_free), _norms(own)
        norms = np.maximum(norms, _SHORT * whole)
        along = by_free if self._within is None else by_free @ self._within
        return along, np.where(norms > 1e-12, norms, 1.0)

    def gradient(self, dual: Vector) -> Vector:
        """(f,) of what the free variables change, those that they determine with them; dual (n,)."""
        return np.asarray(self._Z.T @ dual)


_structures: OrderedDict[bytes, tuple[list[Elimination], Condenser]] = OrderedDict()


def _structure(
    equations: Matrix, empty: Matrix, every: npt.NDArray[np.bool_], determined: Sequence[Determined]
) -> tuple[list[Elimination], Condenser]:
    found = find_eliminations(equations, every, determined)
    nowhere = np.zeros(equations.shape[1], dtype=bool)
    return found, Condenser(equations, empty, found, every, nowhere, kernels())


def _key(equations: Matrix, determined: Sequence[Determined]) -> bytes:
    digest = hashlib.sha256(repr([(rank, v.size) for rank, v in determined]).encode())
    for array in (equations.indptr, equations.indices, *[variables for _, variables in determined]):
        digest.update(np.ascontiguousarray(array, dtype=np.int64).tobytes())
    return digest.digest()


def _norms(rows: Any) -> Vector:
    squares = rows.multiply(rows) if sp.issparse(rows) else rows**2
    return np.sqrt(np.asarray(squares.sum(axis=1)).ravel())


def _without_zeros(Z: np.ndarray) -> Matrix:
    i, j = np.nonzero(np.abs(Z) > _NOTHING)
    return sp.csr_array((Z[i, j], (i, j)), shape=Z.shape)


_FLOOR = 1e-5  # least eigenvalue
# weights of active rows that are tried in making the Hessian convex: they change no step that keeps the rows
_WEIGHTS = (0.0, 10.0, 1e2, 1e3, 1e4)
_LEARNED = 1e-3  # least eigenvalue of what BFGS has learned
_FIRST = 1e-2  # curvature that BFGS begins with
_STEEPEST = 1e4  # that it learns
_SHIFT = 1e-4  # least of a sparse Hessian that is not convex
_STEEP = 0.1  # curvature where only the violation counts
Active = Callable[[], Matrix]


@dataclass(frozen=True)
class ReducedModel:
    """gradient . d + 1/2 t'Bt of a step d = d0 + T t, B (r, r) positive definite.

    leads : whether it is of the objective; else of the violation alone.
    """

    B: Matrix  # it, T and of_start are dense or sparse, as the reduction is
    gradient: Vector
    T: Matrix
    of_start: Matrix | None  # T' H (r, n): what d0 adds to the gradient
    leads: bool = True

    def slope(self, d0: Vector) -> Vector:
        """Gradient by t where the step d0 is made already."""
        out = self.T.T @ self.gradient
        return np.asarray(out if self.of_start is None else out + self.of_start @ d0)


class ModelRule(Protocol):
    """Makes the model at a point."""

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        """Model of the Lagrangian with multipliers y (m,); active: gives the unit rows (a, r) that hold;
        objective: whether it counts, or the violation alone.
        """
        ...

    def forget(self) -> None:
        """Forget what was learned from earlier points."""
        ...


class ExactModel:
    """The exact Hessian in these directions, its eigenvalues lifted where active rows leave them negative."""

    def __init__(self, program: TimedProgram, reduction: Reduction):
        self._program, self._reduction = program, reduction
        self._shift = 0.0

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        T = self._reduction.T
        if not objective:
            return _steep(point, T)
        # far from a solution multipliers may be anything
        H = self._program.hessian(point.x, 1.0, y)
        of_start = T.T @ H
        B = of_start @ T
        if self._reduction.sparse:
            return ReducedModel(self._lifted(0.5 * (B + B.T), active()), point.gradient, T, of_start)
        return ReducedModel(_convex(0.5 * (B + B.T), active()), point.gradient, T, of_start)

    def forget(self) -> None:
        self._shift = 0.0

    def _lifted(self, B: Matrix, active: Matrix) -> Matrix:
        """B with a weight of active rows, and a multiple of the identity, that make it convex and keep it
        sparse."""
        rows, identity = active.T @ active, sp.eye_array(B.shape[0], format="csc")
        for weight in _WEIGHTS[:2]:
            if _is_convex(made := B + weight * rows):
                self._shift /= 3.0
                return made
        self._shift = max(self._shift / 3.0, _SHIFT)
        while not _is_convex(lifted := made + self._shift * identity):
            self._shift *= 4.0
        return lifted


class BFGSModel:
    """Powell's damped update of the reduced Hessian in the free variables (Nocedal, Wright 2006, 18.3)."""

    def __init__(self, reduction: Reduction):
        self._reduction = reduction
        self.forget()

    def forget(self) -> None:
        self._B = _FIRST * np.eye(self._reduction.free.size)
        self._last: tuple[Point, np.ndarray] | None = None

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        reduction = self._reduction
        if not objective:
            return _steep(point, reduction.T)
        if self._last is None or self._last[0] is not point:
            if self._last is not None:
                self._update(point, y)
            self._last = point, reduction.basis
        free = reduction.T[reduction.free]
        of_start = np.zeros((free.shape[1], reduction.T.shape[0]))
        of_start[:, reduction.free] = free.T @ self._B
        B = of_start @ reduction.T
        values, vectors = la.eigh(0.5 * (B + B.T), check_finite=False)
        B = (vectors * np.maximum(values, _LEARNED)) @ vectors.T
        return ReducedModel(B, point.gradient, reduction.T, of_start)

    def _update(self, point: Point, y: Vector) -> None:
        """Update with multipliers that are the same at both points: of rows, and of equalities that determine
        nothing, which steps have to follow as they bend. What the others determine is in the gradients."""
        assert self._last is not None
        before, basis = self._last
        reduction = self._reduction
        only = np.zeros_like(y)
        only[reduction.rows], only[reduction.left] = y[reduction.rows], y[reduction.left]
        step = (point.x - before.x)[reduction.free]
        change = reduction.gradient(point.gradient + point.jacobian.T @ only)
        change = change - basis.T @ (before.gradient + before.jacobian.T @ only)
        Bs = self._B @ step
        sBs, sy = float(step @ Bs), float(step @ change)
        if sBs < 1e-16:
            return
        # procedure 18.2: a change of the gradient that shows too little curvature is mixed with Bs until
        # s'r is 0.2 s'Bs, so that B stays positive definite
        theta = 1.0 if sy >= 0.2 * sBs else 0.8 * sBs / (sBs - sy)
        r = theta * change + (1.0 - theta) * Bs
        if float(r @ r) > _STEEPEST * float(step @ r):
            return  # a kink between the two points, and no curvature
        self._B = self._B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / float(step @ r)


def _is_convex(B: Matrix) -> bool:
    try:
        la.cholesky(B.toarray() - _FLOOR * np.eye(B.shape[0]), overwrite_a=True, check_finite=False)
    except la.LinAlgError:
        return False
    return True


def _convex(B: np.ndarray, active: np.ndarray) -> np.ndarray:
    """B with the least weight of active rows that makes it convex; else eigenvalues are lifted."""
    rows, floor = active.T @ active, _FLOOR * np.eye(len(B))
    for weight in _WEIGHTS if len(active) else _WEIGHTS[:1]:
        made = B + weight * rows
        with contextlib.suppress(la.LinAlgError):
            la.cholesky(made - floor, check_finite=False)
            return np.asarray(made)
    values, vectors = la.eigh(B + _WEIGHTS[1] * rows, check_finite=False)
    return np.asarray((vectors * np.maximum(values, _FLOOR)) @ vectors.T)


def _steep(point: Point, T: Matrix) -> ReducedModel:
    B = _STEEP * (sp.eye_array(T.shape[1], format="csc") if sp.issparse(T) else np.eye(T.shape[1]))
    return ReducedModel(B, np.zeros_like(point.gradient), T, None, leads=False)


def make_model(program: TimedProgram, options: SQPOptions, reduction: Reduction) -> ModelRule:
    """The rule that the options name."""
    return ExactModel(program, reduction) if options.hessian == "exact" else BFGSModel(reduction)


# part of the way that a row can change, within which it is in the QP from the start; rows for each direction
_NEAR, _NEAREST = 0.1, 2
_MISSED, _ROUNDS, _MORE = 1e-7, 12, 15  # violation of a row left out; times rows are added; so many at least
_SLACK_CURVATURE = 1e-4  # of the price
_ABOVE = 2.0  # times a multiplier that is known: a price
_ACTIVE = 1e-4  # multiplier of a unit row that holds
_SOFT = 1e-9  # violation where t = 0 of rows that may stay violated
_BEYOND = 0.5  # of the way that a row can change inside the radius: what is violated by more is given up
# parts of the radius that a step towards the equalities may be long: it is shortened with the rest, but where
# only the violation counts
_LARGEST, _CAREFUL = 1e4, 0.8


@dataclass(frozen=True)
class Solved:
    """A step d (n,); multipliers y (m,) and z (n,) of all but the equalities; what the linearized rows are
    off by; rows of the QP, and those elastic; iterations of its solver; largest entry of the step that keeps
    the equalities."""

    d: Vector
    y: Vector
    z: Vector
    linear_violation: float
    rows: int
    elastic: int
    iterations: int
    longest: float


class ReducedQP:
    """Solves them one after the other.

    careful : whether no step is longer than the radius, those towards the equalities among them.
    """

    careful = False

    def __init__(self, program: TimedProgram, reduction: Reduction, solver: QPSolver):
        self._program, self._reduction, self._solver = program, reduction, solver
        self._at: Point | None = None
        self.start_from(np.zeros(program.m), np.zeros(program.n))

    def start_from(self, y: Vector, z: Vector) -> None:
        """Take multipliers from elsewhere as the guess of the active set."""
        reduction = self._reduction
        self._unit = np.concatenate([y[reduction.rows], z[reduction.bounded]])

    def active(self, point: Point) -> Matrix:
        """Rows (a, r) of what held in the last QP, in the directions that are left; of all variables their
        gradients would be one long, as those that cease to hold are not to be held by the model's curvature.
        """
        every, which = self._rows(point), np.flatnonzero(np.abs(self._unit) > _ACTIVE)
        own = self._norms / point.row_norms[self._reduction.rows]
        return sp.diags_array(np.append(own, np.ones(every.shape[0] - own.size))[which]) @ every[which]

    def weigh(self, point: Point, y: Vector, price: float) -> None:
        """Weigh rows in the merit function, so that a price suits all alike.

        By what the free variables change them, if that is less than all do: rows of gears change ten thousand
        times as fast with accelerations, which other rows determine. And by known multipliers y (m,), which a
        price has to exceed.
        """
        self._rows(point)
        self._program.weigh(point)
        weights, rows = self._program.weights, self._reduction.rows
        by_free = 1.0 / np.clip(self._norms, 1.0, 1e6)
        weights[rows] = np.maximum(np.maximum(weights[rows], by_free), _ABOVE * np.abs(y[rows]) / price)

    def _rows(self, point: Point) -> Matrix:
        """Unit rows (k, r): those that are not eliminated, then of the bounds."""
        if self._at is not point:
            reduction = self._reduction
            own, self._norms = reduction.rows_by_free(point)
            bounds, self._at = reduction.T[reduction.bounded], point
            if reduction.sparse:
                self._every = sp.vstack([sp.diags_array(1.0 / self._norms) @ own, bounds], "csr")
            else:
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
    ) -> Solved | None:
        """The step where rows are g (m,) and have the point's slopes; None if the QP solver fails."""
        p, reduction, every = self._program, self._reduction, self._rows(point)
        rows, bounded, T = reduction.rows, reduction.bounded, reduction.T
        d0 = reduction.normal(g)
        longest = (_CAREFUL if self.careful or not model.leads else _LARGEST) * radius
        d0 *= min(1.0, longest / max(float(np.abs(d0).max(initial=0.0)), 1e-300))
        after, scale = g + point.jacobian @ d0, self._norms
        x = point.x + d0
        lower = np.concatenate([(p.g_lower - after)[rows] / scale, (p.x_lower - x)[bounded]])
        upper = np.concatenate([(p.g_upper - after)[rows] / scale, (p.x_upper - x)[bounded]])
        prices = price * np.concatenate([p.weights[rows] * scale, np.ones(bounded.size)])
        reach = radius * abs(every).sum(axis=1)  # how much a row can change
        off = np.maximum(lower, -upper)
        soft = off > _SOFT
        # A constraint that no step inside the radius can meet, or whose multiplier was at its price, is given
        # up: its violation is linear in t then, so its price is a part of the gradient, without a slack.
        lost = soft & ((off > _BEYOND * reach) | (np.abs(self._unit) > 0.99 * prices))
        late = np.argsort(-off / np.maximum(reach, 1e-12))[_NEAREST * T.shape[1] :]
        working = off > -_NEAR * reach
        working[late] = False
        working |= np.abs(self._unit) > 1e-9
        slope0, unit, iterations = model.slope(d0), self._unit, 0
        guess = np.zeros(T.shape[1])
        for _ in range(_ROUNDS):
            which, given_up = np.flatnonzero(working & ~lost), np.flatnonzero(lost)
            dear = np.where(lower > 0, -prices, prices)[given_up]
            slope = slope0 + every[given_up].T @ dear
            qp = _elastic(model.B, slope, every[which], lower[which], upper[which], radius, prices[which])
            priced = np.concatenate([which[lower[which] > _SOFT], which[upper[which] < -_SOFT]])
            held = np.minimum(np.abs(unit[priced]) - prices[priced], 0.0)  # of slacks that are zero
            start = (
                np.concatenate([guess, np.zeros(priced.size)]),
                unit[which],
                np.concatenate([np.zeros(guess.size), held]),
            )
            found = self._solver.solve(qp, start=start, time_limit=time_limit) if qp.n else _decided(qp)
            iterations += found.iterations
            if not found.usable:
                return None
            guess = found.x[: T.shape[1]]
            step = T @ guess
            unit = np.zeros(lower.size)
            unit[which], unit[given_up] = found.y, dear
            values = np.concatenate([(point.jacobian @ step)[rows] / scale, step[bounded]])
            beyond = np.maximum(lower - values, values - upper)
            back = lost & (np.where(lower > 0, lower - values, values - upper) < -_MISSED)
            missed = np.where(working | lost, 0.0, beyond)
            if missed.max(initial=0.0) <= _MISSED and not back.any():
                break
            lost &= ~back
            working |= back
            worst = np.argsort(-missed)[: max(_MORE, missed.size // 10)]
            working[worst[missed[worst] > 0]] = True
        self._unit = unit
        d, y, z = d0 + step, np.zeros(p.m), np.zeros(p.n)
        y[rows], z[bounded] = unit[: rows.size] / scale, unit[rows.size :]
        linear = float(p.weights @ row_violations(p, g + point.jacobian @ d))
        return Solved(
            d, y, z, linear, which.size, qp.n - guess.size, iterations, float(np.abs(guess).max(initial=0.0))
        )


def _decided(qp: QuadraticProgram) -> QPSolution:
    """The solution of a QP without variables: the equalities leave no direction."""
    return QPSolution(x=qp.q, y=np.zeros(qp.m), z=qp.q, status=QPStatus.SOLVED, iterations=0)


def _elastic(
    B: Matrix, c: Vector, A: Matrix, lower: Vector, upper: Vector, radius: float, prices: Vector
) -> QuadraticProgram:
    """The QP in (t, s), s >= 0 at a price: A t + s >= lower where t = 0 is below, A t - s <= upper above."""
    below, above = np.flatnonzero(lower > _SOFT), np.flatnonzero(upper < -_SOFT)
    elastic = np.concatenate([below, above])
    k, n = elastic.size, c.size
    box = np.full(n, radius)
    small = isinstance(A, np.ndarray)
    if k:
        sign = np.where(np.arange(k) < below.size, 1.0, -1.0)
        bend = _SLACK_CURVATURE * prices[elastic]  # as the dual method needs a positive definite P
        c = np.concatenate([c, prices[elastic]])
        if small:
            S = np.zeros((lower.size, k))
            S[elastic, np.arange(k)] = sign
            A, B = np.hstack([A, S]), la.block_diag(B, np.diag(bend))
        else:
            S = sp.csc_array((sign, (elastic, np.arange(k))), shape=(lower.size, k))
            A, B = sp.hstack([sp.csc_array(A), S]), sp.block_diag([B, sp.diags_array(bend)])
    return QuadraticProgram(
        P=B if small else sp.csc_array(B),
        q=c,
        A=A if small else sp.csc_array(A),
        lower=lower,
        upper=upper,
        x_lower=np.concatenate([-box, np.zeros(k)]),
        x_upper=np.concatenate([box, np.full(k, np.inf)]),
    )
