"""OSQP (Stellato et al. 2020) as a QP solver: updated in place, warm-started, with refined solutions."""

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
_MAX_DENSE = 300  # variables, up to which dense factorizations are cheap
_MAX_ERROR = 1e-2  # of a usable solution
_EPS = 1e-6  # OSQP's own tolerance
_STAGES = (200, 500, 1000, 2000, 4000, 8000)  # OSQP's iterations before each refinement of its solution
_MAX_CORRECTIONS = 5  # of the active set of an initial guess: constraints added or dropped


class OsqpSolver:
    """OSQP with normalized constraints and our own refinement.

    OSQP's solutions have three or four digits, and its polish often fails. So the active set of its solution
    is corrected and solved exactly: by the dual active-set method if the QP is small, else by `refine`.

    Attributes
    ----------
    tolerance : largest error of a solution that counts as solved, see `QuadraticProgram.error`.
    setups : number of times OSQP was set up (rather than updated in place).
    """

    def __init__(self, *, tolerance: float = 1e-6) -> None:
        self.tolerance = tolerance
        self.setups = 0
        self._active_set, self._near = ActiveSetSolver(), ActiveSetSolver(max_iterations=_MAX_CORRECTIONS)
        self._solver: osqp.OSQP | None = None
        self._pattern: list[np.ndarray] = []

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the initial guess (x, y, z); see `QPSolver`."""
        C, lower, upper = qp.stacked
        # OSQP would refuse these as invalid data.
        if (lower > upper).any():
            return without_solution(qp, QPStatus.INFEASIBLE)
        if start is not None:
            # near the end of an SQP the active set hardly changes: OSQP is not needed
            solution = self._from_active_set(qp, start)
            if solution is not None:
                return solution
        if not self._load(qp, C, lower, upper):
            return without_solution(qp, QPStatus.FAILED)
        assert self._solver is not None
        if start is not None:
            # OSQP sees the normalized constraints: C = row_scale * A, so y_C = y / row_scale.
            self._solver.warm_start(x=start[0], y=np.concatenate(start[1:]) / qp.row_scale)
        deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
        return self._iterate(qp, deadline)

    def _from_active_set(
        self, qp: QuadraticProgram, start: tuple[Vector, Vector, Vector]
    ) -> QPSolution | None:
        """Solution, if the initial guess has its active set but for a few constraints."""
        if qp.n <= _MAX_DENSE:
            # Few iterations: a test of the guess, not a search for the active set.
            found = self._near.solve(qp, start=start)
            exact = found.status is QPStatus.SOLVED and qp.error(found.x, found.y, found.z) <= self.tolerance
            return dataclasses.replace(found, iterations=0) if exact else None
        guess = refine(qp, start[0], np.concatenate(start[1:]) / qp.row_scale, rounds=3)
        if guess is None or guess.error > self.tolerance:
            return None
        return solution_of(qp, guess.x, guess.y, QPStatus.SOLVED, 0)

    def _iterate(self, qp: QuadraticProgram, deadline: float) -> QPSolution:
        """Run OSQP in stages of increasing length, and refine its solution after each."""
        assert self._solver is not None
        iterations, best = 0, without_solution(qp, QPStatus.FAILED)
        least_error = _MAX_ERROR
        for more in _STAGES:
            left = deadline - time.perf_counter()
            if left <= 0.0:
                break
            # 1e10 is OSQP's default: no limit.
            self._solver.update_settings(max_iter=more, time_limit=min(left, 1e10))
            found = self._solver.solve(raise_error=False)
            status = found.info.status_val
            iterations += int(found.info.iter)
            if status == osqp.SolverStatus.OSQP_SIGINT:
                raise KeyboardInterrupt
            if status in _INFEASIBLE:
                if qp.n <= _MAX_DENSE:  # OSQP may be wrong about it; this method is exact
                    return self._active_set.solve(qp, time_limit=None if left == np.inf else left)
                return without_solution(qp, QPStatus.INFEASIBLE, iterations)
            if status not in _USABLE + _UNFINISHED or not (
                np.isfinite(found.x).all() and np.isfinite(found.y).all()
            ):
                self._solver = None  # its state is spoilt
                break
            x, unit, error = self._refined(qp, np.array(found.x), np.array(found.y), deadline)
            if error < least_error:
                least_error = error
                reached = QPStatus.SOLVED if error <= self.tolerance else QPStatus.INACCURATE
                best = solution_of(qp, x, unit, reached, iterations)
            # OSQP goes on from its own state in the next stage; solved to eps it would end
            # at once with the same point.
            if least_error <= self.tolerance or status == osqp.SolverStatus.OSQP_SOLVED:
                break
        return dataclasses.replace(best, iterations=iterations)

    def _refined(
        self, qp: QuadraticProgram, x: Vector, unit: Vector, deadline: float
    ) -> tuple[Vector, Vector, float]:
        """Solution refined from OSQP's, or that itself if it is better; with its error."""
        error = qp.error(x, *split(qp, unit))
        if qp.n <= _MAX_DENSE:
            # +1, 0 and -1 stand for multipliers: the method reads signs only.
            guess = (x, *split(qp, active_set(qp, x, unit).astype(float)))
            left = None if deadline == np.inf else deadline - time.perf_counter()
            exact = self._active_set.solve(qp, start=guess, time_limit=left)
            if exact.status is QPStatus.SOLVED:
                exact_unit = np.concatenate([exact.y, exact.z]) / qp.row_scale
                return exact.x, exact_unit, qp.error(exact.x, exact.y, exact.z)
        refined = refine(qp, x, unit)
        if refined is not None and refined.error < error:
            return refined.x, refined.y, refined.error
        return x, unit, error

    def _load(self, qp: QuadraticProgram, C: Any, lower: Vector, upper: Vector) -> bool:
        """Set up OSQP, or update it in place for the same patterns; False if it refuses."""
        P, C = sp.csc_matrix(np.triu(qp.P)), sp.csc_matrix(C)
        pattern = [P.indptr, P.indices, C.indptr, C.indices]
        if self._solver is not None and all(map(np.array_equal, pattern, self._pattern)):
            self._solver.update(q=qp.q, l=lower, u=upper)
            self._solver.update(Px=P.data, Ax=C.data)
            return True
        solver = osqp.OSQP(algebra="builtin")  # without, its search for others takes longer than a small QP
        try:
            # No scaling, as rows have norm 1 already, and no polishing: `_refined` does that.
            solver.setup(
                P, qp.q, sp.csc_matrix(C), lower, upper,
                eps_abs=_EPS, eps_rel=_EPS, scaling=0, polishing=False,
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
    """Multipliers (y, z) from those of the normalized constraints of `qp.stacked` (m + n,)."""
    y = unit * qp.row_scale
    return y[: qp.m], y[qp.m :]


def solution_of(
    qp: QuadraticProgram, x: Vector, unit: Vector, status: QPStatus, iterations: int
) -> QPSolution:
    """Solution of x and the multipliers of the normalized constraints."""
    y, z = split(qp, unit)
    return QPSolution(x=x, y=y, z=z, status=status, iterations=iterations)


def without_solution(qp: QuadraticProgram, status: QPStatus, iterations: int = 0) -> QPSolution:
    """Status without a solution."""
    return solution_of(qp, np.zeros(qp.n), np.zeros(qp.m + qp.n), status, iterations)
