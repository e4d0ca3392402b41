"""A nonlinear program made of small compiled blocks on affine lifts of the variables.

Every nonlinear function is ``block(S x + c)`` with a constant sparse S, so the Jacobian's and the Hessian's
nonzeros are a *constant* linear map of the blocks' own nonzeros.  That map is built once; an evaluation is:
lift, call the compiled blocks without Python in the loop, and add their numbers up, run by run.

With respect to what it is written with, a function has few derivatives, and so has each stage. Together they
take fewer operations than those of the function with all that is in it written out.

What stands side by side in a function's output mostly belongs side by side in the matrix. A run says so in
four numbers, where a sparse matrix that does the same needs two for every product; they are read as quickly
as memory gives them, once in every iteration.

Blocks take z = S x + c, so the nonzeros of both matrices are sums of multiples of the blocks' own nonzeros,
with factors that never change. They are added up in runs: a block's variables that stand side by side are
mostly variables of the program side by side.
"""

from __future__ import annotations

import copy
import ctypes
import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.codegen.compiler import address, native_library
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import solve_in_order
from impactopt.kinematics.stages import Stage
from impactopt.solvers.program import Determined
from impactopt.transcription.batched import BatchedFunction, Block
from impactopt.transcription.layout import Affine, Array, Index, Layout, Rows, stack

__all__ = [
    "Runs",
    "StructuredProgram",
    "count_up",
    "derivative_functions",
    "derivatives",
    "union",
    "with_transposed",
]


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


Places = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs (k,): ``factor`` times each of ``length`` entries, from ``entry`` on, goes to the places from
    ``place`` on. shape : numbers of all places and of all entries.
    """

    entry: Places
    place: Places
    length: Places
    factor: Array
    shape: tuple[int, int]

    @classmethod
    def make(cls, entry: Index, place: Index, length: Index, factor: Array, shape: tuple[int, int]) -> Runs:
        """Makes runs from index arrays of any integer type."""
        return cls(entry.astype(np.int32), place.astype(np.int32), length.astype(np.int32), factor, shape)

    def add_to(self, out: Array, entries: Array) -> None:
        """Add the sums of these entries to ``out``."""
        library = _library()
        if library is None:
            out += self._matrix @ entries
            return
        runs = (address(a) for a in (self.entry, self.place, self.length, self.factor))
        library.runs_add(ctypes.c_int64(self.entry.size), *runs, address(entries), address(out))

    @functools.cached_property
    def _matrix(self) -> sp.csr_array:
        within = count_up(self.length)
        at = np.repeat(self.place, self.length) + within, np.repeat(self.entry, self.length) + within
        return sp.csr_array((np.repeat(self.factor, self.length), at), shape=self.shape)


def with_transposed(values: Array, across: Places) -> Array:
    """Values (nnz,) of the sum of a matrix with a symmetric pattern and its transpose.

    across (nnz,) : of each place the one across the diagonal.
    """
    library = _library()
    if library is None:
        return values + values[across]
    out = np.empty_like(values)
    library.runs_add_transposed(ctypes.c_int64(values.size), address(across), address(values), address(out))
    return out


def count_up(lengths: Index | Places) -> Index:
    """0, 1, ... length - 1 of each, one after the other."""
    ends = np.append(0, np.cumsum(lengths))
    return np.arange(int(ends[-1])) - np.repeat(ends[:-1], lengths)


def union(first: Index, length: Index | int = 1) -> Index:
    """The numbers (sorted, each once) in the runs that begin with ``first``."""
    length = np.broadcast_to(length, first.shape)
    order = np.argsort(first)
    start, end = first[order], np.maximum.accumulate(first[order] + length[order])
    begins = np.append(True, start[1:] > end[:-1])[: start.size]
    start, end = start[begins], end[np.append(begins[1:], True)[: end.size]]
    return np.repeat(start, end - start) + count_up(end - start)


@functools.cache
def _library() -> Any:
    """C library, if there is a compiler; None: sparse products replace it."""
    return native_library(__package__, "scatter_add")


class JacobianMap:
    """Map of the blocks' Jacobians to that of the constraints g = out[...] + A x."""

    def __init__(self, blocks: Sequence[Block], lift: sp.csr_array, row_of: Index, linear: sp.csr_array):
        """lift : S, of the inputs of all blocks.  row_of : each output's row; -1: none.  linear : A."""
        self._entries, starts = _shared([b.jacobian for b in blocks])
        self._shape = m, _ = linear.shape
        parts, z, out = [], 0, 0
        for b, start in zip(blocks, starts, strict=False):
            rows, columns = b.jac_pattern
            instance = np.arange(b.count)[:, None]
            row, column = row_of[out + instance * b.n_out + rows], z + instance * b.n_in + columns
            below = (columns[1:] == columns[:-1]) & (row[:, 1:] == row[:, :-1] + 1) & (row[:, :-1] >= 0)
            first, length = _runs(row.shape, below)
            row, column = row.ravel()[first], column.ravel()[first]
            first, length, row, column = (a[row >= 0] for a in (first, length, row, column))
            owner, x, factor = _terms(lift, column)
            parts.append((start + first[owner], x * m + row[owner], length[owner], factor))
            z, out = z + b.count * b.n_in, out + b.count * b.n_out
        entry, place, length, factor = _joined(parts)
        at, values = _placed(linear)
        places = union(np.concatenate([place, at]), np.concatenate([length, np.ones_like(at)]))
        self._linear = np.bincount(np.searchsorted(places, at), values, places.size)
        self._made = sp.csc_array((self._linear, *_csc(places, self._shape)), shape=self._shape)
        shape = places.size, self._entries.size
        self._sums = Runs.make(entry, np.searchsorted(places, place), length, factor, shape)

    def matrix(self) -> sp.csc_array:
        """Jacobian for the blocks' latest values."""
        values = self._linear.copy()
        self._sums.add_to(values, self._entries)
        return _with(self._made, values)


