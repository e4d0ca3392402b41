"""Derivatives of what is written in stages, put together by the chain rule.

With respect to what it is written with, a function has few derivatives, and so has each stage. Together they
take fewer operations than those of the function with all that is in it written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from impactopt.kinematics.coordinates import solve_in_order
from impactopt.kinematics.stages import Stage

__all__ = ["derivatives"]


def derivatives(z: Any, out: Any, weights: Any, stages: Sequence[Stage] = ()) -> list[Any]:
    """``out`` (m,) of z (n,), its Jacobian (m, n) and the Hessian (n, n) of ``weights . out``, SX.

    stages : what ``out`` is written with; each may be written with those before it.
    """
    symbols = [stage.symbols for stage in stages]
    both = ca.vertcat(z, *symbols)
    jac = ca.jacobian(out, both)
    slopes = ca.gradient(ca.dot(weights, out), both)
    hess = ca.jacobian(slopes, both)
    for k in reversed(range(len(stages))):
        before = ca.vertcat(z, *symbols[:k])
        n = before.numel()
        inner, bends = _slopes_and_bends(before, stages[k], slopes[n:])
        hess += bends
        crossed = ca.mtimes(inner.T, hess[n:, :n])
        hess = hess[:n, :n] + crossed + crossed.T + ca.mtimes(ca.mtimes(inner.T, hess[n:, n:]), inner)
        jac = jac[:, :n] + ca.mtimes(jac[:, n:], inner)
        slopes = slopes[:n] + ca.mtimes(inner.T, slopes[n:])
    values: list[Any] = []
    for k, stage in enumerate(stages):
        values += ca.substitute([stage.expression], symbols[:k], values)
    found: list[Any] = ca.substitute([out, jac, hess], symbols, values)
    return found


def _slopes_and_bends(before: Any, stage: Stage, along: Any) -> tuple[Any, Any]:
    """Slopes (k, n) of a stage's numbers, and what its second derivatives add to a Hessian (n + k, n + k) by
    what is before them and by them, where they are weighted with ``along`` (k,).
    """
    weights = ca.SX.sym("along", along.numel())
    if stage.zero is None:
        bends = ca.jacobian(ca.gradient(ca.dot(weights, stage.expression), before), before)
        k = along.numel()
        bends = ca.diagcat(bends, ca.SX(k, k))
        return ca.jacobian(stage.expression, before), ca.substitute(bends, weights, along)
    both, first = ca.vertcat(before, stage.symbols), 0
    right, slopes, adjoint = ca.jacobian(stage.zero, before), [], []
    for matrix, (rows, columns) in stage.blocks:
        at = slice(first, first + matrix.size1())
        moved = [j for j in range(before.numel()) if right[at, j].nnz()]
        solved = solve_in_order(matrix, -right[at, moved], (rows, columns))[0]
        part = ca.SX(matrix.size1(), before.numel())
        part[:, moved] = solved
        slopes.append(ca.sparsify(part))
        # the same pivots eliminate the transposed
        adjoint.append(solve_in_order(matrix.T, along[at], (columns, rows))[0])
        first = at.stop
    bends = ca.jacobian(ca.gradient(ca.dot(weights, stage.zero), both), both)
    return ca.vertcat(*slopes), -ca.substitute(bends, weights, ca.vertcat(*adjoint))
