"""Variables of a saved program by name, and pieces of it: functions of a few of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
RowName = tuple[str, str, str]  # term, place, component


class Variables:
    """Solver variables x (n,), read in physical units.

    scales : of each group's members, by name.  read : a set, to note in it which of them are read; or None.
    """

    def __init__(self, groups: Sequence[tuple[str, int, int]], scales: dict[str, Array], x: Array) -> None:
        self.x = np.array(x, dtype=float)
        self.read: set[int] | None = None
        self._at: dict[str, tuple[int, int, int, Array]] = {}
        offset = 0
        for name, count, size in groups:
            scale = np.broadcast_to(scales.get(name, np.ones(1)), (size,))
            self._at[name] = offset, count, size, scale
            offset += count * size
        self.n = offset

    def __contains__(self, name: str) -> bool:
        return name in self._at

    @property
    def names(self) -> list[str]:
        """Of all groups."""
        return list(self._at)

    def count(self, name: str) -> int:
        """How many members a group has; 0 if there is none of that name."""
        return self._at[name][1] if name in self._at else 0

    def get(self, name: str, k: int = 0) -> Array:
        """Member k of a group, from the end if negative."""
        offset, count, size, scale = self._at[name]
        first = offset + (k % count) * size
        if self.read is not None:
            self.read.update(range(first, first + size))
        return self.x[first : first + size] * scale

    def one(self, name: str, k: int = 0) -> float:
        """Member k of a group of single numbers."""
        return float(self.get(name, k)[0])

    def all(self, name: str) -> Array:
        """(count, size) of a group."""
        return np.array([self.get(name, k) for k in range(self._at[name][1])]).reshape(self._at[name][1:3])

    def span(self, name: str) -> slice:
        """Where a group is among the variables."""
        offset, count, size, _ = self._at[name]
        return slice(offset, offset + count * size)

    def scaled(self, name: str, values: Array) -> Array:
        """Physical values (count, size) in solver units, flat."""
        _, count, size, scale = self._at[name]
        return np.asarray((np.broadcast_to(values, (count, size)) / scale).ravel())


@dataclass(frozen=True)
class Piece:
    """Rows  lower <= value(variables) <= upper, by name; a part of the objective has none."""

    value: Callable[[Variables], Array]
    names: tuple[RowName, ...] = ()
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(
        cls,
        value: Callable[[Variables], Array],
        rows: Sequence[tuple[str, str, Sequence[str], Array | float, Array | float]],
    ) -> Piece:
        """rows : term, place, components, lower, upper, in the order of the value's numbers."""
        names = tuple((term, place, c) for term, place, components, _, _ in rows for c in components)
        sides = [
            np.concatenate([np.zeros(0), *(np.broadcast_to(row[k], (len(row[2]),)) for row in rows)])
            for k in (3, 4)
        ]
        return cls(value, names, *sides)
