"""Which entries a condensed Newton system has, and where they stand: found once for all its numbers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from impactopt.solvers.program import Matrix
from impactopt.solvers.sqp.kernels import EliminationStep, Index, Places, Products


class Elimination(NamedTuple):
    """Systems of one shape: equality rows (k, r), and the variables (k, r) that each system's rows determine.

    Those that a row or the Hessian ties to each other are eliminated one after the other, all else at once.
    """

    rows: Index
    variables: Index


class Touched(NamedTuple):
    """What one system touches.

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
    out = []
    for elimination in eliminations:
        waiting = list(zip(*elimination, strict=True))
        while waiting:
            systems, waiting = _apart(waiting, touches, couples, row_left)
            for q, e in systems:
                row_left[q] = column_left[e] = False
            found = []
            for q, e in systems:
                t = np.flatnonzero(touches[:, e].any(axis=1) & row_left)
                c = np.flatnonzero(touches[q].any(axis=0) & column_left)
                more = couples[e].any(axis=0) & column_left
                more[c] = False
                u = np.concatenate([c, np.flatnonzero(more)])
                touches[np.ix_(t, c)] = touches[np.ix_(t, e)] = True
                touches[np.ix_(q, e)] = couples[np.ix_(e, e)] = True
                couples[np.ix_(c, u)] = couples[np.ix_(u, c)] = True
                found.append(Touched(q, e, t, c, u))
            out.append(found)
    return out


_Systems = list[tuple[Index, Index]]  # rows and variables of each


def _apart(systems: _Systems, touches: Any, couples: Any, row_left: Any) -> tuple[_Systems, _Systems]:
    """Those of these systems that nothing ties to one before them, and the others."""
    rows, variables = np.zeros(touches.shape[0], dtype=bool), np.zeros(touches.shape[1], dtype=bool)
    now, later = _Systems(), _Systems()
    for q, e in systems:
        touched = touches[:, e].any(axis=1) & row_left
        if (rows & touched).any() or couples[e][:, variables].any():
            later.append((q, e))
            continue
        rows |= touched
        variables[e] = True
        now.append((q, e))
    return now, later


_Rows = tuple[Index, Index, Places]


def by_pattern(jacobian: Matrix, rows: Index) -> list[_Rows]:
    """Columns, rows that touch just them, and where their values (rows, columns) stand in the data, csc."""
    numbered = sp.csc_array((np.arange(jacobian.nnz), jacobian.indices, jacobian.indptr), jacobian.shape)
    by_rows = numbered.tocsr()
    by_rows.sort_indices()
    start, columns, at = by_rows.indptr, by_rows.indices, by_rows.data.astype(np.int32)
    found: dict[bytes, list[int]] = {}
    for i in rows:
        found.setdefault(columns[start[i] : start[i + 1]].tobytes(), []).append(i)
    found.pop(b"", None)
    out = []
    for key, numbers in found.items():
        own, same = np.frombuffer(key, dtype=columns.dtype).astype(np.intp), np.array(numbers)
        out.append((own, same, at[start[same][:, None] + np.arange(own.size)]))
    return out


def entries(matrix: Any) -> tuple[Index, Index]:
    """np.nonzero, which takes twice as long for two dimensions as for one."""
    return np.divmod(np.flatnonzero(matrix), matrix.shape[1])


def numbered(i: Index, j: Index, shape: tuple[int, ...]) -> tuple[Places, int]:
    """Places of the entries (i, j), counted from 0, in a matrix; the others have the number of all."""
    out = np.full(shape, i.size, dtype=np.int32)
    out[i, j] = np.arange(i.size)
    return out, i.size


_lower = functools.cache(np.tril_indices)


def alike(groups: Sequence[_Rows]) -> list[tuple[Index, list[_Rows]]]:
    """All columns (group, column) of those groups that have as many as each other, and these groups."""
    sizes: dict[int, list[_Rows]] = {}
    for group in groups:
        sizes.setdefault(group[0].size, []).append(group)
    return [(np.array([columns for columns, _, _ in same]), same) for same in sizes.values()]


def products(pairs: Places, columns: Index, groups: list[_Rows]) -> list[Products]:
    i, j = _lower(columns.shape[1])
    return [
        Products(rows=rows.astype(np.int32), values=values, to=to)
        for (_, rows, values), to in zip(groups, pairs[columns[:, i], columns[:, j]], strict=True)
    ]


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
