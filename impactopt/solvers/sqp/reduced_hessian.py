"""Convex quadratic models in the directions that a reduction leaves: exact, made convex, or BFGS."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from impactopt.solvers.options import SQPOptions
from impactopt.solvers.point import Point, TimedProgram
from impactopt.solvers.program import Matrix, Vector
from impactopt.solvers.sqp.reduction import Reduction

_FLOOR = 1e-5  # least eigenvalue
# weights of active rows that are tried in making the Hessian convex: they change no step that keeps the rows
_ACTIVE = (0.0, 10.0, 1e2, 1e3, 1e4)
_LEARNED = 1e-3  # least eigenvalue of what BFGS has learned
_FIRST = 1e-2  # curvature that BFGS begins with
_STEEPEST = 1e4  # that it learns
_SHIFT = 1e-4  # least of a sparse Hessian that is not convex
_STEEP = 0.1  # curvature where only the violation counts
Active = Callable[[], Matrix]


@dataclass(frozen=True)
class ReducedModel:
    """gradient . d + 1/2 t'Bt of a step d = d0 + T t, B (r, r) positive definite.

    leads : whether it is of the objective; else of the violation alone.
    """

    B: Matrix  # it, T and of_start are dense or sparse, as the reduction is
    gradient: Vector
    T: Matrix
    of_start: Matrix | None  # T' H (r, n): what d0 adds to the gradient
    leads: bool = True

    def slope(self, d0: Vector) -> Vector:
        """Gradient by t where the step d0 is made already."""
        out = self.T.T @ self.gradient
        return np.asarray(out if self.of_start is None else out + self.of_start @ d0)


class ModelRule(Protocol):
    """Makes the model at a point."""

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        """Model of the Lagrangian with multipliers y (m,); active: gives the unit rows (a, r) that hold;
        objective: whether it counts, or the violation alone.
        """
        ...

    def forget(self) -> None:
        """Forget what was learned from earlier points."""
        ...


class ExactModel:
    """The exact Hessian in these directions, its eigenvalues lifted where active rows leave them negative."""

    def __init__(self, program: TimedProgram, reduction: Reduction):
        self._program, self._reduction = program, reduction
        self._shift = 0.0

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        T = self._reduction.T
        if not objective:
            return _steep(point, T)
        # far from a solution multipliers may be anything
        H = self._program.hessian(point.x, 1.0, y)
        of_start = T.T @ H
        B = of_start @ T
        if self._reduction.sparse:
            return ReducedModel(self._lifted(0.5 * (B + B.T), active()), point.gradient, T, of_start)
        return ReducedModel(_convex(0.5 * (B + B.T), active()), point.gradient, T, of_start)

    def forget(self) -> None:
        self._shift = 0.0

    def _lifted(self, B: Matrix, active: Matrix) -> Matrix:
        """B with a weight of active rows, and a multiple of the identity, that make it convex and keep it
        sparse."""
        rows, identity = active.T @ active, sp.eye_array(B.shape[0], format="csc")
        for weight in _ACTIVE[:2]:
            if _is_convex(made := B + weight * rows):
                self._shift /= 3.0
                return made
        self._shift = max(self._shift / 3.0, _SHIFT)
        while not _is_convex(lifted := made + self._shift * identity):
            self._shift *= 4.0
        return lifted


class BFGSModel:
    """Powell's damped update of the reduced Hessian in the free variables (Nocedal, Wright 2006, 18.3)."""

    def __init__(self, reduction: Reduction):
        self._reduction = reduction
        self.forget()

    def forget(self) -> None:
        self._B = _FIRST * np.eye(self._reduction.free.size)
        self._last: tuple[Point, np.ndarray] | None = None

    def at(self, point: Point, y: Vector, active: Active, objective: bool) -> ReducedModel:
        reduction = self._reduction
        if not objective:
            return _steep(point, reduction.T)
        if self._last is None or self._last[0] is not point:
            if self._last is not None:
                self._update(point, y)
            self._last = point, reduction.basis
        free = reduction.T[reduction.free]
        of_start = np.zeros((free.shape[1], reduction.T.shape[0]))
        of_start[:, reduction.free] = free.T @ self._B
        B = of_start @ reduction.T
        values, vectors = la.eigh(0.5 * (B + B.T), check_finite=False)
        B = (vectors * np.maximum(values, _LEARNED)) @ vectors.T
        return ReducedModel(B, point.gradient, reduction.T, of_start)

    def _update(self, point: Point, y: Vector) -> None:
        """Update with multipliers that are the same at both points: of rows, and of equalities that determine
        nothing, which steps have to follow as they bend. What the others determine is in the gradients."""
        assert self._last is not None
        before, basis = self._last
        reduction = self._reduction
        only = np.zeros_like(y)
        only[reduction.rows], only[reduction.left] = y[reduction.rows], y[reduction.left]
        step = (point.x - before.x)[reduction.free]
        change = reduction.gradient(point.gradient + point.jacobian.T @ only)
        change = change - basis.T @ (before.gradient + before.jacobian.T @ only)
        Bs = self._B @ step
        sBs, sy = float(step @ Bs), float(step @ change)
        if sBs < 1e-16:
            return
        # procedure 18.2: a change of the gradient that shows too little curvature is mixed with Bs until
        # s'r is 0.2 s'Bs, so that B stays positive definite
        theta = 1.0 if sy >= 0.2 * sBs else 0.8 * sBs / (sBs - sy)
        r = theta * change + (1.0 - theta) * Bs
        if float(r @ r) > _STEEPEST * float(step @ r):
            return  # a kink between the two points, and no curvature
        self._B = self._B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / float(step @ r)


def _is_convex(B: Matrix) -> bool:
    try:
        la.cholesky(B.toarray() - _FLOOR * np.eye(B.shape[0]), overwrite_a=True, check_finite=False)
    except la.LinAlgError:
        return False
    return True


def _convex(B: np.ndarray, active: np.ndarray) -> np.ndarray:
    """B with the least weight of active rows that makes it convex; else eigenvalues are lifted."""
    rows, floor = active.T @ active, _FLOOR * np.eye(len(B))
    for weight in _ACTIVE if len(active) else _ACTIVE[:1]:
        made = B + weight * rows
        with contextlib.suppress(la.LinAlgError):
            la.cholesky(made - floor, check_finite=False)
            return np.asarray(made)
    values, vectors = la.eigh(B + _ACTIVE[1] * rows, check_finite=False)
    return np.asarray((vectors * np.maximum(values, _FLOOR)) @ vectors.T)


def _steep(point: Point, T: Matrix) -> ReducedModel:
    B = _STEEP * (sp.eye_array(T.shape[1], format="csc") if sp.issparse(T) else np.eye(T.shape[1]))
    return ReducedModel(B, np.zeros_like(point.gradient), T, None, leads=False)


def make_model(program: TimedProgram, options: SQPOptions, reduction: Reduction) -> ModelRule:
    """The rule that the options name."""
    return ExactModel(program, reduction) if options.hessian == "exact" else BFGSModel(reduction)
