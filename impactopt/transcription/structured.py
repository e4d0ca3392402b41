"""Nonlinear program (NLP) assembled from small compiled blocks.

**Assembly.** Every nonlinear function is ``block(z)`` of a lift z = S x + c of the decision vector x, with a
constant sparse S. By the chain rule the nonzeros of Jacobian and Hessian are sums of the blocks' nonzeros
times constant factors. These scatter-adds are planned once. An evaluation then computes the lift, calls the
compiled blocks, and adds up their nonzeros.

**Runs.** Neighbours in a block's output mostly are neighbours in the matrix. So a scatter-add is stored as
runs of neighbours, at four numbers a run; a sparse matrix for the same map has two numbers for each product.
The map is read from memory in every iteration, and its size decides the time.

**Stages.** A block may be written with intermediate quantities (`Stage`), each a function of few others. The
derivatives of function and stages, chained, take fewer operations than those of one large expression.
"""

from __future__ import annotations

import copy
import ctypes
import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.arrays import Array, Index
from impactopt.codegen.batched import BatchedFunction
from impactopt.codegen.compiler import address, native_library
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import solve_in_order
from impactopt.kinematics.stages import Stage
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Block
from impactopt.transcription.layout import Affine, Constraints, Layout, stack


def derivatives(z: Any, out: Any, weights: Any, stages: Sequence[Stage] = ()) -> list[Any]:
    """``out`` (m,) of z (n,), its Jacobian (m, n) and the Hessian (n, n) of ``weights . out``, SX.

    stages : intermediate quantities that ``out`` is written with; each may depend on those before it.
    """
    symbols = [stage.symbols for stage in stages]
    both = ca.vertcat(z, *symbols)
    # derivatives by z and the stages' symbols, as if these were independent
    jac = ca.jacobian(out, both)
    gradient = ca.gradient(ca.dot(weights, out), both)
    hess = ca.jacobian(gradient, both)
    # Eliminate stages from the last to the first. With s(u), u all before the stage, and S = ds/du:
    #   J <- J_u + J_s S,   H <- H_uu + S'H_su + H_us S + S'H_ss S + sum_i (df/ds_i) d2s_i/du2
    for k in reversed(range(len(stages))):
        before = ca.vertcat(z, *symbols[:k])
        n = before.numel()
        inner, curvature = _stage_derivatives(before, stages[k], gradient[n:])
        hess += curvature
        mixed = ca.mtimes(inner.T, hess[n:, :n])
        hess = hess[:n, :n] + mixed + mixed.T + ca.mtimes(ca.mtimes(inner.T, hess[n:, n:]), inner)
        jac = jac[:, :n] + ca.mtimes(jac[:, n:], inner)
        gradient = gradient[:n] + ca.mtimes(inner.T, gradient[n:])
    # replace the stages' symbols by their expressions of z
    values: list[Any] = []
    for k, stage in enumerate(stages):
        values += ca.substitute([stage.expression], symbols[:k], values)
    found: list[Any] = ca.substitute([out, jac, hess], symbols, values)
    return found


def _stage_derivatives(before: Any, stage: Stage, adjoint: Any) -> tuple[Any, Any]:
    """Jacobian (k, n) of a stage's k symbols, and its curvature (n + k, n + k), to be added to a Hessian.

    before (n,) : variables and symbols that it depends on.  adjoint (k,) : gradient of the function by the
    stage's symbols, which weights the second derivatives.
    """
    weights = ca.SX.sym("along", adjoint.numel())
    if stage.zero is None:
        curvature = ca.jacobian(ca.gradient(ca.dot(weights, stage.expression), before), before)
        k = adjoint.numel()
        curvature = ca.diagcat(curvature, ca.SX(k, k))
        return ca.jacobian(stage.expression, before), ca.substitute(curvature, weights, adjoint)
    # Implicit function theorem: zero(u, s) = 0 with block diagonal M = dzero/ds has ds/du = -M^-1 dzero/du.
    # The adjoint M^-T (df/ds) weights the second derivatives of `zero`, by u and s.
    both, first = ca.vertcat(before, stage.symbols), 0
    by_before, slopes, adjoints = ca.jacobian(stage.zero, before), [], []
    for matrix, (rows, columns) in stage.blocks:
        at = slice(first, first + matrix.size1())
        nonzero = [j for j in range(before.numel()) if by_before[at, j].nnz()]
        solved = solve_in_order(matrix, -by_before[at, nonzero], (rows, columns))[0]
        part = ca.SX(matrix.size1(), before.numel())
        part[:, nonzero] = solved
        slopes.append(ca.sparsify(part))
        # the transposed matrix has the same pivots, with rows and columns swapped
        adjoints.append(solve_in_order(matrix.T, adjoint[at], (columns, rows))[0])
        first = at.stop
    curvature = ca.jacobian(ca.gradient(ca.dot(weights, stage.zero), both), both)
    return ca.vertcat(*slopes), -ca.substitute(curvature, weights, ca.vertcat(*adjoints))


