"""Quadratic programs: the problem, its solution, the rows' common form, and the table of solvers."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from impactopt.solvers.program import Matrix, Vector


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram:
    """Minimize 1/2 x'Px + q'x subject to lower <= A x <= upper and x_lower <= x <= x_upper.

    Attributes
    ----------
    P : full symmetric, positive semidefinite (n, n): csc_array, or, as A, an array where the QP is small.
    q : (n,).
    A : (m, n), as P.
    lower, upper : (m,), equal for equalities, +-inf for none.
    x_lower, x_upper : (n,), likewise.
    """

    P: Matrix
    q: Vector
    A: Matrix
    lower: Vector
    upper: Vector
    x_lower: Vector
    x_upper: Vector

    @property
    def n(self) -> int:
        """Number of variables."""
        return int(self.q.size)

    @property
    def m(self) -> int:
        """Number of rows of A; the variables' bounds are not counted."""
        return int(self.lower.size)

    @property
    def dense(self) -> bool:
        """True if its matrices are arrays."""
        return isinstance(self.A, np.ndarray)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """P, and C of `stacked`, as arrays."""
        C = self.stacked[0]
        return (self.P, C) if self.dense else (self.P.toarray(), C.toarray())

    @cached_property
    def stacked(self) -> tuple[Any, Vector, Vector]:
        """(C, l, u) with bounds as rows, l <= C x <= u, C = [A; I], rows of norm 1 (zero rows stay zero).

        First-order solvers live by the norms of the rows; `row_scale` brings their multipliers back.
        """
        if self.dense:
            C: Any = np.vstack([self.row_scale[: self.m, None] * self.A, np.eye(self.n)])
        else:
            C = sp.csc_array(
                sp.diags_array(self.row_scale)
                @ sp.vstack([self.A, sp.diags_array(np.ones(self.n))], format="csc")
            )
            C.sort_indices()
        lower = np.concatenate([self.lower, self.x_lower]) * self.row_scale
        upper = np.concatenate([self.upper, self.x_upper]) * self.row_scale
        return C, lower, upper

    @cached_property
    def row_scale(self) -> Vector:
        """Factors of the rows of [A; I] in `stacked`, (m + n,)."""
        squares = self.A**2 if self.dense else self.A.multiply(self.A)
        norms = np.sqrt(np.asarray(squares.sum(axis=1)).ravel())
        return np.concatenate([1.0 / np.where(norms > 1e-12, norms, 1.0), np.ones(self.n)])

    def residuals(self, x: Vector, y: Vector, z: Vector) -> tuple[float, float, float]:
        """Residuals of the optimality (KKT) conditions at x, with multipliers y of the rows, z of the bounds.

        Returns the largest violation of a unit row, the largest entry of P x + q + A'y + z, and the largest
        product of a multiplier (in units of the unit row) and the distance to the bound it belongs to.
        """
        C, lower, upper = self.stacked
        v = C @ x
        multipliers = np.concatenate([y, z]) / self.row_scale
        primal = np.max(np.maximum(np.maximum(lower - v, v - upper), 0.0), initial=0.0)
        dual = np.max(np.abs(self.P @ x + self.q + C.T @ multipliers), initial=0.0)
        held = multipliers != 0.0
        gap = np.where(multipliers > 0, np.abs(upper - v), np.abs(v - lower))[held]
        return float(primal), float(dual), float(np.max(np.abs(multipliers[held]) * gap, initial=0.0))

    def error(self, x: Vector, y: Vector, z: Vector) -> float:
        """The largest of the residuals; those in units of the objective relative to 1 + |q|."""
        primal, dual, gap = self.residuals(x, y, z)
        return max(primal, max(dual, gap) / (1.0 + float(np.max(np.abs(self.q), initial=0.0))))


class QPStatus(enum.Enum):
    """End of a QP solver. INACCURATE: usable, outside the tolerances."""

    SOLVED = "solved"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class QPSolution:
    """Answer of a QP solver; x, y, z are meaningless unless `usable`.

    Attributes
    ----------
    x : variables (n,); y: multipliers of the rows (m,); z: of the bounds (n,), positive where the upper bound
        holds.
    status : how the solver ended.
    iterations : of the solver.
    """

    x: Vector
    y: Vector
    z: Vector
    status: QPStatus
    iterations: int

    @property
    def usable(self) -> bool:
        """True if x, y, z can be used as an (approximate) solution."""
        return self.status in (QPStatus.SOLVED, QPStatus.INACCURATE)


class QPSolver(Protocol):
    """Solves one QP after the other; may keep factors and settings between them."""

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the guess (x, y, z). A hard or infeasible QP is a status, no exception."""
        ...
