"""A program some of whose bounds may give way, as little as possible: what it takes to meet all others.

Each relaxation moves a set of bounds together, by one variable of its own. What is minimized is their sum (an
l1 penalty of bounds, Nocedal and Wright 2006, section 17.2), which leaves most of them at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.solvers.program import Determined, Matrix, NonlinearProgram, Vector

Index = npt.NDArray[np.intp]
# weight of the program's own objective, over its size: of many points with the least relaxation, it picks one
_KEEP = 1e-3


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Bounds that move together, outward.

    rows, variables : whose bounds, by their numbers.  unit : how far they move where its variable is one.
    """

    rows: Index
    variables: Index
    unit: float = 1.0


class RelaxedProgram:
    """Minimize the sum of how far bounds move, subject to all of a program's constraints; a
    `NonlinearProgram`.

    Its variables are the program's (n,), and behind them one for each relaxation, >= 0. Its constraints are
    the program's (m,), and behind them the lower sides of relaxed constraints and the bounds of relaxed
    variables.

    x : (n,) somewhere: patterns of derivatives are taken from there, and the size of the objective.
    """

    def __init__(self, program: NonlinearProgram, relaxations: Sequence[Relaxation], x: Vector) -> None:
        self._program, self._more = program, len(relaxations)
        n, m = program.n, program.m
        self.determined: tuple[Determined, ...] = tuple(getattr(program, "determined", ()))
        self._weight = _KEEP / max(1.0, abs(program.objective(x)))
        x_lower, x_upper = program.x_lower.copy(), program.x_upper.copy()
        upper, lower = program.g_upper.copy(), program.g_lower.copy()
        sources, lows, highs = [np.arange(m)], list[Vector](), list[Vector]()
        # constraints, their relaxation, and its coefficient in them
        coupled: list[tuple[Index, int, float]] = []
        size = m
        for k, relaxed in enumerate(relaxations):
            i, j, unit = relaxed.rows, relaxed.variables, relaxed.unit
            # A constraint with both bounds cannot move both by one coefficient: its lower side becomes a
            # constraint of its own, as bounds of variables do.
            both = np.isfinite(lower[i]) & np.isfinite(upper[i])
            coupled += [(i[np.isfinite(upper[i])], k, -unit), (i[~np.isfinite(upper[i])], k, unit)]
            parts = [
                (i[both], lower[i[both]], np.full(both.sum(), np.inf), unit),
                (m + j, x_lower[j], np.full(j.size, np.inf), unit),
                (m + j, np.full(j.size, -np.inf), x_upper[j], -unit),
            ]
            for source, low, high, weight in parts:
                bounded = np.isfinite(low) | np.isfinite(high)
                count = int(bounded.sum())
                coupled.append((np.arange(size, size + count), k, weight))
                sources.append(source[bounded])
                lows.append(low[bounded])
                highs.append(high[bounded])
                size += count
            lower[i[both]], x_lower[j], x_upper[j] = -np.inf, -np.inf, np.inf
        # of each constraint: one of the program's, or m + variable
        self._source = np.concatenate(sources)
        self.n, self.m = n + self._more, size
        self.g_lower, self.g_upper = np.concatenate([lower, *lows]), np.concatenate([upper, *highs])
        self.x_lower = np.concatenate([x_lower, np.zeros(self._more)])
        self.x_upper = np.concatenate([x_upper, np.full(self._more, np.inf)])
        rows = np.concatenate([rows for rows, _, _ in coupled])
        columns = np.concatenate([np.full(rows.size, k) for rows, k, _ in coupled])
        weights = np.concatenate([np.full(rows.size, w) for rows, _, w in coupled])
        self._coupling = sp.csr_array((weights, (rows, columns)), shape=(size, self._more))
        self._number_entries(program.jacobian(x))

    def _number_entries(self, jacobian: Matrix) -> None:
        """Sources of the Jacobian's entries: the program's entries, a one, or the coupling's weights."""
        n, own = self._program.n, jacobian.nnz
        theirs = sp.csc_array(
            (np.arange(1, own + 1), jacobian.indices, jacobian.indptr), shape=jacobian.shape
        ).tocsr()
        ones = sp.csr_array((np.full(n, own + 1), (np.arange(n), np.arange(n))), shape=(n, n))
        weights = self._coupling.copy()
        self._weights = weights.data
        weights.data = own + 2 + np.arange(weights.nnz)
        picked = sp.csr_array(sp.vstack([theirs, ones]))[self._source]
        numbered = sp.csc_array(sp.hstack([picked, weights]))
        numbered.sort_indices()
        self._entry = numbered.data - 1
        self._indices, self._indptr = (a.astype(np.int32) for a in (numbered.indices, numbered.indptr))

    def sizes(self, x: Vector) -> Vector:
        """Relaxation of each group of bounds, in its unit; x : variables of this program."""
        return np.asarray(x[self._program.n :])

    def start(self, x: Vector, room: float) -> Vector:
        """Variables of this program with the program's (n,): bounds have moved as far as it takes, and some
        room.
        """
        whole = np.concatenate([x, np.zeros(self._more)])
        g = self.constraints(whole)
        short = np.maximum(np.maximum(self.g_lower - g, g - self.g_upper), 0.0)
        entries = self._coupling.tocoo()
        np.maximum.at(whole, self._program.n + entries.col, short[entries.row] / np.abs(entries.data))
        whole[self._program.n :] += room
        return whole

    def objective(self, x: Vector) -> float:
        return float(self.sizes(x).sum() + self._weight * self._program.objective(x[: self._program.n]))

    def gradient(self, x: Vector) -> Vector:
        return np.concatenate(
            [self._weight * self._program.gradient(x[: self._program.n]), np.ones(self._more)]
        )

    def constraints(self, x: Vector) -> Vector:
        own = x[: self._program.n]
        values = np.concatenate([self._program.constraints(own), own])
        return np.asarray(values[self._source] + self._coupling @ self.sizes(x))

    def jacobian(self, x: Vector) -> Matrix:
        known = np.concatenate([self._program.jacobian(x[: self._program.n]).data, [1.0], self._weights])
        return sp.csc_array((known[self._entry], self._indices, self._indptr), shape=(self.m, self.n))

    def hessian(self, x: Vector, sigma: float, multipliers: Vector) -> Matrix:
        of_rows = self._source < self._program.m
        summed = np.zeros(self._program.m)
        np.add.at(summed, self._source[of_rows], multipliers[of_rows])
        found = self._program.hessian(x[: self._program.n], sigma * self._weight, summed)
        indptr = np.concatenate([found.indptr, np.full(self._more, found.nnz, dtype=found.indptr.dtype)])
        return sp.csc_array((found.data, found.indices, indptr), shape=(self.n, self.n))

    def constraint_name(self, i: int) -> str:
        source = int(self._source[i])
        inside = source < self._program.m
        return (
            self._program.constraint_name(source) if inside else self.variable_name(source - self._program.m)
        )

    def variable_name(self, j: int) -> str:
        return self._program.variable_name(j) if j < self._program.n else f"relaxation {j - self._program.n}"
