"""Sparsity maps: positions of the blocks' derivatives in a program's Jacobian and Hessian.

Blocks take z = S x + c, so the nonzeros of both matrices are sums of multiples of the blocks' own nonzeros,
with factors that never change. They are added up in runs: a block's variables that stand side by side are
mostly variables of the program side by side.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.transcription.batched import BatchedFunction, Block
from impactopt.transcription.constraints import Index
from impactopt.transcription.layout import Array
from impactopt.transcription.scatter_add import Runs, count_up, union, with_transposed


class JacobianMap:
    """Map of the blocks' Jacobians to that of the constraints g = out[...] + A x."""

    def __init__(self, blocks: Sequence[Block], lift: sp.csr_array, row_of: Index, linear: sp.csr_array):
        """lift : S, of the inputs of all blocks.  row_of : each output's row; -1: none.  linear : A."""
        self._entries, starts = _shared([b.jacobian for b in blocks])
        self._shape = m, _ = linear.shape
        parts, z, out = [], 0, 0
        for b, start in zip(blocks, starts, strict=False):
            rows, columns = b.jac_pattern
            instance = np.arange(b.count)[:, None]
            row, column = row_of[out + instance * b.n_out + rows], z + instance * b.n_in + columns
            below = (columns[1:] == columns[:-1]) & (row[:, 1:] == row[:, :-1] + 1) & (row[:, :-1] >= 0)
            first, length = _runs(row.shape, below)
            row, column = row.ravel()[first], column.ravel()[first]
            first, length, row, column = (a[row >= 0] for a in (first, length, row, column))
            owner, x, factor = _terms(lift, column)
            parts.append((start + first[owner], x * m + row[owner], length[owner], factor))
            z, out = z + b.count * b.n_in, out + b.count * b.n_out
        entry, place, length, factor = _joined(parts)
        at, values = _placed(linear)
        places = union(np.concatenate([place, at]), np.concatenate([length, np.ones_like(at)]))
        self._linear = np.bincount(np.searchsorted(places, at), values, places.size)
        self._made = sp.csc_array((self._linear, *_csc(places, self._shape)), shape=self._shape)
        shape = places.size, self._entries.size
        self._sums = Runs.make(entry, np.searchsorted(places, place), length, factor, shape)

    def matrix(self) -> sp.csc_array:
        """Jacobian for the blocks' latest values."""
        values = self._linear.copy()
        self._sums.add_to(values, self._entries)
        return _with(self._made, values)


class HessianMap:
    """Map of the lower triangles of the blocks' Hessians to the Hessian of sigma x'Qx/2 + multipliers . out.

    An entry off the diagonal of z stands for the one across it, too, and so does what it is a part of in x.
    So entries are added up on one side, those of the diagonal halved, and the whole is that and its
    transpose.
    """

    def __init__(self, blocks: Sequence[Block], lift: sp.csr_array, quadratic: sp.csc_array):
        """lift : S, of the inputs of all blocks.  quadratic : Q (n, n)."""
        self._entries, starts = _shared([b.hessian for b in blocks])
        self._shape = n, _ = quadratic.shape
        parts, z, alike = [], 0, _alike(lift)
        for b, start in zip(blocks, starts, strict=False):
            rows, columns = b.hess_pattern
            instance = np.arange(b.count)[:, None] * b.n_in
            row, column = z + instance + rows, z + instance + columns
            below = (columns[1:] == columns[:-1]) & (rows[1:] == rows[:-1] + 1) & (rows[:-1] > columns[:-1])
            first, length = _runs(row.shape, below & alike[row[:, 1:]])
            row, column = row.ravel()[first], column.ravel()[first]
            of_column, c, factor = _terms(lift, column)
            of_term, r, by = _terms(lift, row[of_column])
            owner = of_column[of_term]
            by = by * factor[of_term] * np.where(row == column, 0.5, 1.0)[owner]
            parts.append((start + first[owner], c[of_term] * n + r, length[owner], by))
            z += b.count * b.n_in
        entry, place, length, factor = _joined(parts)
        at, values = _placed(quadratic)
        one, other = (_pattern(p, self._shape) for p in (union(place, length), union(at)))
        whole = sp.csc_array(one + one.T + other)
        self._made = whole
        places = np.repeat(np.arange(n), np.diff(whole.indptr)) * n + whole.indices
        numbers = sp.csc_array((np.arange(places.size), whole.indices, whole.indptr), self._shape)
        self._across = numbers.T.tocsc().data.astype(np.int32)
        self._half = np.bincount(np.searchsorted(places, at), 0.5 * values, places.size)
        shape = places.size, self._entries.size
        self._sums = Runs.make(entry, np.searchsorted(places, place), length, factor, shape)

    def matrix(self, sigma: float) -> sp.csc_array:
        """Hessian for the blocks' latest values."""
        values: Array = np.multiply(sigma, self._half)
        self._sums.add_to(values, self._entries)
        values = with_transposed(values, self._across)
        return _with(self._made, values)


