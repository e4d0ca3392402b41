"""Named groups of decision variables and affine expressions in them.

The solver sees scaled variables; everything built from a :class:`Group` is in physical units, because a
group's affine expressions carry its scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Affine:
    """``size`` affine expressions  c + sum_k v_k x[col_k]  of the decision variables, as triplets."""

    size: int
    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    vals: Array
    const: Array

    @classmethod
    def constant(cls, values: ArrayLike) -> Affine:
        c = np.atleast_1d(np.asarray(values, dtype=float)).ravel()
        none = np.zeros(0, dtype=np.intp)
        return cls(c.size, none, none, np.zeros(0), c)

    @classmethod
    def zeros(cls, size: int) -> Affine:
        return cls.constant(np.zeros(size))

    @classmethod
    def of_matrix(cls, matrix: Any, const: Array) -> Affine:
        """matrix (size, n), sparse, times the variables, plus const (size,)."""
        entries = sp.coo_array(matrix)
        rows, cols = (np.asarray(i, dtype=np.intp) for i in (entries.row, entries.col))
        return cls(len(const), rows, cols, np.asarray(entries.data), np.asarray(const))

    def __add__(self, other: Affine) -> Affine:
        return add([self, other])

    def __mul__(self, factor: ArrayLike) -> Affine:
        k = np.asarray(factor, dtype=float) + np.zeros(self.size)
        return Affine(self.size, self.rows, self.cols, self.vals * k[self.rows], self.const * k)

    __rmul__ = __mul__

    def __neg__(self) -> Affine:
        return self * -1.0

    def __sub__(self, other: Affine) -> Affine:
        return self + (-other)

    def __getitem__(self, index: NDArray[np.intp] | slice) -> Affine:
        keep = np.atleast_1d(np.arange(self.size)[index])
        return select(self, keep)

    def matrix(self, n: int) -> sp.csr_array:
        return sp.csr_array((self.vals, (self.rows, self.cols)), shape=(self.size, n))

    def apply(self, matrix: ArrayLike) -> Affine:
        """The affine expressions ``matrix @ self``."""
        m = np.asarray(matrix, dtype=float)
        r, c = np.nonzero(m[:, self.rows])
        return Affine(m.shape[0], r, self.cols[c], m[r, self.rows[c]] * self.vals[c], m @ self.const)

    def evaluate(self, x: Array) -> Array:
        return self.const + np.bincount(self.rows, self.vals * x[self.cols], self.size)


def select(expression: Affine, keep: NDArray[np.intp]) -> Affine:
    out = [np.flatnonzero(expression.rows == k) for k in keep]
    where = np.concatenate(out) if out else np.zeros(0, dtype=np.intp)
    rows = np.repeat(np.arange(len(keep)), [len(o) for o in out])
    return Affine(len(keep), rows, expression.cols[where], expression.vals[where], expression.const[keep])


def add(parts: Sequence[Affine]) -> Affine:
    """The sum of one expression or more, of one size."""
    if len(sizes := dict.fromkeys(p.size for p in parts)) > 1:
        raise ValueError(f"affine expressions of sizes {' and '.join(map(str, sizes))} do not add")
    return Affine(
        parts[0].size,
        np.concatenate([p.rows for p in parts]),
        np.concatenate([p.cols for p in parts]),
        np.concatenate([p.vals for p in parts]),
        np.sum([p.const for p in parts], axis=0),
    )


def stack(parts: Sequence[Affine]) -> Affine:
    """One tall expression from several."""
    offset = np.cumsum([0] + [p.size for p in parts])
    none = np.zeros(0, dtype=np.intp)
    return Affine(
        int(offset[-1]),
        np.concatenate([none] + [p.rows + o for p, o in zip(parts, offset, strict=False)]),
        np.concatenate([none] + [p.cols for p in parts]),
        np.concatenate([np.zeros(0)] + [p.vals for p in parts]),
        np.concatenate([np.zeros(0)] + [p.const for p in parts]),
    )


@dataclass(frozen=True)
class Group:
    """Variables of one kind: ``count`` vectors of length ``size``.

    ``scale`` turns solver units to physical ones.
    """

    name: str
    offset: int
    count: int
    size: int
    scale: Array  # (size,)
    labels: tuple[str, ...]

    def index(self, k: int) -> NDArray[np.intp]:
        if not -self.count <= k < self.count:
            raise IndexError(f"{self.name} has {self.count} members, not {k}")
        return self.offset + (k % self.count) * self.size + np.arange(self.size)

    def __getitem__(self, k: int) -> Affine:
        return Affine(self.size, np.arange(self.size), self.index(k), self.scale.copy(), np.zeros(self.size))

    def read(self, x: Array) -> Array:
        """Physical values, shape (count, size)."""
        return (
            x[self.offset : self.offset + self.count * self.size].reshape(self.count, self.size) * self.scale
        )

    def write(self, x: Array, values: ArrayLike) -> None:
        v = np.broadcast_to(np.asarray(values, dtype=float), (self.count, self.size)) / self.scale
        x[self.offset : self.offset + self.count * self.size] = v.ravel()


@dataclass
class Layout:
    """The decision vector: groups one behind the other, with their bounds in solver units."""

    groups: dict[str, Group] = field(default_factory=dict)
    n: int = 0
    _lower: list[Array] = field(default_factory=list)
    _upper: list[Array] = field(default_factory=list)

    def add(
        self,
        name: str,
        count: int,
        size: int,
        *,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        scale: ArrayLike = 1.0,
        labels: Sequence[str] | None = None,
    ) -> Group:
        """Append ``count`` vectors of ``size`` variables; bounds (physical) broadcast to (count, size)."""
        s = np.broadcast_to(np.asarray(scale, dtype=float), (size,)).copy()
        tags = tuple(labels) if labels is not None else tuple(str(i) for i in range(size))
        group = Group(name, self.n, count, size, s, tags)
        self.groups[name] = group
        for store, bound in ((self._lower, lower), (self._upper, upper)):
            store.append((np.broadcast_to(np.asarray(bound, dtype=float), (count, size)) / s).ravel())
        self.n += count * size
        return group

    @property
    def lower(self) -> Array:
        return np.concatenate([np.zeros(0), *self._lower])

    @property
    def upper(self) -> Array:
        return np.concatenate([np.zeros(0), *self._upper])

    def bounds(self, group: Group) -> tuple[float, float]:
        """Bounds of a group of one variable, physical units."""
        if group.count * group.size != 1:
            raise ValueError(f"{group.name} has more than one variable")
        scale = float(group.scale[0])
        return float(self.lower[group.offset]) * scale, float(self.upper[group.offset]) * scale

    def bound(self, group: Group, lower: ArrayLike, upper: ArrayLike) -> None:
        """Other bounds, as of :meth:`add`."""
        k = list(self.groups).index(group.name)
        for store, bound in ((self._lower, lower), (self._upper, upper)):
            shape = group.count, group.size
            store[k] = (np.broadcast_to(np.asarray(bound, dtype=float), shape) / group.scale).ravel()

    def name(self, j: int) -> str:
        for g in self.groups.values():
            k = j - g.offset
            if 0 <= k < g.count * g.size:
                return f"{g.name}[{k // g.size}], {g.labels[k % g.size]}"
        raise IndexError(j)
