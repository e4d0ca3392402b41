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
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from impactopt.program import Matrix, Vector
from impactopt.sqp.kernels import Index, Kernels, Places, Products, Stage

Mask = npt.NDArray[np.bool_]


class Elimination(NamedTuple):
    """Systems of one shape: equality rows (k, r), and the variables (k, r) that each system's rows determine.

    No row may touch the variables of two systems of the same elimination.
    """

    rows: Index
    variables: Index


class Determined(NamedTuple):
    """Variables that equality rows of their own determine; those of lower rank are eliminated first."""

    rank: tuple[int, ...]
    variables: Index


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
    """Whether a square system with this pattern can be regular: most systems have that of another."""
    system = sp.csr_matrix(np.frombuffer(pattern, dtype=bool).reshape(size, size))
    return bool((maximum_bipartite_matching(system) >= 0).all())


class _Touched(NamedTuple):
    """What one system touches.

    q, e : its rows and variables; t : other equality rows that these variables touch; c : variables that its
    rows touch; u : c, and behind them those that only the Hessian couples to e.
    """

    q: Index
    e: Index
    t: Index
    c: Index
    u: Index


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
        self._kernels = kernels
        gone = np.concatenate([np.zeros(0, np.intp), *[e.variables.ravel() for e in eliminations]])
        taken = np.concatenate([np.zeros(0, np.intp), *[e.rows.ravel() for e in eliminations]])
        self.eliminated = np.sort(taken)
        self.bounded = np.sort(gone[bounded[gone]])
        self.m, self.n = m + self.bounded.size, n
        left, free = np.ones(self.m, dtype=bool), np.ones(n, dtype=bool)
        left[self.eliminated] = free[gone] = False
        self.rows, self.free = np.flatnonzero(left), np.flatnonzero(free)
        self._equations = np.flatnonzero(equal)
        self.equal = np.searchsorted(self.rows, self._equations[left[self._equations]])

        number = np.full(m, -1)  # of an equality among them
        number[self._equations] = np.arange(self._equations.size)
        J, H = jacobian.tocoo(), hessian.tocoo()
        mine = np.flatnonzero(number[J.row] >= 0)
        own_rows, own_columns = number[J.row[mine]], J.col[mine]
        touches = np.zeros((self._equations.size, n), dtype=bool)
        touches[own_rows, own_columns] = True
        groups = _alike(_by_pattern(jacobian, np.setdiff1d(self.rows[self.rows < m], self._equations)))
        couples = np.eye(n, dtype=bool)
        couples[H.row, H.col] = True
        for columns, _ in groups:
            couples[columns[:, :, None], columns[:, None, :]] = True
        systems = _fill(touches, couples, [Elimination(number[q], e) for q, e in eliminations])

        p, c = _entries(touches)
        rows, none = _numbered(p, c, touches.shape)
        i, j = _entries(couples)
        i, j = i[i >= j], j[i >= j]
        pairs, nothing = _numbered(i, j, couples.shape)
        pairs[j, i] = pairs[i, j]
        self.J, self.W = np.zeros(none + 1), np.zeros(nothing + 1)
        self._own_jacobian = mine.astype(np.int32), rows[own_rows, own_columns]
        lower = H.row >= H.col
        self._own_hessian = np.flatnonzero(lower).astype(np.int32), pairs[H.row[lower], H.col[lower]]
        self._diagonal = np.diagonal(pairs).copy()
        at = np.flatnonzero(H.row == H.col)
        self._curved = at, H.row[at]
        self._products = [made for columns, same in groups for made in _products(pairs, columns, same)]
        self._stages = [_stage(same, rows, pairs) for found in systems for same in _shapes(found)]
        self._left = number[self.rows[self.equal]]
        self.pattern = couples[np.ix_(self.free, self.free)]
        of_left = touches[np.ix_(self._left, self.free)]
        self.left = [
            (np.flatnonzero(t), rows[k, self.free[t]]) for k, t in zip(self._left, of_left, strict=True)
        ]
        for columns, _ in self.left:
            self.pattern[np.ix_(columns, columns)] = True
        place = np.full(n, -1)
        place[self.free] = np.arange(self.free.size)
        inside = (place[i] >= 0) & (place[j] >= 0)
        self.at_free = np.flatnonzero(inside).astype(np.int32), place[i[inside]], place[j[inside]]

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
        """Of the equalities left, by the free variables (l, f)."""
        out = np.zeros((len(self.left), self.free.size))
        for row, (columns, at) in zip(out, self.left, strict=True):
            row[columns] = self.J[at]
        return out

    @property
    def curvature(self) -> Vector:
        """Of the Hessian, along the free variables (f,)."""
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
        g, off = np.append(gradient, 0.0), np.append(residual[self._equations], 0.0)
        self._kernels.forward(self._stages, g, off)
        return g[self.free], off[self._left]

    def expand(self, step: Vector) -> Vector:
        """The step of all variables (n,) for one of the free ones (f,), after `forward`."""
        d = np.zeros(self.n + 1)
        d[self.free] = step
        self._kernels.expand(self._stages, d)
        return d[:-1]

    def multipliers(self, dual: Vector, y: Vector) -> Vector:
        """Multipliers of the eliminated rows.

        dual (n,) : gradient of the Lagrangian without the equalities; y (l,) : multipliers of those left.
        """
        v, out = np.append(dual, 0.0), np.zeros(self._equations.size + 1)
        out[self._left] = y
        self._kernels.multipliers(self._stages, v, out)
        everything = np.zeros(self.m)
        everything[self._equations] = out[:-1]
        return everything[self.eliminated]