def _shared(functions: Sequence[BatchedFunction]) -> tuple[Array, Index]:
    """One array that these functions write to from now on, and where each begins in it."""
    starts = np.cumsum([0, *[f.size for f in functions]])
    entries = np.zeros(int(starts[-1]))
    for f, start in zip(functions, starts, strict=False):
        f.write_to(entries[start : start + f.size])
    return entries, starts


def _with(matrix: sp.csc_array, values: Array) -> sp.csc_array:
    """The same pattern with other values: SciPy's own way looks at the whole pattern again."""
    out = copy.copy(matrix)
    out.data = values
    return out


def _terms(lift: sp.csr_array, z: Index) -> tuple[Index, Index, Array]:
    """Terms of these inputs: the position in z, the variable, and its coefficient."""
    count = lift.indptr[z + 1] - lift.indptr[z]
    owner = np.repeat(np.arange(len(z)), count)
    at = lift.indptr[z][owner] + count_up(count)
    return owner, lift.indices[at].astype(np.intp), lift.data[at]


def _alike(lift: sp.csr_array) -> npt.NDArray[np.bool_]:
    """Mask of the inputs that have the coefficients of the input before, each of the next variable."""
    count = np.diff(lift.indptr)
    owner = np.repeat(np.arange(count.size), count)
    out = np.append(False, count[1:] == count[:-1])[: count.size]
    here = np.flatnonzero(out[owner])
    before = here - count[owner[here]]
    differ = (lift.indices[here] != lift.indices[before] + 1) | (lift.data[here] != lift.data[before])
    out[owner[here[differ]]] = False
    return out


def _runs(shape: tuple[int, ...], follows: npt.NDArray[np.bool_]) -> tuple[Index, Index]:
    """Beginnings and lengths of the runs of entries.

    shape : instances and entries of each; follows : which of the entries after the first goes on.
    """
    begins = np.ones(shape, dtype=bool)
    begins[:, 1:] = ~follows
    first = np.flatnonzero(begins)
    return first, np.diff(np.append(first, begins.size))


def _joined(parts: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Entries, places, lengths and factors of all parts."""
    none = np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0)
    return tuple(np.concatenate(of) for of in zip(none, *parts, strict=True))


def _placed(matrix: sp.sparray) -> tuple[Index, Array]:
    """Places ``column * rows + row`` of a matrix's entries, and their values."""
    entries = matrix.tocoo()
    rows, columns = entries.coords
    return columns.astype(np.intp) * matrix.shape[0] + rows, entries.data


def _csc(places: Index, shape: tuple[int, int]) -> tuple[Index, Index]:
    """Rows, and starts of columns, of the places ``column * rows + row``, which are in order."""
    columns, rows = np.divmod(places, shape[0])
    starts = np.searchsorted(columns, np.arange(shape[1] + 1))
    return rows.astype(np.int32), starts.astype(np.int32)


def _pattern(places: Index, shape: tuple[int, int]) -> sp.csc_array:
    return sp.csc_array((np.ones(places.size), *_csc(places, shape)), shape)
