"""A program's linearization in few variables: what rows determine is eliminated, and equalities left.

Rows that determine variables of their own (`Determined`) give x_D = x_D(x_F) to first order, as a shooting
method has by integration; of the free variables x_F only those directions are left that keep the other
equalities. A QP of thousands of variables becomes one of some dozens, dense, with the same solution.
Nocedal and Wright 2006, section 15.3.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from impactopt.solvers.elimination.compiled import kernels
from impactopt.solvers.elimination.condense import Condenser, find_eliminations
from impactopt.solvers.elimination.patterns import Elimination
from impactopt.solvers.point import Point, TimedProgram
from impactopt.solvers.program import Determined, Matrix, Vector

Index = npt.NDArray[np.intp]
_KEPT = 4  # structures
_LARGE = 300  # free variables: beyond, QPs stay sparse, with the equalities that are left as rows
_NOTHING = 1e-13  # what rounding leaves of a zero
_SHORT = 1e-6  # of a row's length: what rounding may leave of it by the free variables
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
        self._equations, every = np.flatnonzero(equal), np.ones(int(equal.sum()), dtype=bool)
        equations = self._of_equations(jacobian.tocsr())
        self._empty = sp.csc_array((program.n, program.n))
        self._key = _key(equations, determined)
        if self._key not in _structures:
            _structures[self._key] = _structure(equations, self._empty, every, determined)
        self._found, self._condenser = _structures.pop(self._key)
        found = self._found
        none = np.zeros(0, dtype=np.intp)
        self.gone: Index = self._equations[np.concatenate([none, *[e.rows.ravel() for e in found]])]
        self.variables: Index = np.concatenate([none, *[e.variables.ravel() for e in found]])
        self._place = np.argsort(np.argsort(self.gone))
        self._level = program.g_lower
        self.free = np.setdiff1d(np.arange(program.n), self.variables)
        here = np.ones(program.m, dtype=bool)
        here[self.gone] = False
        self.sparse = not dense and self.free.size > _LARGE
        apart = here & equal & (not self.sparse)
        self.left, self.rows = np.flatnonzero(apart), np.flatnonzero(here & ~apart)
        self.bounded = np.flatnonzero(np.isfinite(program.x_lower) | np.isfinite(program.x_upper))
        self._n = program.n

    def release(self) -> None:
        """Keep the structure for the next program that has it."""
        _structures[self._key] = self._found, self._condenser
        while len(_structures) > _KEPT:
            _structures.popitem(last=False)

    def load(self, point: Point) -> None:
        """Take the Jacobian at a point, by the interior-point method's elimination.

        Raises
        ------
        LinAlgError : rows do not determine their variables there.
        """
        equations = self._of_equations(point.rows)
        self._of_left = point.rows[self.left]
        self._condenser.load(equations, self._empty)
        Z = np.zeros((self._n, self.free.size))
        Z[self.free, np.arange(self.free.size)] = 1.0
        self._condenser.expand_basis(Z)
        Z = self._Z = _without_zeros(Z) if self.sparse else Z
        A = self._of_left @ Z
        if not self.left.size:
            self._Y, self._R, self._order = np.zeros((self.free.size, 0)), np.zeros((0, 0)), self.left
            self.T, self._within = Z, None
            return
        Q, R, self._order = la.qr(A.T, pivoting=True, check_finite=False)
        sizes = np.abs(np.diagonal(R))
        rank = int((sizes > _RANK * max(float(sizes.max(initial=0.0)), 1e-300)).sum())
        self._Y, self._R = Q[:, :rank], R[:rank]
        self._within = Q[:, rank:]
        self.T = Z @ self._within

    def _of_equations(self, rows: Matrix) -> Matrix:
        return rows[self._equations].tocsc()

    def normal(self, g: Vector) -> Vector:
        """The step (n,) that meets the linearized equalities, as well as they can be, whose values are g
        (m,); the shortest of the free variables."""
        d = self._condenser.particular((g - self._level)[self._equations])
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
        of_gone = self._condenser.multipliers(dual, np.zeros(len(self._condenser.left)))
        y[self.gone] = of_gone[self._place]
        return y

    @property
    def basis(self) -> Any:
        """(n, f) what all variables do with each of the free ones."""
        return self._Z

    def rows_by_free(self, point: Point) -> tuple[Any, Vector]:
        """`rows` along the columns of `T` (k, r), and their norms (k,) by the free variables: what a row
        changes with these, those that they determine with them. Its gradient by all variables may be
        thousands of times as long. 1 for rows that nothing changes.
        """
        own = point.rows[self.rows]
        by_free = own @ self._Z
        norms, whole = _norms(by_free), _norms(own)
        norms = np.maximum(norms, _SHORT * whole)
        along = by_free if self._within is None else by_free @ self._within
        return along, np.where(norms > 1e-12, norms, 1.0)

    def gradient(self, dual: Vector) -> Vector:
        """(f,) of what the free variables change, those that they determine with them; dual (n,)."""
        return np.asarray(self._Z.T @ dual)


_structures: OrderedDict[bytes, tuple[list[Elimination], Condenser]] = OrderedDict()


def _structure(
    equations: Matrix, empty: Matrix, every: npt.NDArray[np.bool_], determined: Sequence[Determined]
) -> tuple[list[Elimination], Condenser]:
    found = find_eliminations(equations, every, determined)
    nowhere = np.zeros(equations.shape[1], dtype=bool)
    return found, Condenser(equations, empty, found, every, nowhere, kernels())


def _key(equations: Matrix, determined: Sequence[Determined]) -> bytes:
    digest = hashlib.sha256(repr([(rank, v.size) for rank, v in determined]).encode())
    for array in (equations.indptr, equations.indices, *[variables for _, variables in determined]):
        digest.update(np.ascontiguousarray(array, dtype=np.int64).tobytes())
    return digest.digest()


def _norms(rows: Any) -> Vector:
    squares = rows.multiply(rows) if sp.issparse(rows) else rows**2
    return np.sqrt(np.asarray(squares.sum(axis=1)).ravel())


def _without_zeros(Z: np.ndarray) -> Matrix:
    i, j = np.nonzero(np.abs(Z) > _NOTHING)
    return sp.csr_array((Z[i, j], (i, j)), shape=Z.shape)
