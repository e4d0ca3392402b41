"""Tasks of the controller: weighted squared errors that are linear in the torques."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Tasks"]

Array = NDArray[np.float64]


class Tasks:
    """Sum of 1/2 weight (rows x + off)^2 over tasks, for n unknowns; one product for all of them.

    most : rows of all tasks together.
    """

    def __init__(self, n: int, most: int) -> None:
        self._rows, self._off, self._weight = np.zeros((most, n)), np.zeros(most), np.zeros(most)
        self._used = 0

    def begin(self) -> None:
        """There is none."""
        self._used = 0

    def add(self, weight: float | Array, rows: Array, off: Array) -> None:
        """Rows (k, n) and off (k,), with one weight or (k,)."""
        its = slice(self._used, self._used + len(off))
        self._rows[its], self._off[its], self._weight[its] = rows, off, weight
        self._used = its.stop

    def sums(self) -> tuple[Array, Array]:
        """Hessian (n, n) and gradient (n,) at x = 0."""
        rows = self._rows[: self._used]
        weighted = rows.T * self._weight[: self._used]
        return weighted @ rows, weighted @ self._off[: self._used]
