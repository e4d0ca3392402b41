"""Sparsity patterns of condensed Newton systems, found once for all their numbers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from impactopt.solvers.elimination.kernels import EliminationStep, Index, Places, Products
from impactopt.solvers.program import Matrix


class Elimination(NamedTuple):
    """Systems of one shape: equality rows (k, r), and the variables (k, r) that each system's rows determine.

    Those that a row or the Hessian ties to each other are eliminated one after the other, all else at once.
    """

    rows: Index
    variables: Index


class Touched(NamedTuple):
    """Rows and variables of one system.

    q, e : its rows and variables; t : other equality rows that these variables touch; c : variables that its
    rows touch; u : c, and behind them those that only the Hessian couples to e.
    """

    q: Index
    e: Index
    t: Index
    c: Index
    u: Index


def fill(touches: Any, couples: Any, eliminations: Sequence[Elimination]) -> list[list[Touched]]:
    """Mark what becomes nonzero on the way, and find what each system touches.

    The systems of each list of those that come out can be eliminated at once, list after list.
    """
    row_left, column_left = np.ones(touches.shape[0], dtype=bool), np.ones(touches.shape[1], dtype=bool)
    touched_by = np.ascontiguousarray(touches.T)  # the same, as columns are looked at as often as rows
    out = []
    for elimination in eliminations:
        waiting = list(zip(*elimination, strict=True))
        while waiting:
            systems, waiting = _apart(waiting, touched_by, couples, row_left)
            for q, e in systems:
                row_left[q] = column_left[e] = False
            found = []
            for q, e in systems:
                t = np.flatnonzero(touched_by[e].any(axis=0) & row_left)
                c = np.flatnonzero(touches[q].any(axis=0) & column_left)
                more = couples[e].any(axis=0) & column_left
                more[c] = False
                u = np.concatenate([c, np.flatnonzero(more)])
                for rows, columns in ((t, c), (t, e), (q, e)):
                    touches[rows[:, None], columns] = touched_by[columns[:, None], rows] = True
                couples[e[:, None], e] = couples[c[:, None], u] = couples[u[:, None], c] = True
                found.append(Touched(q, e, t, c, u))
            out.append(found)
    return out


_Systems = list[tuple[Index, Index]]  # rows and variables of each


def _apart(systems: _Systems, touched_by: Any, couples: Any, row_left: Any) -> tuple[_Systems, _Systems]:
    """Systems that nothing ties to one before them, and the others."""
    rows, variables = np.zeros(touched_by.shape[1], dtype=bool), np.zeros(touched_by.shape[0], dtype=bool)
    now, later = _Systems(), _Systems()
    for q, e in systems:
        touched = touched_by[e].any(axis=0) & row_left
        if (rows & touched).any() or couples[e][:, variables].any():
            later.append((q, e))
            continue
        rows |= touched
        variables[e] = True
        now.append((q, e))
    return now, later


class Alike(NamedTuple):
    """Groups of rows, each of which touches the same columns, as many as those of the other groups.

    columns (g, p) : of each group; counts (g,) : its rows; rows (k,) : of one group after the other; values
    (k, p) : where their numbers stand in the data.
    """

    columns: Index
    counts: Index
    rows: Index
    values: Places


def by_pattern(jacobian: Matrix, rows: Index) -> list[Alike]:
    """All of these rows that touch any column; the data are those of a csc."""
    numbered = sp.csc_array((np.arange(jacobian.nnz), jacobian.indices, jacobian.indptr), jacobian.shape)
    by_rows = numbered.tocsr()
    by_rows.sort_indices()
    start, columns, at = by_rows.indptr, by_rows.indices, by_rows.data.astype(np.int32)
    touched, ends = columns.tobytes(), (columns.itemsize * start).tolist()
    groups: dict[bytes, int] = {}
    group = np.array([groups.setdefault(touched[ends[i] : ends[i + 1]], len(groups)) for i in rows.tolist()])
    if not group.size:
        return []
    first, counts = np.unique(group, return_index=True, return_counts=True)[1:]
    sizes = (start[1:] - start[:-1])[rows[first]]
    order = np.argsort(group, kind="stable")
    size_of = sizes[group[order]]
    out = []
    for p in dict.fromkeys(sizes[sizes > 0].tolist()):
        chosen, same, every = np.flatnonzero(sizes == p), rows[order[size_of == p]], np.arange(p)
        own = columns[start[rows[first[chosen]]][:, None] + every].astype(np.intp)
        out.append(Alike(own, counts[chosen], same, at[start[same][:, None] + every]))
    return out


def entries(matrix: Any) -> tuple[Index, Index]:
    """np.nonzero, which takes twice as long for two dimensions as for one."""
    return np.divmod(np.flatnonzero(matrix), matrix.shape[1])


def numbered(i: Index, j: Index, shape: tuple[int, ...]) -> tuple[Places, int]:
    """Places of the entries (i, j) in a matrix, counted from 1; the others have 0. And how many there are."""
    out = np.zeros(shape, dtype=np.int32)
    out[i, j] = np.arange(1, i.size + 1)
    return out, i.size


_lower = functools.cache(np.tril_indices)


def products(pairs: Places, groups: Sequence[Alike]) -> list[Products]:
    """Places of the products of each row's numbers; pairs : places of the entries of W, as of `numbered`."""
    out = []
    for columns, counts, rows, values in groups:
        i, j = _lower(columns.shape[1])
        to = pairs[columns[:, i], columns[:, j]]
        out.append(Products(counts=counts, rows=rows.astype(np.int32), values=values, to=to))
    return out


def shapes(systems: list[Touched]) -> list[list[Touched]]:
    """Systems of one elimination that touch as many variables and rows as each other."""
    out: dict[tuple[int, int, int], list[Touched]] = {}
    for s in systems:
        out.setdefault((s.c.size, s.u.size, s.t.size), []).append(s)
    return list(out.values())


def stage(systems: list[Touched], rows: Places, pairs: Places) -> EliminationStep:
    """Systems of one shape; rows, pairs : places of the entries of equalities and W, as of `numbered`."""
    q, e, t, c, u = (np.array([getattr(s, name) for s in systems]) for name in ("q", "e", "t", "c", "u"))
    i, j = _lower(c.shape[1])
    places = {
        "qe": rows[q[:, None, :], e[:, :, None]],
        "qc": rows[q[:, None, :], c[:, :, None]],
        "te": rows[t[:, :, None], e[:, None, :]],
        "tc": rows[t[:, :, None], c[:, None, :]],
        "hee": pairs[e[:, :, None], e[:, None, :]],
        "heu": pairs[u[:, :, None], e[:, None, :]],
        "hcc": pairs[c[:, i], c[:, j]],
        "hcv": pairs[c[:, :, None], u[:, None, c.shape[1] :]],
    }
    numbers = {"q": q, "e": e, "t": t, "u": u, **places}
    return EliminationStep(**{name: np.ascontiguousarray(a, dtype=np.int32) for name, a in numbers.items()})
