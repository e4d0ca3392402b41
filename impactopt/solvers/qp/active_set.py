"""Goldfarb and Idnani's dual active-set method (Mathematical Programming 27, 1983).

For small dense strictly convex QPs. Exact, finite, and quick from a good guess of the active set: what an SQP
has near its end.
"""

from __future__ import annotations

import time

import numpy as np
import scipy.linalg as la

from impactopt.solvers.program import Vector
from impactopt.solvers.qp.quadratic_program import QPSolution, QPStatus, QuadraticProgram, solve_equality_qp

_FEASIBLE = 1e-10  # violation of a unit row that counts as none, relative to its bound
_DEPENDENT = 1e-9  # sine of the angle to the active rows below which a row is one of their combinations


class ActiveSetSolver:
    """The method as a QP solver; see `QPSolver`."""

    def __init__(self, *, max_iterations: int = 2000):
        """max_iterations: rows added or dropped, at most."""
        self._max_iterations = max_iterations

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the active set of the guess (x, y, z)."""
        (P, C), (_, lower, upper) = qp.arrays, qp.stacked
        size = qp.m + qp.n
        nothing = QPSolution(
            x=np.zeros(qp.n), y=np.zeros(qp.m), z=np.zeros(qp.n), status=QPStatus.FAILED, iterations=0
        )
        try:
            method = _DualActiveSet(P, qp.q, C, lower, upper)
        except la.LinAlgError:  # P is not positive definite
            return nothing
        guess = np.zeros(size) if start is None else np.concatenate(start[1:])
        deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
        status = method.run(guess, self._max_iterations, deadline)
        x, unit = method.x(), method.multipliers()
        if status is QPStatus.SOLVED:
            # The factors carry the condition of P; the KKT system, solved afresh, does not.
            held = method.rows
            target = np.where(method.signs > 0, upper[held], lower[held])
            sharp = solve_equality_qp(P, qp.q, C[held], target)
            if sharp is not None:
                sharp_unit = np.zeros(size)
                sharp_unit[held] = sharp[1]
                better = _error(qp, sharp[0], sharp_unit) < _error(qp, x, unit)
                x, unit = (sharp[0], sharp_unit) if better else (x, unit)
        y = unit * qp.row_scale
        return QPSolution(x=x, y=y[: qp.m], z=y[qp.m :], status=status, iterations=method.iterations)


def _error(qp: QuadraticProgram, x: Vector, unit: Vector) -> float:
    y = unit * qp.row_scale
    return qp.error(x, y[: qp.m], y[qp.m :])


class _DualActiveSet:
    """Minimize 1/2 |w|^2 subject to l <= M w <= u: the QP in w = L'x + L^-1 q, P = LL', M = C L^-T.

    The iterate is optimal for the rows in the active set, with multipliers of the right sign; what it
    violates is brought in, one row at a time, and rows whose multiplier reaches zero on the way leave.

    Attributes
    ----------
    rows, signs : the active set: row numbers, +1 where the upper bound holds and -1 where the lower one does.
    iterations : rows added or dropped.
    """

    def __init__(self, P: np.ndarray, q: Vector, C: np.ndarray, lower: Vector, upper: Vector):
        self._L = la.cholesky(P, lower=True, check_finite=False)
        self._w0 = -la.solve_triangular(self._L, q, lower=True, check_finite=False)
        self._M = la.solve_triangular(self._L, C.T, lower=True, check_finite=False).T
        offset = self._M @ self._w0
        self._lower, self._upper = lower - offset, upper - offset
        self._equal = lower == upper
        self._slack = _FEASIBLE * (1.0 + np.minimum(np.abs(lower), np.abs(upper)))
        self._norms = np.linalg.norm(self._M, axis=1)
        n = q.size
        self._w = np.zeros(n)
        self.rows, self.signs = np.zeros(0, dtype=int), np.zeros(0)
        self._y = np.zeros(0)  # multipliers of signs * M[rows], >= 0 but for equalities
        self._Q, self._R = np.eye(n), np.zeros((n, 0))  # of (signs * M[rows])'
        self.iterations = 0

    def run(self, guess: Vector, max_iterations: int, deadline: float) -> QPStatus:
        """Run from the active set that the multipliers in `guess` tell, to the solution."""
        self._warm_start(guess)
        while self.iterations < max_iterations and time.perf_counter() < deadline:
            v = self._M @ self._w
            excess = np.maximum(self._lower - v, v - self._upper) - self._slack
            excess[self.rows] = -np.inf
            j = int(np.argmax(np.where(excess > 0, excess / np.maximum(self._norms, 1e-12), -np.inf)))
            if excess[j] <= 0:
                return QPStatus.SOLVED
            if not self._bring_in(j, 1.0 if v[j] > self._upper[j] else -1.0):
                return QPStatus.INFEASIBLE
        return QPStatus.FAILED

    def x(self) -> Vector:
        """The iterate in the QP's variables."""
        return np.asarray(
            la.solve_triangular(self._L, self._w + self._w0, lower=True, trans=1, check_finite=False)
        )

    def multipliers(self) -> Vector:
        """Multipliers of all rows, positive where the upper bound holds."""
        y = np.zeros(self._norms.size)
        y[self.rows] = self._y * self.signs
        return y

    def _warm_start(self, guess: Vector) -> None:
        wanted = np.flatnonzero((self._equal | (np.abs(guess) > 0)) & (self._norms > 0))
        signs = np.where((guess[wanted] > 0) | self._equal[wanted], 1.0, -1.0)
        bounded = np.isfinite(np.where(signs > 0, self._upper[wanted], self._lower[wanted]))
        wanted, signs = wanted[bounded], signs[bounded]
        # All at once: pivoting puts the rows that depend on others last.
        lengths = signs * self._norms[wanted]
        self._Q, R, order = la.qr(self._M[wanted].T / lengths, pivoting=True, check_finite=False)
        rank = int((np.abs(np.diagonal(R)) > _DEPENDENT).sum())
        kept = order[:rank]
        self._R = R[:, :rank] * np.abs(lengths[kept])
        self.rows, self.signs, self._y = wanted[kept], signs[kept], np.zeros(rank)
        self._solve()
        while (negative := (self._y < 0) & ~self._equal[self.rows]).any():
            self._drop(int(np.argmin(np.where(negative, self._y, 0.0))))
            self._solve()

    def _bring_in(self, j: int, sign: float) -> bool:
        """Steps 2 and 3 of the paper for the violated row j; False if the rows contradict each other."""
        a = sign * self._M[j]
        bound = sign * (self._upper[j] if sign > 0 else self._lower[j])
        y_j = 0.0
        while True:
            self.iterations += 1
            k = self.rows.size
            c = self._Q.T @ a
            z = self._Q[:, k:] @ c[k:]  # direction of the iterate
            r = _triangular(self._R[:k], c[:k])  # direction of the multipliers
            free = (r > 1e-14) & ~self._equal[self.rows]
            ratios = np.where(free, self._y / np.where(free, r, 1.0), np.inf)
            partial = max(float(ratios.min(initial=np.inf)), 0.0)
            curvature = float(z @ a)
            dependent = curvature <= (_DEPENDENT * self._norms[j]) ** 2
            full = np.inf if dependent else (float(a @ self._w) - bound) / curvature
            t = min(partial, full)
            if not np.isfinite(t):
                return False
            self._y, y_j = self._y - t * r, y_j + t
            if not dependent:
                self._w = self._w - t * z
            if full <= partial:
                self._insert(j, sign)
                self._solve()
                return True
            self._drop(int(np.argmin(ratios)))

    def _insert(self, j: int, sign: float) -> None:
        """Add a row to the active set, unless it depends on those in there."""
        a = sign * self._M[j]
        k = self.rows.size
        if np.linalg.norm(self._Q[:, k:].T @ a) <= _DEPENDENT * self._norms[j] or self._norms[j] == 0.0:
            return
        self._Q, self._R = la.qr_insert(self._Q, self._R, a, k, which="col", check_finite=False)
        self.rows, self.signs = np.append(self.rows, j), np.append(self.signs, sign)
        self._y = np.append(self._y, 0.0)

    def _drop(self, position: int) -> None:
        self._Q, self._R = la.qr_delete(self._Q, self._R, position, which="col", check_finite=False)
        self.rows, self.signs = np.delete(self.rows, position), np.delete(self.signs, position)
        self._y = np.delete(self._y, position)

    def _solve(self) -> None:
        """The minimum on the active set, and its multipliers, from the factors: no drift."""
        k = self.rows.size
        bounds = self.signs * np.where(self.signs > 0, self._upper[self.rows], self._lower[self.rows])
        s = _triangular(self._R[:k], bounds, transposed=True)
        self._w = self._Q[:, :k] @ s
        self._y = -_triangular(self._R[:k], s)


def _triangular(R: np.ndarray, b: Vector, *, transposed: bool = False) -> Vector:
    """R^-1 b or R^-T b, without SciPy's checks, which cost more than the solve."""
    return b if b.size == 0 else np.asarray(la.lapack.dtrtrs(R, b, trans=int(transposed))[0])
