"""Relaxed program: selected bounds may move, by the least total amount that meets all constraints.

Each relaxation moves a set of bounds together, by one variable of its own. The sum of these is minimized (an
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
_OBJECTIVE_WEIGHT = 1e-3  # over the objective's size: it selects one of many points of least relaxation


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Bounds that move outward together.

    constraints, variables : their numbers.  unit : distance by which their bounds move for a relaxation of 1.
    """

    constraints: Index
    variables: Index
    unit: float = 1.0


class RelaxedProgram:
    """`NonlinearProgram` that minimizes the sum of relaxations, subject to a program's relaxed constraints.

    Its variables are the program's (n,), then one for each relaxation, >= 0. Its constraints are the
    program's (m,), then the lower sides of relaxed constraints and the bounds of relaxed variables.
    """

    def __init__(self, program: NonlinearProgram, relaxations: Sequence[Relaxation], x: Vector) -> None:
        """x (n,) : a point, for the patterns of derivatives and the size of the objective."""
        self._program, self._more = program, len(relaxations)
        n, m = program.n, program.m
        self.determined: tuple[Determined, ...] = tuple(getattr(program, "determined", ()))
        # The program's objective may be of any size, also zero.
        self._weight = _OBJECTIVE_WEIGHT / max(1.0, abs(program.objective(x)))
        x_lower, x_upper = program.x_lower.copy(), program.x_upper.copy()
        upper, lower = program.g_upper.copy(), program.g_lower.copy()
        sources, lows, highs = [np.arange(m)], list[Vector](), list[Vector]()
        # constraints, number of their relaxation, and its coefficient in them
        coupled: list[tuple[Index, int, float]] = []
        size = m
        for k, relaxed in enumerate(relaxations):
            i, j, unit = relaxed.constraints, relaxed.variables, relaxed.unit
            # A constraint with both bounds cannot move both by one coefficient: its lower side becomes a
            # constraint of its own, as bounds of variables do.
            both = np.isfinite(lower[i]) & np.isfinite(upper[i])
            # g - unit s <= upper and g + unit s >= lower, so that s >= 0 moves a bound outward.
            coupled += [(i[np.isfinite(upper[i])], k, -unit), (i[~np.isfinite(upper[i])], k, unit)]
            parts = [
                (i[both], lower[i[both]], np.full(both.sum(), np.inf), unit),
                # A variable's bound cannot depend on s: x + unit s >= x_lower and x - unit s
                # <= x_upper are constraints.
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
            # The moved sides are removed where they were; otherwise they would still hold without relaxation.
            lower[i[both]], x_lower[j], x_upper[j] = -np.inf, -np.inf, np.inf
        # number of the program's constraint, or m + number of the variable, for each constraint
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
        """Number the Jacobian's entries: each is one of the program's, a 1, or a relaxation's coefficient."""
        # The same operations as on values, on a matrix of the numbers (from 1 on, as zeros are dropped),
        # once: an evaluation then only has to pick `known[self._entry]`.
        n, own = self._program.n, jacobian.nnz
        numbers = sp.csc_array(
            (np.arange(1, own + 1), jacobian.indices, jacobian.indptr), shape=jacobian.shape
        ).tocsr()
        ones = sp.csr_array((np.full(n, own + 1), (np.arange(n), np.arange(n))), shape=(n, n))
        weights = self._coupling.copy()
        self._weights = weights.data
        weights.data = own + 2 + np.arange(weights.nnz)
        # [J; I] picked by source: rows of J for constraints, of the identity for bounds of variables.
        picked = sp.csr_array(sp.vstack([numbers, ones]))[self._source]
        numbered = sp.csc_array(sp.hstack([picked, weights]))
        numbered.sort_indices()
        self._entry = numbered.data - 1
        self._indices, self._indptr = (a.astype(np.int32) for a in (numbered.indices, numbered.indptr))

    def sizes(self, x: Vector) -> Vector:
        """Relaxations, in their units, for variables x of this program."""
        return np.asarray(x[self._program.n :])

    def start(self, x: Vector, room: float) -> Vector:
        """Initial guess from the program's variables (n,): relaxations that meet all, and some room more."""
        whole = np.concatenate([x, np.zeros(self._more)])
        g = self.constraints(whole)
        short = np.maximum(np.maximum(self.g_lower - g, g - self.g_upper), 0.0)
        entries = self._coupling.tocoo()
        # One relaxation moves many bounds: it takes the largest shortage, hence
        # `maximum.at` and not assignment.
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
        # A constraint and its lower side, split off, have the same curvature: their multipliers add up.
        # Bounds of variables have none.
        np.add.at(summed, self._source[of_rows], multipliers[of_rows])
        found = self._program.hessian(x[: self._program.n], sigma * self._weight, summed)
        # Relaxations enter linearly: their columns of the Hessian are empty.
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
