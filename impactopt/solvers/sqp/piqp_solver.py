"""PIQP (Schwan et al. 2023) as a QP solver: a proximal interior-point method, dense or sparse."""

from __future__ import annotations

from typing import Any

import numpy as np
import piqp
import scipy.sparse as sp

from impactopt.solvers.program import Matrix, Vector
from impactopt.solvers.sqp.answers import SMALL, finished, no_answer, refusal
from impactopt.solvers.sqp.qp import QPSolution, QPStatus, QuadraticProgram

# PIQP's own scaling spoils some QPs of whole motions, unless every linear solve is refined; refined, some
# with dependent rows do not end. So: our unit rows alone, or the other way where they do not do; and for the
# next QP first the way that did.
_WAYS: dict[str, dict[str, Any]] = {
    "unit rows": {"preconditioner_iter": 0},
    "refined": {"iterative_refinement_always_enabled": True},
}


class PiqpSolver:
    """PIQP with unit rows; a dozen or two iterations, whatever the guess.

    It has no warm start and no clock: the guess is not used, and a time limit is looked at before it starts.

    Attributes
    ----------
    tolerance : largest error of an answer that counts as solved, see `QuadraticProgram.error`.
    setups : number of times PIQP was set up (rather than updated in place).
    """

    def __init__(self, *, tolerance: float = 1e-6, dense_limit: int = SMALL, max_iterations: int = 60):
        """Tolerance as above; dense_limit: most variables for which PIQP's dense factorization is used."""
        self.tolerance, self.setups = tolerance, 0
        self._dense_limit, self._max_iterations = dense_limit, max_iterations
        self._loaded: dict[str, tuple[Any, list[np.ndarray]]] = {}
        self._first = next(iter(_WAYS))

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP; see `QPSolver`."""
        refused = refusal(qp)
        if refused is not None:
            return no_answer(qp, refused)
        if time_limit is not None and time_limit <= 0.0:
            return no_answer(qp, QPStatus.FAILED)
        C, lower, upper = qp.stacked
        equal = lower == upper
        held = np.flatnonzero(equal)
        rows = np.flatnonzero(~equal[: qp.m])
        free = equal[qp.m :]  # of bounds: an equality has no interior, and is a row
        C = sp.csr_array(C)
        matrices = {"P": sp.csc_array(qp.P), "A": C[held], "G": C[rows]}
        vectors = {
            "c": qp.q,
            "b": lower[held],
            "h_l": lower[rows],
            "h_u": upper[rows],
            "x_l": np.where(free, -np.inf, qp.x_lower),
            "x_u": np.where(free, np.inf, qp.x_upper),
        }
        iterations = 0
        for way in sorted(_WAYS, key=lambda way: way != self._first):
            solver = self._load(way, matrices, vectors)
            status = solver.solve()
            result = solver.result
            iterations += int(result.info.iter)
            if status == piqp.PIQP_PRIMAL_INFEASIBLE:
                return no_answer(qp, QPStatus.INFEASIBLE, iterations)
            if status == piqp.PIQP_SOLVED:
                self._first = way
                break
        if status not in (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED, piqp.PIQP_NUMERICS):
            return no_answer(qp, QPStatus.FAILED, iterations)
        unit = np.zeros(lower.size)
        unit[held] = result.y
        unit[rows] = result.z_u - result.z_l
        unit[qp.m :] += np.where(free, 0.0, result.z_bu - result.z_bl)
        return finished(qp, np.array(result.x), unit, self.tolerance, iterations)

    def _load(self, way: str, matrices: dict[str, Matrix], vectors: dict[str, Vector]) -> Any:
        """The solver of a way with the data, in place while the patterns are those of the last QP."""
        dense = vectors["c"].size <= self._dense_limit
        given: dict[str, Any] = {}
        pattern: list[np.ndarray] = []
        for name, matrix in matrices.items():
            sparse = sp.csc_matrix(matrix)
            sparse.sort_indices()
            given[name] = np.asfortranarray(sparse.toarray()) if dense else sparse
            pattern += [np.array(sparse.shape), sparse.indptr, sparse.indices]
        solver, known = self._loaded.get(way, (None, []))
        if known and all(map(np.array_equal, pattern, known)):
            solver.update(**given, **vectors)
            return solver
        solver = piqp.DenseSolver() if dense else piqp.SparseSolver()
        for option, value in _WAYS[way].items():
            setattr(solver.settings, option, value)
        # A row that nearly holds hides in the gap: multiplier and distance 1e-5 each, their product 1e-10.
        eps = 1e-4 * self.tolerance
        solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = eps
        solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = eps
        solver.settings.max_iter = self._max_iterations
        solver.setup(**given, **vectors)
        self._loaded[way] = solver, pattern
        self.setups += 1
        return solver