Int32 = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Runs:
    """Scatter-add in k runs: for i < length,  out[destination + i] += factor * entries[source + i].

    source, destination, length, factor : (k,) of each run.  shape : sizes of ``out`` and of ``entries``.
    """

    source: Int32
    destination: Int32
    length: Int32
    factor: Array
    shape: tuple[int, int]

    @classmethod
    def make(
        cls, source: Index, destination: Index, length: Index, factor: Array, shape: tuple[int, int]
    ) -> Runs:
        """Makes runs from index arrays of any integer type."""
        runs = source.astype(np.int32), destination.astype(np.int32), length.astype(np.int32)
        return cls(*runs, factor, shape)

    def with_more(
        self, source: Index, destination: Index, length: Index, factor: Array, entries: int
    ) -> Runs:
        """These runs and more, of so many ``entries`` in all."""
        return Runs.make(
            np.append(self.source, source),
            np.append(self.destination, destination),
            np.append(self.length, length),
            np.append(self.factor, factor),
            (self.shape[0], entries),
        )

    def add_to(self, out: Array, entries: Array) -> None:
        """Add the scattered entries to ``out``."""
        library = _library()
        if library is None:
            out += self._matrix @ entries
            return
        runs = (address(a) for a in (self.source, self.destination, self.length, self.factor))
        library.runs_add(ctypes.c_int64(self.source.size), *runs, address(entries), address(out))

    @functools.cached_property
    def _matrix(self) -> sp.csr_array:
        within = count_up(self.length)
        at = np.repeat(self.destination, self.length) + within, np.repeat(self.source, self.length) + within
        return sp.csr_array((np.repeat(self.factor, self.length), at), shape=self.shape)


def with_transposed(values: Array, across: Int32) -> Array:
    """Values (nnz,) of the sum of a matrix with a symmetric pattern and its transpose.

    across (nnz,) : for each nonzero, the number of the one mirrored at the diagonal.
    """
    library = _library()
    if library is None:
        return values + values[across]
    out = np.empty_like(values)
    library.runs_add_transposed(ctypes.c_int64(values.size), address(across), address(values), address(out))
    return out


def count_up(lengths: Index | Int32) -> Index:
    """Ranges 0, 1, ... length - 1 of all lengths, concatenated."""
    ends = np.append(0, np.cumsum(lengths))
    return np.arange(int(ends[-1])) - np.repeat(ends[:-1], lengths)


def union(first: Index, length: Index | int = 1) -> Index:
    """Integers in the ranges  first ... first + length - 1,  sorted, each once."""
    length = np.broadcast_to(length, first.shape)
    order = np.argsort(first)
    start, end = first[order], np.maximum.accumulate(first[order] + length[order])
    begins = np.append(True, start[1:] > end[:-1])[: start.size]  # of ranges that overlap none before them
    start, end = start[begins], end[np.append(begins[1:], True)[: end.size]]
    return np.repeat(start, end - start) + count_up(end - start)


@functools.cache
def _library() -> Any:
    """C library; None without a compiler: then sparse products replace it."""
    return native_library(__package__, "scatter_add")


