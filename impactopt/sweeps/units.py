"""A unit of work: what goes to a worker, and the rows that come back. One whole solve, or many collisions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from impactopt import __version__
from impactopt.files.output import Record
from impactopt.sweeps.design import Column

__all__ = ["GRACE", "Columns", "Found", "Unit", "Work", "failed_columns"]

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
