"""Kernels of condensed Newton systems: small dense algebra in NumPy, and the same in C (`newton.c`).

NumPy is used if there is no compiler, with the same arrays.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
from scipy.linalg import cython_blas, cython_lapack

from impactopt.codegen.compiler import address, native_library
from impactopt.solvers.program import Vector

Index = npt.NDArray[np.intp]
Places = npt.NDArray[np.int32]
Stack = npt.NDArray[np.float64]
_SINGULAR = "constraints do not determine their variables"


@dataclass(eq=False, kw_only=True)
class EliminationStage:
    """Systems (k) of one shape, with r equalities each: places of their values, and results.

    The stages of a structure are eliminated one after the other. In each system, with the equalities
    B d_e + N d_c + residual = 0, the variables e become d_e = -(x0 + X d_c). Places of entries outside the
    pattern are 0, where the value is zero.

    Attributes
    ----------
    q, e (k, r) : numbers of the equalities, and of the variables that they determine.
    t (k, nt) : other equalities that contain these variables.
    u (k, nu) : variables that a constraint or the Hessian couples to e; first the nc variables c that are in
        the equalities q.
    qe (k, column, row), qc (k, nc, r), te (k, nt, r), tc (k, nt, nc) : places in the equalities' values,
        named by rows and columns.
    hee (k, r, r), heu (k, nu, r), hcv (k, nc, nu - nc) : places in the values of W's lower triangle; v are
        the variables in u that are not in c.
    hcc (k, nc (nc + 1) / 2) : of the lower triangle of the variables c.
    lu, pivots : factors of B, the part qe.
    X (k, nc, r) : B^-1 N, transposed.
    T (k, nt, r), H (k, r, r), G (k, nu, r) : parts te, hee and heu.
    x0 (k, r) : B^-1 residual.  own (k, r) : gradient by e.
    """

    q: Places
    e: Places
    t: Places
    u: Places
    qe: Places
    qc: Places
    te: Places
    tc: Places
    hee: Places
    heu: Places
    hcc: Places
    hcv: Places
    lu: Stack = field(init=False)
    pivots: Places = field(init=False)
    X: Stack = field(init=False)
    T: Stack = field(init=False)
    H: Stack = field(init=False)
    G: Stack = field(init=False)
    x0: Stack = field(init=False)
    own: Stack = field(init=False)

    def __post_init__(self) -> None:
        k, nt, nc = self.tc.shape
        r, nu = self.q.shape[1], self.u.shape[1]
        self.lu, self.pivots = np.zeros((k, r, r)), np.zeros((k, r), dtype=np.int32)
        self.X, self.T = np.zeros((k, nc, r)), np.zeros((k, nt, r))
        self.H, self.G = np.zeros((k, r, r)), np.zeros((k, nu, r))
        self.x0, self.own = np.zeros((k, r)), np.zeros((k, r))

    @property
    def c(self) -> Places:
        """Numbers (k, nc) of the other variables in the equalities q."""
        return self.u[:, : self.X.shape[1]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Products:
    """Outer products of the Jacobian's rows, in groups (g,) of rows with the same p columns.

    Attributes
    ----------
    counts (g,) : number of rows of each group.
    rows (k,), values (k, p) : rows, one group after the other, and the places of their values.
    to (g, p (p + 1) / 2) : places of the products in W, row by row of the lower triangle.
    """

    counts: Index
    rows: Places
    values: Places
    to: Places


@dataclass(frozen=True, eq=False, kw_only=True)
class Panels:
    """Layout of a block Cholesky factor.

    For each block of columns, its panel has the nonzero blocks of rows of the lower triangle, as one dense
    matrix that is stored by columns.

    Attributes
    ----------
    start : first variable of each block, and the end.
    at : place in the values at which each panel begins, and the end.
    height : number of rows of each panel.
    below : blocks of rows under the diagonal of each panel.
    row_at (block, panel) : row of a panel at which a block begins; -1 if the panel lacks the block.
    """

    start: Places
    at: Index
    height: Places
    below: tuple[Places, ...]
    row_at: Places

    @property
    def size(self) -> Places:
        """Number of variables of each block."""
        return np.diff(self.start)


class Kernels:
    """Kernels in NumPy."""

    def forget(self, thing: Any) -> None:
        """Discard what was derived from this list of stages or products, which is no longer used."""

    def copy(self, values: Vector, source: Places, to: Vector, places: Places) -> None:
        """to[places] = values[source]"""
        to[places] = values[source]

    def add_products(self, products: Sequence[Products], values: Vector, weights: Vector, W: Vector) -> None:
        """W += J' diag(weights) J."""
        for p in products:
            # (k, p); a row's product with itself by its lower triangle only, p (p + 1) / 2 entries.
            part = values[p.values]
            i, j = np.tril_indices(part.shape[1])
            _add(W, np.repeat(p.to, p.counts, axis=0), weights[p.rows][:, None] * part[:, i] * part[:, j])

    def eliminate(self, stages: Sequence[EliminationStage], J: Vector) -> None:
        """Compute X = B^-1 N, and replace d_e in the other equalities by -X d_c.

        Raises
        ------
        LinAlgError : B is singular.
        """
        for a in stages:
            a.T[:] = J[a.te]
            # arrays (k, column, row), as LAPACK stores matrices by columns: each B and N is a transposed
            # matrix
            for i, (B, N) in enumerate(zip(J[a.qe], J[a.qc], strict=True)):
                lu, pivots, info = la.lapack.dgetrf(B.T)
                # Only a pivot that is exactly zero; what a nearly singular B costs in digits is
                # left to the step's refinement.
                if info:
                    raise np.linalg.LinAlgError(_SINGULAR)
                a.lu[i], a.pivots[i] = lu.T, pivots
                a.X[i] = la.lapack.dgetrs(lu, pivots, N.T)[0].T
            # (k, nt, r) times (k, r, nc)
            _add(J, a.tc, -(a.T @ a.X.swapaxes(1, 2)))

    def reduce(self, stages: Sequence[EliminationStage], W: Vector) -> None:
        """Replace d_e in the quadratic form of W by -X d_c."""
        for a in stages:
            # Gathered once, (k, r, r) and (k, nu, r): `forward` uses them for every right-hand side.
            a.H[:], a.G[:] = W[a.hee], W[a.heu]
            G, nc = -a.G, a.X.shape[1]
            # W_cc += C + C' with C = X (H X' / 2 - G'), as each of the two has half of the symmetric term;
            # W_cv += C_v for the other variables in u (formulas with the arrays, in which X is transposed)
            G[:, :nc] += 0.5 * a.X @ a.H
            C = a.X @ G.swapaxes(1, 2)
            i, j = np.tril_indices(nc)
            _add(W, a.hcc, C[:, i, j] + C[:, j, i])
            _add(W, a.hcv, C[:, :, nc:])

    def forward(self, stages: Sequence[EliminationStage], g: Vector, off: Vector) -> None:
        """Replace d_e in gradient and residual by -(x0 + X d_c), with x0 = B^-1 residual."""
        for a in stages:
            # Kept for `expand`.
            a.x0[:] = self._solve(a, off[a.q], transposed=0)
            _add(off, a.t, -(a.T @ a.x0[..., None])[..., 0])
            # g_c -= X (g_e - H x0), g_u -= G x0
            own = g[a.e] - (a.H @ a.x0[..., None])[..., 0]
            _add(g, a.c, -(a.X @ own[..., None])[..., 0])
            _add(g, a.u, -(a.G @ a.x0[..., None])[..., 0])

    def expand(self, stages: Sequence[EliminationStage], d: Vector) -> None:
        """Set d_e of all stages, the last stage first."""
        for a in reversed(stages):
            # The variables c may be determined by a later stage, hence the reversed order.
            d[a.e] = -a.x0 - (d[a.c][:, None] @ a.X)[:, 0]

    def multipliers(self, stages: Sequence[EliminationStage], v: Vector, y: Vector) -> None:
        """Set the multipliers of the eliminated equalities.

        v : gradient of the Lagrangian without equalities, which is overwritten.  y : multipliers of the
        remaining equalities, to which those of the eliminated ones are added.
        """
        # forward: the gradient by c, with e replaced; backward: B' y_q = -(v_e + T' y_t) makes e stationary
        for a in stages:
            a.own[:] = v[a.e]
            _add(v, a.c, -(a.X @ a.own[..., None])[..., 0])
        for a in reversed(stages):
            y[a.q] = -self._solve(a, a.own + (y[a.t][:, None] @ a.T)[:, 0], transposed=1)

    def factor(self, p: Panels, values: Vector) -> bool:
        """Replace the panels of L L' by those of L; False: the matrix is not positive definite."""
        size, panels = p.size, _split(p, values)
        for k, panel in enumerate(panels):
            # diagonal block, rows below it, then their products subtracted from later panels (right-looking)
            own = size[k]
            panel[:own], info = la.lapack.dpotrf(panel[:own], lower=1)
            if info:
                return False
            # L_under L_own' = K_under; then the whole update of later panels is one product.
            under = la.blas.dtrsm(1.0, panel[:own], panel[own:], side=1, lower=1, trans_a=1)
            panel[own:] = under
            update = under @ under.T
            for column in p.below[k]:
                b = p.row_at[column, k] - own
                for row in p.below[k][p.below[k] >= column]:
                    a, to = p.row_at[row, k] - own, p.row_at[row, column]
                    panels[column][to : to + size[row]] -= update[a : a + size[row], b : b + size[column]]
        return True

    def solve(self, p: Panels, values: Vector, x: Stack) -> Stack:
        """(L L')^-1 x for columns (n, k), in place."""
        blocks = [slice(a, b) for a, b in zip(p.start[:-1], p.start[1:], strict=True)]
        every = np.arange(p.start[-1])
        under = [np.concatenate([every[:0], *[every[blocks[i]] for i in below]]) for below in p.below]
        panels = _split(p, values)
        # L, then its transpose, block by block
        for panel, own, rows in zip(panels, blocks, under, strict=True):
            size = own.stop - own.start
            x[own] = la.blas.dtrsm(1.0, panel[:size], x[own], lower=1)
            x[rows] -= panel[size:] @ x[own]
        for panel, own, rows in zip(panels[::-1], blocks[::-1], under[::-1], strict=True):
            size = own.stop - own.start
            x[own] = la.blas.dtrsm(1.0, panel[:size], x[own] - panel[size:].T @ x[rows], lower=1, trans_a=1)
        return x

    @staticmethod
    def _solve(a: EliminationStage, right: Stack, *, transposed: int) -> Stack:
        """B^-1, or B^-T, times right (k, r)."""
        found = [
            la.lapack.dgetrs(lu.T, p, b, trans=transposed)[0]
            for lu, p, b in zip(a.lu, a.pivots, right, strict=True)
        ]
        return np.array(found)


