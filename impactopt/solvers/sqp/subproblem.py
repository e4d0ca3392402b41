"""The QP of one SQP iteration: linearized rows, elastic where they have to be, added when they are needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from impactopt.solvers.program import Matrix, Vector, row_violations
from impactopt.solvers.sqp.hessian import ActiveRows, QuadraticModel
from impactopt.solvers.sqp.point import Point, TimedProgram
from impactopt.solvers.sqp.qp import QPSolver, QPStatus, QuadraticProgram

_FEASIBLE = 1e-9  # violation of a unit row that counts as none
_NEAR = 0.02  # rows with less room than this, in units of the unit row, are in the QP from the start
_SLACK_CURVATURE = 1e-4  # of the price; the QP stays strictly convex in its slacks


@dataclass(frozen=True, kw_only=True)
class Step:
    """A solution of the subproblem.

    Attributes
    ----------
    d : step (n,).
    y, z : multipliers of the rows (m,) and of the variables' bounds (n,), without those of the trust region.
    linear_violation : weighted sum of the violations of the linearized rows at d.
    rows : number of rows in the last QP; elastic: of those, with a slack.
    qp_iterations : of the QP solver, over all the QPs it took.
    hard : whether the QP solver struggled.
    """

    d: Vector
    y: Vector
    z: Vector
    linear_violation: float
    rows: int
    elastic: int
    qp_iterations: int
    hard: bool


class Subproblem:
    """Minimize m(d) + price * sum of slacks subject to the linearized rows, the bounds and |d|_inf <= radius.

    Slack only where needed: a normal step towards the violated rows is made first; what it meets is asked for
    exactly, what it cannot meet within the trust region gets a slack. So the QP always has a solution, and
    most often no slack.

    Rows only where needed: the QP starts with those active last time, those nearly reached and those the
    normal step leaves violated; whatever its solution then violates is added and the QP solved again.
    """

    def __init__(self, program: TimedProgram, solver: QPSolver):
        self._program, self._solver = program, solver
        self.start_from(np.zeros(program.m), np.zeros(program.n))

    def start_from(self, y: Vector, z: Vector) -> None:
        """Take multipliers from elsewhere as the guess of the active set."""
        self._active, self._guess, self._held = np.abs(y) > 0, (y.copy(), z.copy()), (y.copy(), z.copy())

    def active_rows(self, point: Point) -> ActiveRows:
        """What held in the last QP, and the equalities, linearized at the point: unit rows."""
        p, (y, z) = self._program, self._held
        rows = np.flatnonzero((np.abs(y) * point.row_norms > 1e-6) | (p.g_lower == p.g_upper))
        bounds = np.flatnonzero(np.abs(z) > 1e-6)
        scale = 1.0 / point.row_norms[rows]
        A = sp.diags_array(scale) @ point.jacobian.tocsr()[rows]
        target = np.where(y < 0, p.g_lower, p.g_upper)[rows]
        room = np.where(z < 0, p.x_lower, p.x_upper)[bounds] - point.x[bounds]
        r = np.concatenate([(target - point.g[rows]) * scale, room])
        r = np.clip(np.where(np.isfinite(r), r, 0.0), -0.3, 0.3)
        return ActiveRows(
            A=sp.csc_array(sp.vstack([A, sp.diags_array(np.ones(p.n), format="csr")[bounds]])), r=r
        )

    def solve(
        self,
        point: Point,
        model: QuadraticModel,
        *,
        radius: float,
        price: float,
        levenberg: float,
        correction: Vector | None = None,
        time_limit: float | None = None,
    ) -> Step | None:
        """Solve the subproblem, with `correction` (m,) added to g; None if the QP solver fails."""
        p, J = self._program, point.jacobian
        g = point.g if correction is None else point.g + correction
        lower, upper = p.g_lower - g, p.g_upper - g
        box = np.maximum(p.x_lower - point.x, -radius), np.minimum(p.x_upper - point.x, radius)
        slack = _FEASIBLE * point.row_norms
        anchor = normal_step(J, lower, upper, slack, 0.8 * box[0], 0.8 * box[1])
        reached = J @ anchor
        below, above = reached < lower - slack, reached > upper + slack
        room = np.minimum(reached - lower, upper - reached) / point.row_norms
        working = (lower == upper) | self._active | (room < _NEAR)
        B = sp.csc_array(model.B + levenberg * sp.diags_array(np.ones(p.n))) if levenberg else model.B
        start, iterations, hard = anchor, 0, False
        while True:
            rows = np.flatnonzero(working)
            prices = price * p.weights[rows]
            qp = _elastic_qp(
                B,
                model.gradient,
                J.tocsr()[rows],
                lower[rows],
                upper[rows],
                box,
                below[rows],
                above[rows],
                prices,
            )
            guess = _guess(qp, start, self._guess[0][rows], self._guess[1], reached[rows], p.n)
            solution = self._solver.solve(qp, start=guess, time_limit=time_limit)
            iterations += solution.iterations
            hard = hard or solution.status is not QPStatus.SOLVED
            if not solution.usable:
                return None
            d = np.clip(solution.x[: p.n], *box)
            y, z = np.zeros(p.m), solution.z[: p.n]
            y[rows] = solution.y
            self._guess = (y, z)
            linear = J @ d
            missed = ((linear < lower - 1e2 * slack) | (linear > upper + 1e2 * slack)) & ~working
            if not missed.any():
                break
            working, start = working | missed, d
        self._active = np.abs(y) * point.row_norms > 1e-9
        at_bound = np.where(z > 0, box[1] >= p.x_upper - point.x, box[0] <= p.x_lower - point.x)
        self._held = (y, np.where(at_bound, z, 0.0))
        return Step(
            d=d,
            y=y,
            z=self._held[1],
            linear_violation=float(p.weights @ row_violations(p, g + linear)),
            rows=rows.size,
            elastic=qp.n - p.n,
            qp_iterations=iterations,
            hard=hard,
        )


def normal_step(
    J: Matrix, lower: Vector, upper: Vector, slack: Vector, d_lower: Vector, d_upper: Vector
) -> Vector:
    """The shortest step that meets the violated rows of lower <= J d <= upper, cut off at the box (n,)."""
    norms = np.sqrt(np.asarray(J.multiply(J).sum(axis=1)).ravel())
    violated = np.flatnonzero(((lower > slack) | (upper < -slack)) & (norms > 1e-12))
    if violated.size == 0:
        return np.zeros(J.shape[1])
    A = sp.csr_array(sp.diags_array(1.0 / norms[violated]) @ J.tocsr()[violated])
    r = np.where(lower > 0, lower, upper)[violated] / norms[violated]
    # min |d|^2 subject to A d = r, regularized for dependent rows: d = A' (A A' + eps I)^-1 r
    G = sp.csc_matrix(A @ A.T + 1e-9 * sp.diags_array(np.ones(violated.size)))
    return np.clip(A.T @ spla.splu(G).solve(r), d_lower, d_upper)


def _elastic_qp(
    B: Matrix,
    gradient: Vector,
    A: Matrix,
    lower: Vector,
    upper: Vector,
    box: tuple[Vector, Vector],
    below: np.ndarray,
    above: np.ndarray,
    prices: Vector,
) -> QuadraticProgram:
    """The QP in (d, s): A d + s >= lower for rows below, A d - s <= upper for rows above, s >= 0 at a price.

    A slack is measured in units of its unit row, so that its column is as long as the row.
    """
    elastic = np.flatnonzero(below | above)
    if elastic.size:
        k = elastic.size
        norms = np.maximum(np.sqrt(np.asarray(A.multiply(A).sum(axis=1)).ravel())[elastic], 1e-12)
        cost = prices[elastic] * norms
        sign = np.where(below[elastic], 1.0, -1.0)
        S = sp.csr_array((norms * sign, (elastic, np.arange(k))), shape=(lower.size, k))
        A = sp.hstack([A, S], format="csc")
        B = sp.block_diag([B, sp.diags_array(_SLACK_CURVATURE * cost)], format="csc")
        gradient = np.concatenate([gradient, cost])
        box = np.concatenate([box[0], np.zeros(k)]), np.concatenate([box[1], np.full(k, np.inf)])
    A = sp.csc_array(A)
    A.sort_indices()
    B = sp.csc_array(B)
    B.sort_indices()
    return QuadraticProgram(P=B, q=gradient, A=A, lower=lower, upper=upper, x_lower=box[0], x_upper=box[1])


def _guess(
    qp: QuadraticProgram, d: Vector, y: Vector, z: Vector, reached: Vector, n: int
) -> tuple[Vector, Vector, Vector]:
    """A start for the QP: the step d, slacks that make up for what it leaves, the last multipliers.

    A slack is at its bound 0 unless its row's multiplier has reached its price.
    """
    missing = np.maximum(np.maximum(qp.lower - reached, reached - qp.upper), 0.0)
    columns = qp.A[:, n:]
    slacks = np.abs(columns.T @ missing) / np.maximum(
        np.asarray(columns.multiply(columns).sum(axis=0)).ravel(), 1e-12
    )
    at_zero = np.minimum(np.abs(columns.T @ y) - qp.q[n:], 0.0)
    return np.concatenate([d, slacks]), y, np.concatenate([z, at_zero])