class JacobianMap:
    """Scatter-add of the blocks' Jacobians to that of the constraints g = out[...] + A x, which is (m, n)."""

    def __init__(
        self, blocks: Sequence[Block], lift: sp.csr_array, constraint_of: Index, linear: sp.csr_array
    ):
        """lift : S, of the inputs of all blocks.  linear : A (m, n).
        constraint_of : index of the constraint that each output is in; -1: none.
        """
        self._entries, starts = _shared([b.jacobian for b in blocks])
        self._shape = m, _ = linear.shape
        parts, z, out = [], 0, 0  # offsets of the block's inputs and outputs in those of all blocks
        for b, start in zip(blocks, starts, strict=False):
            rows, columns = b.jac_pattern
            instance = np.arange(b.count)[:, None]
            # (instances, nonzeros of one): row in the constraints' Jacobian, column among the blocks' inputs
            row, column = constraint_of[out + instance * b.n_out + rows], z + instance * b.n_in + columns
            # a run: nonzeros of one column whose outputs are in consecutive constraints
            below = (columns[1:] == columns[:-1]) & (row[:, 1:] == row[:, :-1] + 1) & (row[:, :-1] >= 0)
            first, length = _runs(row.shape, below)
            row, column = row.ravel()[first], column.ravel()[first]
            first, length, row, column = (a[row >= 0] for a in (first, length, row, column))
            # chain rule: input z_j = S_j x sends its column of the block's Jacobian to each x that it has
            owner, x, factor = _lift_terms(lift, column)
            parts.append((start + first[owner], x * m + row[owner], length[owner], factor))
            z, out = z + b.count * b.n_in, out + b.count * b.n_out
        source, linear_index, length, factor = _concatenated(parts)
        at, values = _linear_indices(linear)
        # All places that anything is ever added to, sorted by column and row: the same pattern at every x.
        pattern = union(np.concatenate([linear_index, at]), np.concatenate([length, np.ones_like(at)]))
        self._linear = np.bincount(np.searchsorted(pattern, at), values, pattern.size)  # A in that pattern
        self._template = sp.csc_array((self._linear, *_csc(pattern, self._shape)), shape=self._shape)
        shape = pattern.size, self._entries.size
        self._sums = Runs.make(source, np.searchsorted(pattern, linear_index), length, factor, shape)

    def matrix(self) -> sp.csc_array:
        """Jacobian for the blocks' latest values."""
        values = self._linear.copy()
        self._sums.add_to(values, self._entries)
        return _with_values(self._template, values)


