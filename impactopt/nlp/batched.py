"""Compiled functions called for many instances through buffers."""

from __future__ import annotations

from typing import Any

import numpy as np

from impactopt.nlp.layout import Array
from impactopt.nlp.rows import Index

# of functions that take one instance a call: those in lanes are done before a thread has started
THREADS = 2


class BatchedFunction:
    """A CasADi function of ``count`` instances, called through its buffer: no copies, no Python lists.

    The function takes as many instances a call as z has columns.
    """

    def __init__(self, function: Any, count: int, parameters: Array) -> None:
        self.columns = columns = function.size2_in(0)
        calls = -(-count // columns)
        threads = ("thread", THREADS) if columns == 1 else ()
        self._mapped = function.map(calls, *threads) if calls > 1 else function
        self._buffer, self._run = self._mapped.buffer()
        # instances beyond `count` fill the last call up: they are the last one, again
        self.inputs = [np.zeros((calls * columns, function.size1_in(i))) for i in range(function.n_in())]
        self.inputs[1][...] = parameters[np.minimum(np.arange(calls * columns), count - 1)]
        self._output = np.zeros((calls * columns, function.nnz_out(0) // columns))
        self.count, self.output = count, self._output[:count]
        for i, a in enumerate(self.inputs):
            if a.size:
                self._buffer.set_arg(i, a.data)
        if self._output.size:
            self._buffer.set_res(0, self._output.data)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        """Rows are instances: z (count, n_z) -> (count, nnz of the output).

        The result is overwritten by the next call.
        """
        self.inputs[0][: self.count] = z
        self.inputs[0][self.count :] = z[-1:]
        if multipliers is not None:
            self.inputs[2][: self.count] = multipliers
        self._run()
        return self.output

    @property
    def pattern(self) -> tuple[Index, Index]:
        """Rows and columns of an instance's nonzeros, in CasADi's (column-major) order."""
        rows, columns = pattern(self._mapped.sparsity_out(0))
        return rows[: self.output.shape[1]], columns[: self.output.shape[1]]


def pattern(sparsity: Any) -> tuple[Index, Index]:
    """Rows and columns of a CasADi sparsity's nonzeros, in its (column-major) order."""
    start = np.array(sparsity.colind(), dtype=np.intp)
    columns = np.repeat(np.arange(sparsity.size2()), start[1:] - start[:-1])
    return np.array(sparsity.row(), dtype=np.intp), columns
