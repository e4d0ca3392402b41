"""Quadratic programs: the problem, its solution, the rows' common form, and how an answer is made exact.

Source of that: Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13, 2002.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from impactopt.solvers.program import Matrix, Vector


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram:
    """Minimize 1/2 x'Px + q'x subject to lower <= A x <= upper and x_lower <= x <= x_upper.

    Attributes
    ----------
    P : full symmetric, positive semidefinite (n, n): csc_array, or, as A, an array where the QP is small.
    q : (n,).
    A : (m, n), as P.
    lower, upper : (m,), equal for equalities, +-inf for none.
    x_lower, x_upper : (n,), likewise.
    """

    P: Matrix
    q: Vector
    A: Matrix
    lower: Vector
    upper: Vector
    x_lower: Vector
    x_upper: Vector

    @property
    def n(self) -> int:
        """Number of variables."""
        return int(self.q.size)

    @property
    def m(self) -> int:
        """Number of rows of A; the variables' bounds are not counted."""
        return int(self.lower.size)

    @property
    def dense(self) -> bool:
        """True if its matrices are arrays."""
        return isinstance(self.A, np.ndarray)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """P, and C of `stacked`, as arrays."""
        C = self.stacked[0]
        return (self.P, C) if self.dense else (self.P.toarray(), C.toarray())

    @cached_property
    def stacked(self) -> tuple[Any, Vector, Vector]:
        """(C, l, u) with bounds as rows, l <= C x <= u, C = [A; I], rows of norm 1 (zero rows stay zero).

        First-order solvers live by the norms of the rows; `row_scale` brings their multipliers back.
        """
        if self.dense:
            C: Any = np.vstack([self.row_scale[: self.m, None] * self.A, np.eye(self.n)])
        else:
            C = sp.csc_array(
                sp.diags_array(self.row_scale)
                @ sp.vstack([self.A, sp.diags_array(np.ones(self.n))], format="csc")
            )
            C.sort_indices()
        lower = np.concatenate([self.lower, self.x_lower]) * self.row_scale
        upper = np.concatenate([self.upper, self.x_upper]) * self.row_scale
        return C, lower, upper

    @cached_property
    def row_scale(self) -> Vector:
        """Factors of the rows of [A; I] in `stacked`, (m + n,)."""
        squares = self.A**2 if self.dense else self.A.multiply(self.A)
        norms = np.sqrt(np.asarray(squares.sum(axis=1)).ravel())
        return np.concatenate([1.0 / np.where(norms > 1e-12, norms, 1.0), np.ones(self.n)])

    def residuals(self, x: Vector, y: Vector, z: Vector) -> tuple[float, float, float]:
        """Residuals of the optimality (KKT) conditions at x, with multipliers y of the rows, z of the bounds.

        Returns the largest violation of a unit row, the largest entry of P x + q + A'y + z, and the largest
        product of a multiplier (in units of the unit row) and the distance to the bound it belongs to.
        """
        C, lower, upper = self.stacked
        v = C @ x
        multipliers = np.concatenate([y, z]) / self.row_scale
        primal = np.max(np.maximum(np.maximum(lower - v, v - upper), 0.0), initial=0.0)
        dual = np.max(np.abs(self.P @ x + self.q + C.T @ multipliers), initial=0.0)
        held = multipliers != 0.0
        gap = np.where(multipliers > 0, np.abs(upper - v), np.abs(v - lower))[held]
        return float(primal), float(dual), float(np.max(np.abs(multipliers[held]) * gap, initial=0.0))

    def error(self, x: Vector, y: Vector, z: Vector) -> float:
        """The largest of the residuals; those in units of the objective relative to 1 + |q|."""
        primal, dual, gap = self.residuals(x, y, z)
        return max(primal, max(dual, gap) / (1.0 + float(np.max(np.abs(self.q), initial=0.0))))


class QPStatus(enum.Enum):
    """End of a QP solver. INACCURATE: usable, outside the tolerances."""

    SOLVED = "solved"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class QPSolution:
    """Answer of a QP solver; x, y, z are meaningless unless `usable`.

    Attributes
    ----------
    x : variables (n,); y: multipliers of the rows (m,); z: of the bounds (n,), positive where the upper bound
        holds.
    status : how the solver ended.
    iterations : of the solver.
    """

    x: Vector
    y: Vector
    z: Vector
    status: QPStatus
    iterations: int

    @property
    def usable(self) -> bool:
        """True if x, y, z can be used as an (approximate) solution."""
        return self.status in (QPStatus.SOLVED, QPStatus.INACCURATE)


