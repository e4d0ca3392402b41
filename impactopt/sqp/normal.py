"""The matrix K = P + A' diag(w) A + diag(d) of a condensed Newton system, banded, and its Cholesky factor.

Rows of A that touch the same variables form dense panels, so that A' diag(w) A is a few hundred small dense
products; ordered along a motion's time, K is banded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from impactopt.program import Matrix, Vector

Index = npt.NDArray[np.intp]
_LOOSE = 4  # rows of so few entries are added one by one
_SMALL = (
    1e-10  # a row's share of the matrix below which it is left out: far below the shift that rounding needs
)
_HELD = 1e15  # on the diagonal of variables that must not move
_BORDER = 24  # variables in the border, at most


@dataclass
class _Panel:
    """Rows of A over the same columns: places of its values in A's data, and of its products in the band."""

    rows: Index
    at: Index
    product: Index
    band: Index


class NormalMatrix:
    """K for a P and an A whose patterns do not change: a band, bordered by the few variables that touch most
    others.

    Attributes
    ----------
    width : number of subdiagonals of the band.
    border : number of variables in the border.
    """

    def __init__(self, P: Matrix, A: Matrix, owner: Index, sequence: Vector | None):
        """Patterns of P csr (n, n), symmetric, and of A csr (m, n).

        owner (m,) : rows of one owner >= 0 are likely to touch the same columns; sequence (n,) : variables
        near each other in it touch each other, None: to be found.
        """
        self._n, self._m = P.shape[0], A.shape[0]
        groups = self._groups(A, owner)
        loose = np.setdiff1d(
            np.arange(self._m), np.concatenate([np.zeros(0, np.intp), *[g[0] for g in groups]])
        )
        row, first, second, at_first, at_second = self._pairs(A, loose)
        own = P.tocoo()
        pattern = np.zeros(P.shape, dtype=bool)
        pattern[own.row, own.col] = pattern[first, second] = True
        for _, columns in groups:
            pattern[np.ix_(columns, columns)] = True
        place = self._arrange(pattern, sequence)
        band, width = self._band, self.width

        def at(i: Any, j: Any) -> Any:
            """Where the entry (i, j) of the lower triangle stands: in the band, or in the border behind."""
            below, above = np.maximum(place[i], place[j]), np.minimum(place[i], place[j])
            inside = (below - above) + (width + 1) * above
            return np.where(below < band, inside, band * (width + 1) + (below - band) * self._n + above)

        self._size = band * (width + 1) + self.border * self._n
        self._diagonal = at(np.arange(self._n), np.arange(self._n))
        lower = place[own.row] >= place[own.col]
        self._P_from, self._P_to = np.flatnonzero(lower), at(own.row[lower], own.col[lower])
        lower = place[first] >= place[second]
        self._loose_row, self._loose_to = row[lower], at(first[lower], second[lower])
        self._loose_first, self._loose_second = at_first[lower], at_second[lower]
        self._panels = []
        for rows, columns in groups:
            columns = columns[np.argsort(place[columns])]
            i, j = np.tril_indices(columns.size)
            to = at(columns[i], columns[j])
            self._panels.append(_Panel(rows, _dense_places(A, rows, columns), i * columns.size + j, to))

    def _arrange(self, pattern: Any, sequence: Vector | None) -> Index:
        """Where each variable comes.

        Those that touch most are the border, if the band gets narrow without them.
        """
        n = self._n
        if sequence is None:
            order = reverse_cuthill_mckee(sp.csr_matrix(pattern), symmetric_mode=True).astype(np.intp)
        else:
            order = np.argsort(sequence, kind="stable")
        pattern = pattern[np.ix_(order, order)]
        widest = np.argsort(-pattern.sum(axis=1), kind="stable")
        best, self.border, self.width = np.inf, 0, 0
        for border in range(min(n, _BORDER) + 1):
            kept = np.ones(n, dtype=bool)
            kept[widest[:border]] = False
            r, c = np.nonzero(pattern[np.ix_(kept, kept)])
            width = int(np.abs(r - c).max(initial=0))
            work = (n - border) * (width + 1.0) * (width + 1.0 + 4.0 * border)
            if work < 0.9 * best:
                best, self.border, self.width, best_kept = work, border, width, kept
        order = np.concatenate([order[best_kept], order[~best_kept]])
        self._order, self._band = order, n - self.border
        place = np.empty(n, dtype=np.intp)
        place[order] = np.arange(n)
        return place

    @staticmethod
    def _groups(A: Matrix, owner: Index) -> list[tuple[Index, Index]]:
        """Rows and columns of the panels."""
        count = np.diff(A.indptr)
        columns_of = [
            frozenset(A.indices[a:b].tolist()) for a, b in zip(A.indptr[:-1], A.indptr[1:], strict=True)
        ]
        sets: dict[int, set[int]] = {}
        rows: dict[int, list[int]] = {}
        for i in np.flatnonzero((owner >= 0) & (count > _LOOSE)):
            sets.setdefault(int(owner[i]), set()).update(columns_of[i])
            rows.setdefault(int(owner[i]), []).append(int(i))
        new = -1
        known: dict[frozenset[int], int] = {}
        for i in np.flatnonzero((owner < 0) & (count > _LOOSE)):
            pattern = columns_of[i]
            if pattern not in known:
                home = next((k for k, s in sets.items() if pattern <= s), None)
                if home is None:
                    home, new = new, new - 1
                    sets[home], rows[home] = set(pattern), []
                known[pattern] = home
            rows[known[pattern]].append(int(i))
        return [(np.array(rows[k]), np.array(sorted(sets[k]))) for k in rows]

    @staticmethod
    def _pairs(A: Matrix, rows: Index) -> tuple[Index, ...]:
        """Of the rows' outer products: row, both columns, and where both values stand in A's data."""
        out: list[tuple[Any, ...]] = [(np.zeros(0, np.intp),) * 5]
        for i in rows:
            at = np.arange(A.indptr[i], A.indptr[i + 1])
            first, second = np.repeat(at, at.size), np.tile(at, at.size)
            out.append((np.full(first.size, i), A.indices[first], A.indices[second], first, second))
        return tuple(np.concatenate(part).astype(np.intp) for part in zip(*out, strict=True))

    def load(self, P: Matrix, A: Matrix) -> None:
        """Take new values."""
        data = np.append(A.data, 0.0)
        self._values = [data[p.at] for p in self._panels]
        self._squares = np.asarray(A.multiply(A).sum(axis=1)).ravel()
        self._products = A.data[self._loose_first] * A.data[self._loose_second]
        self._base = self.entries(P)

    def entries(self, P: Matrix) -> Vector:
        """The entries of a matrix with P's pattern as `factor` takes them."""
        out = np.zeros(self._size)
        out[self._P_to] = P.data[self._P_from]
        return out

    def weighed(self, weights: Vector) -> Vector:
        """P + A' diag(w) A, its entries as `factor` takes them; weights w (m,) >= 0."""
        products = self._products * weights[self._loose_row]
        K: Vector = self._base + np.bincount(self._loose_to, products, self._size)
        counts = weights * self._squares > _SMALL
        for panel, values in zip(self._panels, self._values, strict=True):
            keep = np.flatnonzero(counts[panel.rows])
            if keep.size:
                part = values[keep]
                K[panel.band] += ((part.T * weights[panel.rows[keep]]) @ part).ravel()[panel.product]
        return K

    def factor(self, K: Vector, diagonal: Vector, held: Index) -> bool:
        """Factor K with `diagonal` (n,) added; variables in `held` will not move.

        K is overwritten. False: not positive definite.
        """
        K[self._diagonal] += diagonal
        K[self._diagonal[held]] += _HELD
        split, band = self._band * (self.width + 1), self._band
        if band:
            lower = K[:split].reshape(band, self.width + 1).T
            self._factor, info = la.lapack.dpbtrf(lower, lower=1, overwrite_ab=1)
            if info:
                return False
        if self.border:
            side = K[split:].reshape(self.border, self._n)
            self._coupling = side[:, :band]
            self._spread = self._in_band(self._coupling.T)
            corner = side[:, band:] - self._coupling @ self._spread
            self._corner, info = la.lapack.dpotrf(np.tril(corner), lower=1)
            return bool(info == 0)
        return True

    def _in_band(self, right: Vector) -> Vector:
        return np.asarray(la.lapack.dpbtrs(self._factor, right, lower=1)[0]) if self._band else right

    def solve(self, right: Vector) -> Vector:
        """K^-1 times a vector (n,) or columns (n, k)."""
        sorted_right = right[self._order]
        found = self._in_band(sorted_right[: self._band]).reshape(self._band, *right.shape[1:])
        if self.border:
            left = sorted_right[self._band :] - self._coupling @ found
            corner = la.lapack.dpotrs(self._corner, left, lower=1)[0].reshape(left.shape)
            found = np.concatenate([found - self._spread @ corner, corner])
        out = np.empty_like(found)
        out[self._order] = found
        return out


def _dense_places(A: Matrix, rows: Index, columns: Index) -> Index:
    """Where the values of A's rows stand in its data, over these columns; none: at its end."""
    where = np.full(A.shape[1], -1)
    where[columns] = np.arange(columns.size)
    out = np.full((rows.size, columns.size), A.nnz)
    for k, i in enumerate(rows):
        at = np.arange(A.indptr[i], A.indptr[i + 1])
        out[k, where[A.indices[at]]] = at
    return out
