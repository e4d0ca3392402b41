"""A program's linearization in few variables: what rows determine is eliminated, and equalities left.

Rows that determine variables of their own (`Determined`) give x_D = x_D(x_F) to first order, as a shooting
method has by integration; of the free variables x_F only those directions are left that keep the other
equalities. A QP of thousands of variables becomes one of some dozens, dense, with the same solution.
Nocedal and Wright 2006, section 15.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from impactopt.solvers.program import Determined, Matrix, Vector
from impactopt.solvers.sqp.condense import find_eliminations
from impactopt.solvers.sqp.point import Point, TimedProgram

Index = npt.NDArray[np.intp]
_LARGE = 300  # free variables: beyond, QPs stay sparse, with the equalities that are left as rows
_NOTHING = 1e-13  # what rounding leaves of a zero
_RANK = 1e-9  # of the equalities left: what is this much smaller than the largest depends on the others


class Reduction:
    """Eliminates, for Jacobians whose pattern does not change.

    Attributes
    ----------
    gone, variables : rows that are eliminated, and the variables that they determine.
    free : the other variables.  sparse : whether they are many.
    left : equalities that are left, none where it is sparse.  rows : all others that are not gone.
    bounded : variables with a bound, whichever they are.
    T : (n, r) steps of all variables, one a column, that keep the equalities but those in `rows`; r is the
        size of the QPs; sparse or dense.
    """

    def __init__(
        self,
        program: TimedProgram,
        jacobian: Matrix,
        determined: Sequence[Determined],
        *,
        dense: bool = False,
    ):
        """jacobian : (m, n) csc, at any point.  dense : never sparse, however many variables are free."""
        equal = program.g_lower == program.g_upper
        found = find_eliminations(jacobian, equal, determined)
        none = np.zeros(0, dtype=np.intp)
        self.gone: Index = np.concatenate([none, *[e.rows.ravel() for e in found]])
        self.variables: Index = np.concatenate([none, *[e.variables.ravel() for e in found]])
        self._level = program.g_lower
        self.free = np.setdiff1d(np.arange(program.n), self.variables)
        here = np.ones(program.m, dtype=bool)
        here[self.gone] = False
        self.sparse = not dense and self.free.size > _LARGE
        apart = here & equal & (not self.sparse)
        self.left, self.rows = np.flatnonzero(apart), np.flatnonzero(here & ~apart)
        self.bounded = np.flatnonzero(np.isfinite(program.x_lower) | np.isfinite(program.x_upper))
        self._n = program.n

    def load(self, point: Point) -> None:
        """Take the Jacobian at a point.

        Raises
        ------
        LinAlgError : rows do not determine their variables there.
        """
        rows = point.jacobian.tocsr()
        of_gone, self._of_left = rows[self.gone].tocsc(), rows[self.left]
        self._factors: Any = None
        determined = np.zeros((0, self.free.size))
        if self.gone.size:
            try:
                self._factors = spla.splu(sp.csc_matrix(of_gone[:, self.variables]))
            except RuntimeError as error:
                raise np.linalg.LinAlgError(str(error)) from None
            determined = -self._factors.solve(of_gone[:, self.free].toarray())
        Z = self._placed(determined)
        self._Z = Z
        A = self._of_left @ Z
        if not self.left.size:
            self._Y, self._R, self._order = np.zeros((self.free.size, 0)), np.zeros((0, 0)), self.left
            self.T = Z
            return
        Q, R, self._order = la.qr(A.T, pivoting=True, check_finite=False)
        sizes = np.abs(np.diagonal(R))
        rank = int((sizes > _RANK * max(float(sizes.max(initial=0.0)), 1e-300)).sum())
        self._Y, self._R = Q[:, :rank], R[:rank]
        self.T = Z @ Q[:, rank:]

    def _placed(self, determined: np.ndarray) -> Any:
        """(n, f) from what the variables that are determined do with each of the free ones."""
        every = np.arange(self.free.size)
        if not self.sparse:
            Z = np.zeros((self._n, self.free.size))
            Z[self.free, every], Z[self.variables] = 1.0, determined
            return Z
        i, j = np.nonzero(np.abs(determined) > _NOTHING)
        rows, columns = np.concatenate([self.free, self.variables[i]]), np.concatenate([every, j])
        values = np.concatenate([np.ones(every.size), determined[i, j]])
        return sp.csr_array((values, (rows, columns)), shape=(self._n, self.free.size))

    def normal(self, g: Vector) -> Vector:
        """The step (n,) that meets the linearized equalities, as well as they can be, whose values are g
        (m,); the shortest of the free variables."""
        d = np.zeros(self._n)
        if self.gone.size:
            d[self.variables] = -self._factors.solve(g[self.gone] - self._level[self.gone])
        if self.left.size:
            off = -(g[self.left] - self._level[self.left] + self._of_left @ d)
            along = np.linalg.lstsq(self._R.T, off[self._order], rcond=None)[0]
            d = d + self._Z @ (self._Y @ along)
        return d

    def add_multipliers(self, y: Vector, dual: Vector) -> Vector:
        """y (m,) with those of the equalities that make grad f + J'y + z zero where equalities can.

        y : of the other rows.  dual (n,) : grad f + J'y + z of these.
        """
        y = y.copy()
        if self.left.size:
            of_left = np.zeros(self.left.size)
            target = -(self._Y.T @ (self._Z.T @ dual))
            of_left[self._order] = np.linalg.lstsq(self._R, target, rcond=None)[0]
            y[self.left] = of_left
            dual = dual + self._of_left.T @ of_left
        if self.gone.size:
            y[self.gone] = -self._factors.solve(dual[self.variables], trans="T")
        return y

    @property
    def basis(self) -> Any:
        """(n, f) what all variables do with each of the free ones."""
        return self._Z

    def gradient(self, dual: Vector) -> Vector:
        """(f,) of what the free variables change, those that they determine with them; dual (n,)."""
        return np.asarray(self._Z.T @ dual)
