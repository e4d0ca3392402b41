"""Quadratic programs: problem, normalized constraints, solution, and the refinement of approximate solutions.

Source of the refinement: Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13, 2002.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg as la

from impactopt.errors import InputError
from impactopt.solvers.program import Vector, row_norms


@dataclass(frozen=True, kw_only=True)
class QuadraticProgram:
    """Minimize 1/2 x'Px + q'x subject to lower <= A x <= upper and x_lower <= x <= x_upper.

    Attributes
    ----------
    P : full symmetric, positive semidefinite (n, n), dense.
    q : (n,).
    A : (m, n), dense.
    lower, upper : (m,), equal for equalities, +-inf for none.
    x_lower, x_upper : (n,), likewise.

    Raises
    ------
    InputError : P or A is no dense array.
    """

    P: np.ndarray
    q: Vector
    A: np.ndarray
    lower: Vector
    upper: Vector
    x_lower: Vector
    x_upper: Vector

    def __post_init__(self) -> None:
        for name in ("P", "A"):
            if not isinstance(given := getattr(self, name), np.ndarray):
                kind = type(given).__name__
                raise InputError(f"{name} of a quadratic program is a {kind}; give a dense array")

    @property
    def n(self) -> int:
        """Number of variables."""
        return int(self.q.size)

    @property
    def m(self) -> int:
        """Number of constraints: rows of A, without the variables' bounds."""
        return int(self.lower.size)

    @cached_property
    def stacked(self) -> tuple[np.ndarray, Vector, Vector]:
        """Normalized constraints l <= C x <= u: (C, l, u); C = [A; I] with rows of norm 1, or zero.

        First-order solvers depend on the norms of the rows. `row_scale` times their multipliers are those of
        the QP.
        """
        # Bounds have norm 1 already.
        C = np.vstack([self.row_scale[: self.m, None] * self.A, np.eye(self.n)])
        lower = np.concatenate([self.lower, self.x_lower]) * self.row_scale
        upper = np.concatenate([self.upper, self.x_upper]) * self.row_scale
        return C, lower, upper

    @cached_property
    def row_scale(self) -> Vector:
        """Factors of the rows of [A; I] in `stacked`, (m + n,)."""
        norms = row_norms(self.A)
        return np.concatenate([1.0 / np.where(norms > 1e-12, norms, 1.0), np.ones(self.n)])

    def residuals(self, x: Vector, y: Vector, z: Vector) -> tuple[float, float, float]:
        """Residuals of the KKT conditions at x, with multipliers y of the constraints and z of the bounds.

        Returns the largest violation of a normalized constraint, the largest entry of P x + q + A'y + z, and
        the largest product of a normalized constraint's multiplier and its distance to the bound.
        """
        C, lower, upper = self.stacked
        v = C @ x
        # C = row_scale [A; I], so its multipliers are those of the QP over row_scale.
        multipliers = np.concatenate([y, z]) / self.row_scale
        primal = np.max(np.maximum(np.maximum(lower - v, v - upper), 0.0), initial=0.0)
        dual = np.max(np.abs(self.P @ x + self.q + C.T @ multipliers), initial=0.0)
        active = multipliers != 0.0
        gap = np.where(multipliers > 0, np.abs(upper - v), np.abs(v - lower))[active]
        return float(primal), float(dual), float(np.max(np.abs(multipliers[active]) * gap, initial=0.0))

    def error(self, x: Vector, y: Vector, z: Vector) -> float:
        """The largest of the residuals; those in units of the objective relative to 1 + |q|."""
        primal, dual, gap = self.residuals(x, y, z)
        return max(primal, max(dual, gap) / (1.0 + float(np.max(np.abs(self.q), initial=0.0))))


