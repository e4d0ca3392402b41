"""Newton systems made smaller: equalities that determine variables of their own are solved for them first.

A motion's program has thousands of variables that rows determine by themselves: leg joints follow from the
base's pose by the closed legs, a sole's wrench from the equation of motion, a collision's motion from its
beginning. An elimination names such rows and variables, system by system; all systems of one shape are
treated together. What is left is a Newton system in the free variables (Nocedal and Wright 2006, section
15.3: elimination of variables), with the same solution: nothing is approximated.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from impactopt.solvers.elimination.kernels import EliminationStep, Index, Kernels, Places, Products
from impactopt.solvers.program import Determined, Matrix, Vector


class Elimination(NamedTuple):
    """Systems of one shape: equality rows (k, r), and the variables (k, r) that each system's rows determine.

    Those that a row or the Hessian ties to each other are eliminated one after the other, all else at once.
    """

    rows: Index
    variables: Index


class Touched(NamedTuple):
    """Rows and variables of one system.

    q, e : its rows and variables; t : other equality rows that these variables touch; c : variables that its
    rows touch; u : c, and behind them those that only the Hessian couples to e.
    """

    q: Index
    e: Index
    t: Index
    c: Index
    u: Index


def fill(touches: Any, couples: Any, eliminations: Sequence[Elimination]) -> list[list[Touched]]:
    """Mark what becomes nonzero on the way, and find what each system touches.

    The systems of each list of those that come out can be eliminated at once, list after list.
    """
    row_left, column_left = np.ones(touches.shape[0], dtype=bool), np.ones(touches.shape[1], dtype=bool)
    touched_by = np.ascontiguousarray(touches.T)  # the same, as columns are looked at as often as rows
    out = []
    for elimination in eliminations:
        waiting = list(zip(*elimination, strict=True))
        while waiting:
            systems, waiting = _apart(waiting, touched_by, couples, row_left)
            for q, e in systems:
                row_left[q] = column_left[e] = False
            found = []
            for q, e in systems:
                t = np.flatnonzero(touched_by[e].any(axis=0) & row_left)
                c = np.flatnonzero(touches[q].any(axis=0) & column_left)
                more = couples[e].any(axis=0) & column_left
                more[c] = False
                u = np.concatenate([c, np.flatnonzero(more)])
                for rows, columns in ((t, c), (t, e), (q, e)):
                    touches[rows[:, None], columns] = touched_by[columns[:, None], rows] = True
                couples[e[:, None], e] = couples[c[:, None], u] = couples[u[:, None], c] = True
                found.append(Touched(q, e, t, c, u))
            out.append(found)
    return out


_Systems = list[tuple[Index, Index]]  # rows and variables of each


def _apart(systems: _Systems, touched_by: Any, couples: Any, row_left: Any) -> tuple[_Systems, _Systems]:
    """Systems that nothing ties to one before them, and the others."""
    rows, variables = np.zeros(touched_by.shape[1], dtype=bool), np.zeros(touched_by.shape[0], dtype=bool)
    now, later = _Systems(), _Systems()
    for q, e in systems:
        touched = touched_by[e].any(axis=0) & row_left
        if (rows & touched).any() or couples[e][:, variables].any():
            later.append((q, e))
            continue
        rows |= touched
        variables[e] = True
        now.append((q, e))
    return now, later


class Alike(NamedTuple):
    """Groups of rows, each of which touches the same columns, as many as those of the other groups.

    columns (g, p) : of each group; counts (g,) : its rows; rows (k,) : of one group after the other; values
    (k, p) : where their numbers stand in the data.
    """

    columns: Index
    counts: Index
    rows: Index
    values: Places


def by_pattern(jacobian: Matrix, rows: Index) -> list[Alike]:
    """All of these rows that touch any column; the data are those of a csc."""
    numbered = sp.csc_array((np.arange(jacobian.nnz), jacobian.indices, jacobian.indptr), jacobian.shape)
    by_rows = numbered.tocsr()
    by_rows.sort_indices()
    start, columns, at = by_rows.indptr, by_rows.indices, by_rows.data.astype(np.int32)
    touched, ends = columns.tobytes(), (columns.itemsize * start).tolist()
    groups: dict[bytes, int] = {}
    group = np.array([groups.setdefault(touched[ends[i] : ends[i + 1]], len(groups)) for i in rows.tolist()])
    if not group.size:
        return []
    first, counts = np.unique(group, return_index=True, return_counts=True)[1:]
    sizes = (start[1:] - start[:-1])[rows[first]]
    order = np.argsort(group, kind="stable")
    size_of = sizes[group[order]]
    out = []
    for p in dict.fromkeys(sizes[sizes > 0].tolist()):
        chosen, same, every = np.flatnonzero(sizes == p), rows[order[size_of == p]], np.arange(p)
        own = columns[start[rows[first[chosen]]][:, None] + every].astype(np.intp)
        out.append(Alike(own, counts[chosen], same, at[start[same][:, None] + every]))
    return out


def entries(matrix: Any) -> tuple[Index, Index]:
    """np.nonzero, which takes twice as long for two dimensions as for one."""
    return np.divmod(np.flatnonzero(matrix), matrix.shape[1])


def numbered(i: Index, j: Index, shape: tuple[int, ...]) -> tuple[Places, int]:
    """Places of the entries (i, j) in a matrix, counted from 1; the others have 0. And how many there are."""
    out = np.zeros(shape, dtype=np.int32)
    out[i, j] = np.arange(1, i.size + 1)
    return out, i.size


_lower = functools.cache(np.tril_indices)


class Pairs:
    """Places of the entries of W's lower triangle (i, j), counted from 1.

    They take a search in half a million entries. Programs that grow by a few rows ask for the same ones
    again, so those of each pattern of a row are kept.
    """

    def __init__(self, i: Index, j: Index, n: int) -> None:
        """i, j : ascending, row by row."""
        self._n, self._keys = n, i * n + j
        self._of_row: dict[bytes, Places] = {}
        self._of_matrix: tuple[Index, Index, Places] | None = None

    def at(self, i: Index, j: Index) -> Places:
        """Places (k,) of entries (k,); 0: there is none."""
        wanted = i.astype(np.int64) * self._n + j
        found = np.searchsorted(self._keys, wanted).clip(max=self._keys.size - 1)
        return np.where(self._keys[found] == wanted, found + 1, 0).astype(np.int32)

    def of_rows(self, columns: Index) -> Places:
        """Places (k, p (p + 1) / 2) of the products of the numbers of rows with columns (k, p)."""
        i, j = _lower(columns.shape[1])
        keys, ends = columns.tobytes(), range(0, columns.nbytes + 1, max(columns[:1].nbytes, 1))
        names = [keys[one:two] for one, two in itertools.pairwise(ends)]
        new = [k for k, name in enumerate(names) if name not in self._of_row]
        found = self.at(columns[new][:, i].ravel(), columns[new][:, j].ravel())
        self._of_row.update(zip((names[k] for k in new), found.reshape(len(new), i.size), strict=True))
        return np.array([self._of_row[name] for name in names])

    def of_matrix(self, lower: Index, matrix: Matrix) -> Places:
        """Places of a csc's entries, of which ``lower`` are in the lower triangle."""
        known, pattern = self._of_matrix, (matrix.indices, matrix.indptr)
        if known is None or not all(map(np.array_equal, known[:2], pattern)):
            found = self.at(matrix.indices[lower], _columns(matrix)[lower])
            known = self._of_matrix = matrix.indices.copy(), matrix.indptr.copy(), found
        return known[2]


