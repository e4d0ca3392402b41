"""Refinement of an approximate QP solution to an exact one: the primal-dual active-set method.

Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13, 2002.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from impactopt.solvers.program import Matrix, Vector
from impactopt.solvers.qp.quadratic_program import QuadraticProgram

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
