"""Goldfarb and Idnani's dual active-set method (Mathematical Programming 27, 1983) for small dense QPs.

The QPs have to be strictly convex. The method is exact and finite, and quick from a good guess of the active
set, which an SQP has near its end.
"""

from __future__ import annotations

import time

import numpy as np
import scipy.linalg as la

from impactopt.solvers.program import Vector
from impactopt.solvers.qp.quadratic_program import QPSolution, QPStatus, QuadraticProgram, solve_equality_qp

_MAX_VIOLATION = 1e-10  # of a normalized constraint at the solution, relative to its bound
# Sine of the angle between a constraint's gradient and the span of the active ones, below which it is
# dependent.
_DEPENDENT = 1e-9


class ActiveSetSolver:
    """Dual active-set method as a `QPSolver`."""

    def __init__(self, *, max_iterations: int = 2000):
        """max_iterations : constraints added to or dropped from the active set, at most."""
        self._max_iterations = max_iterations

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the active set of the initial guess (x, y, z)."""
        P, (C, lower, upper) = qp.P, qp.stacked
        size = qp.m + qp.n
        failure = QPSolution(
            x=np.zeros(qp.n), y=np.zeros(qp.m), z=np.zeros(qp.n), status=QPStatus.FAILED, iterations=0
        )
        try:
            method = _DualActiveSet(P, qp.q, C, lower, upper)
        except la.LinAlgError:  # P is not positive definite
            return failure
        # Only which multipliers are nonzero matters, and their signs.
        guess = np.zeros(size) if start is None else np.concatenate(start[1:])
        deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
        status = method.run(guess, self._max_iterations, deadline)
        x, unit = method.x(), method.multipliers()
        if status is QPStatus.SOLVED:
            # the factors lose digits with the condition of P, the KKT system of the active set does not
            active = method.active
            target = np.where(method.signs > 0, upper[active], lower[active])
            refined = solve_equality_qp(P, qp.q, C[active], target)
            if refined is not None:
                refined_unit = np.zeros(size)
                refined_unit[active] = refined[1]
                better = _error(qp, refined[0], refined_unit) < _error(qp, x, unit)
                x, unit = (refined[0], refined_unit) if better else (x, unit)
        y = unit * qp.row_scale
        return QPSolution(x=x, y=y[: qp.m], z=y[qp.m :], status=status, iterations=method.iterations)


def _error(qp: QuadraticProgram, x: Vector, unit: Vector) -> float:
    y = unit * qp.row_scale
    return qp.error(x, y[: qp.m], y[qp.m :])


class _DualActiveSet:
    """Minimize 1/2 |w|^2 subject to l <= M w <= u: the QP in w = L'x + L^-1 q, P = LL', M = C L^-T.

    The iterate is optimal for the active constraints, with multipliers of the right sign. Violated
    constraints are added, one at a time; during that, active ones whose multiplier reaches zero are dropped.

    Attributes
    ----------
    active, signs : numbers of the active constraints; +1 at the upper bound, -1 at the lower one.
    iterations : constraints added or dropped.
    """

    def __init__(self, P: np.ndarray, q: Vector, C: np.ndarray, lower: Vector, upper: Vector):
        # In w the objective is |w|^2 / 2 about w = 0, the unconstrained minimum, so gradients are rows of M.
        self._L = la.cholesky(P, lower=True, check_finite=False)
        self._w0 = -la.solve_triangular(self._L, q, lower=True, check_finite=False)
        self._M = la.solve_triangular(self._L, C.T, lower=True, check_finite=False).T
        offset = self._M @ self._w0
        self._lower, self._upper = lower - offset, upper - offset
        self._equal = lower == upper
        # The nearer bound, as the other one may be infinite.
        self._slack = _MAX_VIOLATION * (1.0 + np.minimum(np.abs(lower), np.abs(upper)))
        self._norms = np.linalg.norm(self._M, axis=1)
        n = q.size
        self._w = np.zeros(n)
        self.active, self.signs = np.zeros(0, dtype=int), np.zeros(0)
        self._y = np.zeros(0)  # multipliers of signs * M[active], >= 0 but for equalities
        self._Q, self._R = np.eye(n), np.zeros((n, 0))  # factors of (signs * M[active])'
        self.iterations = 0

    def run(self, guess: Vector, max_iterations: int, deadline: float) -> QPStatus:
        """Iterate from the active set of the constraints whose multiplier in `guess` is not zero."""
        self._warm_start(guess)
        while self.iterations < max_iterations and time.perf_counter() < deadline:
            v = self._M @ self._w
            # Step 1 takes any violated constraint; ours is the one at the largest distance in w.
            excess = np.maximum(self._lower - v, v - self._upper) - self._slack
            # Met up to rounding by construction; a second time they would be dependent on themselves.
            excess[self.active] = -np.inf
            j = int(np.argmax(np.where(excess > 0, excess / np.maximum(self._norms, 1e-12), -np.inf)))
            if excess[j] <= 0:
                return QPStatus.SOLVED
            if not self._add(j, 1.0 if v[j] > self._upper[j] else -1.0):
                return QPStatus.INFEASIBLE
        return QPStatus.FAILED

    def x(self) -> Vector:
        """The iterate in the QP's variables."""
        return np.asarray(
            la.solve_triangular(self._L, self._w + self._w0, lower=True, trans=1, check_finite=False)
        )

    def multipliers(self) -> Vector:
        """Multipliers of all constraints, positive if the upper bound is active."""
        y = np.zeros(self._norms.size)
        y[self.active] = self._y * self.signs
        return y

    def _warm_start(self, guess: Vector) -> None:
        wanted = np.flatnonzero((self._equal | (np.abs(guess) > 0)) & (self._norms > 0))
        # Equalities belong to every active set; their sign is arbitrary, their multiplier's too.
        signs = np.where((guess[wanted] > 0) | self._equal[wanted], 1.0, -1.0)
        bounded = np.isfinite(np.where(signs > 0, self._upper[wanted], self._lower[wanted]))
        wanted, signs = wanted[bounded], signs[bounded]
        # One QR factorization for all: pivoting puts constraints that depend on others last.
        lengths = signs * self._norms[wanted]
        self._Q, R, order = la.qr(self._M[wanted].T / lengths, pivoting=True, check_finite=False)
        # Gradients have norm 1 here, so a diagonal entry is the sine of the angle
        # to the span of those before.
        rank = int((np.abs(np.diagonal(R)) > _DEPENDENT).sum())
        kept = order[:rank]
        self._R = R[:, :rank] * np.abs(lengths[kept])
        self.active, self.signs, self._y = wanted[kept], signs[kept], np.zeros(rank)
        self._solve()
        # The dual method needs a dual feasible start: wrong signs are dropped, the worst first.
        while (negative := (self._y < 0) & ~self._equal[self.active]).any():
            self._drop(int(np.argmin(np.where(negative, self._y, 0.0))))
            self._solve()

    def _add(self, j: int, sign: float) -> bool:
        """Steps 2 and 3 of the paper for the violated constraint j; False if the QP is infeasible."""
        a = sign * self._M[j]
        bound = sign * (self._upper[j] if sign > 0 else self._lower[j])
        y_j = 0.0
        while True:
            self.iterations += 1
            k = self.active.size
            c = self._Q.T @ a
            # a = Q c: the part of a outside the span of the active gradients, by the columns of Q beyond k.
            z = self._Q[:, k:] @ c[k:]  # direction of the iterate
            r = _triangular(self._R[:k], c[:k])  # direction of the multipliers
            # partial step: until a multiplier is zero; full step: until constraint j is met
            free = (r > 1e-14) & ~self._equal[self.active]
            ratios = np.where(free, self._y / np.where(free, r, 1.0), np.inf)
            partial = max(float(ratios.min(initial=np.inf)), 0.0)
            curvature = float(z @ a)
            dependent = curvature <= (_DEPENDENT * self._norms[j]) ** 2
            # (a w - b) / (a z): constraint j is met with equality. A dependent one cannot be met by moving;
            # only multipliers change, until one of them is zero.
            full = np.inf if dependent else (float(a @ self._w) - bound) / curvature
            t = min(partial, full)
            # No multiplier limits it and no step meets it: the dual is unbounded,
            # so the primal is infeasible.
            if not np.isfinite(t):
                return False
            self._y, y_j = self._y - t * r, y_j + t
            if not dependent:
                self._w = self._w - t * z
            # The violated constraint enters; else the active one whose multiplier became zero
            # leaves, and it is tried again.
            if full <= partial:
                self._insert(j, sign)
                self._solve()
                return True
            self._drop(int(np.argmin(ratios)))

    def _insert(self, j: int, sign: float) -> None:
        """Insert a constraint into the active set and the factors, unless it depends on those in there."""
        a = sign * self._M[j]
        k = self.active.size
        if np.linalg.norm(self._Q[:, k:].T @ a) <= _DEPENDENT * self._norms[j] or self._norms[j] == 0.0:
            return
        self._Q, self._R = la.qr_insert(self._Q, self._R, a, k, which="col", check_finite=False)
        self.active, self.signs = np.append(self.active, j), np.append(self.signs, sign)
        self._y = np.append(self._y, 0.0)

    def _drop(self, position: int) -> None:
        self._Q, self._R = la.qr_delete(self._Q, self._R, position, which="col", check_finite=False)
        self.active, self.signs = np.delete(self.active, position), np.delete(self.signs, position)
        self._y = np.delete(self._y, position)

    def _solve(self) -> None:
        """Minimum for the active set, and its multipliers; from the factors, so that errors do not add up."""
        k = self.active.size
        bounds = self.signs * np.where(self.signs > 0, self._upper[self.active], self._lower[self.active])
        s = _triangular(self._R[:k], bounds, transposed=True)
        self._w = self._Q[:, :k] @ s
        self._y = -_triangular(self._R[:k], s)


def _triangular(R: np.ndarray, b: Vector, *, transposed: bool = False) -> Vector:
    """R^-1 b or R^-T b, without SciPy's checks, which cost more than the solve."""
    return b if b.size == 0 else np.asarray(la.lapack.dtrtrs(R, b, trans=int(transposed))[0])
