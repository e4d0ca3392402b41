"""Condensation of Newton systems: equalities that determine variables are solved for these first.

Equalities determine most of the thousands of variables of a motion's program. Leg joints follow from the
base's pose, as the legs are closed; a sole's wrench follows from the equation of motion; the motion during a
collision follows from its initial state. An elimination lists such equalities and variables as many small
systems of one shape, which are treated together. A Newton system in the free variables remains (Nocedal and
Wright 2006, section 15.3: elimination of variables). It has the same solution: nothing is approximated.

The analysis of the patterns is here, once for each structure; the arithmetic is in `kernels`.
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

from impactopt.arrays import Index
from impactopt.errors import InputError
from impactopt.solvers.elimination.kernels import EliminationStage, Kernels, Places, Products
from impactopt.solvers.program import PATTERN_CHANGED, Determined, Matrix, Vector


class Elimination(NamedTuple):
    """Systems of one shape: equalities (k, r), and the variables (k, r) that those of each system determine.

    Systems coupled by a constraint or by the Hessian are eliminated one after the other, all others at once.
    """

    constraints: Index
    variables: Index


class Touched(NamedTuple):
    """Constraints and variables of one system.

    q, e : its equalities, and the variables that they determine.
    t : other equalities that contain variables of e.
    c : other variables in the equalities q.
    u : c, then the variables that only the Hessian couples to e.
    """

    q: Index
    e: Index
    t: Index
    c: Index
    u: Index


def fill(touches: Any, couples: Any, eliminations: Sequence[Elimination]) -> list[list[Touched]]:
    """Symbolic elimination: mark the fill-in, in place, and list what each system touches.

    touches : which variables each equality contains.  couples (n, n) : which variables the Hessian couples.

    The systems of each list that is returned can be eliminated at once, list after list.
    """
    row_left, column_left = np.ones(touches.shape[0], dtype=bool), np.ones(touches.shape[1], dtype=bool)
    # The masks are dense: n^2 bytes for couples, 11 MB for the demo's punch (n = 3347).
    # Columns are read as often as rows. A dense transposition would take ten times as long.
    touched_by = np.zeros(touches.shape[::-1], dtype=bool)
    touched_by[nonzero_entries(touches)[::-1]] = True
    out = []
    for elimination in eliminations:
        waiting = list(zip(*elimination, strict=True))
        while waiting:
            systems, waiting = _independent(waiting, touched_by, couples, row_left)
            # First for all systems of the list, so that none counts the equalities
            # or variables of another one.
            for q, e in systems:
                row_left[q] = column_left[e] = False
            found = []
            for q, e in systems:
                t = np.flatnonzero(touched_by[e].any(axis=0) & row_left)
                c = np.flatnonzero(touches[q].any(axis=0) & column_left)
                more = couples[e].any(axis=0) & column_left
                more[c] = False
                # c comes first in u: kernels take c as the first columns of u.
                u = np.concatenate([c, np.flatnonzero(more)])
                # e is replaced by a function of c: in the equalities t, and in the Hessian
                for rows, columns in ((t, c), (t, e), (q, e)):
                    touches[rows[:, None], columns] = touched_by[columns[:, None], rows] = True
                couples[e[:, None], e] = couples[c[:, None], u] = couples[u[:, None], c] = True
                found.append(Touched(q, e, t, c, u))
            out.append(found)
    return out


_Systems = list[tuple[Index, Index]]  # equalities and variables of each


def _independent(
    systems: _Systems, touched_by: Any, couples: Any, row_left: Any
) -> tuple[_Systems, _Systems]:
    """Systems that neither a constraint nor the Hessian couples to one before them, and the others."""
    # Greedy, in the order given: the earliest of a chain is taken, the next one waits for the next round.
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


class RowGroups(NamedTuple):
    """Groups of the Jacobian's rows; all rows of a group have the same columns, p of them in every group.

    columns (g, p) : of each group.  counts (g,) : number of its rows.
    rows (k,) : numbers of the rows, one group after the other.
    values (k, p) : places of the rows' values in the Jacobian's data.
    """

    columns: Index
    counts: Index
    rows: Index
    values: Places


def group_rows(jacobian: Matrix, rows: Index) -> list[RowGroups]:
    """Groups of these rows of a csc matrix, for each number of columns; empty rows are left out."""
    # the same pattern by rows, with the places of the values in the csc data as its values
    numbered = sp.csc_array((np.arange(jacobian.nnz), jacobian.indices, jacobian.indptr), jacobian.shape)
    by_rows = numbered.tocsr()
    by_rows.sort_indices()
    start, columns, at = by_rows.indptr, by_rows.indices, by_rows.data.astype(np.int32)
    # rows with the same bytes of column numbers form a group
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
        # groups with p columns, and their rows
        chosen, same, every = np.flatnonzero(sizes == p), rows[order[size_of == p]], np.arange(p)
        own = columns[start[rows[first[chosen]]][:, None] + every].astype(np.intp)
        out.append(RowGroups(own, counts[chosen], same, at[start[same][:, None] + every]))
    return out


def nonzero_entries(matrix: Any) -> tuple[Index, Index]:
    """np.nonzero, which takes twice as long for two dimensions as for one."""
    return np.divmod(np.flatnonzero(matrix), matrix.shape[1])


_lower = functools.cache(np.tril_indices)


class EntryPlaces:
    """Places of the entries (i, j) of a matrix with n columns, from 1 on, and 0 for all others.

    Place 0 of the values is a zero, so that entries outside the pattern need no special case. Each look-up is
    a search among half a million entries: a table of all n^2 places would take longer to fill.
    """

    def __init__(self, i: Index, j: Index, n: int) -> None:
        """i, j (k,) : ascending, row by row."""
        self.count = i.size
        self._n, self._keys = n, i * n + j

    def at(self, i: Index, j: Index) -> Places:
        """Places of entries; i, j : arrays of any shapes that NumPy broadcasts."""
        # In 64 bits, as n^2 exceeds 32 from 46 341 variables on.
        wanted = i.astype(np.int64) * self._n + j
        found = np.searchsorted(self._keys, wanted).clip(max=self._keys.size - 1)
        return np.where(self._keys[found] == wanted, found + 1, 0).astype(np.int32)


class HessianPlaces(EntryPlaces):
    """Places of the entries of the lower triangle of W, the condensed Hessian.

    Programs that grow by a few constraints repeat the same look-ups, so those of each row pattern are cached.
    """

    def __init__(self, i: Index, j: Index, n: int) -> None:
        super().__init__(i, j, n)
        self._of_row: dict[bytes, Places] = {}
        self._of_matrix: tuple[Index, Index, Places] | None = None

    def symmetric(self, i: Index, j: Index) -> Places:
        """Places of entries in either triangle, as of `at`."""
        return self.at(np.maximum(i, j), np.minimum(i, j))

    def of_rows(self, columns: Index) -> Places:
        """Places (k, p (p + 1) / 2) of the outer products of rows with these columns (k, p)."""
        i, j = _lower(columns.shape[1])
        keys, ends = columns.tobytes(), range(0, columns.nbytes + 1, max(columns[:1].nbytes, 1))
        names = [keys[one:two] for one, two in itertools.pairwise(ends)]
        new = [k for k, name in enumerate(names) if name not in self._of_row]
        found = self.at(columns[new][:, i].ravel(), columns[new][:, j].ravel())
        self._of_row.update(zip((names[k] for k in new), found.reshape(len(new), i.size), strict=True))
        return np.array([self._of_row[name] for name in names])

    def of_matrix(self, lower: Index, matrix: Matrix) -> Places:
        """Places of those entries of a csc matrix that ``lower`` selects from its lower triangle."""
        # The Hessian's pattern stays when constraints are added, so one look-up
        # serves all programs of a solve.
        cached, pattern = self._of_matrix, (matrix.indices, matrix.indptr)
        if cached is None or not all(map(np.array_equal, cached[:2], pattern)):
            found = self.at(matrix.indices[lower], _columns(matrix)[lower])
            cached = self._of_matrix = matrix.indices.copy(), matrix.indptr.copy(), found
        return cached[2]


def same_shapes(systems: list[Touched]) -> list[list[Touched]]:
    """Systems of one elimination, by the numbers of constraints and variables that they touch."""
    out: dict[tuple[int, int, int], list[Touched]] = {}
    for s in systems:
        out.setdefault((s.c.size, s.u.size, s.t.size), []).append(s)
    return list(out.values())


def elimination_stage(systems: list[Touched], of_J: EntryPlaces, of_W: HessianPlaces) -> EliminationStage:
    """Elimination stage for systems of one shape.

    of_J, of_W : places of the entries of the equalities and of W.
    """
    # All of one shape: (k, r) of q and e, (k, nt), (k, nc) and (k, nu).
    q, e, t, c, u = (np.array([getattr(s, name) for s in systems]) for name in ("q", "e", "t", "c", "u"))
    i, j = _lower(c.shape[1])
    places = {
        # (k, column, row), which is LAPACK's storage by columns.
        "qe": of_J.at(q[:, None, :], e[:, :, None]),
        "qc": of_J.at(q[:, None, :], c[:, :, None]),
        "te": of_J.at(t[:, :, None], e[:, None, :]),
        "tc": of_J.at(t[:, :, None], c[:, None, :]),
        "hee": of_W.symmetric(e[:, :, None], e[:, None, :]),
        "heu": of_W.symmetric(u[:, :, None], e[:, None, :]),
        "hcc": of_W.symmetric(c[:, i], c[:, j]),
        "hcv": of_W.symmetric(c[:, :, None], u[:, None, c.shape[1] :]),
    }
    numbers = {"q": q, "e": e, "t": t, "u": u, **places}
    return EliminationStage(**{name: np.ascontiguousarray(a, dtype=np.int32) for name, a in numbers.items()})


Mask = npt.NDArray[np.bool_]


def find_eliminations(jacobian: Matrix, equal: Mask, determined: Sequence[Determined]) -> list[Elimination]:
    """Eliminations of the variables that a program declares as determined by equalities.

    Each set of variables takes the first equalities that contain one of them and are not taken yet. If there
    are too few, or their pattern is singular, the variables stay free.

    equal (m,) : which constraints are equalities.
    """
    touches = jacobian.tocsc()
    start, touching = touches.indptr, touches.indices
    # Inequalities count as taken, so only equalities are found.
    taken, touched = ~equal, np.zeros(equal.size, dtype=bool)
    found: dict[tuple[tuple[int, ...], int], list[tuple[Index, Index]]] = {}
    for rank, variables in determined:
        columns = [touching[start[v] : start[v + 1]] for v in variables]
        equalities = np.unique(np.concatenate([np.zeros(0, np.intp), *columns]))
        equalities = equalities[~taken[equalities]][: variables.size]
        if equalities.size < variables.size or not variables.size:
            continue
        system = np.zeros((equalities.size, equalities.size), dtype=bool)
        for k, column in enumerate(columns):
            # One mask for all systems, set and cleared by index: a new one each time would
            # cost m entries a variable.
            touched[column] = True
            system[k] = touched[equalities]
            touched[column] = False
        # A perfect matching of equalities and variables is necessary for a regular system, not sufficient:
        # values may still be singular, which `Condenser.load` finds.
        if not _structurally_regular(system.tobytes(), equalities.size):
            continue
        taken[equalities] = True
        found.setdefault((rank, variables.size), []).append((equalities, variables))
    return [
        Elimination(np.array([r for r, _ in found[key]]), np.array([v for _, v in found[key]]))
        # By rank, the order of elimination, and by size: systems of one shape are treated together.
        for key in sorted(found)
    ]


@functools.lru_cache(maxsize=256)
def _structurally_regular(pattern: bytes, size: int) -> bool:
    """True if a square matrix with this pattern can be regular; cached, as most systems share a pattern."""
    system = sp.csr_matrix(np.frombuffer(pattern, dtype=bool).reshape(size, size))
    return bool((maximum_bipartite_matching(system) >= 0).all())


def _columns(matrix: Matrix) -> Index:
    """Column of each entry of a csc matrix."""
    return np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))


class Condenser:
    """Elimination of variables from Newton systems with fixed patterns.

    Its constraints are those of the program, then the bounds of eliminated variables. Inequalities are not
    eliminated: they enter the Hessian, W = H + J' diag(w) J, before the elimination.

    Attributes
    ----------
    m, n : number of constraints, with those of `bounded`, and of variables.
    eliminated : numbers of the constraints that are eliminated.
    remaining, free : numbers of the constraints and variables that remain.
    equal : which of the remaining constraints are equalities: indices into `remaining`.
    bounded : eliminated variables with a bound; these bounds are constraints after those of the program.
    remaining_equalities : the free variables in each, as indices into `free`, and the places of their
        coefficients in `J`.
    free_entries : places in `W` of the entries of free variables, and their rows and columns.
    pattern (f, f) : entries of the condensed Hessian, with those that a remaining equality couples.
    J, W : values of the equalities and of the condensed Hessian; the first value of each is zero.
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
        """Patterns of the Jacobian (m, n) and the Hessian (n, n), csc.

        equal (m,) : which constraints are equalities.  bounded (n,) : variables with a finite bound.
        """
        m, n = jacobian.shape
        self._kernels, self.n = kernels, n
        number = np.full(m, -1)  # of an equality among the equalities
        number[equal] = np.arange(int(equal.sum()))
        none = np.zeros(0, dtype=np.intp)
        variables = np.concatenate([none, *[e.variables.ravel() for e in eliminations]])
        constraints = np.concatenate([none, *[e.constraints.ravel() for e in eliminations]])
        self._taken = np.sort(number[constraints])
        self._left = np.setdiff1d(np.arange(int(equal.sum())), self._taken)
        self.bounded = np.sort(variables[bounded[variables]])
        self.free = np.setdiff1d(np.arange(n), variables)

        # symbolic elimination, with dense masks
        own = number[jacobian.indices]  # of each entry: the number of its equality, -1: of an inequality
        own_rows, own_columns = own[own >= 0], _columns(jacobian)[own >= 0]
        touches = np.zeros((int(equal.sum()), n), dtype=bool)
        touches[own_rows, own_columns] = True
        # An inequality has a weight, and so couples all its variables in the Hessian: w J_i' J_i.
        groups = group_rows(jacobian, np.flatnonzero(~equal))
        couples = np.eye(n, dtype=bool)
        couples[hessian.indices, _columns(hessian)] = True
        for group in groups:
            couples[group.columns[:, :, None], group.columns[:, None, :]] = True
        systems = fill(touches, couples, [Elimination(number[q], e) for q, e in eliminations])

        # places of all entries, fill-in included
        of_J = EntryPlaces(*nonzero_entries(touches), n)
        i, j = nonzero_entries(couples)
        i, j = i[i >= j], j[i >= j]
        self._hessian_places = of_W = HessianPlaces(i, j, n)
        self.J, self.W = np.zeros(of_J.count + 1), np.zeros(of_W.count + 1)
        self._to = of_J.at(own_rows, own_columns)
        self._diagonal = of_W.at(np.arange(n), np.arange(n))
        self._products: list[Products] = []
        self._adapt(jacobian, hessian, equal, groups)
        self._stages = [
            elimination_stage(same, of_J, of_W) for found in systems for same in same_shapes(found)
        ]

        # what remains
        self.pattern = couples[np.ix_(self.free, self.free)]
        of_left = touches[np.ix_(self._left, self.free)]
        self.remaining_equalities = [
            (np.flatnonzero(t), of_J.at(k, self.free[t])) for k, t in zip(self._left, of_left, strict=True)
        ]
        # The Newton system adds a penalty, A' diag(w) A, so they couple as inequalities do.
        for columns, _ in self.remaining_equalities:
            self.pattern[np.ix_(columns, columns)] = True
        at = (np.concatenate([none, *[one[k] for one in self.remaining_equalities]]) for k in (0, 1))
        self._A_entries = np.repeat(np.arange(self._left.size), of_left.sum(axis=1)), *at
        place = np.full(n, -1)
        place[self.free] = np.arange(self.free.size)
        # i and j are of the lower triangle, in the order of W's places, which begin at 1.
        inside = (place[i] >= 0) & (place[j] >= 0)
        self.free_entries = (np.flatnonzero(inside) + 1).astype(np.int32), place[i[inside]], place[j[inside]]

    def adapt(self, jacobian: Matrix, hessian: Matrix, equal: Mask) -> bool:
        """Adapt to matrices with the same equalities and other inequalities.

        False, and no change, if these matrices couple variables that the pattern of W does not couple.
        """
        return self._adapt(jacobian, hessian, equal, group_rows(jacobian, np.flatnonzero(~equal)))

    def _adapt(self, jacobian: Matrix, hessian: Matrix, equal: Mask, groups: Sequence[RowGroups]) -> bool:
        found = [
            Products(
                counts=group.counts,
                rows=group.rows.astype(np.int32),
                values=group.values,
                to=self._hessian_places.of_rows(group.columns),
            )
            for group in groups
        ]
        row, column = hessian.indices, _columns(hessian)
        lower = np.flatnonzero(row >= column)
        to = self._hessian_places.of_matrix(lower, hessian)
        # Place 0 means that the pattern lacks an entry.
        if not (to.all() and all(p.to.all() for p in found)):
            return False
        # Before the list is replaced: C's arguments are cached by the list's identity.
        self._kernels.forget(self._products)
        self._products, self._own_hessian = found, (lower.astype(np.int32), to)
        at = np.flatnonzero(row == column)
        self._curved = at, row[at]
        self._own_jacobian = np.flatnonzero(equal[jacobian.indices]).astype(np.int32), self._to
        self._equations, self._entries = np.flatnonzero(equal), (jacobian.nnz, hessian.nnz)
        self.eliminated = self._equations[self._taken]
        self.m = equal.size + self.bounded.size
        self.remaining = np.setdiff1d(np.arange(self.m), self.eliminated)
        self.equal = np.searchsorted(self.remaining, self._equations[self._left])
        return True

    # ------------------------------------------------------------------ values
    def load(self, jacobian: Matrix, hessian: Matrix) -> None:
        """Take the values of matrices with the known patterns, and eliminate in the equalities.

        Raises
        ------
        LinAlgError : constraints do not determine their variables.
        InputError : a matrix with another number of entries than its pattern.
        """
        # Places outside the values would be read in C.
        if (jacobian.nnz, hessian.nnz) != self._entries:
            raise InputError(PATTERN_CHANGED)
        self._jacobian, self._hessian = (
            np.ascontiguousarray(a.data, dtype=float) for a in (jacobian, hessian)
        )
        # Also fill-in that the last elimination left.
        self.J[:] = 0.0
        where, to = self._own_jacobian
        self._kernels.copy(self._jacobian, where, self.J, to)
        self._kernels.eliminate(self._stages, self.J)

    @property
    def A(self) -> Vector:
        """Jacobian (l, f) of the remaining equalities by the free variables."""
        out = np.zeros((self._left.size, self.free.size))
        rows, columns, at = self._A_entries
        out[rows, columns] = self.J[at]
        return out

    @property
    def curvature(self) -> Vector:
        """Diagonal (f,) of the Hessian for the free variables, before the elimination."""
        out = np.zeros(self.n)
        at, variables = self._curved
        out[variables] = self._hessian[at]
        return out[self.free]

    def reduce(self, weights: Vector, diagonal: Vector) -> Vector:
        """Values of W = H + diag(diagonal) + J' diag(weights) J after the elimination; see `free_entries`.

        weights (m,) of the constraints: those of equalities have no effect.  diagonal (n,).
        """
        self.W[:] = 0.0
        # The lower triangle only.
        where, to = self._own_hessian
        self._kernels.copy(self._hessian, where, self.W, to)
        self.W[self._diagonal] += diagonal
        bounds = self._diagonal[self.bounded]
        self.W[bounds] += weights[self.m - self.bounded.size :]
        self._kernels.add_products(self._products, self._jacobian, weights, self.W)
        self._kernels.reduce(self._stages, self.W)
        return self.W

    def forward(self, gradient: Vector, residual: Vector) -> tuple[Vector, Vector]:
        """Gradient (f,) by the free variables, and residual (l,) of the remaining equalities.

        gradient : (n,), of the quadratic model with W.  residual : (m,).  Both results are for a step of the
        eliminated variables that meets the eliminated equalities while no free variable moves.
        """
        g, off = gradient.copy(), residual[self._equations]
        self._kernels.forward(self._stages, g, off)
        return g[self.free], off[self._left]

    def expand(self, step: Vector) -> Vector:
        """Step (n,) of all variables for one of the free ones (f,), after `forward` with a residual."""
        d = np.zeros(self.n)
        d[self.free] = step
        self._kernels.expand(self._stages, d)
        return d

    def particular(self, residual: Vector) -> Vector:
        """Step (n,) that meets the eliminated equalities while no free variable moves; residual (m,)."""
        self.forward(np.zeros(self.n), residual)
        return self.expand(np.zeros(self.free.size))

    def expand_basis(self, Z: np.ndarray) -> None:
        """Set the steps of eliminated variables for those of the free ones: columns of Z (n, k)."""
        # backwards: the variables of a system may depend on those of later ones
        for a in reversed(self._stages):
            Z[a.e] = -(a.X.swapaxes(1, 2) @ Z[a.c])

    def multipliers(self, dual: Vector, y: Vector) -> Vector:
        """Multipliers of the eliminated constraints, which make the eliminated variables stationary.

        dual (n,) : gradient of the Lagrangian without the equalities.
        y (l,) : multipliers of the remaining equalities.
        """
        v, out = dual.copy(), np.zeros(self._equations.size)
        out[self._left] = y
        self._kernels.multipliers(self._stages, v, out)
        of_all = np.zeros(self.m)
        of_all[self._equations] = out
        return of_all[self.eliminated]
