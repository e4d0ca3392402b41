"""The Newton system of one interior-point iteration, condensed and factored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from impactopt.program import Matrix, Vector
from impactopt.sqp.cholesky import BlockCholesky
from impactopt.sqp.condense import Condenser
from impactopt.sqp.kernels import Index, Kernels

_PENALTY = 1e9  # times the curvature along it: weight of an equality that is left; it changes no step
_HELD = 1e15  # on the diagonal of variables that must not move
_REFINEMENTS = 1  # weights of ten decades cost digits
_FIRST, _LEAST, _MOST = 1e-4, 1e-20, 1e20  # shifts of the diagonal (Waechter and Biegler 2006, section 3.1)
_RELATIVE = 0.1  # the first shift is at most this part of the Hessian's largest entry
_GROW, _GROW_FIRST, _SHRINK = 8.0, 100.0, 3.0


class NewtonSystem:
    """Minimize q.d + 1/2 d'(H + diag) d with rows y = w (J d + r), and J d + r = 0 for hard equalities.

    The rows with weights enter the Hessian, W = H + diag + J' diag(w) J + shift I; then the eliminated
    equalities are solved for their variables (`Condenser`), and the matrix left gets a Cholesky factor; hard
    equalities that are left, by their Schur complement. The shift makes that matrix positive definite, and
    with it the whole system's inertia right. What rounding leaves, all of the system's own equations tell.

    Attributes
    ----------
    shift : the last.
    """

    def __init__(self, condenser: Condenser, held: Index, sequence: Vector | None, kernels: Kernels):
        """held: numbers of the free variables that do not move; sequence (n,): variables near each other in
        it touch each other, None: to be found.
        """
        self._condenser, self._held = condenser, held
        order = None if sequence is None else sequence[condenser.free]
        self._matrix = BlockCholesky(condenser.pattern, order, kernels)
        _, i, j = condenser.at_free
        self._to = self._matrix.places(i, j)
        self._diagonal_to = self._matrix.places(
            np.arange(condenser.free.size), np.arange(condenser.free.size)
        )
        self._last = 0.0
        self.shift = 0.0

    def factor(
        self,
        jacobian: Matrix,
        hessian: Matrix,
        diagonal: Vector,
        weights: Callable[[float], Vector],
        *,
        hard: bool,
    ) -> bool:
        """Factor, shifted as far as it takes.

        diagonal : (f,) of the free variables; weights : gives those of the rows left (k,) for a shift; hard :
        equalities among them have none.

        False: nothing helps.
        """
        c = self._condenser
        try:
            c.load(jacobian, hessian)
        except np.linalg.LinAlgError:
            return False
        self._jacobian, self._hessian, self._hard = jacobian, hessian, hard
        self._transposed = jacobian.T
        self._A = c.A
        penalty = self._penalty()
        everywhere = np.zeros(c.n)
        everywhere[c.free] = diagonal
        self.shift = 0.0
        while True:
            self._diagonal = everywhere + self.shift
            self._weights = np.zeros(c.m)
            self._weights[c.rows] = weights(self.shift)
            if hard:
                self._weights[c.rows[c.equal]] = penalty
            if self._matrix.factor(self._values()):
                break
            self.shift = self._next()
            if self.shift > _MOST:
                return False
        self._last = self.shift or self._last
        if hard and c.equal.size:
            self._spread = self._matrix.solve(np.asfortranarray(self._A.toarray().T))
            self._schur = self._A @ self._spread
        return True

    def _penalty(self) -> Vector:
        """Weights of the equalities left: far above the curvature along them, and no farther."""
        squares = self._A.multiply(self._A)
        length = np.maximum(1e-30, squares.sum(axis=1))
        curvature = squares @ np.abs(self._hessian.diagonal()[self._condenser.free]) / length
        out: Vector = _PENALTY * np.maximum(1.0, curvature) / np.maximum(1.0, length)
        return out

    def _next(self) -> float:
        """The shift to try where this one was not enough."""
        if not self.shift:
            # what a far more curved Hessian needed is no guide here
            most = _RELATIVE * float(np.abs(self._hessian.data).max(initial=1.0))
            return min(most, max(_LEAST, self._last / _SHRINK)) if self._last else _FIRST
        return self.shift * (_GROW if self._last else _GROW_FIRST)

    def _values(self) -> Vector:
        """The matrix as `BlockCholesky` takes it."""
        c, matrix = self._condenser, self._matrix
        values = np.zeros(matrix.size)
        values[self._to] = c.reduce(self._weights, self._diagonal)
        values[self._diagonal_to[self._held]] += _HELD
        A = self._A
        for w, a, b in zip(self._weights[c.rows[c.equal]], A.indptr[:-1], A.indptr[1:], strict=True):
            columns, row = A.indices[a:b], A.data[a:b]
            i, j = np.tril_indices(columns.size)
            values[matrix.places(columns[i], columns[j])] += w * row[i] * row[j]
        return values

    def solve(self, q: Vector, r: Vector) -> tuple[Vector, Vector]:
        """The step (n,) and the new multipliers (m,) of all rows, for a gradient (n,) and the rows' residuals
        (m,): what they are off by, with weights.
        """
        c = self._condenser
        d, y = self._respond(q, r)
        gone_or_hard = np.concatenate([c.eliminated, c.rows[c.equal]]) if self._hard else c.eliminated
        for _ in range(_REFINEMENTS):
            left = q + self._times(d) + self._pulled(y)
            left[c.free[self._held]] = 0.0
            off = np.zeros(c.m)
            off[gone_or_hard] = (self._rows(d) + r)[gone_or_hard]
            more_d, more_y = self._respond(left, off)
            d, y = d + more_d, y + more_y
        return d, y

    def _respond(self, q: Vector, r: Vector) -> tuple[Vector, Vector]:
        c, w = self._condenser, self._weights.copy()
        equal = c.rows[c.equal]
        own, w[equal] = w[equal], 0.0
        g, off = c.forward(q + self._pulled(w * r), r)
        g += self._A.T @ (own * off)
        g[self._held] = 0.0
        free = -self._matrix.solve(g)
        extra = np.zeros(equal.size)
        if self._hard and equal.size:
            extra = np.linalg.lstsq(self._schur, self._A @ free + off, rcond=None)[0]
            free -= self._spread @ extra
        free[self._held] = 0.0
        d = c.expand(free)
        y = w * (self._rows(d) + r)
        y_left = own * (self._A @ free + off) + extra
        y[c.eliminated] = c.multipliers(q + self._times(d) + self._pulled(y), y_left)
        y[equal] = y_left
        return d, y

    def _times(self, d: Vector) -> Vector:
        out: Vector = self._hessian @ d + self._diagonal * d
        return out

    def _rows(self, d: Vector) -> Vector:
        """All rows' change with a step."""
        return np.concatenate([self._jacobian @ d, d[self._condenser.bounded]])

    def _pulled(self, y: Vector) -> Vector:
        """Gradient of all rows with multipliers (m,)."""
        m = self._jacobian.shape[0]
        out: Vector = self._transposed @ y[:m]
        out[self._condenser.bounded] += y[m:]
        return out
