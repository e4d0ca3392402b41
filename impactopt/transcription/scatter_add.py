"""Sums of functions' entries at places of a matrix, in runs.

What stands side by side in a function's output mostly belongs side by side in the matrix. A run says so in
four numbers, where a sparse matrix that does the same needs two for every product; they are read as quickly
as memory gives them, once in every iteration.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.codegen.compiler import address, native_library
from impactopt.transcription.constraints import Index
from impactopt.transcription.layout import Array

Places = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs (k,): ``factor`` times each of ``length`` entries, from ``entry`` on, goes to the places from
    ``place`` on. shape : numbers of all places and of all entries.
    """

    entry: Places
    place: Places
    length: Places
    factor: Array
    shape: tuple[int, int]

    @classmethod
    def make(cls, entry: Index, place: Index, length: Index, factor: Array, shape: tuple[int, int]) -> Runs:
        """Makes runs from index arrays of any integer type."""
        return cls(entry.astype(np.int32), place.astype(np.int32), length.astype(np.int32), factor, shape)

    def add_to(self, out: Array, entries: Array) -> None:
        """Add the sums of these entries to ``out``."""
        library = _library()
        if library is None:
            out += self._matrix @ entries
            return
        runs = (address(a) for a in (self.entry, self.place, self.length, self.factor))
        library.runs_add(ctypes.c_int64(self.entry.size), *runs, address(entries), address(out))

    @functools.cached_property
    def _matrix(self) -> sp.csr_array:
        within = count_up(self.length)
        at = np.repeat(self.place, self.length) + within, np.repeat(self.entry, self.length) + within
        return sp.csr_array((np.repeat(self.factor, self.length), at), shape=self.shape)


def with_transposed(values: Array, across: Places) -> Array:
    """Values (nnz,) of the sum of a matrix with a symmetric pattern and its transpose.

    across (nnz,) : of each place the one across the diagonal.
    """
    library = _library()
    if library is None:
        return values + values[across]
    out = np.empty_like(values)
    library.runs_add_transposed(ctypes.c_int64(values.size), address(across), address(values), address(out))
    return out


def count_up(lengths: Index | Places) -> Index:
    """0, 1, ... length - 1 of each, one after the other."""
    ends = np.append(0, np.cumsum(lengths))
    return np.arange(int(ends[-1])) - np.repeat(ends[:-1], lengths)


def union(first: Index, length: Index | int = 1) -> Index:
    """The numbers (sorted, each once) in the runs that begin with ``first``."""
    length = np.broadcast_to(length, first.shape)
    order = np.argsort(first)
    start, end = first[order], np.maximum.accumulate(first[order] + length[order])
    begins = np.append(True, start[1:] > end[:-1])[: start.size]
    start, end = start[begins], end[np.append(begins[1:], True)[: end.size]]
    return np.repeat(start, end - start) + count_up(end - start)


@functools.cache
def _library() -> Any:
    """C library, if there is a compiler; None: sparse products replace it."""
    return native_library(__package__, "scatter_add")