@dataclass(frozen=True, eq=False)
class HessianMap:
    """Scatter-add of the blocks' Hessians to that of sigma x'Qx/2 + multipliers . out, which is (n, n).

    The lower triangle L of a block contributes S'(L + L' - diag L)S. So S'(L - diag L / 2)S is added up,
    together with Q/2, and the Hessian is that matrix plus its transpose.

    blocks : their number.  template : matrix with the Hessian's pattern.
    pattern : linear indices of its nonzeros, sorted.  across : number of each nonzero's mirrored one.
    half : Q/2 in that pattern.  sums : scatter-add of the nonzeros of all blocks' Hessians.
    """

    blocks: int
    template: sp.csc_array
    pattern: Index
    across: Int32
    half: Array
    sums: Runs

    @classmethod
    def of(cls, blocks: Sequence[Block], lift: sp.csr_array, quadratic: sp.csc_array) -> HessianMap:
        """lift : S, of the inputs of all blocks.  quadratic : Q (n, n)."""
        shape = n, _ = quadratic.shape
        source, linear_index, length, factor = cls._terms(blocks, lift)
        at, values = _linear_indices(quadratic)
        half, other = (_pattern(p, shape) for p in (union(linear_index, length), union(at)))
        template = sp.csc_array(half + half.T + other)
        pattern = np.repeat(np.arange(n), np.diff(template.indptr)) * n + template.indices
        # transposing a matrix that holds the nonzeros' own numbers gives the number of each mirrored one
        numbers = sp.csc_array((np.arange(pattern.size), template.indices, template.indptr), shape)
        across = numbers.T.tocsc().data.astype(np.int32)
        in_pattern = np.bincount(np.searchsorted(pattern, at), 0.5 * values, pattern.size).astype(float)
        sizes = pattern.size, int(_starts([b.hessian for b in blocks])[-1])
        sums = Runs.make(source, np.searchsorted(pattern, linear_index), length, factor, sizes)
        return cls(len(blocks), template, pattern, across, in_pattern, sums)

    def extended(self, blocks: Sequence[Block], lift: sp.csr_array) -> HessianMap | None:
        """Map of these blocks and more; None if the pattern lacks one of their entries."""
        source, linear_index, length, factor = self._terms(blocks, lift, self.blocks)
        begin = np.searchsorted(self.pattern, linear_index)
        # a run beyond the pattern ends where no index is
        end = (begin + length - 1).clip(max=self.pattern.size)
        # indices ascend, so those of a run are all there if its last one is where it has to be
        if (np.append(self.pattern, -1)[end] != linear_index + length - 1).any():
            return None
        entries = int(_starts([b.hessian for b in blocks])[-1])
        sums = self.sums.with_more(source, begin, length, factor, entries)
        return replace(self, blocks=len(blocks), sums=sums)

    @staticmethod
    def _terms(
        blocks: Sequence[Block], lift: sp.csr_array, since: int = 0
    ) -> tuple[Index, Index, Index, Array]:
        """Sources, linear indices, lengths and factors of the runs of the blocks from number ``since`` on."""
        parts, n, continues = [], lift.shape[1], _continues(lift)
        z = sum(b.count * b.n_in for b in blocks[:since])
        starts = _starts([b.hessian for b in blocks])
        for b, start in zip(blocks[since:], starts[since:], strict=False):
            rows, columns = b.hess_pattern
            instance = np.arange(b.count)[:, None] * b.n_in
            # (instances, nonzeros of one): row and column among the inputs of all blocks
            row, column = z + instance + rows, z + instance + columns
            # a run: consecutive nonzeros of one column below the diagonal (diagonal ones are halved), whose
            # rows have the same lift, of consecutive variables
            below = (columns[1:] == columns[:-1]) & (rows[1:] == rows[:-1] + 1) & (rows[:-1] > columns[:-1])
            first, length = _runs(row.shape, below & continues[row[:, 1:]])
            row, column = row.ravel()[first], column.ravel()[first]
            # chain rule on both sides: each pair of a variable in the column's lift and one in the row's
            of_column, c, factor = _lift_terms(lift, column)
            of_term, r, row_factor = _lift_terms(lift, row[of_column])
            owner = of_column[of_term]
            row_factor = row_factor * factor[of_term] * np.where(row == column, 0.5, 1.0)[owner]
            parts.append((start + first[owner], c[of_term] * n + r, length[owner], row_factor))
            z += b.count * b.n_in
        return _concatenated(parts)

    def matrix(self, sigma: float, entries: Array) -> sp.csc_array:
        """Hessian for nonzeros of all blocks' Hessians."""
        values: Array = np.multiply(sigma, self.half)
        self.sums.add_to(values, entries)
        values = with_transposed(values, self.across)
        return _with_values(self.template, values)


def _starts(functions: Sequence[BatchedFunction]) -> Index:
    """Offset of each function's nonzeros among those of all, and their number."""
    return np.cumsum([0, *[f.size for f in functions]])


def _shared(functions: Sequence[BatchedFunction]) -> tuple[Array, Index]:
    """One array that all these functions write to from now on, and the offset of each in it."""
    starts = _starts(functions)
    entries = np.zeros(int(starts[-1]))
    for f, start in zip(functions, starts, strict=False):
        f.write_to(entries[start : start + f.size])
    return entries, starts


def _with_values(matrix: sp.csc_array, values: Array) -> sp.csc_array:
    """Matrix of the same pattern with other values, without SciPy's constructor, which checks the pattern."""
    out = copy.copy(matrix)
    out.data = values
    return out


