"""The Cholesky factor of a sparse matrix in dense blocks, for a motion's Newton system."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from impactopt.program import Vector
from impactopt.sqp.kernels import Index, Kernels, Panels, Places

_BLOCK = 32  # variables


class BlockCholesky:
    """L L' = K for matrices whose pattern does not change.

    Variables come in blocks; of each block of columns the blocks of rows that become nonzero are kept as one
    panel, so that the work is a few dense products a panel (Davis, Direct Methods for Sparse Linear Systems,
    2006, chapter 4: a supernodal factorization whose supernodes have one size).

    Attributes
    ----------
    size : of the array of all panels' numbers.
    """

    def __init__(self, pattern: Any, sequence: Vector | None, kernels: Kernels):
        """pattern: which entries may be nonzero (n, n), symmetric; sequence (n,): variables near each other
        in it touch each other, None: to be found.
        """
        n, self._kernels = pattern.shape[0], kernels
        if sequence is None:
            order = reverse_cuthill_mckee(sp.csr_matrix(pattern), symmetric_mode=True).astype(np.intp)
        else:
            order = np.argsort(sequence, kind="stable")
        self._n, self._order = n, order
        self._place = np.empty(n, dtype=np.intp)
        self._place[order] = np.arange(n)
        starts = np.arange(0, n, _BLOCK)
        start = np.append(starts, n)
        count = starts.size
        i, j = np.nonzero(pattern)
        filled = np.zeros((count, count), dtype=bool)
        filled[self._place[i] // _BLOCK, self._place[j] // _BLOCK] = True
        below: list[Places] = []
        for k in range(count):
            rows = (np.flatnonzero(filled[k + 1 :, k]) + k + 1).astype(np.int32)
            filled[np.ix_(rows, rows)] = True
            below.append(rows)
        sizes = np.diff(start)
        row_at = np.full((count, count), -1, dtype=np.int32)
        height, at = np.zeros(count, dtype=np.int32), np.zeros(count + 1, dtype=np.intp)
        for k, rows in enumerate(below):
            stacked = np.concatenate([[k], rows]).astype(np.intp)
            ends = np.cumsum(sizes[stacked])
            row_at[stacked, k] = ends - sizes[stacked]
            height[k] = ends[-1]
            at[k + 1] = at[k] + ends[-1] * sizes[k]
        self._panels = Panels(
            start=start.astype(np.int32), at=at, height=height, below=tuple(below), row_at=row_at
        )
        self.size = int(at[-1])

    def places(self, i: Index, j: Index) -> Index:
        """Where the entries (i, j) of the lower triangle, or (j, i), stand."""
        low, high = np.maximum(self._place[i], self._place[j]), np.minimum(self._place[i], self._place[j])
        row, column = low // _BLOCK, high // _BLOCK
        p = self._panels
        out: Index = p.at[column] + p.height[column] * (high % _BLOCK) + p.row_at[row, column] + low % _BLOCK
        return out

    def factor(self, values: Vector) -> bool:
        """Factor the matrix with these values (size,), overwriting them; False: not positive definite."""
        self._values = values
        return self._kernels.factor(self._panels, values)

    def solve(self, right: Vector) -> Vector:
        """K^-1 times a vector (n,) or columns (n, k)."""
        x = np.asfortranarray(right[self._order].reshape(self._n, -1))
        x = self._kernels.solve(self._panels, self._values, x)
        out = np.empty(x.shape)
        out[self._order] = x
        return out.reshape(right.shape)