def _add(to: Vector, places: Places, values: Stack) -> None:
    """Add values; places may repeat."""
    # to[places] += values would add only one of the values at a repeated place.
    np.add.at(to, places.ravel(), values.ravel())


def _split(p: Panels, values: Vector) -> list[Stack]:
    """Each panel as a view (height, width) of the values."""
    return [values[a:b].reshape(-1, h).T for a, b, h in zip(p.at[:-1], p.at[1:], p.height, strict=True)]


_ROUTINES = (
    (cython_blas, "dgemm"),
    (cython_blas, "dgemv"),
    (cython_blas, "dsyrk"),
    (cython_blas, "dtrsm"),
    (cython_lapack, "dgetrf"),
    (cython_lapack, "dgetrs"),
    (cython_lapack, "dpotrf"),
)


def kernels() -> Kernels:
    """Kernels in C if there is a compiler, else in NumPy."""
    library = _library()
    return Kernels() if library is None else CompiledKernels(library)


@functools.cache
def _library() -> Any:
    library = native_library(__package__, "newton")
    if library is None:
        return None
    # SciPy's own BLAS: C links against none, and the limit of BLAS's threads (`run.threads`) holds here, too.
    pointers = (ctypes.c_void_p * len(_ROUTINES))(*[_pointer(*routine) for routine in _ROUTINES])
    library.newton_setup(pointers)
    return library


