"""DAQP (Arnstroem, Bemporad, Axehill 2022) as a QP solver: a dual active-set method in C, dense."""

from __future__ import annotations

import daqp
import numpy as np

from impactopt.solvers.program import Vector
from impactopt.solvers.sqp.answers import answer, finished, no_answer, refusal, split
from impactopt.solvers.sqp.qp import QPSolution, QPStatus, QuadraticProgram

_SOLVED, _INFEASIBLE, _CONTRADICTION = 1, -1, -6  # exit flags; the last: of equalities
_EQUALITY = 5  # "sense" of a row: active, and never to leave
_NONE = 1e30  # DAQP's infinity
_EXACT = 1e-3  # of the tolerance: an error that needs no refinement


class DaqpSolver:
    """DAQP with unit rows, started from the active set of the guess.

    Its matrices are dense and its loops are plain C: quick for some hundred variables, cubic beyond.

    Attributes
    ----------
    tolerance : largest error of an answer that counts as solved, see `QuadraticProgram.error`.
    """

    def __init__(self, *, tolerance: float = 1e-6, max_iterations: int = 10_000):
        """Tolerance as above; max_iterations: rows added or dropped, at most."""
        self.tolerance = tolerance
        self._max_iterations = max_iterations

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the active set of the guess (x, y, z)."""
        refused = refusal(qp)
        if refused is not None:
            return no_answer(qp, refused)
        (P, C), (_, lower, upper) = qp.arrays, qp.stacked
        m, n = qp.m, qp.n
        first = np.roll(np.arange(m + n), n)  # DAQP has the bounds of the variables before the rows
        low, high = np.maximum(lower[first], -_NONE), np.minimum(upper[first], _NONE)
        guess = None if start is None else (np.concatenate(start[1:]) / qp.row_scale)[first]
        x, _, flag, info = daqp.solve(
            P,
            qp.q,
            C[:m],
            high,
            low,
            np.where(low == high, _EQUALITY, 0).astype(np.intc),
            dual_start=guess,
            primal_tol=1e-3 * self.tolerance,
            iter_limit=self._max_iterations,
            time_limit=0.0 if time_limit is None else max(time_limit, 1e-6),
        )
        iterations = int(info["iterations"])
        if flag in (_INFEASIBLE, _CONTRADICTION):
            return no_answer(qp, QPStatus.INFEASIBLE, iterations)
        if flag != _SOLVED:
            return no_answer(qp, QPStatus.FAILED, iterations)
        unit = np.zeros(m + n)
        unit[first] = info["lam"]
        x = np.array(x)
        # its multipliers of rows that do not hold are zeros
        if qp.error(x, *split(qp, unit)) <= _EXACT * self.tolerance:
            return answer(qp, x, unit, QPStatus.SOLVED, iterations)
        return finished(qp, x, unit, self.tolerance, iterations)
