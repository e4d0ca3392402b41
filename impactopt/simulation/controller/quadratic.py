"""The controller's QP in OSQP: dense matrices whose places never change, updated in place, warm."""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
import scipy.sparse as sp
from numpy.typing import NDArray

__all__ = ["TorqueQP"]

Array = NDArray[np.float64]
RHO, SIGMA, RELAXED = 0.1, 1e-6, 1.6  # of OSQP's ADMM; rows and unknowns are scaled to about one
BARRED = 1e30  # OSQP's infinity


class TorqueQP:
    """min 1/2 x' P x + q' x  with  C x >= c,  low <= x <= high, for n unknowns and m rows C.

    A fixed number of iterations from the answer to the QP before.
    """

    def __init__(self, n: int, m: int, *, iterations: int) -> None:
        P = sp.csc_matrix(np.triu(np.ones((n, n))))
        A = sp.csc_matrix(np.vstack([np.ones((m, n)), np.eye(n)]))
        for matrix in (P, A):
            matrix.sort_indices()
        self._at = [(M.indices, np.repeat(np.arange(n), np.diff(M.indptr))) for M in (P, A)]
        self.m, self._rows = m, np.vstack([np.zeros((m, n)), np.eye(n)])
        self._upper = np.full(m, BARRED)
        P.data[:] = self._at[0][0] == self._at[0][1]
        A.data[:] = self._rows[self._at[1]]
        self._solver: Any = osqp.OSQP()
        self._solver.setup(
            P, np.zeros(n), A, np.full(m + n, -BARRED), np.full(m + n, BARRED),
            scaling=0, adaptive_rho=False, rho=RHO, sigma=SIGMA, alpha=RELAXED, max_iter=iterations,
            check_termination=0, polishing=False, warm_starting=True, verbose=False,
        )  # fmt: skip

    def solve(self, P: Array, q: Array, C: Array, c: Array, low: Array, high: Array) -> Array:
        """x (n,), inside its bounds."""
        self._rows[: self.m] = C
        self._solver.update(Px=P[self._at[0]], Ax=self._rows[self._at[1]])
        self._solver.update(q=q, l=np.concatenate([c, low]), u=np.concatenate([self._upper, high]))
        x = np.array(self._solver.solve(raise_error=False).x)
        return np.clip(x, low, high)