def _pointer(module: Any, name: str) -> int:
    """Address of one of SciPy's BLAS and LAPACK routines, which it exports to Cython as capsules."""
    # PyCapsule_GetPointer wants the capsule's own name, which is the routine's C signature.
    api, capsule = ctypes.pythonapi, module.__pyx_capi__[name]
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    return int(api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule)))


# Fields of the structs `stage` and `panels` of newton.c, in their order there.
_STAGE_ARRAYS = (
    *("q", "e", "t", "u", "qe", "qc", "te", "tc", "hee", "heu"),
    *("lu", "pivots", "X", "T", "H", "G", "x0", "own"),
)
_PANEL_ARRAYS = ("size", "height", "first", "below", "row_at", "start", "at")


class _Stage(ctypes.Structure):
    _fields_ = (
        *[(name, ctypes.c_int64) for name in ("k", "r", "nt", "nc", "nu")],
        *[(name, ctypes.c_void_p) for name in (*_STAGE_ARRAYS, "work", "hcc", "hcv")],
    )


class _Panels(ctypes.Structure):
    _fields_ = ("count", ctypes.c_int64), *[(name, ctypes.c_void_p) for name in (*_PANEL_ARRAYS, "work")]


class CompiledKernels(Kernels):
    """Kernels in C."""

    def __init__(self, library: Any):
        self._c = library
        self._cached: dict[int, tuple[Any, Any]] = {}

    # ------------------------------------------------------------------ arguments of the C functions
    def _arguments(self, thing: Any, make: Callable[[Any], Any]) -> Any:
        """Arguments of C for a list of stages, products or panels, made once."""
        # The thing is kept with them, so that its id is not given to another one, nor the memory that C
        # points to be freed.
        found = self._cached.get(id(thing))
        if found is None:
            found = self._cached[id(thing)] = thing, make(thing)
        return found[1]

    def forget(self, thing: Any) -> None:
        self._cached.pop(id(thing), None)

    @staticmethod
    def _stages(stages: Sequence[EliminationStage]) -> tuple[Any, ...]:
        structs, keep = [], []
        for a in stages:
            k, nt, nc = a.tc.shape
            r, nu = a.q.shape[1], a.u.shape[1]
            # scratch of one system: the largest of what eliminate, reduce, and the operations on vectors need
            spread = nc * max(nc + 1, nu)
            work = np.zeros(max(nt * nc, r * (nu + nc) + max(r * nu, spread), r + max(nt, nc, nu)) + 1)
            within = _runs(a.hcc.ravel(), np.arange(k)[:, None] * a.hcc.shape[1] + _rows_of_triangle(nc))
            beyond = _runs(a.hcv.transpose(0, 2, 1).ravel(), np.arange(k * (nu - nc) if nc else 0) * nc)
            # Kept in `keep`, as the struct holds their addresses only.
            arrays = [*[getattr(a, name) for name in _STAGE_ARRAYS], work, within, beyond]
            structs.append(_Stage(k, r, nt, nc, nu, *[x.ctypes.data for x in arrays]))
            keep.append(arrays)
        return (_Stage * len(structs))(*structs), ctypes.c_int64(len(structs)), keep

    @staticmethod
    def _panels(p: Panels) -> tuple[Any, ...]:
        size = p.size
        rest = int((p.height - size).max(initial=0))  # most rows below a diagonal block
        first = np.cumsum([0, *[len(b) for b in p.below]]).astype(np.int32)
        below = np.concatenate([np.zeros(0, np.int32), *p.below])
        work = np.zeros(rest * max(rest, p.start[-1]) + 1)
        keep = size, p.height, first, below, p.row_at, p.start, p.at, work
        return ctypes.byref(_Panels(size.size, *[x.ctypes.data for x in keep])), keep

    @staticmethod
    def _groups(products: Sequence[Products]) -> tuple[Any, ...]:
        none = [np.zeros(0, np.int32)]  # as np.concatenate takes no empty list
        columns = [p.values.shape[1] for p in products]
        before = np.cumsum([0, *[p.to.size for p in products]])
        rows = [
            start + p.to.shape[1] * np.arange(len(p.to))[:, None] + _rows_of_triangle(m)
            for start, p, m in zip(before, products, columns, strict=False)
        ]
        parts = (
            np.concatenate(none + [p.counts for p in products]).astype(np.int32),
            np.repeat(columns, [len(p.to) for p in products]).astype(np.int32),
            np.concatenate(none + [p.rows for p in products]),
            np.concatenate(none + [p.values.ravel() for p in products]),
            _runs(
                np.concatenate(none + [p.to.ravel() for p in products]),
                np.concatenate(none + [r.ravel() for r in rows]),
            ),
        )
        most = [(int(p.counts.max(initial=0)) + 1) * (p.values.shape[1] + 1) for p in products]
        return ctypes.c_int64(parts[0].size), parts, np.zeros(max(most, default=1))

    # ------------------------------------------------------------------ the operations
    def copy(self, values: Vector, source: Places, to: Vector, places: Places) -> None:
        arrays = address(values), address(source), address(to), address(places)
        self._c.newton_copy(*arrays, ctypes.c_int64(source.size))

    def add_products(self, products: Sequence[Products], values: Vector, weights: Vector, W: Vector) -> None:
        groups, parts, work = self._arguments(products, self._groups)
        self._c.newton_products(groups, *map(address, [*parts, values, weights, W, work]))

    def eliminate(self, stages: Sequence[EliminationStage], J: Vector) -> None:
        if self._c.newton_eliminate(*self._arguments(stages, self._stages)[:2], address(J)):
            raise np.linalg.LinAlgError(_SINGULAR)

    def reduce(self, stages: Sequence[EliminationStage], W: Vector) -> None:
        self._c.newton_reduce(*self._arguments(stages, self._stages)[:2], address(W))

    def forward(self, stages: Sequence[EliminationStage], g: Vector, off: Vector) -> None:
        self._c.newton_forward(*self._arguments(stages, self._stages)[:2], address(g), address(off))

    def expand(self, stages: Sequence[EliminationStage], d: Vector) -> None:
        self._c.newton_expand(*self._arguments(stages, self._stages)[:2], address(d))

    def multipliers(self, stages: Sequence[EliminationStage], v: Vector, y: Vector) -> None:
        self._c.newton_multipliers(*self._arguments(stages, self._stages)[:2], address(v), address(y))

    def factor(self, p: Panels, values: Vector) -> bool:
        return not self._c.newton_cholesky(self._arguments(p, self._panels)[0], address(values))

    def solve(self, p: Panels, values: Vector, x: Stack) -> Stack:
        shape = (ctypes.c_int64(x.shape[0]), ctypes.c_int64(x.shape[1]))
        self._c.newton_solve(self._arguments(p, self._panels)[0], address(values), address(x), *shape)
        return x


def _runs(places: Places, first: Index) -> Places:
    """Runs (count, 2) of consecutive places: the first one and the length; each of ``first`` begins a run.

    C adds a run without looking up each place.
    """
    begins = np.append(True, places[1:] != places[:-1] + 1)[: places.size]
    begins[first.ravel()] = True
    at = np.flatnonzero(begins)
    return np.column_stack([places[at], np.diff(np.append(at, places.size))]).astype(np.int32)


@functools.cache
def _rows_of_triangle(n: int) -> Index:
    """Index at which each row of a lower triangle begins."""
    i = np.arange(n)
    return i * (i + 1) // 2
