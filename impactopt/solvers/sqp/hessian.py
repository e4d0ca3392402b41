"""Convex quadratic models of the Lagrangian: the exact Hessian made convex, or damped BFGS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from impactopt.solvers.program import Matrix, NonlinearProgram, Vector
from impactopt.solvers.sqp.options import SQPOptions
from impactopt.solvers.sqp.point import Point


@dataclass(frozen=True, kw_only=True)
class ActiveRows:
    """The rows and bounds expected to hold at the solution, as A d = r: unit rows A (k, n) sparse, r (k,)."""

    A: Matrix
    r: Vector


@dataclass(frozen=True, kw_only=True)
class QuadraticModel:
    """gradient . d + 1/2 d'Bd, B positive definite, the objective of the QP; and what of it predicts f.

    B holds weight * A'A and gradient -weight * A'r of the active rows, which cancel where A d = r. They
    belong to no function, so `change` leaves them out.
    """

    gradient: Vector
    B: Matrix
    objective_gradient: Vector
    weight: float
    active: ActiveRows

    def change(self, d: Vector) -> float:
        """Predicted change of the objective by a step d."""
        rows = self.active.A @ d
        return float(self.objective_gradient @ d + 0.5 * (d @ (self.B @ d) - self.weight * (rows @ rows)))


class HessianRule(Protocol):
    """Makes the quadratic model at a point."""

    def model(self, point: Point, sigma: float, y: Vector, active: ActiveRows) -> QuadraticModel:
        """The model of sigma f + y . g at the point."""
        ...


class ExactHessian:
    """The exact Hessian, made convex where the active rows do not make it so by themselves.

    At a strict optimum the Hessian is positive definite on the active rows' null space only. Adding weight *
    A'A changes nothing there (an augmented Lagrangian; Nocedal and Wright 2006, theorem 17.5) and makes it
    positive definite as a whole for a weight large enough. What is negative still is lifted: eigenvalue by
    eigenvalue where the matrix is small, by a multiple of the identity where it is large.
    """

    def __init__(self, program: NonlinearProgram, options: SQPOptions):
        self._program, self._options = program, options
        self._shift = 0.0

    def model(self, point: Point, sigma: float, y: Vector, active: ActiveRows) -> QuadraticModel:
        H = sp.csc_array(self._program.hessian(point.x, sigma, y))
        norm = max(float(np.abs(H).sum(axis=0).max()), 1e-3)
        weight = self._options.augmentation * norm
        B = sp.csc_array(H + weight * (active.A.T @ active.A)) if active.r.size else H
        floor = self._options.curvature_floor * norm
        B = (
            self._clip(B, floor)
            if self._program.n <= self._options.dense_limit
            else self._lift(B, floor, norm)
        )
        return QuadraticModel(
            gradient=sigma * point.gradient - weight * (active.A.T @ active.r),
            B=B,
            objective_gradient=sigma * point.gradient,
            weight=weight,
            active=active,
        )

    @staticmethod
    def _clip(B: Matrix, floor: float) -> Matrix:
        dense = B.toarray()
        values, vectors = la.eigh(0.5 * (dense + dense.T))
        if values[0] >= floor:
            return B
        return sp.csc_array((vectors * np.maximum(values, floor)) @ vectors.T)

    def _lift(self, B: Matrix, floor: float, norm: float) -> Matrix:
        # As in IPOPT: try none first, then start from a third of what was needed last.
        identity = sp.diags_array(np.ones(self._program.n), format="csc")
        B = sp.csc_array(B + floor * identity)
        if is_positive_definite(B):
            self._shift /= 3.0
            return B
        shift = max(self._shift / 3.0, 1e-4 * norm)
        while shift < 1e3 * norm:
            lifted = sp.csc_array(B + shift * identity)
            if is_positive_definite(lifted):
                break
            shift *= 4.0
        self._shift = shift
        return lifted


class DampedBFGS:
    """Powell's damped BFGS update of the Lagrangian's Hessian (Nocedal and Wright 2006, procedure 18.2)."""

    def __init__(self, program: NonlinearProgram, options: SQPOptions):
        self._program = program
        self._B: np.ndarray | None = None
        self._last: Point | None = None

    def model(self, point: Point, sigma: float, y: Vector, active: ActiveRows) -> QuadraticModel:
        n = self._program.n
        if self._last is not None and not np.array_equal(point.x, self._last.x):
            s = point.x - self._last.x
            change = (
                sigma * (point.gradient - self._last.gradient) + (point.jacobian - self._last.jacobian).T @ y
            )
            if self._B is None:
                self._B = np.eye(n) * np.clip(change @ change / max(abs(change @ s), 1e-12), 1e-2, 1e4)
            self._update(s, change)
        self._last = point
        B = sp.csc_array(self._B if self._B is not None else np.eye(n))
        gradient = sigma * point.gradient
        return QuadraticModel(gradient=gradient, B=B, objective_gradient=gradient, weight=0.0, active=active)

    def _update(self, s: Vector, change: Vector) -> None:
        assert self._B is not None
        Bs = self._B @ s
        sBs, sy = s @ Bs, s @ change
        if sBs < 1e-16:
            return
        theta = 1.0 if sy >= 0.2 * sBs else 0.8 * sBs / (sBs - sy)
        r = theta * change + (1.0 - theta) * Bs
        self._B = self._B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / (s @ r)


def make_hessian(program: NonlinearProgram, options: SQPOptions) -> HessianRule:
    """The rule that the options name."""
    return ExactHessian(program, options) if options.hessian == "exact" else DampedBFGS(program, options)


def is_positive_definite(B: Matrix) -> bool:
    """Whether a symmetric sparse matrix is positive definite: all pivots are, without interchanges."""
    try:
        factor = spla.splu(
            sp.csc_matrix(B),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError:  # a pivot is zero
        return False
    # An interchange happens only at a zero pivot.
    return bool((factor.perm_r == factor.perm_c).all() and (factor.U.diagonal() > 0.0).all())