class HessianMap:
    """Map of the lower triangles of the blocks' Hessians to the Hessian of sigma x'Qx/2 + multipliers . out.

    An entry off the diagonal of z stands for the one across it, too, and so does what it is a part of in x.
    So entries are added up on one side, those of the diagonal halved, and the whole is that and its
    transpose.
    """

    def __init__(self, blocks: Sequence[Block], lift: sp.csr_array, quadratic: sp.csc_array):
        """lift : S, of the inputs of all blocks.  quadratic : Q (n, n)."""
        self._entries, starts = _shared([b.hessian for b in blocks])
        self._shape = n, _ = quadratic.shape
        parts, z, alike = [], 0, _alike(lift)
        for b, start in zip(blocks, starts, strict=False):
            rows, columns = b.hess_pattern
            instance = np.arange(b.count)[:, None] * b.n_in
            row, column = z + instance + rows, z + instance + columns
            below = (columns[1:] == columns[:-1]) & (rows[1:] == rows[:-1] + 1) & (rows[:-1] > columns[:-1])
            first, length = _runs(row.shape, below & alike[row[:, 1:]])
            row, column = row.ravel()[first], column.ravel()[first]
            of_column, c, factor = _terms(lift, column)
            of_term, r, by = _terms(lift, row[of_column])
            owner = of_column[of_term]
            by = by * factor[of_term] * np.where(row == column, 0.5, 1.0)[owner]
            parts.append((start + first[owner], c[of_term] * n + r, length[owner], by))
            z += b.count * b.n_in
        entry, place, length, factor = _joined(parts)
        at, values = _placed(quadratic)
        one, other = (_pattern(p, self._shape) for p in (union(place, length), union(at)))
        whole = sp.csc_array(one + one.T + other)
        self._made = whole
        places = np.repeat(np.arange(n), np.diff(whole.indptr)) * n + whole.indices
        numbers = sp.csc_array((np.arange(places.size), whole.indices, whole.indptr), self._shape)
        self._across = numbers.T.tocsc().data.astype(np.int32)
        self._half = np.bincount(np.searchsorted(places, at), 0.5 * values, places.size)
        shape = places.size, self._entries.size
        self._sums = Runs.make(entry, np.searchsorted(places, place), length, factor, shape)

    def matrix(self, sigma: float) -> sp.csc_array:
        """Hessian for the blocks' latest values."""
        values: Array = np.multiply(sigma, self._half)
        self._sums.add_to(values, self._entries)
        values = with_transposed(values, self._across)
        return _with(self._made, values)


def _shared(functions: Sequence[BatchedFunction]) -> tuple[Array, Index]:
    """One array that these functions write to from now on, and where each begins in it."""
    starts = np.cumsum([0, *[f.size for f in functions]])
    entries = np.zeros(int(starts[-1]))
    for f, start in zip(functions, starts, strict=False):
        f.write_to(entries[start : start + f.size])
    return entries, starts