def _lift_terms(lift: sp.csr_array, z: Index) -> tuple[Index, Index, Array]:
    """Nonzeros of rows z of the lift: position in z, variable, coefficient; (k,) each."""
    count = lift.indptr[z + 1] - lift.indptr[z]
    owner = np.repeat(np.arange(len(z)), count)
    at = lift.indptr[z][owner] + count_up(count)
    return owner, lift.indices[at].astype(np.intp), lift.data[at]


def _continues(lift: sp.csr_array) -> npt.NDArray[np.bool_]:
    """Mask of the rows of the lift that are the row before, shifted by one variable."""
    count = np.diff(lift.indptr)
    owner = np.repeat(np.arange(count.size), count)
    out = np.append(False, count[1:] == count[:-1])[: count.size]
    here = np.flatnonzero(out[owner])
    before = here - count[owner[here]]
    differ = (lift.indices[here] != lift.indices[before] + 1) | (lift.data[here] != lift.data[before])
    out[owner[here[differ]]] = False
    return out


def _runs(shape: tuple[int, ...], follows: npt.NDArray[np.bool_]) -> tuple[Index, Index]:
    """Beginnings and lengths of runs of nonzeros; none crosses from one instance to the next.

    shape : (instances, nonzeros of one).  follows (instances, nonzeros - 1) : mask of nonzeros that continue
    the run of the one before.
    """
    begins = np.ones(shape, dtype=bool)
    begins[:, 1:] = ~follows
    first = np.flatnonzero(begins)
    return first, np.diff(np.append(first, begins.size))


