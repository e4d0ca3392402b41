"""Progress of a sweep: cases done, rate, best result, and remaining time."""

from __future__ import annotations

import re
import time
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.sweeps.table import merge_kinds
from impactopt.sweeps.units import Columns

__all__ = ["ProgressCounter", "SweepProgress"]

BEST = "impulse_Ns"
START = "started_from"  # a case; "": none
OF_LATE = 30.0  # [s]
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.e+-]*")


@dataclass(frozen=True, kw_only=True)
class SweepProgress:
    """Cases of the sweep, done, failed among these, and resumed from runs before.

    seconds : since this run began.  rate : its cases a second, of late: workers take a while to start.
    remaining [s] : at this rate; nan at first.
    best [N s], best_case : the largest impulse of usable rows; None if there is none.
    """

    cases: int
    done: int
    failed: int
    resumed: int
    seconds: float
    rate: float
    remaining: float
    best: float | None
    best_case: int | None


class ProgressCounter:
    """Counts rows as they come.

    kinds : of the columns' values, for the table.  reasons : how often each came, numbers left out.
    """

    def __init__(self, cases: int) -> None:
        self.cases, self.done, self.failed, self.resumed = cases, 0, 0, 0
        self.peak_mb = 0.0
        self.best: float | None = None
        self.best_case: int | None = None
        self.kinds: dict[str, str] = {}
        self.reasons: Counter[str] = Counter()
        self._iterations: dict[str, list[int]] = {}
        self._began = time.perf_counter()
        self._recent = deque([(self._began, 0)])

    @property
    def seconds(self) -> float:
        """Since this run began."""
        return time.perf_counter() - self._began

    def begin(self) -> None:
        """Begins this run; cases counted so far are of earlier runs."""
        self.resumed, self._began = self.done, time.perf_counter()
        self._recent = deque([(self._began, self.done)])

    def add(self, first: int, columns: Columns, peak_mb: float) -> None:
        """Count rows: of cases from `first` on."""
        good = np.array([reason == "" for reason in columns["reason"]])
        self.done += len(good)
        self.failed += int((~good).sum())
        self.reasons.update(_NUMBER.sub("...", reason) for reason in columns["reason"] if reason)
        self.peak_mb = max(self.peak_mb, peak_mb)
        merge_kinds(self.kinds, columns)
        if START in columns and "iterations" in columns:
            self._count_iterations(columns, good)
        found = np.array([np.nan if x is None else x for x in columns.get(BEST, ())], dtype=float)
        if found.size and np.isfinite(found[good]).any():
            at = int(np.nanargmax(np.where(good, found, np.nan)))
            if self.best is None or found[at] > self.best:
                self.best, self.best_case = float(found[at]), first + at

    def _count_iterations(self, columns: Columns, good: NDArray[np.bool_]) -> None:
        for start, iterations, usable in zip(columns[START], columns["iterations"], good, strict=True):
            if usable:
                name = "neighbour" if start else "reach"
                self._iterations.setdefault(name, []).append(int(iterations))

    @property
    def iterations(self) -> dict[str, float]:
        """Mean of usable rows that say what they started from, by that."""
        return {name: float(np.mean(found)) for name, found in sorted(self._iterations.items())}

    def progress(self) -> SweepProgress:
        """Present progress."""
        now = time.perf_counter()
        while len(self._recent) > 2 and now - self._recent[0][0] > OF_LATE:
            self._recent.popleft()
        since, before = self._recent[0]
        self._recent.append((now, self.done))
        rate = (self.done - before) / (now - since) if now > since else 0.0
        return SweepProgress(
            cases=self.cases,
            done=self.done,
            failed=self.failed,
            resumed=self.resumed,
            seconds=now - self._began,
            rate=rate,
            remaining=(self.cases - self.done) / rate if rate > 0 else float("nan"),
            best=self.best,
            best_case=self.best_case,
        )