def products(pairs: Pairs, groups: Sequence[Alike]) -> list[Products]:
    """Places of the products of each row's numbers."""
    return [
        Products(counts=counts, rows=rows.astype(np.int32), values=values, to=pairs.of_rows(columns))
        for columns, counts, rows, values in groups
    ]


def shapes(systems: list[Touched]) -> list[list[Touched]]:
    """Systems of one elimination that touch as many variables and rows as each other."""
    out: dict[tuple[int, int, int], list[Touched]] = {}
    for s in systems:
        out.setdefault((s.c.size, s.u.size, s.t.size), []).append(s)
    return list(out.values())


def stage(systems: list[Touched], rows: Places, pairs: Places) -> EliminationStep:
    """Systems of one shape; rows, pairs : places of the entries of equalities and W, as of `numbered`."""
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
    return EliminationStep(**{name: np.ascontiguousarray(a, dtype=np.int32) for name, a in numbers.items()})


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
        i, j = i[i >= j], j[i >= j]
        pairs, coupled = numbered(i, j, couples.shape)
        self._pairs = Pairs(i, j, n)
        self.J, self.W = np.zeros(count + 1), np.zeros(coupled + 1)
        self._to = rows[own_rows, own_columns]
        self._diagonal = np.diagonal(pairs).copy()
        self._products: list[Products] = []
        self._take(jacobian, hessian, equal, groups)
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
        return self._take(jacobian, hessian, equal, by_pattern(jacobian, np.flatnonzero(~equal)))

    def _take(self, jacobian: Matrix, hessian: Matrix, equal: Mask, groups: Sequence[Alike]) -> bool:
        found = products(self._pairs, groups)
        row, column = hessian.indices, _columns(hessian)
        lower = np.flatnonzero(row >= column)
        to = self._pairs.of_matrix(lower, hessian)
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
