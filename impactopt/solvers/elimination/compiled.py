"""The small dense algebra of condensed Newton systems, in C."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from impactopt.codegen.compiler import address, native_library
from impactopt.solvers.elimination.kernels import (
    EliminationStep,
    Index,
    Kernels,
    Panels,
    Places,
    Products,
    Stack,
)
from impactopt.solvers.program import Vector

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
    """The kernels in C where there is a compiler, or else in NumPy."""
    library = _library()
    return Kernels() if library is None else CompiledKernels(library)


@functools.cache
def _library() -> Any:
    library = native_library(__package__, "newton")
    if library is None:
        return None
    pointers = (ctypes.c_void_p * len(_ROUTINES))(*[_pointer(*routine) for routine in _ROUTINES])
    library.newton_setup(pointers)
    return library


def _pointer(module: Any, name: str) -> int:
    """The address of one of SciPy's BLAS and LAPACK routines, which come in capsules for Cython's sake."""
    api, capsule = ctypes.pythonapi, module.__pyx_capi__[name]
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    return int(api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule)))


_OF_STAGES = (
    *("q", "e", "t", "u", "qe", "qc", "te", "tc", "hee", "heu"),
    *("lu", "pivots", "X", "T", "H", "G", "x0", "own"),
)
_OF_PANELS = ("size", "height", "first", "below", "row_at", "start", "at")


class _Stage(ctypes.Structure):
    _fields_ = (
        *[(name, ctypes.c_int64) for name in ("k", "r", "nt", "nc", "nu")],
        *[(name, ctypes.c_void_p) for name in (*_OF_STAGES, "work", "hcc", "hcv")],
    )


class _Panels(ctypes.Structure):
    _fields_ = ("count", ctypes.c_int64), *[(name, ctypes.c_void_p) for name in (*_OF_PANELS, "work")]


class CompiledKernels(Kernels):
    """Kernels in C."""

    def __init__(self, library: Any):
        self._c = library
        self._made: dict[int, tuple[Any, Any]] = {}

    # ------------------------------------------------------------------ what C needs to know
    def _of(self, thing: Any, make: Callable[[Any], Any]) -> Any:
        """Arguments that C takes for a thing, made once, and kept with it and with what it points to."""
        found = self._made.get(id(thing))
        if found is None:
            found = self._made[id(thing)] = thing, make(thing)
        return found[1]

    def forget(self, thing: Any) -> None:
        self._made.pop(id(thing), None)

    @staticmethod
    def _all(stages: Sequence[EliminationStep]) -> tuple[Any, ...]:
        made, keep = [], []
        for a in stages:
            k, nt, nc = a.tc.shape
            r, nu = a.q.shape[1], a.u.shape[1]
            spread = nc * max(nc + 1, nu)  # of products of variables that rows touch, and of others
            work = np.zeros(max(nt * nc, r * (nu + nc) + max(r * nu, spread), r + max(nt, nc, nu)) + 1)
            within = _runs(a.hcc.ravel(), np.arange(k)[:, None] * a.hcc.shape[1] + _rows_of_triangle(nc))
            beyond = _runs(a.hcv.transpose(0, 2, 1).ravel(), np.arange(k * (nu - nc) if nc else 0) * nc)
            arrays = [*[getattr(a, name) for name in _OF_STAGES], work, within, beyond]
            made.append(_Stage(k, r, nt, nc, nu, *[x.ctypes.data for x in arrays]))
            keep.append(arrays)
        return (_Stage * len(made))(*made), ctypes.c_int64(len(made)), keep

    @staticmethod
    def _panels(p: Panels) -> tuple[Any, ...]:
        size = p.size
        rest = int((p.height - size).max(initial=0))
        first = np.cumsum([0, *[len(b) for b in p.below]]).astype(np.int32)
        below = np.concatenate([np.zeros(0, np.int32), *p.below])
        work = np.zeros(rest * max(rest, p.start[-1]) + 1)
        keep = size, p.height, first, below, p.row_at, p.start, p.at, work
        return ctypes.byref(_Panels(size.size, *[x.ctypes.data for x in keep])), keep

    @staticmethod
    def _groups(products: Sequence[Products]) -> tuple[Any, ...]:
        none = [np.zeros(0, np.int32)]
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
        groups, parts, work = self._of(products, self._groups)
        self._c.newton_products(groups, *map(address, [*parts, values, weights, W, work]))

    def eliminate(self, stages: Sequence[EliminationStep], J: Vector) -> None:
        if self._c.newton_eliminate(*self._of(stages, self._all)[:2], address(J)):
            raise np.linalg.LinAlgError("rows do not determine their variables")

    def reduce(self, stages: Sequence[EliminationStep], W: Vector) -> None:
        self._c.newton_reduce(*self._of(stages, self._all)[:2], address(W))

    def forward(self, stages: Sequence[EliminationStep], g: Vector, off: Vector) -> None:
        self._c.newton_forward(*self._of(stages, self._all)[:2], address(g), address(off))

    def expand(self, stages: Sequence[EliminationStep], d: Vector) -> None:
        self._c.newton_expand(*self._of(stages, self._all)[:2], address(d))

    def multipliers(self, stages: Sequence[EliminationStep], v: Vector, y: Vector) -> None:
        self._c.newton_multipliers(*self._of(stages, self._all)[:2], address(v), address(y))

    def factor(self, p: Panels, values: Vector) -> bool:
        return not self._c.newton_cholesky(self._of(p, self._panels)[0], address(values))

    def solve(self, p: Panels, values: Vector, x: Stack) -> Stack:
        shape = (ctypes.c_int64(x.shape[0]), ctypes.c_int64(x.shape[1]))
        self._c.newton_solve(self._of(p, self._panels)[0], address(values), address(x), *shape)
        return x


def _runs(places: Places, first: Index) -> Places:
    """Places in runs of neighbours (runs, 2): the first and how many; a run begins at each of ``first``."""
    begins = np.append(True, places[1:] != places[:-1] + 1)[: places.size]
    begins[first.ravel()] = True
    at = np.flatnonzero(begins)
    return np.column_stack([places[at], np.diff(np.append(at, places.size))]).astype(np.int32)


@functools.cache
def _rows_of_triangle(n: int) -> Index:
    """Beginnings of the rows of a lower triangle."""
    i = np.arange(n)
    return i * (i + 1) // 2
