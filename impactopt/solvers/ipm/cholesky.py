"""The Cholesky factor of a sparse matrix in dense blocks, for a motion's Newton system."""

from __future__ import annotations

from typing import Any

import numpy as np

from impactopt.solvers.elimination.kernels import Index, Kernels, Panels, Places
from impactopt.solvers.ipm.ordering import elimination_blocks
from impactopt.solvers.program import Vector


class BlockCholesky:
    """L L' = K for matrices whose pattern does not change.

    Variables come in blocks (`ordering`); of each block of columns the blocks of rows that become nonzero are
    kept as one panel, so that the work is a few dense products a panel (Davis, Direct Methods for Sparse
    Linear Systems, 2006, chapter 4: a supernodal factorization).

    Attributes
    ----------
    size : of the array of all panels' numbers.
    """

    def __init__(self, pattern: Any, kernels: Kernels):
        """pattern: which entries may be nonzero (n, n), symmetric."""
        n, self._kernels = pattern.shape[0], kernels
        blocks = elimination_blocks(pattern)
        count, sizes = len(blocks), np.array([b.size for b in blocks], dtype=np.intp)
        self._n, self._order = n, np.concatenate([np.zeros(0, np.intp), *blocks])
        self._place = np.empty(n, dtype=np.intp)
        self._place[self._order] = np.arange(n)
        self._block = np.repeat(np.arange(count), sizes)  # of each place
        start = np.append(0, np.cumsum(sizes))
        i, j = np.nonzero(pattern)
        filled = np.zeros((count, count), dtype=bool)
        filled[self._block[self._place[i]], self._block[self._place[j]]] = True
        below: list[Places] = []
        for k in range(count):
            rows = (np.flatnonzero(filled[k + 1 :, k]) + k + 1).astype(np.int32)
            filled[np.ix_(rows, rows)] = True
            below.append(rows)
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
        """Places of the entries (i, j) of the lower triangle, or (j, i)."""
        low, high = np.maximum(self._place[i], self._place[j]), np.minimum(self._place[i], self._place[j])
        row, column = self._block[low], self._block[high]
        p = self._panels
        across, down = high - p.start[column], p.row_at[row, column] + low - p.start[row]
        out: Index = p.at[column] + p.height[column] * across + down
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
