"""The Newton system of one interior-point iteration, condensed and factored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impactopt.program import Matrix, Vector
from impactopt.sqp.condense import Condensed
from impactopt.sqp.normal import Index, NormalMatrix

_PENALTY = 1e9  # weight of the equalities that are left, in the matrix: it changes no step
_REFINEMENTS = 1  # weights of ten decades cost digits
_FIRST, _LEAST, _MOST = 1e-4, 1e-20, 1e20  # shifts of the diagonal (Waechter and Biegler 2006, section 3.1)
_GROW, _GROW_FIRST, _SHRINK = 8.0, 100.0, 3.0


class NewtonSystem:
    """Minimize q.d + 1/2 d'(P + diag) d with rows y = w (A d + r + h), and A_e d + r_e = 0 for equalities.

    Solved with K = P + diag + A' diag(w) A + shift M, banded Cholesky; the equalities that are left, by their
    Schur complement. M is the identity of all variables, condensed as the Hessian is; the shift makes K
    positive definite, and with it the whole system's inertia right.

    Attributes
    ----------
    shift : the last.
    """

    def __init__(self, matrix: NormalMatrix, held: Index):
        """held: numbers of the free variables that do not move."""
        self._matrix, self._held = matrix, held
        self._last = 0.0
        self.shift = 0.0

    def factor(
        self,
        system: Condensed,
        weights: Callable[[float], Vector],
        diagonal: Vector,
        equal: Index,
        identity: Callable[[], Matrix],
    ) -> bool:
        """Factor K, shifted as far as it takes.

        weights : gives those of the rows (k,) for a shift; diagonal (f,); numbers of the equalities.

        False: nothing helps.
        """
        self._system, self._equal, self._diagonal = system, equal, diagonal
        self._transposed = system.A.T.tocsr()
        matrix = self._matrix
        matrix.load(system.P, system.A)
        self.shift, entries = 0.0, np.zeros(0)
        while True:
            self._weights = weights(self.shift)
            self._weights[equal] = _PENALTY
            K = matrix.weighed(self._weights)
            if matrix.factor(K + self.shift * entries if self.shift else K, diagonal, self._held):
                break
            if not self.shift:
                self._M = identity()
                entries = matrix.entries(self._M)
                self.shift = max(_LEAST, self._last / _SHRINK) if self._last else _FIRST
            else:
                self.shift *= _GROW if self._last else _GROW_FIRST
            if self.shift > _MOST:
                return False
        self._last = self.shift or self._last
        if self._equal.size:
            self._rows = system.A[self._equal]
            self._spread = self._matrix.solve(np.asfortranarray(self._rows.toarray().T))
            self._schur = self._rows @ self._spread
        return True

    def solve(self, q: Vector, r: Vector, h: Vector) -> tuple[Vector, Vector]:
        """The step (f,) and the rows' new multipliers (k,), for gradient q, residual r and offsets h of the
        rows."""
        target = r + h
        target[self._equal] = r[self._equal]
        A, weights = self._system.A, self._weights
        d, y = self._respond(-(q + self._transposed @ (weights * target)), r[self._equal])
        y += weights * target
        for _ in range(_REFINEMENTS):
            # y is a large weight times a small difference: what that costs shows in the stationarity
            left = q + self._system.P @ d + self._diagonal * d + self._transposed @ y
            if self.shift:
                left += self.shift * (self._M @ d)
            dd, dy = self._respond(-left, A[self._equal] @ d + r[self._equal])
            d, y = d + dd, y + dy
        return d, y

    def _respond(self, right: Vector, off: Vector) -> tuple[Vector, Vector]:
        """K^-1 right with the equalities' rows A_e d = -off, and what it adds to the multipliers."""
        right[self._held] = 0.0
        d = self._matrix.solve(right)
        extra = np.zeros(0)
        if self._equal.size:
            extra = np.linalg.lstsq(self._schur, self._rows @ d + off, rcond=None)[0]
            d = d - self._spread @ extra
        d[self._held] = 0.0
        y = self._weights * (self._system.A @ d)
        y[self._equal] += extra
        return d, y
