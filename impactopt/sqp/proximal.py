"""A multiple of the identity added to Hessians.

Minimizing with weight/2 |d|^2 beside the model keeps steps short in directions that nothing decides: the
proximal point method (Rockafellar 1976), its centre the iterate. It changes steps, not solutions.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from impactopt.program import Matrix


class Proximal:
    """Adds to matrices of one pattern, whose diagonal becomes part of the pattern."""

    def __init__(self, hessian: Matrix):
        """Pattern of the matrices: csc (n, n)."""
        own, n = hessian.tocoo(), hessian.shape[0]
        key = np.concatenate([own.col.astype(np.int64) * n + own.row, np.arange(n) * (n + 1)])
        entries, place = np.unique(key, return_inverse=True)
        self._own, self._diagonal = place[: own.nnz], place[own.nnz :]
        self._indices = (entries % n).astype(np.int32)
        self._starts = np.searchsorted(entries, np.arange(n + 1) * n).astype(np.int32)

    def add(self, hessian: Matrix, weight: float) -> Matrix:
        """The matrix with `weight` added to its diagonal, csc (n, n)."""
        values = np.zeros(self._indices.size)
        values[self._own] = hessian.data
        values[self._diagonal] += weight
        return sp.csc_array((values, self._indices, self._starts), shape=hessian.shape)
