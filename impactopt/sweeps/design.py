"""Design of a sweep: grids, lists and draws, and the units of work that its cases are.

Cases are never written out all at once: a million of them are a formula and the draws.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil, log2, prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt import __version__
from impactopt.files.output import Record

__all__ = [
    "GRACE",
    "Axis",
    "Column",
    "Columns",
    "Design",
    "Draws",
    "Found",
    "Span",
    "Unit",
    "Work",
    "column",
    "failed_columns",
]

Array = NDArray[np.float64]
Column = Sequence[Any] | NDArray[Any]


def column(values: Sequence[Any]) -> Column:
    """Values of one key, as an array where they are numbers."""
    kinds = {type(value) for value in values}
    return np.array(values) if kinds and kinds <= {int, float} else list(values)


@dataclass(frozen=True, kw_only=True)
class Span:
    """Numbers from `first` to `last`, both included; in equal steps, or with "log" by equal factors."""

    first: float
    last: float
    scale: str = "linear"

    def at(self, u: Array) -> Array:
        """The numbers at shares u of the way, 0 to 1; rounding does not leave the range."""
        if self.scale == "log":
            x = self.first * (self.last / self.first) ** u
        else:
            x = self.first + (self.last - self.first) * u
        return np.asarray(np.clip(x, min(self.first, self.last), max(self.first, self.last)))

    def spread(self, count: int) -> Array:
        """So many numbers, evenly; of one, the first."""
        return self.at(np.linspace(0.0, 1.0, count))


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A key and its values, one after the other."""

    key: str
    values: Column

    def take(self, indices: NDArray[np.int64]) -> Column:
        if isinstance(self.values, np.ndarray):
            return np.asarray(self.values[indices])
        return [self.values[i] for i in indices]


@dataclass(frozen=True, kw_only=True)
class Draws:
    """So many points drawn over the unit cube, and what each of its sides stands for.

    method : "random" (independent), "sobol" (scrambled: the first so many of the sequence) or "latin
        hypercube".
    over : by key, a `Span`, or a list of values of which one is drawn.

    The points are those of `scipy.stats.qmc`.
    """

    method: str
    count: int
    seed: int
    over: dict[str, Span | Column]

    def columns(self) -> tuple[Axis, ...]:
        """The drawn values, (count,) by key."""
        cube = self._cube()
        return tuple(
            Axis(key=key, values=self._values(what, u))
            for (key, what), u in zip(self.over.items(), cube.T, strict=True)
        )

    def _cube(self) -> Array:
        from scipy.stats import qmc  # as long to import as all else, and workers do not draw

        rng, sides = np.random.default_rng(self.seed), len(self.over)
        if self.method == "sobol":
            # SciPy warns of counts that are no powers of two; the first points of the sequence are asked for
            points = qmc.Sobol(sides, seed=rng).random_base2(ceil(log2(self.count)))
            return np.asarray(points[: self.count])
        if self.method == "latin hypercube":
            return np.asarray(qmc.LatinHypercube(sides, seed=rng).random(self.count))
        return rng.random((self.count, sides))

    @staticmethod
    def _values(what: Span | Column, u: Array) -> Column:
        if isinstance(what, Span):
            return what.at(u)
        chosen = np.minimum((u * len(what)).astype(np.int64), len(what) - 1)
        return Axis(key="", values=what).take(chosen)


class Design:
    """Every combination of the grid's values, the list's rows and the draws; the draws go fastest.

    grid : axes that are combined.  rows : axes of one length that are read side by side.
    """

    def __init__(
        self, *, grid: Sequence[Axis] = (), rows: Sequence[Axis] = (), draws: Draws | None = None
    ) -> None:
        drawn = () if draws is None else draws.columns()
        # groups of axes that go together, the fastest last
        self._groups = [(axis,) for axis in grid] + [group for group in (tuple(rows), drawn) if group]
        self._lengths = [len(group[0].values) for group in self._groups]

    @property
    def cases(self) -> int:
        return prod(self._lengths)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """All that is varied."""
        return tuple(axis for group in self._groups for axis in group)

    def content(self) -> bytes:
        """All values, the drawn ones too, for hashes."""
        parts = []
        for axis in self.axes:
            array = isinstance(axis.values, np.ndarray)
            values = np.asarray(axis.values).tobytes() if array else json.dumps(axis.values).encode()
            parts.append(axis.key.encode() + b"\0" + values)
        return b"\0".join(parts)

    def columns(self, first: int, last: int) -> dict[str, Column]:
        """Values by key of the cases first, ..., last - 1."""
        where = np.unravel_index(np.arange(first, last), self._lengths) if self._lengths else ()
        out: dict[str, Column] = {}
        for group, indices in zip(self._groups, where, strict=True):
            out |= {axis.key: axis.take(indices) for axis in group}
        return out


GRACE = 60.0  # [s]: a case that says nothing for so long after its time is killed

Columns = Mapping[str, Sequence[Any] | NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """Data that all units of a sweep share.

    data, path : of the problem's file with the sweep's [set].  folder : of the sweep's file.
    case_kind, seed, start, starts, time_limit [s], trajectories, at_contact, outputs : as of `Sweep`.
    grace [s] : after the time limit, until the worker is killed.
    solved : where cases are kept that others start from; None: none do.
    version : of impactopt, which workers have to have too.
    """

    data: Mapping[str, Any]
    path: Path
    case_kind: str
    seed: int = 0
    start: str = "reach"
    starts: int = 1
    time_limit: float | None = None
    trajectories: bool = False
    at_contact: Mapping[str, Any] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    folder: Path = Path()
    solved: Path | None = None
    grace: float = GRACE
    version: str = __version__


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Cases that are done together: `count` of them from case `first` on, with their values by key."""

    index: int
    first: int
    count: int
    columns: Mapping[str, Column]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of a unit: columns of `count` values each, and whole results by case, where they are kept.

    Every row has a `status`, and a `reason` where it has no usable result, else "".
    peak_mb : the most memory that the worker has had so far [MB].
    """

    columns: Columns
    peak_mb: float
    records: Mapping[int, Record] = field(default_factory=dict)


def failed_columns(count: int, status: str, reason: str) -> Columns:
    """Rows of cases that have no result."""
    return {"status": [status] * count, "reason": [reason] * count}