# ---------------------------------------------------------------- patterns
def _fill(touches: Any, couples: Any, eliminations: Sequence[Elimination]) -> list[list[_Touched]]:
    """Mark what becomes nonzero on the way, and find what each system touches."""
    row_left, column_left = np.ones(touches.shape[0], dtype=bool), np.ones(touches.shape[1], dtype=bool)
    others = np.zeros(touches.shape[1], dtype=bool)
    out = []
    for q_all, e_all in eliminations:
        row_left[q_all.ravel()] = False
        column_left[e_all.ravel()] = False
        others[e_all.ravel()] = True
        found, touched = [], np.zeros(touches.shape[0], dtype=np.intp)
        for q, e in zip(q_all, e_all, strict=True):
            t = np.flatnonzero(touches[:, e].any(axis=1) & row_left)
            c = np.flatnonzero(touches[q].any(axis=0) & column_left)
            coupled = couples[e].any(axis=0)
            others[e] = False
            if (coupled & others).any():
                raise ValueError("the Hessian couples variables of two systems of one elimination")
            others[e] = True
            more = coupled & column_left
            more[c] = False
            u = np.concatenate([c, np.flatnonzero(more)])
            touched[t] += 1
            touches[np.ix_(t, c)] = touches[np.ix_(t, e)] = True
            touches[np.ix_(q, e)] = couples[np.ix_(e, e)] = True
            couples[np.ix_(c, u)] = couples[np.ix_(u, c)] = True
            found.append(_Touched(q, e, t, c, u))
        others[e_all.ravel()] = False
        if (touched > 1).any():
            raise ValueError(f"row {int(np.argmax(touched > 1))} touches two systems of one elimination")
        out.append(found)
    return out


_Rows = tuple[Index, Index, Places]


def _by_pattern(jacobian: Matrix, rows: Index) -> list[_Rows]:
    """Columns, rows that touch just them, and where their values (rows, columns) stand in the data, csc."""
    numbered = sp.csc_array((np.arange(jacobian.nnz), jacobian.indices, jacobian.indptr), jacobian.shape)
    by_rows = numbered.tocsr()
    by_rows.sort_indices()
    start, columns, at = by_rows.indptr, by_rows.indices, by_rows.data.astype(np.int32)
    found: dict[bytes, list[int]] = {}
    for i in rows:
        found.setdefault(columns[start[i] : start[i + 1]].tobytes(), []).append(i)
    found.pop(b"", None)
    out = []
    for key, numbers in found.items():
        own, same = np.frombuffer(key, dtype=columns.dtype).astype(np.intp), np.array(numbers)
        out.append((own, same, at[start[same][:, None] + np.arange(own.size)]))
    return out


def _entries(matrix: Any) -> tuple[Index, Index]:
    """np.nonzero, which takes twice as long for two dimensions as for one."""
    return np.divmod(np.flatnonzero(matrix), matrix.shape[1])


def _numbered(i: Index, j: Index, shape: tuple[int, ...]) -> tuple[Places, int]:
    """Places of the entries (i, j), counted from 0, in a matrix; the others have the number of all."""
    out = np.full(shape, i.size, dtype=np.int32)
    out[i, j] = np.arange(i.size)
    return out, i.size


_lower = functools.cache(np.tril_indices)


def _alike(groups: Sequence[_Rows]) -> list[tuple[Index, list[_Rows]]]:
    """All columns (group, column) of those groups that have as many as each other, and these groups."""
    sizes: dict[int, list[_Rows]] = {}
    for group in groups:
        sizes.setdefault(group[0].size, []).append(group)
    return [(np.array([columns for columns, _, _ in same]), same) for same in sizes.values()]


def _products(pairs: Places, columns: Index, groups: list[_Rows]) -> list[Products]:
    i, j = _lower(columns.shape[1])
    return [
        Products(rows=rows.astype(np.int32), values=values, to=to)
        for (_, rows, values), to in zip(groups, pairs[columns[:, i], columns[:, j]], strict=True)
    ]


def _shapes(systems: list[_Touched]) -> list[list[_Touched]]:
    """Systems of one elimination that touch as many variables and rows as each other."""
    out: dict[tuple[int, int, int], list[_Touched]] = {}
    for s in systems:
        out.setdefault((s.c.size, s.u.size, s.t.size), []).append(s)
    return list(out.values())


def _stage(systems: list[_Touched], rows: Places, pairs: Places) -> Stage:
    """Systems of one shape; rows, pairs : places of the entries of equalities and W, as of `_numbered`."""
    q, e, t, c, u = (np.array([getattr(s, name) for s in systems]) for name in ("q", "e", "t", "c", "u"))
    i, j = _lower(c.shape[1])
    places = {
        "qe": rows[q[:, None, :], e[:, :, None]],
        "qc": rows[q[:, None, :], c[:, :, None]],
        "te": rows[t[:, :, None], e[:, None, :]],
        "tc": rows[t[:, :, None], c[:, None, :]],
        "hee": pairs[e[:, :, None], e[:, None, :]],
        "heu": pairs[u[:, :, None], e[:, None, :]],
        "hcc": pairs[c[:, i], c[:, j]],
        "hcv": pairs[c[:, :, None], u[:, None, c.shape[1] :]],
    }
    numbers = {"q": q, "e": e, "t": t, "u": u, **places}
    return Stage(**{name: np.ascontiguousarray(a, dtype=np.int32) for name, a in numbers.items()})
