"""The QPs of the reduced SQP: a step that keeps all equalities, with the rows that it needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from impactopt.solvers.point import Point, TimedProgram
from impactopt.solvers.program import Matrix, Vector, row_violations
from impactopt.solvers.qp.quadratic_program import QPSolution, QPSolver, QPStatus, QuadraticProgram
from impactopt.solvers.sqp.reduced_hessian import ReducedModel
from impactopt.solvers.sqp.reduction import Reduction

# part of the way that a row can change, within which it is in the QP from the start; rows for each direction
_NEAR, _NEAREST = 0.1, 2
_MISSED, _ROUNDS, _MORE = 1e-7, 12, 15  # violation of a row left out; times rows are added; so many at least
_SLACK_CURVATURE = 1e-4  # of the price
_ABOVE = 2.0  # times a multiplier that is known: a price
_ACTIVE = 1e-4  # multiplier of a unit row that holds
_SOFT = 1e-9  # violation where t = 0 of rows that may stay violated
_BEYOND = 0.5  # of the way that a row can change inside the radius: what is violated by more is given up
# parts of the radius that a step towards the equalities may be long: it is shortened with the rest, but where
# only the violation counts
_LARGEST, _CAREFUL = 1e4, 0.8


@dataclass(frozen=True)
class Solved:
    """A step d (n,); multipliers y (m,) and z (n,) of all but the equalities; what the linearized rows are
    off by; rows of the QP, and those elastic; iterations of its solver; largest entry of the step that keeps
    the equalities."""

    d: Vector
    y: Vector
    z: Vector
    linear_violation: float
    rows: int
    elastic: int
    iterations: int
    longest: float


class ReducedQP:
    """Solves them one after the other.

    careful : whether no step is longer than the radius, those towards the equalities among them.
    """

    careful = False

    def __init__(self, program: TimedProgram, reduction: Reduction, solver: QPSolver):
        self._program, self._reduction, self._solver = program, reduction, solver
        self._at: Point | None = None
        self.start_from(np.zeros(program.m), np.zeros(program.n))

    def start_from(self, y: Vector, z: Vector) -> None:
        """Take multipliers from elsewhere as the guess of the active set."""
        reduction = self._reduction
        self._unit = np.concatenate([y[reduction.rows], z[reduction.bounded]])

    def active(self, point: Point) -> Matrix:
        """Rows (a, r) of what held in the last QP, in the directions that are left; of all variables their
        gradients would be one long, as those that cease to hold are not to be held by the model's curvature.
        """
        every, which = self._rows(point), np.flatnonzero(np.abs(self._unit) > _ACTIVE)
        own = self._norms / point.row_norms[self._reduction.rows]
        return sp.diags_array(np.append(own, np.ones(every.shape[0] - own.size))[which]) @ every[which]

    def weigh(self, point: Point, y: Vector, price: float) -> None:
        """Weigh rows in the merit function, so that a price suits all alike.

        By what the free variables change them, if that is less than all do: rows of gears change ten thousand
        times as fast with accelerations, which other rows determine. And by known multipliers y (m,), which a
        price has to exceed.
        """
        self._rows(point)
        self._program.weigh(point)
        weights, rows = self._program.weights, self._reduction.rows
        by_free = 1.0 / np.clip(self._norms, 1.0, 1e6)
        weights[rows] = np.maximum(np.maximum(weights[rows], by_free), _ABOVE * np.abs(y[rows]) / price)

    def _rows(self, point: Point) -> Matrix:
        """Unit rows (k, r): those that are not eliminated, then of the bounds."""
        if self._at is not point:
            reduction = self._reduction
            own, self._norms = reduction.rows_by_free(point)
            bounds, self._at = reduction.T[reduction.bounded], point
            if reduction.sparse:
                self._every = sp.vstack([sp.diags_array(1.0 / self._norms) @ own, bounds], "csr")
            else:
                self._every = np.vstack([own / self._norms[:, None], bounds])
        return self._every

    def solve(
        self,
        point: Point,
        model: ReducedModel,
        g: Vector,
        *,
        radius: float,
        price: float,
        time_limit: float | None,
    ) -> Solved | None:
        """The step where rows are g (m,) and have the point's slopes; None if the QP solver fails."""
        p, reduction, every = self._program, self._reduction, self._rows(point)
        rows, bounded, T = reduction.rows, reduction.bounded, reduction.T
        d0 = reduction.normal(g)
        longest = (_CAREFUL if self.careful or not model.leads else _LARGEST) * radius
        d0 *= min(1.0, longest / max(float(np.abs(d0).max(initial=0.0)), 1e-300))
        after, scale = g + point.jacobian @ d0, self._norms
        x = point.x + d0
        lower = np.concatenate([(p.g_lower - after)[rows] / scale, (p.x_lower - x)[bounded]])
        upper = np.concatenate([(p.g_upper - after)[rows] / scale, (p.x_upper - x)[bounded]])
        prices = price * np.concatenate([p.weights[rows] * scale, np.ones(bounded.size)])
        reach = radius * abs(every).sum(axis=1)  # how much a row can change
        off = np.maximum(lower, -upper)
        soft = off > _SOFT
        # A constraint that no step inside the radius can meet, or whose multiplier was at its price, is given
        # up: its violation is linear in t then, so its price is a part of the gradient, without a slack.
        lost = soft & ((off > _BEYOND * reach) | (np.abs(self._unit) > 0.99 * prices))
        late = np.argsort(-off / np.maximum(reach, 1e-12))[_NEAREST * T.shape[1] :]
        working = off > -_NEAR * reach
        working[late] = False
        working |= np.abs(self._unit) > 1e-9
        slope0, unit, iterations = model.slope(d0), self._unit, 0
        guess = np.zeros(T.shape[1])
        for _ in range(_ROUNDS):
            which, given_up = np.flatnonzero(working & ~lost), np.flatnonzero(lost)
            dear = np.where(lower > 0, -prices, prices)[given_up]
            slope = slope0 + every[given_up].T @ dear
            qp = _elastic(model.B, slope, every[which], lower[which], upper[which], radius, prices[which])
            priced = np.concatenate([which[lower[which] > _SOFT], which[upper[which] < -_SOFT]])
            held = np.minimum(np.abs(unit[priced]) - prices[priced], 0.0)  # of slacks that are zero
            start = (
                np.concatenate([guess, np.zeros(priced.size)]),
                unit[which],
                np.concatenate([np.zeros(guess.size), held]),
            )
            found = self._solver.solve(qp, start=start, time_limit=time_limit) if qp.n else _decided(qp)
            iterations += found.iterations
            if not found.usable:
                return None
            guess = found.x[: T.shape[1]]
            step = T @ guess
            unit = np.zeros(lower.size)
            unit[which], unit[given_up] = found.y, dear
            values = np.concatenate([(point.jacobian @ step)[rows] / scale, step[bounded]])
            beyond = np.maximum(lower - values, values - upper)
            back = lost & (np.where(lower > 0, lower - values, values - upper) < -_MISSED)
            missed = np.where(working | lost, 0.0, beyond)
            if missed.max(initial=0.0) <= _MISSED and not back.any():
                break
            lost &= ~back
            working |= back
            worst = np.argsort(-missed)[: max(_MORE, missed.size // 10)]
            working[worst[missed[worst] > 0]] = True
        self._unit = unit
        d, y, z = d0 + step, np.zeros(p.m), np.zeros(p.n)
        y[rows], z[bounded] = unit[: rows.size] / scale, unit[rows.size :]
        linear = float(p.weights @ row_violations(p, g + point.jacobian @ d))
        return Solved(
            d, y, z, linear, which.size, qp.n - guess.size, iterations, float(np.abs(guess).max(initial=0.0))
        )


def _decided(qp: QuadraticProgram) -> QPSolution:
    """The solution of a QP without variables: the equalities leave no direction."""
    return QPSolution(x=qp.q, y=np.zeros(qp.m), z=qp.q, status=QPStatus.SOLVED, iterations=0)


def _elastic(
    B: Matrix, c: Vector, A: Matrix, lower: Vector, upper: Vector, radius: float, prices: Vector
) -> QuadraticProgram:
    """The QP in (t, s), s >= 0 at a price: A t + s >= lower where t = 0 is below, A t - s <= upper above."""
    below, above = np.flatnonzero(lower > _SOFT), np.flatnonzero(upper < -_SOFT)
    elastic = np.concatenate([below, above])
    k, n = elastic.size, c.size
    box = np.full(n, radius)
    small = isinstance(A, np.ndarray)
    if k:
        sign = np.where(np.arange(k) < below.size, 1.0, -1.0)
        bend = _SLACK_CURVATURE * prices[elastic]  # as the dual method needs a positive definite P
        c = np.concatenate([c, prices[elastic]])
        if small:
            S = np.zeros((lower.size, k))
            S[elastic, np.arange(k)] = sign
            A, B = np.hstack([A, S]), la.block_diag(B, np.diag(bend))
        else:
            S = sp.csc_array((sign, (elastic, np.arange(k))), shape=(lower.size, k))
            A, B = sp.hstack([sp.csc_array(A), S]), sp.block_diag([B, sp.diags_array(bend)])
    return QuadraticProgram(
        P=B if small else sp.csc_array(B),
        q=c,
        A=A if small else sp.csc_array(A),
        lower=lower,
        upper=upper,
        x_lower=np.concatenate([-box, np.zeros(k)]),
        x_upper=np.concatenate([box, np.full(k, np.inf)]),
    )
