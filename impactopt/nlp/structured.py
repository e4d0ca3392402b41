"""A nonlinear program made of small compiled blocks on affine lifts of the variables.

Every nonlinear function is ``block(S x + c)`` with a constant sparse S, so the Jacobian's and the Hessian's
nonzeros are a *constant* linear map of the blocks' own nonzeros.  That map is built once; an evaluation is:
lift, call the compiled blocks without Python in the loop, and one sparse matrix-vector product.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from impactopt.nlp.batched import BatchedFunction
from impactopt.nlp.layout import Affine, Array, Layout, stack
from impactopt.nlp.rows import Index, Rank, Rows


@dataclass
class Block:
    """``count`` instances of a compiled function  out = f(z), its Jacobian and the Hessian of lambda.out."""

    name: str
    value: BatchedFunction
    jacobian: BatchedFunction
    hessian: BatchedFunction
    n_in: int
    n_out: int
    count: int
    lift: Affine  # (count * n_in)
    jac_pattern: tuple[Index, Index]
    hess_pattern: tuple[Index, Index]

    @classmethod
    def make(
        cls,
        name: str,
        functions: dict[str, Any],
        instances: Sequence[Sequence[Affine]],
        parameters: ArrayLike,
    ) -> Block:
        """``functions``: of one instance, or `in_lanes`; ``instances``: of each, the slots that make up z.

        ``parameters``: (n_p,) for all or (count, n_p).
        """
        f, j, h = functions[name], functions[f"{name}_jac"], functions[f"{name}_hess"]
        n_in, n_out = f.size1_in(0), f.size1_out(0)
        lifts = [stack(slots) for slots in instances]
        for lift in lifts:
            if lift.size != n_in:
                raise ValueError(f"block {name} takes {n_in} inputs, was given {lift.size}")
        count = len(lifts)
        p = np.broadcast_to(np.asarray(parameters, dtype=float), (count, f.size1_in(1)))
        value, jacobian, hessian = (BatchedFunction(function, count, p) for function in (f, j, h))
        return cls(
            name=name,
            value=value,
            jacobian=jacobian,
            hessian=hessian,
            n_in=n_in,
            n_out=n_out,
            count=count,
            lift=stack(lifts),
            jac_pattern=jacobian.pattern,
            hess_pattern=hessian.pattern,
        )


class StructuredProgram:
    """The assembled program; implements :class:`impactopt.program.NonlinearProgram`."""

    def __init__(
        self,
        layout: Layout,
        blocks: Sequence[Block],
        rows: Rows,
        *,
        objective: Affine,
        quadratic: sp.spmatrix | sp.sparray,
        linear: Array,
        determined: Sequence[tuple[Rank, Index]] = (),
        sequence: Array | None = None,
    ) -> None:
        """Minimize  objective(x) + 1/2 x'Qx + q'x  subject to ``rows`` and the layout's bounds.

        determined : variables that equality rows of their own determine, with their rank in eliminating them.
        sequence (n,) : place of the variables along the motion; near ones share rows.
        """
        self.determined, self.sequence = tuple(determined), sequence
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
        self.m = len(self._row_out)
        self._rows_matrix, self._rows_const = linear_rows.matrix(n), linear_rows.const
        self.g_lower = np.concatenate([np.zeros(0), *rows.lower])
        self.g_upper = np.concatenate([np.zeros(0), *rows.upper])
        self._c = np.zeros(n)
        np.add.at(self._c, objective.cols, objective.vals)
        self._c += linear
        self._c0 = float(objective.const.sum())
        self._Q = sp.csc_array(quadratic)
        self._build_jacobian()
        self._build_hessian()
        self.seconds = 0.0
        self._x: Array | None = None

    # ------------------------------------------------------------------ constant maps
    def _expand(self, z_index: Index) -> tuple[Index, Index, Array]:
        """For lifted indices z: (position in z_index, x column, coefficient) of every term."""
        S = self._lift
        count = S.indptr[z_index + 1] - S.indptr[z_index]
        owner = np.repeat(np.arange(len(z_index)), count)
        start = np.repeat(S.indptr[z_index] - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
        where = start + np.arange(len(owner))
        return owner, S.indices[where].astype(np.intp), S.data[where]

    def _build_jacobian(self) -> None:
        n_out = int(self._out_offset[-1])
        row_of_out = np.full(n_out, -1, dtype=np.intp)
        row_of_out[self._row_out[self._nonlinear]] = self._nonlinear
        r_all, c_all, e_all, s_all, start = [], [], [], [], 0
        for b, z0, o0 in zip(self.blocks, self._z_offset, self._out_offset, strict=False):
            jr, jc = b.jac_pattern
            inst = np.repeat(np.arange(b.count), len(jr))
            out = o0 + inst * b.n_out + np.tile(jr, b.count)
            z = z0 + inst * b.n_in + np.tile(jc, b.count)
            entry = start + np.arange(len(out))
            start += len(out)
            keep = row_of_out[out] >= 0
            owner, col, coef = self._expand(z[keep])
            r_all.append(row_of_out[out[keep]][owner])
            c_all.append(col)
            e_all.append(entry[keep][owner])
            s_all.append(coef)
        lin = self._rows_matrix.tocoo()
        r = np.concatenate([*r_all, lin.coords[0]])
        c = np.concatenate([*c_all, lin.coords[1]])
        nonlinear = sum(len(x) for x in r_all)
        key, slot = np.unique(c.astype(np.int64) * self.m + r, return_inverse=True)
        self._jac_rows, jac_cols = (key % self.m).astype(np.int32), key // self.m
        self._jac_indptr = np.searchsorted(jac_cols, np.arange(self.n + 1)).astype(np.int32)
        self._jac_map = _sums(slot[:nonlinear], e_all, s_all, (len(key), start))
        self._jac_const = np.bincount(slot[nonlinear:], lin.data, len(key))

    def _build_hessian(self) -> None:
        """The map gives the lower triangle; the whole is taken from that."""
        r_all, c_all, e_all, s_all, start = [], [], [], [], 0
        for b, z0 in zip(self.blocks, self._z_offset, strict=False):
            hr, hc = b.hess_pattern  # lower triangle
            inst = np.repeat(np.arange(b.count), len(hr))
            zr, zc = z0 + inst * b.n_in + np.tile(hr, b.count), z0 + inst * b.n_in + np.tile(hc, b.count)
            entry = start + np.arange(len(zr))
            start += len(zr)
            # rows' terms, then for each of them the columns' terms
            o1, i1, s1 = self._expand(zr)
            o2, i2, s2 = self._expand(zc[o1])
            r, c, s, e = i1[o2], i2, s1[o2] * s2, entry[o1[o2]]
            # an entry below the diagonal of z stands for the one above it too: for (r, c) and (c, r) of x
            off = (zr != zc)[o1[o2]]
            s = np.where(off & (r == c), 2 * s, s)
            keep = off | (r >= c)
            r_all.append(np.maximum(r, c)[keep])
            c_all.append(np.minimum(r, c)[keep])
            e_all.append(e[keep])
            s_all.append(s[keep])
        q = sp.tril(self._Q).tocoo()
        r = np.concatenate([*r_all, q.coords[0]])
        c = np.concatenate([*c_all, q.coords[1]])
        nonlinear = sum(len(x) for x in r_all)
        key, slot = np.unique(c.astype(np.int64) * self.n + r, return_inverse=True)
        self._hess_map = _sums(slot[:nonlinear], e_all, s_all, (len(key), start))
        self._hess_const = np.bincount(slot[nonlinear:], q.data, len(key))
        rows, cols = key % self.n, key // self.n
        above = np.flatnonzero(rows != cols)
        source = np.concatenate([np.arange(len(key)), above])
        rows, cols = np.concatenate([rows, cols[above]]), np.concatenate([cols, rows[above]])
        order = np.lexsort((rows, cols))
        self._hess_source, self._hess_rows = source[order], rows[order].astype(np.int32)
        self._hess_indptr = np.searchsorted(cols[order], np.arange(self.n + 1)).astype(np.int32)

    # ------------------------------------------------------------------ evaluation
    def _lifted(self, x: Array) -> list[Array]:
        z = self._lift @ x + self._lift_const
        return [
            z[a : a + b.count * b.n_in].reshape(b.count, b.n_in)
            for a, b in zip(self._z_offset, self.blocks, strict=False)
        ]

    def outputs(self, x: Array) -> dict[str, Array]:
        """Every block's outputs, name -> (count, n_out)."""
        return {b.name: b.value(z).copy() for b, z in zip(self.blocks, self._lifted(x), strict=True)}

    def objective(self, x: Array) -> float:
        return float(self._c0 + self._c @ x + 0.5 * (x @ (self._Q @ x)))

    def gradient(self, x: Array) -> Array:
        return self._c + self._Q @ x

    def constraints(self, x: Array) -> Array:
        t = time.perf_counter()
        g = self._rows_matrix @ x + self._rows_const
        if self.blocks:
            out = np.concatenate(
                [b.value(z).ravel() for b, z in zip(self.blocks, self._lifted(x), strict=True)]
            )
            g[self._nonlinear] += out[self._row_out[self._nonlinear]]
        self.seconds += time.perf_counter() - t
        return g

    def jacobian(self, x: Array) -> sp.csc_array:
        t = time.perf_counter()
        data = self._jac_const.copy()
        if self.blocks:
            data += self._jac_map @ np.concatenate(
                [b.jacobian(z).ravel() for b, z in zip(self.blocks, self._lifted(x), strict=True)]
            )
        self.seconds += time.perf_counter() - t
        return sp.csc_array((data, self._jac_rows, self._jac_indptr), shape=(self.m, self.n))

    def hessian(self, x: Array, sigma: float, multipliers: Array) -> sp.csc_array:
        t = time.perf_counter()
        lower = sigma * self._hess_const
        if self.blocks:
            lam = np.zeros(int(self._out_offset[-1]))
            lam[self._row_out[self._nonlinear]] = multipliers[self._nonlinear]
            parts = []
            for b, z, o in zip(self.blocks, self._lifted(x), self._out_offset, strict=False):
                parts.append(b.hessian(z, lam[o : o + b.count * b.n_out].reshape(b.count, b.n_out)).ravel())
            lower += self._hess_map @ np.concatenate(parts)
        data = lower[self._hess_source]
        self.seconds += time.perf_counter() - t
        return sp.csc_array((data, self._hess_rows, self._hess_indptr), shape=(self.n, self.n))

    # ------------------------------------------------------------------ names
    def row_name(self, i: int) -> str:
        return str(self.origins[i])

    def row_group(self, i: int) -> tuple[str, str]:
        """Its term and place: the rows that one message stands for."""
        return self.origins[i].term, self.origins[i].place.name

    def describe_violation(self, i: int, x: Array, amount: float) -> tuple[str, str]:
        """Row i at x, and how far it is from being met: as a person reads it."""
        return self.origins[i].told(x, amount)

    def variable_name(self, j: int) -> str:
        return self.layout.name(j)