class QPSolver(Protocol):
    """Solves one QP after the other; may keep factors and settings between them."""

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the guess (x, y, z). A hard or infeasible QP is a status, no exception."""
        ...


_DENSE = 400  # up to this many unknowns LAPACK is quicker than a sparse factorization
_REGULARIZATION = 1e-9


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A solution, its multipliers of the unit rows of `QuadraticProgram.stacked`, and its error."""

    x: Vector
    y: Vector
    error: float


def refine(qp: QuadraticProgram, x: Vector, y: Vector, *, rounds: int = 10) -> Refined | None:
    """Solve the QP with the rows that (x, y) holds active as equalities; correct the set until it stays.

    Parameters
    ----------
    qp : with positive definite P.
    x : approximate solution (n,).
    y : approximate multipliers of the unit rows of `qp.stacked` (m + n,).
    rounds : most corrections of the active set.

    Returns
    -------
    The best point found, or None where no active set gave a system that could be solved.
    """
    C, lower, upper = qp.stacked
    rows = C if qp.dense else C.tocsr()
    best: Refined | None = None
    seen: set[bytes] = set()
    for _ in range(rounds):
        held = active_set(qp, x, y)
        high, low = held > 0, held < 0
        key = held.tobytes()
        if key in seen:
            break
        seen.add(key)
        active = np.flatnonzero(high | low)
        target = np.where(high[active], upper[active], lower[active])
        solved = solve_equality_qp(qp.P, qp.q, rows[active], target)
        if solved is None:
            break
        x, y = solved[0], np.zeros(lower.size)
        y[active] = solved[1]
        # A multiplier of the wrong sign leaves the set next time; it does not count as a solution's.
        clipped = np.where(high, np.maximum(y, 0), np.where(low, np.minimum(y, 0), 0))
        clipped = np.where(lower == upper, y, clipped)
        error = qp.error(x, *np.split(clipped * qp.row_scale, [qp.m]))
        if best is None or error < best.error:
            best = Refined(x=x, y=clipped, error=error)
    return best


def active_set(qp: QuadraticProgram, x: Vector, y: Vector) -> np.ndarray:
    """Unit rows of `qp.stacked` that (x, y) holds active.

    +1 at the upper bound (and equalities), -1 at the lower, 0 for the others.

    A row is active where its multiplier pushes harder than its distance to the bound (eq. 2.4 with c = 1).
    """
    C, lower, upper = qp.stacked
    v = C @ x
    high = (y + (v - upper) > 0) | (lower == upper)
    return np.where(high, 1, np.where(y + (v - lower) < 0, -1, 0))


def solve_equality_qp(P: Matrix, q: Vector, A: Matrix, b: Vector) -> tuple[Vector, Vector] | None:
    """Minimize 1/2 x'Px + q'x subject to A x = b, also with dependent rows: regularized, then refined."""
    n, m = q.size, b.size
    K: Any
    if isinstance(A, np.ndarray):
        K = np.zeros((n + m, n + m))
        K[:n, :n], K[n:, :n], K[:n, n:] = P, A, A.T
    else:
        K = sp.csc_array(sp.block_array([[P, A.T], [A, None]] if m else [[P]], format="csc"))
    shift = _REGULARIZATION * np.concatenate([np.ones(n), -np.ones(m)])
    right = np.concatenate([-q, b])
    if n + m <= _DENSE or isinstance(K, np.ndarray):
        whole = K.copy() if isinstance(K, np.ndarray) else K.toarray()
        whole[np.diag_indices(n + m)] += shift
        lu, pivots, info = la.lapack.dgetrf(whole, overwrite_a=True)
        if info != 0:
            return None
        solve: Callable[[Vector], Vector] = lambda r: la.lapack.dgetrs(lu, pivots, r)[0]  # noqa: E731
    else:
        try:
            solve = spla.splu(sp.csc_matrix(K + sp.diags_array(shift))).solve
        except RuntimeError:  # singular
            return None
    # The shift makes the system quasidefinite, and with it regular also for dependent rows; refinement with
    # the true matrix removes what it changes.
    s = solve(right)
    for _ in range(5):
        s = s + solve(right - K @ s)
    return (s[:n], s[n:]) if np.isfinite(s).all() else None
