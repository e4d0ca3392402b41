"""Design of a sweep: grids, lists and draws; units of work, and their results.

The values of cases are computed for a few cases at a time, from the axes and the draws, as there may be a
million.
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
from impactopt.arrays import Array
from impactopt.files.record import Record
from impactopt.sweeps.sections import SweepSection

Column = Sequence[Any] | NDArray[Any]


def column(values: Sequence[Any]) -> Column:
    """Values of one key, as an array if all are numbers."""
    kinds = {type(value) for value in values}
    return np.array(values) if kinds and kinds <= {int, float} else list(values)


@dataclass(frozen=True, kw_only=True)
class Span:
    """Range from `first` to `last`, both included.

    scale : "linear" for equal steps, "log" for equal factors.
    """

    first: float
    last: float
    scale: str = "linear"

    def at(self, u: Array) -> Array:
        """Numbers at fractions u of the range, 0 to 1; clipped, as rounding might leave it."""
        if self.scale == "log":
            x = self.first * (self.last / self.first) ** u
        else:
            x = self.first + (self.last - self.first) * u
        return np.asarray(np.clip(x, min(self.first, self.last), max(self.first, self.last)))

    def spread(self, count: int) -> Array:
        """Evenly spaced numbers (count,); the first one if count is 1."""
        return self.at(np.linspace(0.0, 1.0, count))


@dataclass(frozen=True, kw_only=True)
class Axis:
    """Key and its values, in their order."""

    key: str
    values: Column

    def take(self, indices: NDArray[np.int64]) -> Column:
        if isinstance(self.values, np.ndarray):
            return np.asarray(self.values[indices])
        return [self.values[i] for i in indices]


@dataclass(frozen=True, kw_only=True)
class Draws:
    """Points drawn in the unit cube by `scipy.stats.qmc`, and the key of each dimension.

    method : "random" (independent), "sobol" (the first points of a scrambled sequence) or "latin hypercube".
    over : by key a range, or a list of values of which one is drawn.
    """

    method: str
    count: int
    seed: int
    over: dict[str, Span | Column]

    def columns(self) -> tuple[Axis, ...]:
        """Drawn values (count,) of each key."""
        cube = self._cube()
        return tuple(
            Axis(key=key, values=self._values(what, u))
            for (key, what), u in zip(self.over.items(), cube.T, strict=True)
        )

    def _cube(self) -> Array:
        from scipy.stats import qmc  # slow to import, and workers do not draw

        rng, dimensions = np.random.default_rng(self.seed), len(self.over)
        if self.method == "sobol":
            # drawn up to a power of two, as SciPy warns of other counts
            points = qmc.Sobol(dimensions, seed=rng).random_base2(ceil(log2(self.count)))
            return np.asarray(points[: self.count])
        if self.method == "latin hypercube":
            return np.asarray(qmc.LatinHypercube(dimensions, seed=rng).random(self.count))
        return rng.random((self.count, dimensions))

    @staticmethod
    def _values(what: Span | Column, u: Array) -> Column:
        if isinstance(what, Span):
            return what.at(u)
        indices = np.minimum((u * len(what)).astype(np.int64), len(what) - 1)
        return Axis(key="", values=what).take(indices)


class Design:
    """All combinations of grid, list and draws; the draws vary fastest.

    grid : axes of which all combinations of values are taken.  listed : axes of equal length; values of the
    same index are taken together.
    """

    def __init__(
        self, *, grid: Sequence[Axis] = (), listed: Sequence[Axis] = (), draws: Draws | None = None
    ) -> None:
        drawn = () if draws is None else draws.columns()
        # groups of axes that share an index, the fastest last
        self._groups = [(axis,) for axis in grid] + [group for group in (tuple(listed), drawn) if group]
        self._lengths = [len(group[0].values) for group in self._groups]

    @property
    def cases(self) -> int:
        return prod(self._lengths)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of all keys, the drawn ones included."""
        return tuple(axis for group in self._groups for axis in group)

    def content(self) -> bytes:
        """All values, the drawn ones included, as bytes for a hash."""
        parts = []
        for axis in self.axes:
            array = isinstance(axis.values, np.ndarray)
            values = np.asarray(axis.values).tobytes() if array else json.dumps(axis.values).encode()
            parts.append(axis.key.encode() + b"\0" + values)
        return b"\0".join(parts)

    def columns(self, first: int, last: int) -> dict[str, Column]:
        """Values by key of the cases first, ..., last - 1."""
        by_group = np.unravel_index(np.arange(first, last), self._lengths) if self._lengths else ()
        out: dict[str, Column] = {}
        for group, indices in zip(self._groups, by_group, strict=True):
            out |= {axis.key: axis.take(indices) for axis in group}
        return out


# [s] A case without an iteration for so long after its time limit is killed.
GRACE = 60.0

Columns = Mapping[str, Sequence[Any] | NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """Data that all units of a sweep share.

    data, path : of the problem file with the sweep's [set].  folder : of the sweep file.
    settings, at_contact : as of `Sweep`.
    grace [s] : time after the time limit until the worker is killed.
    solved : folder of the solved cases that others start from; None: cases do not start from others.
    version : of impactopt, which the workers must have.
    """

    data: Mapping[str, Any]
    path: Path
    settings: SweepSection
    at_contact: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()
    solved: Path | None = None
    grace: float = GRACE
    version: str = __version__


@dataclass(frozen=True, kw_only=True)
class Unit:
    """Cases that a worker evaluates together: `count` of them from case `first` on.

    columns : values (count,) by key.
    """

    index: int
    first: int
    count: int
    columns: Mapping[str, Column]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Result of a unit.

    columns : values (count,) of the table's columns by name. ``reason`` says why a case has no usable result,
        and is "" if it has one; solves, strikes and failed cases have a ``status``.
    records : full results by case, if they are kept.
    peak_mb [MB] : peak memory of the worker so far.
    """

    columns: Columns
    peak_mb: float
    records: Mapping[int, Record] = field(default_factory=dict)


def failed_columns(count: int, status: str, reason: str) -> Columns:
    """Columns of cases that have no result."""
    return {"status": [status] * count, "reason": [reason] * count}
