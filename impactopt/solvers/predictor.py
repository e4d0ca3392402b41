"""Parametric steps: a solution's active set, and the solution for changed parameters by a few QPs.

Where active constraints are independent, their multipliers are not zero and the second-order condition holds,
the solution is a smooth function of a parameter, by the implicit function theorem (Fiacco, "Introduction to
sensitivity and stability analysis in nonlinear programming", 1983, ch. 3). Where the active set changes, each
QP has the changed program's constraints made linear, and the known solution's Hessian. Its active set is
found by Newton's method on its augmented Lagrangian, with exact line searches: constraints that begin to hold
and constraints that let go are no matter (Hermans, Themelis, Patrinos, "QPALM: a Newton-type proximal
augmented Lagrangian method for quadratic programs", CDC 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from impactopt.errors import InputError
from impactopt.solvers.ipm.newton import acquire
from impactopt.solvers.program import Matrix, NonlinearProgram, Vector, max_violation
from impactopt.solvers.run import threads

__all__ = ["ActiveSystem", "Change", "Offset", "Prediction", "Predictor"]

Side = npt.NDArray[np.int8]
# on the diagonal of constraints, against zero pivots by dependent ones. The first is best where multipliers
# are large, the other where a constraint touches nothing
_ROUNDING = (1e-14, 1e-10)
_SINGULAR = (
    "the active constraints of this solution are linearly dependent: its KKT system is singular; solve the "
    "changed problem from it, with solve(problem, start=solution)"
)
_REFINEMENTS = 5  # of a solution: they remove the error of what `_ROUNDING` adds to the diagonal
_LEFT = 1e-8  # of what is given: what a step may leave of the equations
_SOFT = 1e4  # slack over multiplier: what gives way more is at no bound
_TINY = 1e-9  # a multiplier that is nothing


@dataclass(frozen=True, kw_only=True)
class Offset:
    """Residual of a solution's KKT conditions in a program with other parameters.

    dual (n,) : grad f + J'y + z.  rows (m,) : g minus the bound that each constraint is at, where it is at
    one.
    variables (n,) : likewise of x.
    """

    PARTS: ClassVar[tuple[str, ...]] = ("dual", "rows", "variables")

    dual: Vector
    rows: Vector
    variables: Vector

    def less(self, other: Offset) -> Offset:
        """Difference of two residuals."""
        return Offset(
            dual=self.dual - other.dual,
            rows=self.rows - other.rows,
            variables=self.variables - other.variables,
        )


@dataclass(frozen=True, kw_only=True)
class Change:
    """Values or changes of variables (n,), multipliers of constraints (m,) and multipliers of bounds (n,)."""

    x: Vector
    y: Vector
    z: Vector


class ActiveSystem:
    """Factored once:  [H A'; A -S] with the constraints and bounds A that a solution is at, or near by.

    S is the slack of an inequality over its multiplier, as of an interior-point method: it lets go of
    constraints that hardly hold, and is nothing for those that do.

    Attributes
    ----------
    x, y, z : of the solution, as of `impactopt.solvers.program.SolverResult`.
    proximal : curvature more of every variable, for steps that leave alone what hardly matters.
    rows (m,), bounds (n,) : 1 where it is near the upper bound, -1 the lower one, 0 none; equalities 1.
    """

    def __init__(
        self, program: NonlinearProgram, x: Vector, y: Vector, z: Vector, *, proximal: float = 0.0
    ) -> None:
        self.x, self.y, self.z = x, y, z
        g = program.constraints(x)
        self.rows, self._soft_rows = _at(g, program.g_lower, program.g_upper, y)
        self.bounds, self._soft_bounds = _at(x, program.x_lower, program.x_upper, z)
        n = program.n
        self._rows, self._bounds = np.flatnonzero(self.rows), np.flatnonzero(self.bounds)
        jacobian = sp.csr_array(program.jacobian(x))[self._rows]
        held = sp.csr_array(
            (np.ones(len(self._bounds)), (np.arange(len(self._bounds)), self._bounds)),
            shape=(len(self._bounds), n),
        )
        A = sp.vstack([jacobian, held])
        H = sp.csc_array(program.hessian(x, 1.0, y))
        if proximal:
            H = sp.csc_array(H + proximal * sp.eye_array(n))
        soft = np.concatenate([self._soft_rows[self._rows], self._soft_bounds[self._bounds]])
        # A dx - (slack / multiplier) dy = -off: the linearization of slack x multiplier = mu
        self._matrix = sp.csc_array(sp.block_array([[H, A.T], [A, sp.diags_array(-soft)]]))
        self._factors: dict[float, Any] = {}

    def _factor(self, rounding: float) -> Any:
        """LU of the system, with a little on the diagonal of the constraints; kept."""
        if rounding not in self._factors:
            n = len(self.x)
            shift = np.concatenate([np.zeros(n), np.full(self._matrix.shape[0] - n, -rounding)])
            try:
                found = splu(sp.csc_matrix(self._matrix + sp.diags_array(shift)))
            except RuntimeError as error:
                raise InputError(_SINGULAR) from error
            self._factors[rounding] = found
        return self._factors[rounding]

    def offset(self, program: NonlinearProgram, at: Change | None = None) -> Offset:
        """KKT residual of a program with other parameters, and the same variables and constraints.

        at : variables and multipliers; None: those of the solution.
        """
        point = Change(x=self.x, y=self.y, z=self.z) if at is None else at
        x, g = point.x, program.constraints(point.x)
        return Offset(
            dual=np.asarray(program.gradient(x) + program.jacobian(x).T @ point.y + point.z),
            rows=_off(g, program.g_lower, program.g_upper, self.rows) - self._soft_rows * (point.y - self.y),
            variables=_off(x, program.x_lower, program.x_upper, self.bounds)
            - self._soft_bounds * (point.z - self.z),
        )

    def step(self, offset: Offset) -> Change:
        """The Newton step that makes up for an offset; or, for a slope of it, minus that of the solution.

        Raises
        ------
        InputError : the active constraints are linearly dependent.
        """
        given = -np.concatenate([offset.dual, offset.rows[self._rows], offset.variables[self._bounds]])
        for rounding in _ROUNDING:
            factor = self._factor(rounding)
            found = factor.solve(given)
            for _ in range(_REFINEMENTS):
                left = given - self._matrix @ found
                if np.abs(left).max(initial=0.0) <= 1e-13 * np.abs(given).max(initial=0.0):
                    break
                found = found + factor.solve(left)
            left = np.abs(given - self._matrix @ found).max(initial=0.0)
            if left <= _LEFT * max(float(np.abs(given).max(initial=0.0)), 1e-12):
                break
        else:
            raise InputError(_SINGULAR)
        n, k = len(self.x), len(self._rows)
        y, z = np.zeros(len(self.y)), np.zeros(n)
        y[self._rows], z[self._bounds] = found[n : n + k], found[n + k :]
        return Change(x=found[:n], y=y, z=z)


def _at(values: Vector, lower: Vector, upper: Vector, multipliers: Vector) -> tuple[Side, Vector]:
    """Bound that each value is at, or near; and its slack over its multiplier."""
    gap = np.abs(np.where(multipliers > 0, upper - values, values - lower))
    size = np.abs(multipliers)
    equal = lower == upper
    at = equal | ((size > _TINY) & (gap < _SOFT * size))
    soft = np.zeros(len(values))
    near = at & ~equal
    soft[near] = gap[near] / size[near]
    return np.where(at, np.where(equal, 1, np.sign(multipliers)), 0).astype(np.int8), soft


def _off(values: Vector, lower: Vector, upper: Vector, at: Side) -> Vector:
    bound = np.where(at > 0, upper, lower)
    out = np.zeros(len(values))
    out[at != 0] = (values - bound)[at != 0]
    return out


Sides = npt.NDArray[np.int8]
_WEIGHT = 1e6  # of the augmented Lagrangian: a constraint is off by a multiplier's change over it
_WEAK = 1e-4  # multiplier of a constraint that hardly holds
_PROXIMAL = 1e-2  # curvature more of every variable, so that what hardly matters stays
_STEPS, _SETS = 5, 20  # QPs, and active sets of each
_SHORT, _JAMMED = 0.1, 5  # so many line searches that are so short: it stalls
_ENOUGH = 1e-4  # of constraints: no more QPs


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Variables (n,), multipliers of rows (m,) and bounds (n,), by how much constraints or bounds are off at
    most, and after how many QPs.
    """

    x: Vector
    y: Vector
    z: Vector
    violation: float
    steps: int


class Predictor:
    """Predicts from one solution of a program: x (n,), y (m,) and z (n,) as of
    `impactopt.solvers.program.SolverResult`.

    A solver leaves it with slack at constraints that hold, and with small multipliers at those that do not.
    Both are kept, so that numbers that do not change give back the solution itself.
    """

    def __init__(self, program: NonlinearProgram, x: Vector, y: Vector, z: Vector) -> None:
        self.x, self.y, self.z = x, y, z
        jacobian, self._hessian = program.jacobian(x), program.hessian(x, 1.0, y).copy()
        self._moves = program.x_upper - program.x_lower > 1e-12
        bounded = (np.isfinite(program.x_lower) | np.isfinite(program.x_upper)) & self._moves
        self._newton = acquire(
            jacobian,
            self._hessian,
            determined=getattr(program, "determined", ()),
            equal=program.g_lower == program.g_upper,
            bounded=bounded,
            moves=self._moves,
        )
        # variables whose bounds are no rows of the condenser
        self._free = np.zeros(program.n, dtype=bool)
        self._free[self._newton.condenser.free] = bounded[self._newton.condenser.free]
        lower, upper = self._bounds(program)
        self._equal = lower == upper
        limited = np.isfinite(lower) | np.isfinite(upper)
        self._inequal = rows = np.flatnonzero(~self._equal & limited)
        values, own = np.concatenate([program.constraints(x), x])[rows], np.concatenate([y, z])[rows]
        self._weak = np.where(np.abs(own) < _WEAK, own, 0.0)
        slack = np.maximum(np.where(own > 0, upper[rows] - values, values - lower[rows]), 0.0)
        self._slack = np.where(self._weak == own, 0.0, slack)
        self._sides = np.sign(own - self._weak).astype(np.int8)

    def _bounds(self, program: NonlinearProgram) -> tuple[Vector, Vector]:
        """Bounds of constraints and variables; infinite for variables that do not move."""
        lower, upper = (
            np.where(self._moves, program.x_lower, -np.inf),
            np.where(self._moves, program.x_upper, np.inf),
        )
        return np.concatenate([program.g_lower, lower]), np.concatenate([program.g_upper, upper])

    def predict(self, program: NonlinearProgram) -> Prediction | None:
        """Prediction for the same program with other parameters; None if a QP's active set is not found.

        QP after QP from where the one before led, while constraints are off and it helps.
        """
        found: Prediction | None = None
        x, y, z, sides = self.x, self.y, self.z, self._sides
        g = program.constraints(x)
        with threads().limit(limits=1, user_api="blas"):
            for k in range(_STEPS):
                if not np.isfinite(g).all():
                    break
                qp = _QP(self, program, x, g, np.concatenate([y, z]))
                if not qp.solve(sides):
                    break
                x = np.clip(x + qp.d, program.x_lower, program.x_upper)
                (y, z), sides, g = qp.multipliers(), qp.sides, program.constraints(x)
                violation = max_violation(program, x, g)
                if found is not None and not violation < found.violation:
                    break
                found = Prediction(x=x, y=y, z=z, violation=violation, steps=k + 1)
                if violation <= _ENOUGH:
                    break
        return found


class _QP:
    """Minimize 1/2 d'Hd + q'd with all constraints and bounds made linear at x.

    Attributes
    ----------
    d : the step (n,).  sides : of inequalities, 1 where the upper bound holds, -1 the lower one, 0 none.
    """

    def __init__(self, of: Predictor, program: NonlinearProgram, x: Vector, g: Vector, own: Vector) -> None:
        self._of, self._newton = of, of._newton
        self._m, rows = program.m, of._inequal
        self._jacobian: Matrix = program.jacobian(x)
        lower, upper = of._bounds(program)
        values = np.concatenate([g, x])
        self._off = np.where(of._equal, values - lower, 0.0)
        self._off[program.m :] = 0.0
        self._values = values[rows]
        self._lower = lower[rows] + np.where(of._sides < 0, of._slack, 0.0)
        self._upper = upper[rows] - np.where(of._sides > 0, of._slack, 0.0)
        self._own = own[rows] - of._weak
        self._constant = np.zeros(len(values))
        self._constant[rows] = of._weak
        self._gradient = program.gradient(x)
        self._q = self._gradient + self._pulled(self._constant)
        self.d, self.sides = np.zeros(len(x)), of._sides

    def _pulled(self, multipliers: Vector) -> Vector:
        out: Vector = self._jacobian.T @ multipliers[: self._m] + multipliers[self._m :]
        return out

    def solve(self, sides: Sides) -> bool:
        """Iterates from an active set (as of `sides`) towards the solution's; true if it gets there."""
        rows, short = self._of._inequal, 0
        at = np.zeros(len(rows))
        for k in range(_SETS):
            d = self._step(sides)
            if d is None or not np.isfinite(d).all():
                return False
            moved = np.concatenate([self._jacobian @ d, d])[rows]
            # later steps end where the augmented Lagrangian is least: full ones may jump between active sets
            # for ever
            part = 1.0 if not k else self._length(d - self.d, at, moved - at)
            short += part < _SHORT
            if short == _JAMMED:
                return False
            self.d, at = self.d + part * (d - self.d), at + part * (moved - at)
            new = np.sign(self._pull(at)).astype(np.int8)
            settled = bool((new == sides).all())
            self.sides = sides = new
            if settled:
                break
        return True

    def _pull(self, at: Vector) -> Vector:
        """Multipliers of inequalities whose linear values have changed by ``at``."""
        values, weight = self._values + at, _WEIGHT
        above = self._own + weight * (values - self._upper)
        below = self._own + weight * (values - self._lower)
        out: Vector = np.where(above > 0, above, np.where(below < 0, below, 0.0))
        return out

    def _step(self, sides: Sides) -> Vector | None:
        """The minimum where these sides hold, and its multipliers."""
        c, of, m, rows = self._newton.condenser, self._of, self._m, self._of._inequal
        weights, off = np.zeros(len(self._off)), self._off.copy()
        on = sides != 0
        weights[rows[on]] = _WEIGHT
        bound = np.where(sides > 0, self._upper, self._lower)[on]
        off[rows[on]] = self._values[on] - bound + self._own[on] / _WEIGHT
        of_free = weights[m:] * of._free
        condensed = np.concatenate([weights[:m], weights[m:][c.bounded]])[c.remaining]
        try:
            factored = self._newton.factor(
                self._jacobian,
                of._hessian,
                of_free[c.free],
                lambda more: condensed,
                hard=True,
                proximal=_PROXIMAL,
            )
        except np.linalg.LinAlgError:
            return None
        if not factored:
            return None
        d, found = self._newton.solve(
            self._q + of_free * off[m:], np.concatenate([off[:m], off[m:][c.bounded]])
        )
        self._y = np.zeros(len(self._off))
        self._y[:m] = found[:m]
        self._y[m:][c.bounded] = found[m:]
        self._y[m:] += of_free * (d + off[m:])
        return d

    def _length(self, step: Vector, at: Vector, along: Vector) -> float:
        """Step length that minimizes the augmented Lagrangian along a step, 1 at most."""
        hessian, more = self._of._hessian, _PROXIMAL + self._newton.shift
        linear = float((self._q + hessian @ self.d + more * self.d) @ step)
        square = float(step @ (hessian @ step) + more * (step @ step))

        def slope(part: float) -> float:
            return linear + part * square + float(self._pull(at + part * along) @ along)

        if slope(1.0) <= 0 or slope(0.0) >= 0:
            return 1.0
        return float(brentq(slope, 0.0, 1.0, xtol=1e-6))

    def multipliers(self) -> tuple[Vector, Vector]:
        """Multipliers of constraints (m,) and bounds (n,), as of the last active set."""
        found = self._y + self._constant
        y, z = found[: self._m], found[self._m :].copy()
        held = ~self._of._moves
        z[held] = -(self._gradient + self._jacobian.T @ y + self._of._hessian @ self.d)[held]
        return y, z