def _sums(slot: Index, entries: list[Index], factors: list[Array], shape: tuple[int, int]) -> sp.csr_array:
    """The matrix that adds factor times entry to each slot; short indices, as reading it takes long."""
    entry = np.concatenate([np.zeros(0, dtype=np.intp), *entries])
    where = slot.astype(np.int32), entry.astype(np.int32)
    return sp.csr_array((np.concatenate([np.zeros(0), *factors]), where), shape=shape)


def derivative_functions(
    name: str, z: Any, p: Any, out: Any, through: tuple[Any, Any] | None = None
) -> list[Any]:
    """A block's three functions of (z, p).

    ``name`` (z, p) -> out, ``name_jac`` (z, p) -> d out/dz,
    ``name_hess`` (z, p, lam) -> lower triangle of d2(lam.out)/dz2.

    through : numbers s, and what they are of (z, p), where ``out`` is written with them: it is then
        differentiated by them and by z apart, and both put together by the chain rule. That saves operations
        where many of z have an effect through few numbers only.
    """
    lam = ca.SX.sym("lam", out.numel())
    out = ca.densify(out)
    if through is None:
        jac = ca.jacobian(out, z)
        hess = ca.jacobian(ca.gradient(ca.dot(lam, out), z), z)
    else:
        out, jac, hess = _through(z, out, lam, *through)
    hess = ca.tril(hess)
    opts = {"cse": True}
    return [
        ca.Function(name, [z, p], [out], opts),
        ca.Function(f"{name}_jac", [z, p], [jac], opts),
        ca.Function(f"{name}_hess", [z, p, lam], [hess], opts),
    ]


def _through(z: Any, out: Any, lam: Any, s: Any, of_z: Any) -> list[Any]:
    """Value, Jacobian and Hessian of lam.out by z, where s in ``out`` stands for ``of_z``."""
    n, both = z.numel(), ca.vertcat(z, s)
    whole = ca.jacobian(out, both)
    slopes = ca.gradient(ca.dot(lam, out), both)
    curvature = ca.jacobian(slopes, both)
    inner, along = ca.jacobian(of_z, z), ca.SX.sym("along", s.numel())
    bends = ca.jacobian(ca.gradient(ca.dot(along, of_z), z), z)
    crossed = ca.mtimes(inner.T, curvature[n:, :n])
    jac = whole[:, :n] + ca.mtimes(whole[:, n:], inner)
    hess = (
        curvature[:n, :n]
        + crossed
        + crossed.T
        + ca.mtimes(ca.mtimes(inner.T, curvature[n:, n:]), inner)
        + ca.substitute(bends, along, slopes[n:])
    )
    found: list[Any] = ca.substitute([out, jac, hess], [s], [of_z])
    return found
