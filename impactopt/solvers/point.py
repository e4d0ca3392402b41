"""An iterate with what has been evaluated there, and the functions that evaluate it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from impactopt.solvers.program import Matrix, NonlinearProgram, Vector, max_violation, row_violations


@dataclass(frozen=True, kw_only=True)
class Point:
    """f and g at x, and their derivatives, evaluated when first asked for."""

    x: Vector
    objective: float
    g: Vector
    program: TimedProgram

    @cached_property
    def finite(self) -> bool:
        """True if f and g are finite."""
        return bool(np.isfinite(self.objective) and np.isfinite(self.g).all())

    @cached_property
    def differentiable(self) -> bool:
        """True if f, g and their derivatives are finite."""
        if not self.finite:
            return False
        try:
            return bool(np.isfinite(self.gradient).all() and np.isfinite(self.jacobian.data).all())
        except (ArithmeticError, np.linalg.LinAlgError):
            return False

    @cached_property
    def gradient(self) -> Vector:
        """df/dx (n,)."""
        return np.asarray(self.program.gradient(self.x), dtype=np.float64)

    @cached_property
    def jacobian(self) -> Matrix:
        """dg/dx, csc_array (m, n)."""
        found = self.program.jacobian(self.x)
        return found if isinstance(found, sp.csc_array) else sp.csc_array(found)

    @cached_property
    def rows(self) -> Matrix:
        """dg/dx by rows, csr_array (m, n)."""
        return self.jacobian.tocsr()

    @cached_property
    def row_norms(self) -> Vector:
        """Euclidean norms of the rows of the Jacobian (m,); 1 for zero rows."""
        norms = np.sqrt(np.asarray(self.jacobian.multiply(self.jacobian).sum(axis=1)).ravel())
        return np.where(norms > 1e-12, norms, 1.0)

    @cached_property
    def violation(self) -> float:
        """Weighted sum of the violations of the rows; inf where not finite."""
        return float(self.program.weights @ row_violations(self.program, self.g)) if self.finite else np.inf

    @cached_property
    def max_violation(self) -> float:
        """Largest violation of a row or a bound."""
        return max_violation(self.program, self.x, self.g)


class TimedProgram:
    """A program that adds up the seconds spent in its functions, and weighs its rows.

    Attributes
    ----------
    seconds : spent in the program's functions.
    weights : of the rows in the merit function (m,).
    """

    def __init__(self, program: NonlinearProgram):
        self.seconds = 0.0
        self.n, self.m = program.n, program.m
        self.x_lower, self.x_upper = np.asarray(program.x_lower, float), np.asarray(program.x_upper, float)
        self.g_lower, self.g_upper = np.asarray(program.g_lower, float), np.asarray(program.g_upper, float)
        self.weights = np.ones(program.m)
        self.row_name, self.variable_name = program.row_name, program.variable_name
        for name in ("objective", "gradient", "constraints", "jacobian", "hessian"):
            setattr(self, name, self._timed(getattr(program, name)))

    objective: Callable[[Vector], float]
    gradient: Callable[[Vector], Vector]
    constraints: Callable[[Vector], Vector]
    jacobian: Callable[[Vector], Matrix]
    hessian: Callable[[Vector, float, Vector], Matrix]

    def point(self, x: Vector) -> Point:
        """Evaluate f and g; where they cannot be computed (ArithmeticError, LinAlgError) they are nan."""
        try:
            objective, g = float(self.objective(x)), np.asarray(self.constraints(x), dtype=np.float64)
        except (ArithmeticError, np.linalg.LinAlgError):
            objective, g = np.nan, np.full(self.m, np.nan)
        return Point(x=x, objective=objective, g=g, program=self)

    def unknown(self, x: Vector) -> Point:
        """The point before anything is evaluated."""
        return Point(x=x, objective=np.nan, g=np.full(self.m, np.nan), program=self)

    def weigh(self, point: Point) -> None:
        """Weigh rows whose gradient is longer than 1 by its length, so that a price suits all rows alike."""
        self.weights = 1.0 / np.clip(point.row_norms, 1.0, 1e6)

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - begin

        return timed
