"""The small dense algebra of condensed Newton systems, in NumPy: what runs where there is no compiler.

`compiled.py` does the same in C, with `native/newton.c`: the same operations on the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from impactopt.solvers.program import Vector

Index = npt.NDArray[np.intp]
Places = npt.NDArray[np.int32]
Stack = npt.NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class EliminationStep:
    """Systems (k) of one shape, r rows each: where their numbers stand, and what eliminating them found.

    Places of what is not there point to the number in front of all others, which is zero.

    Attributes
    ----------
    q, e (k, r), t (k, nt) : numbers of the equalities, of the variables they determine, of other equalities
        that these touch; u (k, nu) : of the variables that rows or Hessian couple to e, first those, nc, that
        the rows touch.
    qe (k, column, row), qc (k, nc, r), te (k, nt, r), tc (k, nt, nc) : places in the equalities' values.
    hee (k, r, r), heu (k, nu, r), hcv (k, nc, nu - nc) : places in the values of W's lower triangle; hcc (k,
        nc (nc + 1) / 2) : of the lower triangle of the variables that the rows touch.
    lu, pivots : factors of B = the part qe. X (k, nc, r) : of B^-1 N, transposed. T (k, nt, r) : part te.
    H (k, r, r), G (k, nu, r) : parts hee and heu. x0 (k, r) : B^-1 residual. own (k, r) : a gradient's part.
    """

    q: Places
    e: Places
    t: Places
    u: Places
    qe: Places
    qc: Places
    te: Places
    tc: Places
    hee: Places
    heu: Places
    hcc: Places
    hcv: Places
    lu: Stack = field(init=False)
    pivots: Places = field(init=False)
    X: Stack = field(init=False)
    T: Stack = field(init=False)
    H: Stack = field(init=False)
    G: Stack = field(init=False)
    x0: Stack = field(init=False)
    own: Stack = field(init=False)

    def __post_init__(self) -> None:
        k, nt, nc = self.tc.shape
        r, nu = self.q.shape[1], self.u.shape[1]
        self.lu, self.pivots = np.zeros((k, r, r)), np.zeros((k, r), dtype=np.int32)
        self.X, self.T = np.zeros((k, nc, r)), np.zeros((k, nt, r))
        self.H, self.G = np.zeros((k, r, r)), np.zeros((k, nu, r))
        self.x0, self.own = np.zeros((k, r)), np.zeros((k, r))

    @property
    def c(self) -> Places:
        """Numbers (k, nc) of the variables that the rows touch."""
        return self.u[:, : self.X.shape[1]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Products:
    """Groups (g,) of rows that touch the same p columns.

    Attributes
    ----------
    counts (g,) : of each group its rows.  rows (k,), values (k, p) : rows, one group after the other, and
        places of their values.  to (g, p (p + 1) / 2) : places of products of two, a row's lower triangle.
    """

    counts: Index
    rows: Places
    values: Places
    to: Places


@dataclass(frozen=True, eq=False, kw_only=True)
class Panels:
    """The lower triangle of a matrix in blocks: of each block of columns, one dense matrix of the blocks of
    rows that are not zero, by columns.

    Attributes
    ----------
    start : of each block, and the end; at : where its panel begins in the values, and the end.
    height : rows of the panel. below : of each block, blocks of rows under the diagonal. row_at (block,
        panel) : the row of a panel at which a block begins, -1: it is not in there.
    """

    start: Places
    at: Index
    height: Places
    below: tuple[Places, ...]
    row_at: Places

    @property
    def size(self) -> Places:
        """Rows of each block."""
        return np.diff(self.start)


class Kernels:
    """Kernels in NumPy."""

    def forget(self, thing: Any) -> None:
        """No operation will be asked for with this list of steps or products any more."""

    def copy(self, values: Vector, source: Places, to: Vector, places: Places) -> None:
        """to[places] = values[source]"""
        to[places] = values[source]

    def add_products(self, products: Sequence[Products], values: Vector, weights: Vector, W: Vector) -> None:
        """W += J' diag(weights) J."""
        for p in products:
            part = values[p.values]
            i, j = np.tril_indices(part.shape[1])
            _add(W, np.repeat(p.to, p.counts, axis=0), weights[p.rows][:, None] * part[:, i] * part[:, j])

    def eliminate(self, stages: Sequence[EliminationStep], J: Vector) -> None:
        """X = B^-1 N, and the other equalities' values with the step -X d_c in place of d_e.

        Raises
        ------
        LinAlgError : B is singular.
        """
        for a in stages:
            a.T[:] = J[a.te]
            for i, (B, N) in enumerate(zip(J[a.qe], J[a.qc], strict=True)):
                lu, pivots, info = la.lapack.dgetrf(B.T)
                if info:
                    raise np.linalg.LinAlgError("rows do not determine their variables")
                a.lu[i], a.pivots[i] = lu.T, pivots
                a.X[i] = la.lapack.dgetrs(lu, pivots, N.T)[0].T
            _add(J, a.tc, -(a.T @ a.X.swapaxes(1, 2)))

    def reduce(self, stages: Sequence[EliminationStep], W: Vector) -> None:
        """W with -X d_c in place of d_e."""
        for a in stages:
            a.H[:], a.G[:] = W[a.hee], W[a.heu]
            G, nc = -a.G, a.X.shape[1]
            G[:, :nc] += 0.5 * a.X @ a.H
            C = a.X @ G.swapaxes(1, 2)
            i, j = np.tril_indices(nc)
            _add(W, a.hcc, C[:, i, j] + C[:, j, i])
            _add(W, a.hcv, C[:, :, nc:])

    def forward(self, stages: Sequence[EliminationStep], g: Vector, off: Vector) -> None:
        """Gradient and residual with d_e = -(x0 + X d_c)."""
        for a in stages:
            a.x0[:] = self._solve(a, off[a.q], 0)
            _add(off, a.t, -(a.T @ a.x0[..., None])[..., 0])
            own = g[a.e] - (a.H @ a.x0[..., None])[..., 0]
            _add(g, a.c, -(a.X @ own[..., None])[..., 0])
            _add(g, a.u, -(a.G @ a.x0[..., None])[..., 0])

    def expand(self, stages: Sequence[EliminationStep], d: Vector) -> None:
        """d_e of all stages, the last one first."""
        for a in reversed(stages):
            d[a.e] = -a.x0 - (d[a.c][:, None] @ a.X)[:, 0]

    def multipliers(self, stages: Sequence[EliminationStep], v: Vector, y: Vector) -> None:
        """Multipliers of the stages' rows, from a gradient, which is spent, and those of the other rows."""
        for a in stages:
            a.own[:] = v[a.e]
            _add(v, a.c, -(a.X @ a.own[..., None])[..., 0])
        for a in reversed(stages):
            y[a.q] = -self._solve(a, a.own + (y[a.t][:, None] @ a.T)[:, 0], 1)

    def factor(self, p: Panels, values: Vector) -> bool:
        """The panels of L in place of those of L L'; False: the matrix is not positive definite."""
        size, panels = p.size, _split(p, values)
        for k, panel in enumerate(panels):
            own = size[k]
            panel[:own], info = la.lapack.dpotrf(panel[:own], lower=1)
            if info:
                return False
            under = la.blas.dtrsm(1.0, panel[:own], panel[own:], side=1, lower=1, trans_a=1)
            panel[own:] = under
            update = under @ under.T
            for column in p.below[k]:
                b = p.row_at[column, k] - own
                for row in p.below[k][p.below[k] >= column]:
                    a, to = p.row_at[row, k] - own, p.row_at[row, column]
                    panels[column][to : to + size[row]] -= update[a : a + size[row], b : b + size[column]]
        return True

    def solve(self, p: Panels, values: Vector, x: Stack) -> Stack:
        """(L L')^-1 x for columns (n, k)."""
        blocks = [slice(a, b) for a, b in zip(p.start[:-1], p.start[1:], strict=True)]
        every = np.arange(p.start[-1])
        under = [np.concatenate([every[:0], *[every[blocks[i]] for i in below]]) for below in p.below]
        panels = _split(p, values)
        for panel, own, rows in zip(panels, blocks, under, strict=True):
            size = own.stop - own.start
            x[own] = la.blas.dtrsm(1.0, panel[:size], x[own], lower=1)
            x[rows] -= panel[size:] @ x[own]
        for panel, own, rows in zip(panels[::-1], blocks[::-1], under[::-1], strict=True):
            size = own.stop - own.start
            x[own] = la.blas.dtrsm(1.0, panel[:size], x[own] - panel[size:].T @ x[rows], lower=1, trans_a=1)
        return x

    @staticmethod
    def _solve(a: EliminationStep, right: Stack, transposed: int) -> Stack:
        found = [
            la.lapack.dgetrs(lu.T, p, b, trans=transposed)[0]
            for lu, p, b in zip(a.lu, a.pivots, right, strict=True)
        ]
        return np.array(found)


def _add(to: Vector, where: Places, what: Stack) -> None:
    """Add numbers; places may repeat."""
    np.add.at(to, where.ravel(), what.ravel())


def _split(p: Panels, values: Vector) -> list[Stack]:
    return [values[a:b].reshape(-1, h).T for a, b, h in zip(p.at[:-1], p.at[1:], p.height, strict=True)]
