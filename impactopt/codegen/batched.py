"""Compiled functions, evaluated for many instances in one call, without copies."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from impactopt.arrays import Array, Index

# For functions of one instance a call. Functions in SIMD lanes are done before a thread has started.
THREADS = 2
MAX_MAPPED_CALLS = 64  # CasADi takes long to map a function to more calls


class BatchedFunction:
    """CasADi function (z, p[, multipliers]) evaluated for ``count`` instances, without copies.

    The function takes as many instances a call as z has columns, `columns`. Arguments and results are NumPy
    arrays that CasADi's buffers point to.

    parameters (count, n_p) : p of the instances.

    Attributes
    ----------
    inputs : arguments, (calls * columns, size) each.
    output (count, nnz) : nonzeros of the result of each instance.
    """

    def __init__(self, function: Any, count: int, parameters: Array) -> None:
        self._function = function
        self.columns = columns = function.size2_in(0)
        calls = -(-count // columns)
        # instances beyond `count` fill the last call up; they repeat the last instance
        self.inputs = [np.zeros((calls * columns, function.size1_in(i))) for i in range(function.n_in())]
        self.count, self._shape = count, (calls * columns, function.nnz_out(0) // columns)
        self.take_parameters(parameters)
        self._parts = []  # slice of the instances, buffer, and function that runs it
        for first, last in _parts(calls, calls if columns == 1 else MAX_MAPPED_CALLS):
            buffer, run = _mapped(function, last - first).buffer()
            self._parts.append((slice(first * columns, last * columns), buffer, run))
        # CasADi keeps bare pointers, so these arrays are written in place from now on and never replaced; the
        # slices are contiguous, as they are of whole instances.
        for part, buffer, _ in self._parts:
            for i, a in enumerate(self.inputs):
                if a.size:
                    buffer.set_arg(i, a[part].data)
        self.write_to(np.zeros(self.size))

    def take_parameters(self, parameters: Array) -> None:
        """Use these parameters (count, n_p) from now on."""
        self.inputs[1][...] = parameters[np.minimum(np.arange(len(self.inputs[1])), self.count - 1)]

    def copy(self) -> BatchedFunction:
        """Copy with arrays of its own."""
        return BatchedFunction(self._function, self.count, self.inputs[1][: self.count])

    @property
    def size(self) -> int:
        """Length of the array that a call writes, with the instances that fill the last call up."""
        return self._shape[0] * self._shape[1]

    def write_to(self, numbers: Array) -> None:
        """Sets the array (size,) that later calls write to."""
        self._all = numbers.reshape(self._shape)
        self.output = self._all[: self.count]
        for part, buffer, _ in self._parts if numbers.size else ():
            buffer.set_res(0, self._all[part].data)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        """Result (count, nnz) for z (count, n_z), which the next call overwrites."""
        self.inputs[0][: self.count] = z
        self.inputs[0][self.count :] = z[-1:]
        if multipliers is not None:
            self.inputs[2][: self.count] = multipliers
        for _, _, run in self._parts:
            run()
        return self.output

    @property
    def pattern(self) -> tuple[Index, Index]:
        """Row and column indices of an instance's nonzeros, in CasADi's (column-major) order."""
        rows, columns = pattern(self._function.sparsity_out(0))
        # In lanes the instances' patterns stand side by side, the first one's nonzeros first.
        return rows[: self.output.shape[1]], columns[: self.output.shape[1]]


def _parts(calls: int, longest: int) -> Iterator[tuple[int, int]]:
    """Begin and end of batches of calls: all calls, or batches of ``longest`` and then of powers of two.

    Few different sizes, because `_mapped` has to make a function for each.
    """
    first = 0
    while first < calls:
        size = min(calls - first, longest)
        size = size if size in (calls, longest) else 1 << (size.bit_length() - 1)
        yield first, first + size
        first += size


@functools.lru_cache(maxsize=1024)
def _mapped(function: Any, calls: int) -> Any:
    """Function that makes this number of calls.

    Cached: for a hundred calls CasADi takes longer to make it than to run it ten times.
    """
    threads = ("thread", THREADS) if function.size2_in(0) == 1 else ()
    return function.map(calls, *threads) if calls > 1 else function


def pattern(sparsity: Any) -> tuple[Index, Index]:
    """Row and column indices of a CasADi sparsity's nonzeros, in its (column-major) order."""
    start = np.array(sparsity.colind(), dtype=np.intp)
    columns = np.repeat(np.arange(sparsity.size2()), start[1:] - start[:-1])
    return np.array(sparsity.row(), dtype=np.intp), columns