def _with(matrix: sp.csc_array, values: Array) -> sp.csc_array:
    """The same pattern with other values: SciPy's own way looks at the whole pattern again."""
    out = copy.copy(matrix)
    out.data = values
    return out


def _terms(lift: sp.csr_array, z: Index) -> tuple[Index, Index, Array]:
    """Terms of these inputs: the position in z, the variable, and its coefficient."""
    count = lift.indptr[z + 1] - lift.indptr[z]
    owner = np.repeat(np.arange(len(z)), count)
    at = lift.indptr[z][owner] + count_up(count)
    return owner, lift.indices[at].astype(np.intp), lift.data[at]


def _alike(lift: sp.csr_array) -> npt.NDArray[np.bool_]:
    """Mask of the inputs that have the coefficients of the input before, each of the next variable."""
    count = np.diff(lift.indptr)
    owner = np.repeat(np.arange(count.size), count)
    out = np.append(False, count[1:] == count[:-1])[: count.size]
    here = np.flatnonzero(out[owner])
    before = here - count[owner[here]]
    differ = (lift.indices[here] != lift.indices[before] + 1) | (lift.data[here] != lift.data[before])
    out[owner[here[differ]]] = False
    return out


def _runs(shape: tuple[int, ...], follows: npt.NDArray[np.bool_]) -> tuple[Index, Index]:
    """Beginnings and lengths of the runs of entries.

    shape : instances and entries of each; follows : which of the entries after the first goes on.
    """
    begins = np.ones(shape, dtype=bool)
    begins[:, 1:] = ~follows
    first = np.flatnonzero(begins)
    return first, np.diff(np.append(first, begins.size))


def _joined(parts: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Entries, places, lengths and factors of all parts."""
    none = np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0)
    return tuple(np.concatenate(of) for of in zip(none, *parts, strict=True))


def _placed(matrix: sp.sparray) -> tuple[Index, Array]:
    """Places ``column * rows + row`` of a matrix's entries, and their values."""
    entries = matrix.tocoo()
    rows, columns = entries.coords
    return columns.astype(np.intp) * matrix.shape[0] + rows, entries.data


def _csc(places: Index, shape: tuple[int, int]) -> tuple[Index, Index]:
    """Rows, and starts of columns, of the places ``column * rows + row``, which are in order."""
    columns, rows = np.divmod(places, shape[0])
    starts = np.searchsorted(columns, np.arange(shape[1] + 1))
    return rows.astype(np.int32), starts.astype(np.int32)


def _pattern(places: Index, shape: tuple[int, int]) -> sp.csc_array:
    return sp.csc_array((np.ones(places.size), *_csc(places, shape)), shape)


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
        taken, times = np.unique(self._of_nonlinear, return_counts=True)
        if (times > 1).any():
            twice = self._nonlinear[self._of_nonlinear == taken[times > 1][0]]
            one, other = (self.origins[i] for i in twice[:2])
            raise InputError(
                f"one output of a block is in two constraints, {one!s} and {other!s}: give the block that "
                "output twice, or lift it"
            )
        self.m = len(self._row_out)
        self._rows_matrix, self._rows_const = linear_rows.matrix(n), linear_rows.const
        self.g_lower = np.concatenate([np.zeros(0), *rows.lower])
        self.g_upper = np.concatenate([np.zeros(0), *rows.upper])
        self._at: tuple[Array, list[Array]] | None = None  # where functions were last asked for
        self._c = np.zeros(n)
        np.add.at(self._c, objective.cols, objective.vals)
        self._c += linear
        self._c0, self._Q = float(objective.const.sum()), sp.csc_array(quadratic)
        self._curvature = self._Q.copy()  # without the zeros of places that clearance may couple
        self._curvature.eliminate_zeros()
        self.seconds = 0.0

    def take_numbers(self, layout: Layout, blocks: Sequence[Block], rows: Rows) -> None:
        """The numbers of another program of the same structure, whose blocks and constraints are the first of
        this one's; the others keep theirs.

        Blocks and constraints touch the same variables, with the same weights, and the objective is the same:
        what differs are bounds, constants and parameters.
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
        return float(self._c0 + self._c @ x + 0.5 * (x @ (self._curvature @ x)))

    def gradient(self, x: Array) -> Array:
        return self._c + self._curvature @ x

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