class QPStatus(enum.Enum):
    """Status of a QP solver. INACCURATE: usable, outside the tolerances."""

    SOLVED = "solved"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class QPSolution:
    """Solution by a QP solver; x, y, z are meaningless unless `usable`.

    Attributes
    ----------
    x : variables (n,).
    y, z : multipliers of the constraints (m,) and of the bounds (n,), positive if the upper bound is active.
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
    """Solver of one QP after the other; may keep factors and settings between them."""

    def solve(
        self,
        qp: QuadraticProgram,
        *,
        start: tuple[Vector, Vector, Vector] | None = None,
        time_limit: float | None = None,
    ) -> QPSolution:
        """Solve the QP from the initial guess (x, y, z); a failure is a status, no exception."""
        ...


_REGULARIZATION = 1e-9  # on the diagonal of a KKT system, against dependent constraints


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Solution x, multipliers y of the normalized constraints (`QuadraticProgram.stacked`), and its error."""

    x: Vector
    y: Vector
    error: float


def refine(qp: QuadraticProgram, x: Vector, y: Vector, *, rounds: int = 10) -> Refined | None:
    """Refine a solution: solve the QP with its active constraints as equalities, until the active set stays.

    Parameters
    ----------
    qp : with positive definite P.
    x : approximate solution (n,).
    y : approximate multipliers of the normalized constraints of `qp.stacked` (m + n,).
    rounds : most corrections of the active set.

    Returns
    -------
    The best point found; None if no active set gave a system that could be solved.
    """
    C, lower, upper = qp.stacked
    best: Refined | None = None
    # Corrections may cycle: an active set that was tried before ends them.
    seen: set[bytes] = set()
    for _ in range(rounds):
        sides = active_set(qp, x, y)
        high, low = sides > 0, sides < 0
        key = sides.tobytes()
        if key in seen:
            break
        seen.add(key)
        active = np.flatnonzero(high | low)
        target = np.where(high[active], upper[active], lower[active])
        solved = solve_equality_qp(qp.P, qp.q, C[active], target)
        if solved is None:
            break
        x, y = solved[0], np.zeros(lower.size)
        y[active] = solved[1]
        # a constraint with a multiplier of the wrong sign is dropped next time; its multiplier is no
        # solution's
        clipped = np.where(high, np.maximum(y, 0), np.where(low, np.minimum(y, 0), 0))
        clipped = np.where(lower == upper, y, clipped)
        error = qp.error(x, *np.split(clipped * qp.row_scale, [qp.m]))
        if best is None or error < best.error:
            best = Refined(x=x, y=clipped, error=error)
    return best


def active_set(qp: QuadraticProgram, x: Vector, y: Vector) -> np.ndarray:
    """Active set (m + n,) of the normalized constraints of `qp.stacked`, estimated from (x, y).

    +1 at the upper bound (and equalities), -1 at the lower, 0 for inactive constraints. A constraint is
    active if its multiplier is larger than its distance to the bound (eq. 2.4 with c = 1).
    """
    C, lower, upper = qp.stacked
    v = C @ x
    high = (y + (v - upper) > 0) | (lower == upper)
    return np.where(high, 1, np.where(y + (v - lower) < 0, -1, 0))


def solve_equality_qp(P: np.ndarray, q: Vector, A: np.ndarray, b: Vector) -> tuple[Vector, Vector] | None:
    """Minimize 1/2 x'Px + q'x subject to A x = b, also dependent: x and multipliers; None if singular."""
    n, m = q.size, b.size
    K = np.zeros((n + m, n + m))
    K[:n, :n], K[n:, :n], K[:n, n:] = P, A, A.T
    right = np.concatenate([-q, b])
    # The shift makes the system quasidefinite, and so regular also for dependent constraints; refinement with
    # the true matrix removes its effect.
    shift = _REGULARIZATION * np.concatenate([np.ones(n), -np.ones(m)])
    lu, pivots, info = la.lapack.dgetrf(K + np.diag(shift), overwrite_a=True)
    if info != 0:
        return None
    s = la.lapack.dgetrs(lu, pivots, right)[0]
    for _ in range(5):
        s = s + la.lapack.dgetrs(lu, pivots, right - K @ s)[0]
    return (s[:n], s[n:]) if np.isfinite(s).all() else None