def _concatenated(parts: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Sources, linear indices, lengths and factors of all parts."""
    none = np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0)
    return tuple(np.concatenate(of) for of in zip(none, *parts, strict=True))


def _linear_indices(matrix: sp.sparray) -> tuple[Index, Array]:
    """Linear indices ``column * rows + row`` of a matrix's nonzeros, and their values."""
    entries = matrix.tocoo()
    rows, columns = entries.coords
    return columns.astype(np.intp) * matrix.shape[0] + rows, entries.data


def _csc(linear_indices: Index, shape: tuple[int, int]) -> tuple[Index, Index]:
    """``indices`` and ``indptr`` of the CSC matrix whose nonzeros have these sorted linear indices."""
    columns, rows = np.divmod(linear_indices, shape[0])
    starts = np.searchsorted(columns, np.arange(shape[1] + 1))
    return rows.astype(np.int32), starts.astype(np.int32)


def _pattern(linear_indices: Index, shape: tuple[int, int]) -> sp.csc_array:
    return sp.csc_array((np.ones(linear_indices.size), *_csc(linear_indices, shape)), shape)


class StructuredProgram:
    """Assembled NLP; implements :class:`impactopt.solvers.program.NonlinearProgram`."""

    def __init__(
        self,
        layout: Layout,
        blocks: Sequence[Block],
        constraints: Constraints,
        *,
        objective: Affine,
        quadratic: sp.spmatrix | sp.sparray,
        linear: Array,
        determined: Sequence[Determined] = (),
        base: StructuredProgram | None = None,
    ) -> None:
        """Minimize  objective(x) + 1/2 x'Qx + q'x  subject to ``constraints`` and the layout's bounds.

        determined : variables that the solver can eliminate by equality constraints.
        base : program of the first blocks alone, with the same variables and Q; its Hessian's structure is
            taken over if it has places for all entries of the other blocks' Hessians.
        """
        self._base = base
        self.determined = tuple(determined)
        self.layout, self.blocks, self.origins = layout, tuple(blocks), tuple(constraints.origins)
        n = self.n = layout.n
        self.x_lower, self.x_upper = layout.lower, layout.upper
        lift = stack([b.lift for b in blocks])
        self._lift, self._lift_const = lift.matrix(n), lift.const
        self._z_offset = np.cumsum([0] + [b.count * b.n_in for b in blocks])
        self._out_offset = np.cumsum([0] + [b.count * b.n_out for b in blocks])
        affine = stack(constraints.affine)
        # index of the block output in each constraint; -1: the constraint is affine
        output_of = np.concatenate([np.zeros(0, dtype=np.intp), *constraints.outputs])
        self._nonlinear = np.flatnonzero(output_of >= 0)  # constraints with an output
        self._of_nonlinear = output_of[self._nonlinear]  # and that output
        if (beyond := self._nonlinear[self._of_nonlinear >= self._out_offset[-1]]).size:
            raise InputError(
                f"{self.origins[beyond[0]]!s}: there is no output {output_of[beyond[0]]} of a block, only "
                f"{self._out_offset[-1]}; add_block returns the number of a block's first output"
            )
        outputs, uses = np.unique(self._of_nonlinear, return_counts=True)
        if (uses > 1).any():
            # Each output has one multiplier and one place in the scatter-adds, `constraint_of`.
            twice = self._nonlinear[self._of_nonlinear == outputs[uses > 1][0]]
            one, other = (self.origins[i] for i in twice[:2])
            raise InputError(
                f"one output of a block is in two constraints, {one!s} and {other!s}: give the block that "
                "output twice, or lift it"
            )
        self.m = len(output_of)
        self._affine_matrix, self._affine_const = affine.matrix(n), affine.const
        self.g_lower = np.concatenate([np.zeros(0), *constraints.lower])
        self.g_upper = np.concatenate([np.zeros(0), *constraints.upper])
        self._at: tuple[Array, list[Array]] | None = None  # last x with its lift, which all functions need
        self._c = np.zeros(n)
        np.add.at(self._c, objective.cols, objective.vals)
        self._c += linear
        self._c0, self.quadratic = float(objective.const.sum()), sp.csc_array(quadratic)
        # Q has explicit zeros, which reserve the pattern for couplings by clearance; products skip them
        self._curvature = self.quadratic.copy()
        self._curvature.eliminate_zeros()
        self.seconds = 0.0  # spent on evaluations

    def update_parameters(self, layout: Layout, blocks: Sequence[Block], constraints: Constraints) -> None:
        """Take over bounds, constants and parameters of another program of the same structure.

        Its blocks and constraints correspond to the first ones of this program; the rest is kept. Variables,
        their coefficients and the objective have to be the same.
        """
        self.x_lower, self.x_upper = layout.lower, layout.upper
        for mine, other in zip(self.blocks, blocks, strict=False):
            mine.take_parameters(other.parameters)
        offset = np.concatenate([np.zeros(0), *(b.lift.const for b in blocks)])
        self._lift_const = np.concatenate([offset, self._lift_const[len(offset) :]])
        for name, given in (("g_lower", constraints.lower), ("g_upper", constraints.upper)):
            found = np.concatenate([np.zeros(0), *given])
            setattr(self, name, np.concatenate([found, getattr(self, name)[len(found) :]]))
        constants = np.concatenate([np.zeros(0), *(affine.const for affine in constraints.affine)])
        self._affine_const = np.concatenate([constants, self._affine_const[len(constants) :]])
        self._at = None

    def same_parameters(self, other: StructuredProgram) -> bool:
        """True if bounds, constants, coefficients and parameters equal another program's, up to rounding."""
        mine, its = self._parameters(), other._parameters()
        return len(mine) == len(its) and all(
            a.shape == b.shape and np.allclose(a, b, rtol=1e-12, atol=1e-12)
            for a, b in zip(mine, its, strict=True)
        )

    def _parameters(self) -> list[Array]:
        matrices = self._lift, self._affine_matrix, self.quadratic
        return [
            *(self.x_lower, self.x_upper, self.g_lower, self.g_upper),
            *(self._lift_const, self._affine_const, self._c, np.array([self._c0])),
            *(part for matrix in matrices for part in (matrix.data, matrix.indices, matrix.indptr)),
            *(b.parameters for b in self.blocks),
        ]

    # ------------------------------------------------------------------ evaluation
    @cached_property
    def _jacobian(self) -> JacobianMap:
        constraint_of = np.full(int(self._out_offset[-1]), -1, dtype=np.intp)
        constraint_of[self._of_nonlinear] = self._nonlinear
        return JacobianMap(self.blocks, self._lift, constraint_of, self._affine_matrix)

    @cached_property
    def _hessian(self) -> HessianMap:
        base = self._base
        return (base and base._hessian.extended(self.blocks, self._lift)) or HessianMap.of(
            self.blocks, self._lift, self.quadratic
        )

    @cached_property
    def _hessian_entries(self) -> Array:
        return _shared([b.hessian for b in self.blocks])[0]

    def _lifted(self, x: Array) -> list[Array]:
        """Inputs z (count, n_in) of each block."""
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
        """Outputs of all blocks, name -> (count, n_out); of several with one name, the last one's."""
        return {b.name: b.value(z).copy() for b, z in zip(self.blocks, self._lifted(x), strict=True)}

    def all_outputs(self, x: Array) -> Array:
        """Outputs of all blocks, concatenated: the numbering that constraints and lifted variables use."""
        return np.concatenate([b.value(z).ravel() for b, z in zip(self.blocks, self._lifted(x), strict=True)])

    def objective(self, x: Array) -> float:
        return float(self._c0 + self._c @ x + 0.5 * (x @ (self._curvature @ x)))

    def gradient(self, x: Array) -> Array:
        return self._c + self._curvature @ x

    def constraints(self, x: Array) -> Array:
        t = time.perf_counter()
        g = self._affine_matrix @ x + self._affine_const
        if self.blocks:
            g[self._nonlinear] += self.all_outputs(x)[self._of_nonlinear]
        self.seconds += time.perf_counter() - t
        return g

    def jacobian(self, x: Array) -> sp.csc_array:
        t = time.perf_counter()
        found = self._jacobian  # before the blocks are called: it sets the array that they write to
        for b, z in zip(self.blocks, self._lifted(x), strict=True):
            b.jacobian(z)
        out = found.matrix()
        self.seconds += time.perf_counter() - t
        return out

    def hessian(self, x: Array, sigma: float, multipliers: Array) -> sp.csc_array:
        t = time.perf_counter()
        entries = self._hessian_entries  # before the blocks are called: it sets the array that they write to
        # outputs that are in no constraint keep zero, and contribute nothing
        lam = np.zeros(int(self._out_offset[-1]))  # multiplier of each output's constraint
        lam[self._of_nonlinear] = multipliers[self._nonlinear]
        for b, z, o in zip(self.blocks, self._lifted(x), self._out_offset, strict=False):
            b.hessian(z, lam[o : o + b.count * b.n_out].reshape(b.count, b.n_out))
        out = self._hessian.matrix(sigma, entries)
        self.seconds += time.perf_counter() - t
        return out

    # ------------------------------------------------------------------ names
    def constraint_name(self, i: int) -> str:
        return str(self.origins[i])

    def constraint_group(self, i: int) -> tuple[str, str]:
        """Term and place of constraint i; a message names one constraint of such a group."""
        return self.origins[i].term, self.origins[i].place.name

    def describe_violation(self, i: int, x: Array, amount: float) -> tuple[str, str]:
        """Name of constraint i with its time at x, and the amount of its violation in words."""
        return self.origins[i].describe(x, amount)

    def variable_name(self, j: int) -> str:
        return self.layout.name(j)


def derivative_functions(name: str, z: Any, p: Any, out: Any, through: Sequence[Stage] = ()) -> list[Any]:
    """A block's three functions of (z, p).

    ``name`` (z, p) -> out, ``name_jac`` (z, p) -> d out/dz,
    ``name_hess`` (z, p, lam) -> lower triangle of d2(lam.out)/dz2.

    through : stages that ``out`` is written with.
    """
    lam = ca.SX.sym("lam", out.numel())
    out, jac, hess = derivatives(z, ca.densify(out), lam, through)
    return [
        ca.Function(name, [z, p], [out]),
        ca.Function(f"{name}_jac", [z, p], [jac]),
        ca.Function(f"{name}_hess", [z, p, lam], [ca.tril(hess)]),
    ]
