"""OSQP (Stellato et al. 2020) as a QP solver: updated in place, warm-started, its answer made exact."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sp

from impactopt.solvers.program import Vector
from impactopt.solvers.qp.active_set import ActiveSetSolver
from impactopt.solvers.qp.quadratic_program import QPSolution, QPStatus, QuadraticProgram, active_set, refine

_USABLE = (osqp.SolverStatus.OSQP_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE)
_INFEASIBLE = (osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE, osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE)
_UNFINISHED = (osqp.SolverStatus.OSQP_MAX_ITER_REACHED, osqp.SolverStatus.OSQP_TIME_LIMIT_REACHED)
_SMALL = 300  # variables; up to here dense factorizations are cheap
_HOPELESS = 1e-2  # largest error of an answer that is of any use
_FEW = 5  # rows that a guess of the active set may lack or have too many


class OsqpSolver:
    """OSQP with unit row norms and our own refinement.

    OSQP alone is good to three or four digits and its polish often fails. So the active set is taken from its
    answer, corrected, and solved exactly: by the dual active-set method where the QP is small, else by
    `refine`.

    Attributes
    ----------
    tolerance : largest error of an answer that counts as solved, see `QuadraticProgram.error`.
    setups : number of times OSQP was set up (rather than updated in place).
    """

    def __init__(
        self,
        *,
        tolerance: float = 1e-6,
        eps: float = 1e-6,
        stages: tuple[int, ...] = (200, 500, 1000, 2000, 4000, 8000),
    ):
        """Tolerance as above; eps: OSQP's; stages: its iterations before the 1st, 2nd, ... try to finish."""
        self.tolerance = tolerance
        self.setups = 0
        self._eps, self._stages = eps, stages
        self._active_set, self._near = ActiveSetSolver(), ActiveSetSolver(max_iterations=_FEW)
        self._solver: osqp.OSQP | None = None
        self._pattern: list[np.ndarray] = []

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the guess (x, y, z); see `QPSolver`."""
        C, lower, upper = qp.stacked
        if (lower > upper).any():
            return no_answer(qp, QPStatus.INFEASIBLE)
        if start is not None:
            # Near the end of an SQP the active set no longer changes: the last one gives the answer.
            known = self._known(qp, start)
            if known is not None:
                return known
        if not self._load(qp, C, lower, upper):
            return no_answer(qp, QPStatus.FAILED)
        assert self._solver is not None
        if start is not None:
            self._solver.warm_start(x=start[0], y=np.concatenate(start[1:]) / qp.row_scale)
        deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
        return self._iterate(qp, deadline)

    def _known(self, qp: QuadraticProgram, start: tuple[Vector, Vector, Vector]) -> QPSolution | None:
        """The solution, if the guess has its active set but for a few rows."""
        if qp.n <= _SMALL:
            found = self._near.solve(qp, start=start)
            exact = found.status is QPStatus.SOLVED and qp.error(found.x, found.y, found.z) <= self.tolerance
            return dataclasses.replace(found, iterations=0) if exact else None
        guess = refine(qp, start[0], np.concatenate(start[1:]) / qp.row_scale, rounds=3)
        if guess is None or guess.error > self.tolerance:
            return None
        return answer(qp, guess.x, guess.y, QPStatus.SOLVED, 0)

    def _iterate(self, qp: QuadraticProgram, deadline: float) -> QPSolution:
        """Let OSQP run for longer and longer, and try to finish from its answer each time."""
        assert self._solver is not None
        iterations, best = 0, no_answer(qp, QPStatus.FAILED)
        worst = _HOPELESS
        for more in self._stages:
            left = deadline - time.perf_counter()
            if left <= 0.0:
                break
            self._solver.update_settings(max_iter=more, time_limit=min(left, 1e10))
            found = self._solver.solve(raise_error=False)
            status = found.info.status_val
            iterations += int(found.info.iter)
            if status == osqp.SolverStatus.OSQP_SIGINT:
                raise KeyboardInterrupt
            if status in _INFEASIBLE:
                if qp.n <= _SMALL:  # OSQP may be wrong about it; this is exact
                    return self._active_set.solve(qp, time_limit=None if left == np.inf else left)
                return no_answer(qp, QPStatus.INFEASIBLE, iterations)
            if status not in _USABLE + _UNFINISHED or not (
                np.isfinite(found.x).all() and np.isfinite(found.y).all()
            ):
                self._solver = None  # whatever went wrong stays in its state
                break
            x, unit, error = self._finish(qp, np.array(found.x), np.array(found.y), deadline)
            if error < worst:
                worst = error
                reached = QPStatus.SOLVED if worst <= self.tolerance else QPStatus.INACCURATE
                best = answer(qp, x, unit, reached, iterations)
            if worst <= self.tolerance or status == osqp.SolverStatus.OSQP_SOLVED:
                break
        return dataclasses.replace(best, iterations=iterations)

    def _finish(
        self, qp: QuadraticProgram, x: Vector, unit: Vector, deadline: float
    ) -> tuple[Vector, Vector, float]:
        """The best of OSQP's answer and what can be made of it, with its error."""
        worst = qp.error(x, *split(qp, unit))
        if qp.n <= _SMALL:
            guess = (x, *split(qp, active_set(qp, x, unit).astype(float)))
            left = None if deadline == np.inf else deadline - time.perf_counter()
            exact = self._active_set.solve(qp, start=guess, time_limit=left)
            if exact.status is QPStatus.SOLVED:
                exact_unit = np.concatenate([exact.y, exact.z]) / qp.row_scale
                return exact.x, exact_unit, qp.error(exact.x, exact.y, exact.z)
        refined = refine(qp, x, unit)
        if refined is not None and refined.error < worst:
            return refined.x, refined.y, refined.error
        return x, unit, worst

    def _load(self, qp: QuadraticProgram, C: Any, lower: Vector, upper: Vector) -> bool:
        """Give OSQP the data, in place while the patterns are those of the last QP. False if refused."""
        if qp.dense:
            P, C = sp.csc_matrix(np.triu(qp.P)), sp.csc_matrix(C)
        else:
            P = sp.csc_matrix(sp.triu(qp.P, format="csc"))
            P.sort_indices()
        pattern = [P.indptr, P.indices, C.indptr, C.indices]
        if self._solver is not None and all(map(np.array_equal, pattern, self._pattern)):
            self._solver.update(q=qp.q, l=lower, u=upper)
            self._solver.update(Px=P.data, Ax=C.data)
            return True
        solver = osqp.OSQP(algebra="builtin")  # to look for others takes longer than a small QP
        try:
            solver.setup(
                P, qp.q, sp.csc_matrix(C), lower, upper,
                eps_abs=self._eps, eps_rel=self._eps, scaling=0, polishing=False,
                adaptive_rho_interval=25, check_termination=10, eps_prim_inf=1e-7, eps_dual_inf=1e-7,
                verbose=False,
            )  # fmt: skip
        except (osqp.interface.OSQPException, ValueError):  # not convex, or not finite
            self._solver = None
            return False
        self._solver, self._pattern = solver, pattern
        self.setups += 1
        return True


def split(qp: QuadraticProgram, unit: Vector) -> tuple[Vector, Vector]:
    """Multipliers (y, z) from those of the unit rows of `qp.stacked` (m + n,)."""
    y = unit * qp.row_scale
    return y[: qp.m], y[qp.m :]


def answer(qp: QuadraticProgram, x: Vector, unit: Vector, status: QPStatus, iterations: int) -> QPSolution:
    """x and the multipliers of the unit rows as a solution."""
    y, z = split(qp, unit)
    return QPSolution(x=x, y=y, z=z, status=status, iterations=iterations)


def no_answer(qp: QuadraticProgram, status: QPStatus, iterations: int = 0) -> QPSolution:
    """A status without a solution."""
    return answer(qp, np.zeros(qp.n), np.zeros(qp.m + qp.n), status, iterations)
