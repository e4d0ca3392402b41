"""Parametric sensitivity steps, with a solution's active set, and predictions for changed parameters by QPs.

If active constraints are independent, their multipliers are not zero, and the second-order condition holds,
the solution is a smooth function of a parameter, by the implicit function theorem (Fiacco, "Introduction to
sensitivity and stability analysis in nonlinear programming", 1983, ch. 3). `ActiveSystem` solves its
equations.

If the active set changes, `Predictor` solves a few QPs, with the changed program's linearized constraints and
the known solution's Hessian. A QP's active set is found by Newton's method on its augmented Lagrangian with
exact line searches, in which constraints may become active and inactive (Hermans, Themelis, Patrinos, "QPALM:
a Newton-type proximal augmented Lagrangian method for quadratic programs", CDC 2019).
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

Sides = npt.NDArray[np.int8]  # 1: at the upper bound, -1: at the lower one, 0: at none
# Subtracted from the diagonal of constraints, against zero pivots by dependent ones. The first suits large
# multipliers, the other constraints without any nonzero derivative.
_REGULARIZATIONS = (1e-14, 1e-10)
_SINGULAR = (
    "the active constraints of this solution are linearly dependent: its KKT system is singular; solve the "
    "changed problem from it, with solve(problem, start=solution)"
)
_REFINEMENTS = 5  # of a solution: they remove the error of the regularization
_MAX_RESIDUAL = 1e-8  # of a step's equations, relative to the right-hand side
_MAX_SOFTNESS = 1e4  # slack over multiplier; a constraint with more is not active
_MIN_MULTIPLIER = 1e-9  # of an active constraint


@dataclass(frozen=True, kw_only=True)
class Offset:
    """Residual of a solution's KKT conditions in a program with other parameters.

    dual (n,) : grad f + J'y + z.
    constraints (m,) : g minus the bound at which each constraint is active; 0 if it is inactive.
    variables (n,) : likewise of x.
    """

    PARTS: ClassVar[tuple[str, ...]] = ("dual", "constraints", "variables")

    dual: Vector
    constraints: Vector
    variables: Vector

    def less(self, other: Offset) -> Offset:
        """Difference of two residuals."""
        return Offset(
            dual=self.dual - other.dual,
            constraints=self.constraints - other.constraints,
            variables=self.variables - other.variables,
        )


@dataclass(frozen=True, kw_only=True)
class Change:
    """Values or changes of variables (n,), multipliers of constraints (m,) and multipliers of bounds (n,)."""

    x: Vector
    y: Vector
    z: Vector


class ActiveSystem:
    """KKT system [H A'; A -S] of a solution, with its active constraints and bounds A; factored once.

    S is the slack of an inequality over its multiplier, its softness, as in an interior-point method: large
    for a weakly active constraint, which the step may leave, and close to 0 for others.

    Attributes
    ----------
    x, y, z : of the solution, as of `impactopt.solvers.program.SolverResult`.
    constraints (m,), bounds (n,) : side at which each constraint and variable is active; 1 for equalities.
    soft_constraints (m,), soft_bounds (n,) : softness of the active ones, S; 0 for others.
    """

    def __init__(
        self, program: NonlinearProgram, x: Vector, y: Vector, z: Vector, *, proximal: float = 0.0
    ) -> None:
        """proximal : added to the diagonal of H, so that a step moves variables little that hardly matter."""
        self.x, self.y, self.z = x, y, z
        g = program.constraints(x)
        self.constraints, self.soft_constraints = _active_sides(g, program.g_lower, program.g_upper, y)
        self.bounds, self.soft_bounds = _active_sides(x, program.x_lower, program.x_upper, z)
        n = program.n
        self._constraints, self._bounds = np.flatnonzero(self.constraints), np.flatnonzero(self.bounds)
        # A = [J of the active constraints; unit rows of the active bounds].
        jacobian = sp.csr_array(program.jacobian(x))[self._constraints]
        active_bounds = sp.csr_array(
            (np.ones(len(self._bounds)), (np.arange(len(self._bounds)), self._bounds)),
            shape=(len(self._bounds), n),
        )
        A = sp.vstack([jacobian, active_bounds])
        H = sp.csc_array(program.hessian(x, 1.0, y))
        if proximal:
            H = sp.csc_array(H + proximal * sp.eye_array(n))
        soft = np.concatenate([self.soft_constraints[self._constraints], self.soft_bounds[self._bounds]])
        # A dx - (slack / multiplier) dy = -off: the linearization of slack x multiplier = mu
        self._matrix = sp.csc_array(sp.block_array([[H, A.T], [A, sp.diags_array(-soft)]]))
        self._factors: dict[float, Any] = {}

    def _factor(self, regularization: float) -> Any:
        """LU factors of the regularized system, cached."""
        if regularization not in self._factors:
            n = len(self.x)
            shift = np.concatenate([np.zeros(n), np.full(self._matrix.shape[0] - n, -regularization)])
            try:
                factor = splu(sp.csc_matrix(self._matrix + sp.diags_array(shift)))
            except RuntimeError as error:
                raise InputError(_SINGULAR) from error
            self._factors[regularization] = factor
        return self._factors[regularization]

    def offset(self, program: NonlinearProgram, at: Change | None = None) -> Offset:
        """KKT residual of a program with other parameters, and the same variables and constraints.

        at : variables and multipliers; None: those of the solution.
        """
        point = Change(x=self.x, y=self.y, z=self.z) if at is None else at
        x, g = point.x, program.constraints(point.x)
        return Offset(
            dual=np.asarray(program.gradient(x) + program.jacobian(x).T @ point.y + point.z),
            # Softness times the multiplier's change: 0 at the solution itself, as its slack is no residual.
            constraints=_bound_residual(g, program.g_lower, program.g_upper, self.constraints)
            - self.soft_constraints * (point.y - self.y),
            variables=_bound_residual(x, program.x_lower, program.x_upper, self.bounds)
            - self.soft_bounds * (point.z - self.z),
        )

    def step(self, offset: Offset) -> Change:
        """Newton step that removes an offset; for an offset's derivative, that of the solution.

        Raises
        ------
        InputError : the active constraints are linearly dependent.
        """
        given = -np.concatenate(
            [offset.dual, offset.constraints[self._constraints], offset.variables[self._bounds]]
        )
        # The regularized factors refine towards the true matrix's solution, so no error of the regularization
        # is left. If that does not converge, the next one is tried.
        for regularization in _REGULARIZATIONS:
            factor = self._factor(regularization)
            found = factor.solve(given)
            for _ in range(_REFINEMENTS):
                residual = given - self._matrix @ found
                if np.abs(residual).max(initial=0.0) <= 1e-13 * np.abs(given).max(initial=0.0):
                    break
                found = found + factor.solve(residual)
            largest = np.abs(given - self._matrix @ found).max(initial=0.0)
            if largest <= _MAX_RESIDUAL * max(float(np.abs(given).max(initial=0.0)), 1e-12):
                break
        else:
            raise InputError(_SINGULAR)
        # Inactive constraints keep a multiplier of 0, to first order.
        n, k = len(self.x), len(self._constraints)
        y, z = np.zeros(len(self.y)), np.zeros(n)
        y[self._constraints], z[self._bounds] = found[n : n + k], found[n + k :]
        return Change(x=found[:n], y=y, z=z)


def _active_sides(values: Vector, lower: Vector, upper: Vector, multipliers: Vector) -> tuple[Sides, Vector]:
    """Side at which each value is active, and its softness: slack over multiplier, 0 for equalities."""
    # slack x multiplier = mu at an interior-point solution, so slack / multiplier is mu / multiplier^2.
    gap = np.abs(np.where(multipliers > 0, upper - values, values - lower))
    size = np.abs(multipliers)
    equal = lower == upper
    active = equal | ((size > _MIN_MULTIPLIER) & (gap < _MAX_SOFTNESS * size))
    softness = np.zeros(len(values))
    unequal = active & ~equal
    softness[unequal] = gap[unequal] / size[unequal]
    return np.where(active, np.where(equal, 1, np.sign(multipliers)), 0).astype(np.int8), softness


def _bound_residual(values: Vector, lower: Vector, upper: Vector, sides: Sides) -> Vector:
    bound = np.where(sides > 0, upper, lower)
    out = np.zeros(len(values))
    out[sides != 0] = (values - bound)[sides != 0]
    return out


_WEIGHT = 1e6  # of the augmented Lagrangian: it violates a constraint by its multiplier's change over this
_WEAK_MULTIPLIER = 1e-4  # below: the constraint is weakly active
_PROXIMAL = 1e-2  # on the Hessian's diagonal, so that variables that hardly matter stay
_MAX_QPS, _MAX_ACTIVE_SETS = 5, 20  # QPs of a prediction, active sets of a QP
_SHORT_STEP, _MAX_SHORT_STEPS = 0.1, 5  # a QP with so many short line searches stalls
_SUFFICIENT_VIOLATION = 1e-4  # no further QP is solved below it


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted solution: variables (n,), multipliers of constraints (m,) and bounds (n,).

    violation : largest violation of a constraint or bound.  steps : number of QPs.
    """

    x: Vector
    y: Vector
    z: Vector
    violation: float
    steps: int


class Predictor:
    """Predictor of solutions for changed parameters, from a known solution.

    A solver ends with some slack at active constraints, and with small multipliers of inactive ones. Both are
    kept, so that the prediction for unchanged parameters is the solution itself.
    """

    def __init__(self, program: NonlinearProgram, x: Vector, y: Vector, z: Vector) -> None:
        """x (n,), y (m,), z (n,) : as of `impactopt.solvers.program.SolverResult`."""
        self.x, self.y, self.z = x, y, z
        # A copy, as a program that is moved to other parameters may reuse its arrays.
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
        # free variables with bounds: these are not among the condenser's constraints
        self._free = np.zeros(program.n, dtype=bool)
        self._free[self._newton.condenser.free] = bounded[self._newton.condenser.free]
        # From here on constraints and variables are one list (m + n,), constraints first.
        lower, upper = self._bounds(program)
        self._equal = lower == upper
        limited = np.isfinite(lower) | np.isfinite(upper)
        self._unequal = i = np.flatnonzero(~self._equal & limited)  # inequalities, and bounds of variables
        values, own = np.concatenate([program.constraints(x), x])[i], np.concatenate([y, z])[i]
        self._weak = np.where(np.abs(own) < _WEAK_MULTIPLIER, own, 0.0)  # multipliers that stay constant
        slack = np.maximum(np.where(own > 0, upper[i] - values, values - lower[i]), 0.0)
        # A weak multiplier, or none, counts as inactive: there is no side to keep a slack from.
        self._slack = np.where(self._weak == own, 0.0, slack)  # of active constraints, which stays
        self._sides = np.sign(own - self._weak).astype(np.int8)

    def _bounds(self, program: NonlinearProgram) -> tuple[Vector, Vector]:
        """Bounds (m + n,) of constraints and variables; infinite for fixed variables."""
        lower = np.where(self._moves, program.x_lower, -np.inf)
        upper = np.where(self._moves, program.x_upper, np.inf)
        return np.concatenate([program.g_lower, lower]), np.concatenate([program.g_upper, upper])

    def predict(self, program: NonlinearProgram) -> Prediction | None:
        """Prediction for the same program with other parameters.

        None if the first QP is not solved, or the constraints are not finite at its solution.

        Each QP is linearized at the last one's solution; they end if constraints are met, or not met better.
        """
        found: Prediction | None = None
        x, y, z, sides = self.x, self.y, self.z, self._sides
        g = program.constraints(x)
        with threads().limit(limits=1, user_api="blas"):
            for k in range(_MAX_QPS):
                if not np.isfinite(g).all():
                    break
                qp = _QP(self, program, x, g, np.concatenate([y, z]))
                if not qp.solve(sides):
                    break
                # The augmented Lagrangian violates bounds by a multiplier's change over its weight.
                x = np.clip(x + qp.d, program.x_lower, program.x_upper)
                (y, z), sides, g = qp.multipliers(), qp.sides, program.constraints(x)
                violation = max_violation(program, x, g)
                if not violation < (np.inf if found is None else found.violation):
                    break
                found = Prediction(x=x, y=y, z=z, violation=violation, steps=k + 1)
                if violation <= _SUFFICIENT_VIOLATION:
                    break
        return found


class _QP:
    """Minimize 1/2 d'Hd + q'd with all constraints and bounds linearized at x.

    Attributes
    ----------
    d : the step (n,).  sides : at which the inequalities are active.
    """

    def __init__(self, of: Predictor, program: NonlinearProgram, x: Vector, g: Vector, own: Vector) -> None:
        """g (m,) : constraints at x.  own (m + n,) : multipliers of constraints and bounds."""
        self._of, self._newton = of, of._newton
        self._m, i = program.m, of._unequal
        self._jacobian: Matrix = program.jacobian(x)
        lower, upper = of._bounds(program)
        values = np.concatenate([g, x])
        self._off = np.where(of._equal, values - lower, 0.0)  # residuals (m + n,) of equalities
        # Equal bounds are those of fixed variables, which the Newton system does not move.
        self._off[program.m :] = 0.0
        self._values = values[i]
        # active constraints keep the slack that the known solution has
        self._lower = lower[i] + np.where(of._sides < 0, of._slack, 0.0)
        self._upper = upper[i] - np.where(of._sides > 0, of._slack, 0.0)
        # and weakly active ones the multiplier, which is a constant part of the gradient
        self._own = own[i] - of._weak
        self._constant = np.zeros(len(values))
        self._constant[i] = of._weak
        self._gradient = program.gradient(x)
        self._q = self._gradient + self._transposed_product(self._constant)
        self.d, self.sides = np.zeros(len(x)), of._sides

    def _transposed_product(self, multipliers: Vector) -> Vector:
        """J'y + z (n,) for multipliers (m + n,)."""
        out: Vector = self._jacobian.T @ multipliers[: self._m] + multipliers[self._m :]
        return out

    def solve(self, sides: Sides) -> bool:
        """Find the solution's active set by Newton steps from another one; False if they stall.

        If the active set still changes after `_MAX_ACTIVE_SETS` steps, the last step counts as the solution.
        """
        i, short = self._of._unequal, 0
        at = np.zeros(len(i))  # change of the inequalities' linearized values by d
        for k in range(_MAX_ACTIVE_SETS):
            # The exact minimum for this active set; the QP is solved if its active set is the same.
            d = self._step(sides)
            if d is None or not np.isfinite(d).all():
                return False
            moved = np.concatenate([self._jacobian @ d, d])[i]
            # later steps minimize the augmented Lagrangian: full ones may cycle between active sets
            length = 1.0 if not k else self._length(d - self.d, at, moved - at)
            short += length < _SHORT_STEP
            if short == _MAX_SHORT_STEPS:
                return False
            self.d, at = self.d + length * (d - self.d), at + length * (moved - at)
            new = np.sign(self._inequality_multipliers(at)).astype(np.int8)
            settled = bool((new == sides).all())
            self.sides = sides = new
            if settled:
                break
        return True

    def _inequality_multipliers(self, at: Vector) -> Vector:
        """Augmented Lagrangian's multipliers of inequalities whose linearized values changed by ``at``."""
        values, weight = self._values + at, _WEIGHT
        above = self._own + weight * (values - self._upper)
        below = self._own + weight * (values - self._lower)
        out: Vector = np.where(above > 0, above, np.where(below < 0, below, 0.0))
        return out

    def _step(self, sides: Sides) -> Vector | None:
        """Minimum (n,) of the augmented Lagrangian for an active set; None if it cannot be factored."""
        c, of, m, i = self._newton.condenser, self._of, self._m, self._of._unequal
        weights, off = np.zeros(len(self._off)), self._off.copy()
        active = sides != 0
        weights[i[active]] = _WEIGHT
        bound = np.where(sides > 0, self._upper, self._lower)[active]
        # y = own + weight (linearized value - bound) as weight (J d + off)
        off[i[active]] = self._values[active] - bound + self._own[active] / _WEIGHT
        of_free = weights[m:] * of._free  # a diagonal, as these bounds are no constraints of the condenser
        condensed = np.concatenate([weights[:m], weights[m:][c.bounded]])[c.remaining]
        factored = self._newton.factor(
            self._jacobian,
            of._hessian,
            of_free[c.free],
            # Unlike those of a barrier's slacks, these weights do not depend on the shift.
            lambda shift: condensed,
            hard=True,
            proximal=_PROXIMAL,
        )
        if not factored:
            return None
        d, found = self._newton.solve(
            self._q + of_free * off[m:], np.concatenate([off[:m], off[m:][c.bounded]])
        )
        self._y = np.zeros(len(self._off))
        self._y[:m] = found[:m]
        self._y[m:][c.bounded] = found[m:]
        # The bounds of free variables are a diagonal of the matrix, so their
        # multipliers are weight x (d + off).
        self._y[m:] += of_free * (d + off[m:])
        return d

    def _length(self, step: Vector, at: Vector, along: Vector) -> float:
        """Step length that minimizes the augmented Lagrangian along a step (n,), 1 at most.

        at, along : changes of the inequalities' linearized values, so far and by the step.
        """
        hessian, shift = self._of._hessian, _PROXIMAL + self._newton.shift
        # The augmented Lagrangian is convex and piecewise quadratic: its slope rises piecewise linearly.
        linear = float((self._q + hessian @ self.d + shift * self.d) @ step)
        square = float(step @ (hessian @ step) + shift * (step @ step))

        def slope(length: float) -> float:
            multipliers = self._inequality_multipliers(at + length * along)
            return linear + length * square + float(multipliers @ along)

        # brentq needs a change of sign. A slope that is still negative at the end
        # makes the full step the best.
        if slope(1.0) <= 0 or slope(0.0) >= 0:
            return 1.0
        return float(brentq(slope, 0.0, 1.0, xtol=1e-6))

    def multipliers(self) -> tuple[Vector, Vector]:
        """Multipliers of constraints (m,) and bounds (n,) for the last active set."""
        found = self._y + self._constant
        y, z = found[: self._m], found[self._m :].copy()
        fixed = ~self._of._moves
        # What makes a fixed variable stationary, as in `BarrierProblem.update_multipliers`.
        z[fixed] = -(self._gradient + self._jacobian.T @ y + self._of._hessian @ self.d)[fixed]
        return y, z
