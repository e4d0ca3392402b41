"""Gaussian elimination in a fixed order of rows and columns: symbolic, without branches."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def elimination_order(matrices: list[Array]) -> tuple[Index, Index]:
    """Row and column order in which Gaussian elimination needs no pivoting at any of the sample matrices.

    Complete pivoting on the least of the samples' normalised magnitudes; with a fixed order the symbolic
    elimination has no branches.
    """
    work = [m / np.abs(m).max() for m in matrices]
    n = work[0].shape[0]
    rows, cols = np.arange(n), np.arange(n)
    for k in range(n):
        size = np.min([np.abs(w[k:, k:]) for w in work], axis=0)
        r, c = np.unravel_index(int(np.argmax(size)), size.shape)
        rows[[k, k + r]], cols[[k, k + c]] = rows[[k + r, k]], cols[[k + c, k]]
        for w in work:
            w[[k, k + r]] = w[[k + r, k]]
            w[:, [k, k + c]] = w[:, [k + c, k]]
            w[k + 1 :, k:] -= np.outer(w[k + 1 :, k] / w[k, k], w[k, k:])
    return rows, cols


def solve_in_order(a: Any, b: Any, order: tuple[Index, Index]) -> tuple[Any, Any]:
    """x of  a x = b  (SX, a square) by elimination in a fixed order, and the product of the pivots.

    Structural zeros are skipped.
    """
    rows, cols = order
    n, k_rhs = a.shape[0], b.shape[1]
    m = [[a[int(r), int(c)] for c in cols] for r in rows]
    y = [[b[int(r), j] for j in range(k_rhs)] for r in rows]
    for k in range(n):
        for i in range(k + 1, n):
            if m[i][k].is_zero():
                continue
            f = m[i][k] / m[k][k]
            for j in range(k + 1, n):
                if not m[k][j].is_zero():
                    m[i][j] = m[i][j] - f * m[k][j]
            for j in range(k_rhs):
                y[i][j] = y[i][j] - f * y[k][j]
    x = ca.SX(n, k_rhs)
    for j in range(k_rhs):
        back: list[Any] = [None] * n
        for i in range(n - 1, -1, -1):
            s = y[i][j]
            for c in range(i + 1, n):
                if not m[i][c].is_zero():
                    s = s - m[i][c] * back[c]
            back[i] = s / m[i][i]
            x[int(cols[i]), j] = back[i]
    pivots = m[0][0]
    for k in range(1, n):
        pivots = pivots * m[k][k]
    return x, pivots
