"""The KKT system at a solution with its active set: what small changes of a program do to its solution.

Source: Fiacco, "Introduction to sensitivity and stability analysis in nonlinear programming" (1983), ch. 3:
where active constraints are independent, their multipliers are not zero and the second-order condition holds,
the solution is a smooth function of a parameter, by the implicit function theorem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from impactopt.errors import InputError
from impactopt.solvers.program import NonlinearProgram, Vector

__all__ = ["ActiveSystem", "Change", "Offset"]

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
