"""A nonlinear program made of small compiled blocks on affine lifts of the variables.

Every nonlinear function is ``block(S x + c)`` with a constant sparse S, so the Jacobian's and the Hessian's
nonzeros are a *constant* linear map of the blocks' own nonzeros.  That map is built once; an evaluation is:
lift, call the compiled blocks without Python in the loop, and add their numbers up, run by run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from impactopt.kinematics.stages import Stage
from impactopt.solvers.program import Determined
from impactopt.transcription.batched import Block
from impactopt.transcription.chain_rule import derivatives
from impactopt.transcription.constraints import Rows
from impactopt.transcription.layout import Affine, Array, Layout, stack
from impactopt.transcription.sparsity import HessianMap, JacobianMap


class StructuredProgram:
    """The assembled program; implements :class:`impactopt.solvers.program.NonlinearProgram`."""

    def __init__(
        self,
        layout: Layout,
        blocks: Sequence[Block],
        rows: Rows,
        *,
        objective: Affine,
        quadratic: sp.spmatrix | sp.sparray,
        linear: Array,
        determined: Sequence[Determined] = (),
    ) -> None:
        """Minimize  objective(x) + 1/2 x'Qx + q'x  subject to ``rows`` and the layout's bounds.

        determined : variables that equality constraints of their own determine.
        """
        self.determined = tuple(determined)
        self.layout, self.blocks, self.origins = layout, tuple(blocks), tuple(rows.origins)
        n = self.n = layout.n
        self.x_lower, self.x_upper = layout.lower, layout.upper
        lift = stack([b.lift for b in blocks])
        self._lift, self._lift_const = lift.matrix(n), lift.const
        self._z_offset = np.cumsum([0] + [b.count * b.n_in for b in blocks])
        self._out_offset = np.cumsum([0] + [b.count * b.n_out for b in blocks])
        linear_rows = stack(rows.affine)
        self._row_out = np.concatenate([np.zeros(0, dtype=np.intp), *rows.outputs])
        self._nonlinear = np.flatnonzero(self._row_out >= 0)
        self._of_nonlinear = self._row_out[self._nonlinear]
        self.m = len(self._row_out)
        self._rows_matrix, self._rows_const = linear_rows.matrix(n), linear_rows.const
        self.g_lower = np.concatenate([np.zeros(0), *rows.lower])
        self.g_upper = np.concatenate([np.zeros(0), *rows.upper])
        self._at: tuple[Array, list[Array]] | None = None  # where functions were last asked for
        self._take_objective(objective, quadratic, linear)
        self.seconds = 0.0

    def take_numbers(
        self,
        layout: Layout,
        blocks: Sequence[Block],
        rows: Rows,
        *,
        objective: Affine,
        quadratic: sp.spmatrix | sp.sparray,
        linear: Array,
    ) -> None:
        """The numbers of another program of the same structure, whose blocks and constraints are the first of
        this one's; the others keep theirs.

        Blocks and constraints touch the same variables, with the same weights: what differs are bounds,
        constants and parameters.
        """
        self.x_lower, self.x_upper = layout.lower, layout.upper
        for mine, other in zip(self.blocks, blocks, strict=False):
            mine.take_parameters(other.parameters)
        offset = np.concatenate([np.zeros(0), *(b.lift.const for b in blocks)])
        self._lift_const = np.concatenate([offset, self._lift_const[len(offset) :]])
        for name, given in (("g_lower", rows.lower), ("g_upper", rows.upper)):
            found = np.concatenate([np.zeros(0), *given])
            setattr(self, name, np.concatenate([found, getattr(self, name)[len(found) :]]))
        constants = np.concatenate([np.zeros(0), *(affine.const for affine in rows.affine)])
        self._rows_const = np.concatenate([constants, self._rows_const[len(constants) :]])
        self._at = None
        self._take_objective(objective, quadratic, linear)

    def _take_objective(self, affine: Affine, quadratic: sp.spmatrix | sp.sparray, linear: Array) -> None:
        """affine(x) + 1/2 x'Qx + q'x."""
        self._c = np.zeros(self.n)
        np.add.at(self._c, affine.cols, affine.vals)
        self._c += linear
        self._c0, self._Q = float(affine.const.sum()), sp.csc_array(quadratic)

    def same_numbers(self, other: StructuredProgram) -> bool:
        """True if bounds, constants, weights and parameters equal those of another program, to rounding."""
        mine, its = self._numbers(), other._numbers()
        return len(mine) == len(its) and all(
            a.shape == b.shape and np.allclose(a, b, rtol=1e-12, atol=1e-12)
            for a, b in zip(mine, its, strict=True)
        )

    def _numbers(self) -> list[Array]:
        matrices = self._lift, self._rows_matrix, self._Q
        return [
            *(self.x_lower, self.x_upper, self.g_lower, self.g_upper),
            *(self._lift_const, self._rows_const, self._c, np.array([self._c0])),
            *(part for matrix in matrices for part in (matrix.data, matrix.indices, matrix.indptr)),
            *(b.parameters for b in self.blocks),
        ]

    # ------------------------------------------------------------------ evaluation
    @cached_property
    def _jacobian(self) -> JacobianMap:
        row_of_out = np.full(int(self._out_offset[-1]), -1, dtype=np.intp)
        row_of_out[self._of_nonlinear] = self._nonlinear
        return JacobianMap(self.blocks, self._lift, row_of_out, self._rows_matrix)

    @cached_property
    def _hessian(self) -> HessianMap:
        return HessianMap(self.blocks, self._lift, self._Q)

    def _lifted(self, x: Array) -> list[Array]:
        if self._at is not None and np.array_equal(self._at[0], x):
            return self._at[1]
        z = self._lift @ x + self._lift_const
        parts = [
            z[a : a + b.count * b.n_in].reshape(b.count, b.n_in)
            for a, b in zip(self._z_offset, self.blocks, strict=False)
        ]
        self._at = x.copy(), parts
        return parts

    def outputs(self, x: Array) -> dict[str, Array]:
        """Every block's outputs, name -> (count, n_out); of several of one name the last's."""
        return {b.name: b.value(z).copy() for b, z in zip(self.blocks, self._lifted(x), strict=True)}

    def all_outputs(self, x: Array) -> Array:
        """Outputs of all blocks one after the other, as constraints and lifted variables number them."""
        return np.concatenate([b.value(z).ravel() for b, z in zip(self.blocks, self._lifted(x), strict=True)])

    def objective(self, x: Array) -> float:
        return float(self._c0 + self._c @ x + 0.5 * (x @ (self._Q @ x)))

    def gradient(self, x: Array) -> Array:
        return self._c + self._Q @ x

    def constraints(self, x: Array) -> Array:
        t = time.perf_counter()
        g = self._rows_matrix @ x + self._rows_const
        if self.blocks:
            g[self._nonlinear] += self.all_outputs(x)[self._of_nonlinear]
        self.seconds += time.perf_counter() - t
        return g

    def jacobian(self, x: Array) -> sp.csc_array:
        t = time.perf_counter()
        found = self._jacobian  # blocks write where it reads
        for b, z in zip(self.blocks, self._lifted(x), strict=True):
            b.jacobian(z)
        out = found.matrix()
        self.seconds += time.perf_counter() - t
        return out

    def hessian(self, x: Array, sigma: float, multipliers: Array) -> sp.csc_array:
        t = time.perf_counter()
        found, lam = self._hessian, np.zeros(int(self._out_offset[-1]))
        lam[self._of_nonlinear] = multipliers[self._nonlinear]
        for b, z, o in zip(self.blocks, self._lifted(x), self._out_offset, strict=False):
            b.hessian(z, lam[o : o + b.count * b.n_out].reshape(b.count, b.n_out))
        out = found.matrix(sigma)
        self.seconds += time.perf_counter() - t
        return out

    # ------------------------------------------------------------------ names
    def row_name(self, i: int) -> str:
        return str(self.origins[i])

    def row_group(self, i: int) -> tuple[str, str]:
        """Its term and place: the constraints that one message stands for."""
        return self.origins[i].term, self.origins[i].place.name

    def describe_violation(self, i: int, x: Array, amount: float) -> tuple[str, str]:
        """Row i at x, and how far it is from being met: as a person reads it."""
        return self.origins[i].told(x, amount)

    def variable_name(self, j: int) -> str:
        return self.layout.name(j)


def derivative_functions(name: str, z: Any, p: Any, out: Any, through: Sequence[Stage] = ()) -> list[Any]:
    """A block's three functions of (z, p).

    ``name`` (z, p) -> out, ``name_jac`` (z, p) -> d out/dz,
    ``name_hess`` (z, p, lam) -> lower triangle of d2(lam.out)/dz2.

    through : what ``out`` is written with.
    """
    lam = ca.SX.sym("lam", out.numel())
    out, jac, hess = derivatives(z, ca.densify(out), lam, through)
    return [
        ca.Function(name, [z, p], [out]),
        ca.Function(f"{name}_jac", [z, p], [jac]),
        ca.Function(f"{name}_hess", [z, p, lam], [ca.tril(hess)]),
    ]
