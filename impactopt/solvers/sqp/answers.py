"""What a QP solver of others has found, as our answer: signs, active set, exactness."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from impactopt.solvers.program import Vector
from impactopt.solvers.sqp.qp import QPSolution, QPStatus, QuadraticProgram
from impactopt.solvers.sqp.refine import active_set, refine

SMALL = 300  # variables; up to here dense factorizations are cheap
HOPELESS = 1e-2  # largest error of an answer that is of any use


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


def finished(qp: QuadraticProgram, x: Vector, unit: Vector, tolerance: float, iterations: int) -> QPSolution:
    """The answer with an active set that is told by its multipliers, corrected where it is not exact enough.

    An interior-point method leaves every row a little of a multiplier, which an SQP would take for active.
    """
    if not (np.isfinite(x).all() and np.isfinite(unit).all()):
        return no_answer(qp, QPStatus.FAILED, iterations)
    held = active_set(qp, x, unit)
    kept = np.where(held > 0, np.maximum(unit, 0.0), np.where(held < 0, np.minimum(unit, 0.0), 0.0))
    _, lower, upper = qp.stacked
    unit = np.where(lower == upper, unit, kept)
    error = qp.error(x, *split(qp, unit))
    if qp.n <= SMALL or error > tolerance:
        exact = refine(qp, x, unit, rounds=5)
        if exact is not None and exact.error < error:
            x, unit, error = exact.x, exact.y, exact.error
    if error > HOPELESS:
        return no_answer(qp, QPStatus.FAILED, iterations)
    return answer(qp, x, unit, QPStatus.SOLVED if error <= tolerance else QPStatus.INACCURATE, iterations)


def refusal(qp: QuadraticProgram) -> QPStatus | None:
    """INFEASIBLE where bounds cross, FAILED where P is seen to be indefinite, else None: may be solved.

    Interior-point methods do not see it: they may end in a saddle point and call it solved. It is looked for
    where that is cheap only.
    """
    if (qp.lower > qp.upper).any() or (qp.x_lower > qp.x_upper).any():
        return QPStatus.INFEASIBLE
    if qp.n > SMALL:
        return None
    P, _ = qp.arrays
    shift = 1e-9 * max(float(np.abs(P).max(initial=0.0)), 1e-300)
    try:
        la.cholesky(P + shift * np.eye(qp.n), lower=True, check_finite=False)
    except la.LinAlgError:
        return QPStatus.FAILED
    return None
