"""Newton systems made smaller: equalities that determine variables of their own are solved for them first.

A motion's program has thousands of variables that rows determine by themselves: leg joints follow from the
base's pose by the closed legs, a sole's wrench from the equation of motion, a collision's motion from its
beginning. An elimination names such rows and variables, system by system; all systems of one shape are
treated at once. What is left is a Newton system in the free variables (Nocedal and Wright 2006, section 15.3:
elimination of variables), with the same solution: nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from impactopt.program import Matrix, Vector

Index = npt.NDArray[np.intp]
Stack = npt.NDArray[np.float64]  # (systems, rows, columns)


class Elimination(NamedTuple):
    """Systems of one shape: equality rows (k, r), and the variables (k, r) that each system's rows determine.

    No row may touch the variables of two systems of the same elimination.
    """

    rows: Index
    variables: Index


class Determined(NamedTuple):
    """Variables that equality rows of their own determine; those of lower rank are eliminated first."""

    rank: int
    variables: Index


def find_eliminations(
    jacobian: Matrix, equal: npt.NDArray[np.bool_], determined: Sequence[Determined]
) -> list[Elimination]:
    """The eliminations for variables that a program says are determined by rows of their own.

    Each gets the first equality rows that touch it and are not taken yet; where there are not enough, or they
    do not determine it by their pattern, it stays free. equal (m,): which rows are equalities.
    """
    touches = jacobian.tocsc()
    taken = ~equal
    found: dict[tuple[int, int], list[tuple[Index, Index]]] = {}
    for rank, variables in determined:
        part = touches[:, variables]
        rows = np.unique(part.indices)
        rows = rows[~taken[rows]][: variables.size]
        if rows.size < variables.size or not variables.size:
            continue
        system = sp.csr_matrix(part.tocsr()[rows])
        system.data[:] = 1.0
        if (maximum_bipartite_matching(system, perm_type="column") < 0).any():
            continue
        taken[rows] = True
        found.setdefault((rank, variables.size), []).append((rows, variables))
    return [
        Elimination(np.array([r for r, _ in found[key]]), np.array([v for _, v in found[key]]))
        for key in sorted(found)
    ]


@dataclass
class _Stage:
    """Where the numbers of one elimination stand; values that are none point to the end.

    q, e : its rows and variables; t : other rows that these variables touch; c : variables that its rows
    touch; h : those that the Hessian couples to e.
    """

    q: Index
    e: Index
    t: Index
    c: Index
    h: Index
    qe: Index
    qc: Index
    te: Index
    tc: Index
    hee: Index
    heh: Index
    hcc: Index
    hch: Index
    hhc: Index


class _Solved(NamedTuple):
    """What going back needs: B^-1, X = B^-1 N, the step x0 = B^-1 r that meets the rows, values touched."""

    inverse: Stack
    X: Stack
    x0: Stack
    te: Stack
    hee: Stack
    heh: Stack
    gradient: Stack


@dataclass(frozen=True)
class Condensed:
    """The system in the free variables: Hessian P and gradient q, rows A d + r.

    Attributes
    ----------
    P : csr (f, f); q: (f,).
    A : csr (k, f); r : (k,), the rows' values after the step that meets the eliminated ones.
    """

    P: Matrix
    q: Vector
    A: Matrix
    r: Vector


class Condenser:
    """Eliminates, for matrices whose patterns do not change.

    Rows are those of the program, and behind them one for each eliminated variable that has a bound.

    Attributes
    ----------
    rows, free : numbers of the rows and variables that are left.
    eliminated : numbers of the rows that are gone.
    bounded : eliminated variables with a bound, each a row of its own from number m on.
    m : number of rows with those of `bounded`.
    owner : for each row that is left, which system touched it last; -1: none.
    """

    def __init__(
        self,
        jacobian: Matrix,
        hessian: Matrix,
        eliminations: Sequence[Elimination],
        bounded: npt.NDArray[np.bool_],
    ):
        """Patterns of the Jacobian (m, n) and the Hessian (n, n), csc; bounded (n,): variables with a finite
        bound."""
        m, n = jacobian.shape
        gone = np.concatenate([np.zeros(0, np.intp), *[e.variables.ravel() for e in eliminations]])
        self.eliminated = np.sort(
            np.concatenate([np.zeros(0, np.intp), *[e.rows.ravel() for e in eliminations]])
        )
        self.bounded = np.sort(gone[bounded[gone]])
        self.m = m + self.bounded.size
        self._n = n
        rows = np.zeros((self.m, n), dtype=bool)
        couples = np.zeros((n, n), dtype=bool)
        J, H = jacobian.tocoo(), hessian.tocoo()
        rows[J.row, J.col] = True
        rows[m + np.arange(self.bounded.size), self.bounded] = True
        couples[H.row, H.col] = True
        np.fill_diagonal(couples, True)
        systems = self._fill(rows, couples, eliminations)
        filled, coupled = _numbered(rows), _numbered(couples)
        self._sizes = filled.nnz, coupled.nnz
        self._stages = [
            _stage(e, found, filled, coupled) for e, found in zip(eliminations, systems, strict=True)
        ]
        left = np.ones(self.m, dtype=bool)
        left[self.eliminated] = False
        free = np.ones(n, dtype=bool)
        free[gone] = False
        self.rows, self.free = np.flatnonzero(left), np.flatnonzero(free)
        self._own_jacobian = _places(filled, J.row, J.col)
        self._own_bounds = _places(filled, m + np.arange(self.bounded.size), self.bounded)
        self._own_hessian = _places(coupled, H.row, H.col)
        self._diagonal = _places(coupled, np.arange(n), np.arange(n))
        self._A = _submatrix(filled, self.rows, self.free)
        self._P = _submatrix(coupled, self.free, self.free)
        owner = np.full(self.m + 1, -1)
        number = 0
        for found in systems:
            for _, _, t, _, _ in found:
                owner[t] = number
                number += 1
        self.owner = owner[self.rows]

    @staticmethod
    def _fill(rows: Any, couples: Any, eliminations: Sequence[Elimination]) -> list[list[tuple[Any, ...]]]:
        """Mark what becomes nonzero on the way, and find what each system touches."""
        row_left, column_left = np.ones(rows.shape[0], dtype=bool), np.ones(rows.shape[1], dtype=bool)
        out: list[list[tuple[Any, ...]]] = []
        for q_all, e_all in eliminations:
            row_left[q_all.ravel()] = False
            column_left[e_all.ravel()] = False
            found, touched = [], np.zeros(rows.shape[0], dtype=np.intp)
            for q, e in zip(q_all, e_all, strict=True):
                t = np.flatnonzero(rows[:, e].any(axis=1) & row_left)
                c = np.flatnonzero(rows[q].any(axis=0) & column_left)
                coupled = couples[e].any(axis=0)
                h = np.flatnonzero(coupled & column_left)
                if np.isin(np.setdiff1d(e_all, e), np.flatnonzero(coupled)).any():
                    raise ValueError("the Hessian couples variables of two systems of one elimination")
                touched[t] += 1
                rows[np.ix_(t, c)] = rows[np.ix_(t, e)] = True
                rows[np.ix_(q, e)] = couples[np.ix_(e, e)] = couples[np.ix_(c, c)] = True
                couples[np.ix_(c, h)] = couples[np.ix_(h, c)] = True
                found.append((q, e, t, c, h))
            if (touched > 1).any():
                raise ValueError(f"row {int(np.argmax(touched > 1))} touches two systems of one elimination")
            out.append(found)
        return out

    # ------------------------------------------------------------------ numbers
    def condense(self, jacobian: Matrix, hessian: Matrix, gradient: Vector, residual: Vector) -> Condensed:
        """The system in the free variables.

        jacobian, hessian : with the patterns given at first; gradient : (n,) of what the Hessian belongs to;
        residual (m,) : what the rows, with those of `bounded`, are off by: an eliminated one is to become
        zero.

        Raises
        ------
        LinAlgError : rows do not determine their variables.
        """
        Jv = np.zeros(self._sizes[0] + 1)
        Jv[self._own_jacobian], Jv[self._own_bounds] = jacobian.data, 1.0
        self._gradient, self._solved = gradient, []
        for a in self._stages:
            te = Jv[a.te]
            inverse = np.linalg.inv(Jv[a.qe])
            X = inverse @ Jv[a.qc]
            Jv[a.tc] -= te @ X
            Jv[-1] = 0.0
            none = np.zeros((*a.e.shape, 1))
            self._solved.append(_Solved(inverse, X, none, te, none, none, none))
        Hv = np.zeros(self._sizes[1] + 1)
        Hv[self._own_hessian] = hessian.data
        for i, own in enumerate(self._reduce(Hv)):
            self._solved[i] = self._solved[i]._replace(hee=own[0], heh=own[1])
        r, q = self.with_residual(residual)
        A = sp.csr_array((Jv[self._A[0]], *self._A[1:]), shape=(self.rows.size, self.free.size))
        return Condensed(self._symmetric(Hv), q, A, r)

    def identity(self) -> Matrix:
        """What the identity in place of the Hessian becomes, for the Jacobian of the last `condense`: csr
        (f, f)."""
        values = np.zeros(self._sizes[1] + 1)
        values[self._diagonal] = 1.0
        for _ in self._reduce(values):
            pass
        return self._symmetric(values)

    def _reduce(self, Hv: Vector) -> Iterator[tuple[Stack, Stack]]:
        """Eliminate in a Hessian's values; of each stage what coupled its variables to each other and to
        others."""
        for a, s in zip(self._stages, self._solved, strict=True):
            hee, heh = Hv[a.hee], Hv[a.heh]
            Xt = np.ascontiguousarray(s.X.swapaxes(1, 2))
            cross = Xt @ -heh
            _add(Hv, (a.hcc, a.hch, a.hhc), (Xt @ (hee @ s.X), cross, cross.swapaxes(1, 2)))
            Hv[-1] = 0.0
            yield hee, heh

    def _symmetric(self, values: Vector) -> Matrix:
        return sp.csr_array((values[self._P[0]], *self._P[1:]), shape=(self.free.size,) * 2)

    def with_residual(self, residual: Vector) -> tuple[Vector, Vector]:
        """r and q of the same system with another residual (m,): the factors stay."""
        off, g = np.append(residual, 0.0), np.append(self._gradient, 0.0)
        for i, (a, s) in enumerate(zip(self._stages, self._solved, strict=True)):
            x0 = s.inverse @ off[a.q][..., None]
            off[a.t] -= (s.te @ x0)[..., 0]
            own = g[a.e][..., None]
            to_c, to_h = s.X.swapaxes(1, 2) @ (own - s.hee @ x0), s.heh.swapaxes(1, 2) @ x0
            _add(g, (a.c, a.h), (-to_c[..., 0], -to_h[..., 0]))
            off[-1] = g[-1] = 0.0
            self._solved[i] = s._replace(x0=x0, gradient=own)
        return off[self.rows], g[self.free]

    def expand(self, step: Vector) -> Vector:
        """The step of all variables (n,) for one of the free ones (f,)."""
        d = np.zeros(self._n + 1)
        d[self.free] = step
        for a, s in zip(self._stages[::-1], self._solved[::-1], strict=True):
            d[a.e] = -(s.x0 + s.X @ d[a.c][..., None])[..., 0]
            d[-1] = 0.0
        return d[:-1]

    def pull(self, gradient: Vector) -> Vector:
        """The gradient (f,) by the free variables of what has one (n,) by all of them."""
        g = np.append(gradient, 0.0)
        for a, s in zip(self._stages, self._solved, strict=True):
            _add(g, (a.c,), (-(s.X.swapaxes(1, 2) @ g[a.e][..., None])[..., 0],))
            g[-1] = 0.0
        return g[self.free]

    def multipliers(self, step: Vector, y: Vector, shift: float) -> Vector:
        """Multipliers (m,) of all rows for those of the rows left (k,) and the step of all variables (n,).

        shift : of the Hessian's diagonal.
        """
        d, out = np.append(step, 0.0), np.zeros(self.m + 1)
        out[self.rows] = y
        for a, s in zip(self._stages[::-1], self._solved[::-1], strict=True):
            own, others = d[a.e][..., None], d[a.h][..., None]
            total = (
                s.gradient
                + shift * own
                + s.hee @ own
                + s.heh @ others
                + s.te.swapaxes(1, 2) @ out[a.t][..., None]
            )
            out[a.q] = -(s.inverse.swapaxes(1, 2) @ total)[..., 0]
            out[-1] = 0.0
        return out[:-1]


def _add(to: Vector, where: Sequence[Index], what: Sequence[Stack]) -> None:
    """Add numbers, places may repeat."""
    for index, values in zip(where, what, strict=True):
        if len(index) == 1:  # one system: no place repeats, but for the last one, which holds none
            to[index] += values
        elif 8 * index.size < to.size:
            np.add.at(to, index.ravel(), values.ravel())
        else:
            to += np.bincount(index.ravel(), values.ravel(), to.size)


def _numbered(pattern: Any) -> Matrix:
    """A pattern in csr, whose values are their places counted from 1, so that 0 is none."""
    out = sp.csr_array(pattern, dtype=np.int64)
    out.data[:] = np.arange(1, out.nnz + 1)
    return out


def _stage(elimination: Elimination, systems: list[tuple[Any, ...]], rows: Matrix, couples: Matrix) -> _Stage:
    """rows, couples : the filled patterns of Jacobian and Hessian, as of `_numbered`."""
    (m, n), (k, r) = rows.shape, elimination.rows.shape
    nt, nc, nh = (max(len(s[i]) for s in systems) for i in (2, 3, 4))
    none, nothing = rows.nnz, couples.nnz
    full = np.full
    a = _Stage(
        q=elimination.rows, e=elimination.variables, t=full((k, nt), m), c=full((k, nc), n), h=full((k, nh),
        n), qe=full((k, r, r), none), qc=full((k, r, nc), none), te=full((k, nt, r), none), tc=full((k, nt,
        nc), none), hee=full((k, r, r), nothing), heh=full((k, r, nh), nothing), hcc=full((k, nc, nc),
        nothing), hch=full((k, nc, nh), nothing), hhc=full((k, nh, nc), nothing),
    )  # fmt: skip
    for i, (q, e, t, c, h) in enumerate(systems):
        a.t[i, : t.size], a.c[i, : c.size], a.h[i, : h.size] = t, c, h
        of_q, of_t = rows[q], rows[t]
        a.qe[i], a.qc[i, :, : c.size] = _block(of_q, e, none), _block(of_q, c, none)
        a.te[i, : t.size], a.tc[i, : t.size, : c.size] = _block(of_t, e, none), _block(of_t, c, none)
        of_e, of_c = couples[e], couples[c]
        a.hee[i], a.heh[i, :, : h.size] = _block(of_e, e, nothing), _block(of_e, h, nothing)
        a.hcc[i, : c.size, : c.size] = _block(of_c, c, nothing)
        a.hch[i, : c.size, : h.size] = _block(of_c, h, nothing)
        a.hhc[i, : h.size, : c.size] = _block(couples[h], c, nothing)
    return a


def _block(rows: Matrix, columns: Index, none: int) -> Index:
    """Places of a dense block's entries, `none` where the pattern has none."""
    place = rows[:, columns].toarray() - 1
    return np.where(place < 0, none, place)


def _places(pattern: Matrix, rows: Index, columns: Index) -> Index:
    """Places of the entries (rows, columns)."""
    key = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr)) * pattern.shape[1] + pattern.indices
    return np.searchsorted(key, rows.astype(np.int64) * pattern.shape[1] + columns)


def _submatrix(pattern: Matrix, rows: Index, columns: Index) -> tuple[Index, Index, Index]:
    """Of a submatrix in csr: places of its values, column indices and row starts."""
    part = pattern[rows][:, columns].sorted_indices()
    return part.data - 1, part.indices.astype(np.int32), part.indptr.astype(np.int32)
