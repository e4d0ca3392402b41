"""H = L' D L by Featherstone's LTDL (2008, chapter 6): L has the tree's pattern, so nothing fills in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from impactopt.errors import InputError
from impactopt.robots.rigid_body._scalar import Number, Vector, as_sx, is_zero, pack_entries, unpack_entries


class Factor:
    """The factorization H = L' D L of a symmetric positive definite matrix with a tree's pattern.

    L is unit lower triangular, D diagonal. Structural zeros of right-hand sides stay zeros, so a sparse one
    costs what its own branch of the tree costs.
    """

    def __init__(self, parents: list[int], upper: Mapping[tuple[int, int], Number]) -> None:
        self._parents, self.nv = parents, len(parents)
        A: dict[tuple[int, int], Number] = {}
        for k in range(self.nv):
            for j in (k, *self._ancestors(k)):
                A[k, j] = upper.get((j, k), 0.0)
        self._L: dict[tuple[int, int], Number] = {}
        self._D: list[Number] = [0.0] * self.nv
        for k in range(self.nv - 1, -1, -1):
            if is_zero(A[k, k]):
                raise InputError(
                    f"H: nothing resists velocity {k} (its row is zero); give the link inertia or armature"
                )
            self._D[k] = A[k, k]
            above = [i for i in self._ancestors(k) if not is_zero(A[k, i])]
            for i in above:
                self._L[k, i] = A[k, i] / A[k, k]
            for i in above:
                for j in (i, *self._ancestors(i)):
                    A[i, j] = A[i, j] - self._L[k, i] * A[k, j]

    def _ancestors(self, k: int) -> list[int]:
        chain = []
        k = self._parents[k]
        while k >= 0:
            chain.append(k)
            k = self._parents[k]
        return chain

    def half_solve(self, b: Any) -> Any:
        """L^-T b, SX (nv, k): with y = half_solve(b), b' H^-1 b = y' D^-1 y."""
        return self._pack([self._half(x) for x in self._columns(b, "b")])

    def solve(self, b: Any) -> Any:
        """H^-1 b, SX (nv, k)."""
        return self._pack([self._back(self._half(x)) for x in self._columns(b, "b")])

    @property
    def diagonal(self) -> Any:
        """D, SX (nv)."""
        return self._pack([dict(enumerate(self._D))])

    # ------------------------------------------------------------ sparse columns {row: number}
    def _columns(self, b: Any, name: str) -> list[dict[int, Number]]:
        b = as_sx(name, b)
        if b.size1() != self.nv:
            raise InputError(f"{name}: expected {self.nv} rows, got shape {b.shape}")
        columns: list[dict[int, Number]] = [{} for _ in range(b.size2())]
        for (r, c), number in unpack_entries(b).items():
            if not is_zero(number):
                columns[c][r] = number
        return columns

    def _pack(self, columns: list[dict[int, Number]]) -> Any:
        entries = {(r, c): x for c, column in enumerate(columns) for r, x in column.items()}
        return pack_entries((self.nv, len(columns)), entries)

    def _half(self, b: dict[int, Number]) -> dict[int, Number]:
        y = dict(b)
        for k in range(self.nv - 1, -1, -1):
            if k in y:
                for i in self._ancestors(k):
                    if (k, i) in self._L:
                        y[i] = y.get(i, 0.0) - self._L[k, i] * y[k]
        return y

    def _back(self, y: dict[int, Number]) -> dict[int, Number]:
        x: dict[int, Number] = {}
        for k in range(self.nv):
            value: Number = y[k] / self._D[k] if k in y else 0.0
            for i in self._ancestors(k):
                if i in x and (k, i) in self._L:
                    value = value - self._L[k, i] * x[i]
            if not is_zero(value):
                x[k] = value
        return x


def tree_entries(parents: list[int], H: Any) -> dict[tuple[int, int], Number]:
    """The upper triangle of H, SX (nv, nv), checked to have the tree's pattern."""
    upper = {place: x for place, x in unpack_entries(H).items() if place[0] <= place[1] and not is_zero(x)}
    for i, j in upper:
        k = j
        while k > i:
            k = parents[k]
        if k != i:
            raise InputError(
                f"H: entry ({i}, {j}) couples two branches of the tree; factorize such a matrix densely"
            )
    return upper


def add_to_diagonal(
    upper: Mapping[tuple[int, int], Number], damping: Vector
) -> dict[tuple[int, int], Number]:
    damped = dict(upper)
    for k, x in enumerate(damping):
        damped[k, k] = damped.get((k, k), 0.0) + x
    return damped
