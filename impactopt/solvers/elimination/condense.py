"""Newton systems made smaller: equalities that determine variables of their own are solved for them first.

A motion's program has thousands of variables that rows determine by themselves: leg joints follow from the
base's pose by the closed legs, a sole's wrench from the equation of motion, a collision's motion from its
beginning. An elimination names such rows and variables, system by system; all systems of one shape are
treated together. What is left is a Newton system in the free variables (Nocedal and Wright 2006, section
15.3: elimination of variables), with the same solution: nothing is approximated.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from impactopt.solvers.elimination.kernels import Index, Kernels, Places, Products
from impactopt.solvers.elimination.patterns import (
    Alike,
    Elimination,
    by_pattern,
    entries,
    fill,
    numbered,
    products,
    shapes,
    stage,
)
from impactopt.solvers.program import Determined, Matrix, Vector

Mask = npt.NDArray[np.bool_]


def find_eliminations(jacobian: Matrix, equal: Mask, determined: Sequence[Determined]) -> list[Elimination]:
    """The eliminations for variables that a program says are determined by rows of their own.

    Each gets the first equality rows that touch it and are not taken yet; where there are not enough, or they
    do not determine it by their pattern, it stays free. equal (m,): which rows are equalities.
    """
    touches = jacobian.tocsc()
    start, touching = touches.indptr, touches.indices
    taken, touched = ~equal, np.zeros(equal.size, dtype=bool)
    found: dict[tuple[tuple[int, ...], int], list[tuple[Index, Index]]] = {}
    for rank, variables in determined:
        columns = [touching[start[v] : start[v + 1]] for v in variables]
        rows = np.unique(np.concatenate([np.zeros(0, np.intp), *columns]))
        rows = rows[~taken[rows]][: variables.size]
        if rows.size < variables.size or not variables.size:
            continue
        system = np.zeros((rows.size, rows.size), dtype=bool)
        for k, column in enumerate(columns):
            touched[column] = True
            system[k] = touched[rows]
            touched[column] = False
        if not _determines(system.tobytes(), rows.size):
            continue
        taken[rows] = True
        found.setdefault((rank, variables.size), []).append((rows, variables))
    return [
        Elimination(np.array([r for r, _ in found[key]]), np.array([v for _, v in found[key]]))
        for key in sorted(found)
    ]


@functools.lru_cache(maxsize=256)
def _determines(pattern: bytes, size: int) -> bool:
    """True if a square system with this pattern can be regular: most systems have that of another."""
    system = sp.csr_matrix(np.frombuffer(pattern, dtype=bool).reshape(size, size))
    return bool((maximum_bipartite_matching(system) >= 0).all())


def _columns(matrix: Matrix) -> Index:
    """Column of each entry of a csc."""
    return np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))


class Condenser:
    """Eliminates, for matrices whose patterns do not change.

    Rows are those of the program, and behind them one for each eliminated variable that has a bound. Those
    that are no equalities are not eliminated from: they enter the Hessian, W = H + J' diag(w) J, before it.

    Attributes
    ----------
    eliminated : numbers of the rows that are gone.
    rows, free : numbers of the rows and variables that are left.
    equal : which of the rows left are equalities: numbers into `rows`.
    bounded : eliminated variables with a bound, each a row of its own from number m on.
    m, n : number of rows with those of `bounded`, and of variables.
    left : of each equality left the free variables that it touches, and places of these numbers in `J`.
    at_free : places of the numbers of free variables in what `reduce` gives, and their rows and columns.
    pattern : which of the free variables W couples (f, f), once all is eliminated, with those that an
        equality left touches.
    """

    def __init__(
        self,
        jacobian: Matrix,
        hessian: Matrix,
        eliminations: Sequence[Elimination],
        equal: Mask,
        bounded: Mask,
        kernels: Kernels,
    ):
        """Patterns of the Jacobian (m, n) and the Hessian (n, n), csc; equal (m,): which rows are equalities;
        bounded (n,): variables with a finite bound.
        """
        m, n = jacobian.shape
        self._kernels, self.n = kernels, n
        number = np.full(m, -1)  # of an equality among them
        number[equal] = np.arange(int(equal.sum()))
        gone = np.concatenate([np.zeros(0, np.intp), *[e.variables.ravel() for e in eliminations]])
        taken = np.concatenate([np.zeros(0, np.intp), *[e.rows.ravel() for e in eliminations]])
        self._taken = np.sort(number[taken])
        self._left = np.setdiff1d(np.arange(int(equal.sum())), self._taken)
        self.bounded = np.sort(gone[bounded[gone]])
        self.free = np.setdiff1d(np.arange(n), gone)

        own = number[jacobian.indices]
        own_rows, own_columns = own[own >= 0], _columns(jacobian)[own >= 0]
        touches = np.zeros((int(equal.sum()), n), dtype=bool)
        touches[own_rows, own_columns] = True
        groups = by_pattern(jacobian, np.flatnonzero(~equal))
        couples = np.eye(n, dtype=bool)
        couples[hessian.indices, _columns(hessian)] = True
        for group in groups:
            couples[group.columns[:, :, None], group.columns[:, None, :]] = True
        systems = fill(touches, couples, [Elimination(number[q], e) for q, e in eliminations])

        rows, count = numbered(*entries(touches), touches.shape)
        i, j = entries(couples)
        i, j = self._entries = i[i >= j], j[i >= j]
        pairs, coupled = numbered(i, j, couples.shape)
        self.J, self.W = np.zeros(count + 1), np.zeros(coupled + 1)
        self._to = rows[own_rows, own_columns]
        self._diagonal = np.diagonal(pairs).copy()
        self._products: list[Products] = []
        self._take(jacobian, hessian, equal, pairs, groups)
        pairs[j, i] = pairs[i, j]
        self._stages = [stage(same, rows, pairs) for found in systems for same in shapes(found)]
        self.pattern = couples[np.ix_(self.free, self.free)]
        of_left = touches[np.ix_(self._left, self.free)]
        self.left = [
            (np.flatnonzero(t), rows[k, self.free[t]]) for k, t in zip(self._left, of_left, strict=True)
        ]
        for columns, _ in self.left:
            self.pattern[np.ix_(columns, columns)] = True
        none = np.zeros(0, dtype=np.intp)
        at = (np.concatenate([none, *[one[k] for one in self.left]]) for k in (0, 1))
        self._of_left = np.repeat(np.arange(len(self.left)), of_left.sum(axis=1)), *at
        place = np.full(n, -1)
        place[self.free] = np.arange(self.free.size)
        inside = (place[i] >= 0) & (place[j] >= 0)
        self.at_free = (np.flatnonzero(inside) + 1).astype(np.int32), place[i[inside]], place[j[inside]]

    def take(self, jacobian: Matrix, hessian: Matrix, equal: Mask) -> bool:
        """Be that of matrices with other patterns but the same equalities; False: these rows or this Hessian
        couple variables that nothing has coupled yet, and all stays as it was.
        """
        pairs, _ = numbered(*self._entries, (self.n, self.n))
        return self._take(jacobian, hessian, equal, pairs, by_pattern(jacobian, np.flatnonzero(~equal)))

    def _take(
        self, jacobian: Matrix, hessian: Matrix, equal: Mask, pairs: Places, groups: Sequence[Alike]
    ) -> bool:
        """pairs : places of the entries of W's lower triangle, as of `numbered`."""
        found = products(pairs, groups)
        row, column = hessian.indices, _columns(hessian)
        lower = np.flatnonzero(row >= column)
        to = pairs[row[lower], column[lower]]
        if not (to.all() and all(p.to.all() for p in found)):
            return False
        self._kernels.forget(self._products)
        self._products, self._own_hessian = found, (lower.astype(np.int32), to)
        at = np.flatnonzero(row == column)
        self._curved = at, row[at]
        self._own_jacobian = np.flatnonzero(equal[jacobian.indices]).astype(np.int32), self._to
        self._equations = np.flatnonzero(equal)
        self.eliminated = self._equations[self._taken]
        self.m = equal.size + self.bounded.size
        self.rows = np.setdiff1d(np.arange(self.m), self.eliminated)
        self.equal = np.searchsorted(self.rows, self._equations[self._left])
        return True

    # ------------------------------------------------------------------ numbers
    def load(self, jacobian: Matrix, hessian: Matrix) -> None:
        """Take new values, with the patterns given at first, and eliminate in the equalities.

        Raises
        ------
        LinAlgError : rows do not determine their variables.
        """
        self._jacobian, self._hessian = (
            np.ascontiguousarray(a.data, dtype=float) for a in (jacobian, hessian)
        )
        self.J[:] = 0.0
        where, to = self._own_jacobian
        self._kernels.copy(self._jacobian, where, self.J, to)
        self._kernels.eliminate(self._stages, self.J)

    @property
    def A(self) -> Vector:
        """Jacobian of the equalities left, by the free variables (l, f)."""
        out = np.zeros((len(self.left), self.free.size))
        rows, columns, at = self._of_left
        out[rows, columns] = self.J[at]
        return out

    @property
    def curvature(self) -> Vector:
        """Curvature of the Hessian, along the free variables (f,)."""
        out = np.zeros(self.n)
        at, variables = self._curved
        out[variables] = self._hessian[at]
        return out[self.free]

    def reduce(self, weights: Vector, diagonal: Vector) -> Vector:
        """H + diag(diagonal) + J' diag(weights) J, eliminated from: its values, to be read by `at_free`.

        weights (m,) of the rows: those of equalities play no part; diagonal (n,).
        """
        self.W[:] = 0.0
        where, to = self._own_hessian
        self._kernels.copy(self._hessian, where, self.W, to)
        self.W[self._diagonal] += diagonal
        bounds = self._diagonal[self.bounded]
        self.W[bounds] += weights[self.m - self.bounded.size :]
        self._kernels.add_products(self._products, self._jacobian, weights, self.W)
        self._kernels.reduce(self._stages, self.W)
        return self.W

    def forward(self, gradient: Vector, residual: Vector) -> tuple[Vector, Vector]:
        """Gradient by the free variables (f,) and residual of the equalities left (l,), where the step meets
        those eliminated.

        gradient : (n,) of what belongs to W; residual (m,).
        """
        g, off = gradient.copy(), residual[self._equations]
        self._kernels.forward(self._stages, g, off)
        return g[self.free], off[self._left]

    def expand(self, step: Vector) -> Vector:
        """The step of all variables (n,) for one of the free ones (f,), after `forward`."""
        d = np.zeros(self.n)
        d[self.free] = step
        self._kernels.expand(self._stages, d)
        return d

    def particular(self, residual: Vector) -> Vector:
        """The step (n,) with which the eliminated equalities are met and no free variable moves; residual
        (m,)."""
        self.forward(np.zeros(self.n), residual)
        return self.expand(np.zeros(self.free.size))

    def expand_basis(self, Z: np.ndarray) -> None:
        """Steps of eliminated variables for those of the free ones, each a column of Z (n, k), in place."""
        # backwards: what a system determines may depend on variables that later ones determine
        for a in reversed(self._stages):
            Z[a.e] = -(a.X.swapaxes(1, 2) @ Z[a.c])

    def multipliers(self, dual: Vector, y: Vector) -> Vector:
        """Multipliers of the eliminated rows.

        dual (n,) : gradient of the Lagrangian without the equalities; y (l,) : multipliers of those left.
        """
        v, out = dual.copy(), np.zeros(self._equations.size)
        out[self._left] = y
        self._kernels.multipliers(self._stages, v, out)
        everything = np.zeros(self.m)
        everything[self._equations] = out
        return everything[self.eliminated]
