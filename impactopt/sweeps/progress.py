"""Progress of a sweep, and its lines on a console."""

from __future__ import annotations

import contextlib
import logging
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.arrays import Mask
from impactopt.errors import printable
from impactopt.sweeps.design import Columns
from impactopt.sweeps.table import START, merge_kinds

BEST = "impulse_Ns"
RATE_WINDOW = 30.0  # [s] over which the present rate is measured
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.e+-]*")


@dataclass(frozen=True, kw_only=True)
class SweepProgress:
    """Progress of a sweep.

    cases : of the sweep.  done : finished ones.  failed : those of them without a usable result.  resumed :
    those of them from earlier runs.
    seconds : since this run began.  rate [1/s] : of recent cases, as workers take a while to start.
    remaining [s] : at this rate; nan at first.
    best [N s], best_case : largest impulse of the usable results, and its case; None if there is none.
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
    """Counter of a sweep's finished cases.

    kinds : of the columns' values, for the table.  reasons : number of failed cases by reason, without
    numbers.
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
        """Time [s] since this run began."""
        return time.perf_counter() - self._began

    def begin(self) -> None:
        """Begin this run; cases counted so far are of earlier runs."""
        self.resumed, self._began = self.done, time.perf_counter()
        self._recent = deque([(self._began, self.done)])

    def add(self, first: int, columns: Columns, peak_mb: float) -> None:
        """Count the cases of a unit, from `first` on."""
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

    def _count_iterations(self, columns: Columns, good: Mask) -> None:
        for start, iterations, usable in zip(columns[START], columns["iterations"], good, strict=True):
            if usable:
                name = "neighbour" if start else "reach"
                self._iterations.setdefault(name, []).append(int(iterations))

    @property
    def iterations(self) -> dict[str, float]:
        """Mean iterations of usable solves by their start, "neighbour" or "reach"; empty if it is not
        known.
        """
        return {name: float(np.mean(found)) for name, found in sorted(self._iterations.items())}

    @property
    def counts(self) -> dict[str, Any]:
        """Fields that a progress and a result have in common."""
        names = ("cases", "done", "failed", "resumed", "best", "best_case")
        return {name: getattr(self, name) for name in names}

    def progress(self) -> SweepProgress:
        """Present progress."""
        now = time.perf_counter()
        while len(self._recent) > 2 and now - self._recent[0][0] > RATE_WINDOW:
            self._recent.popleft()
        since, before = self._recent[0]
        self._recent.append((now, self.done))
        rate = (self.done - before) / (now - since) if now > since else 0.0
        return SweepProgress(
            **self.counts,
            seconds=now - self._began,
            rate=rate,
            remaining=(self.cases - self.done) / rate if rate > 0 else float("nan"),
        )


if TYPE_CHECKING:
    from rich.console import Console


LINE_INTERVAL = 2.0  # [s] between lines about progress, if there is no live bar

_log = logging.getLogger("impactopt")

Say = Callable[[str], None]
Progress = Callable[[SweepProgress], None]


class SweepConsole:
    """Messages of a sweep and a live progress bar on a terminal; elsewhere, a line now and then.

    quiet : print nothing.  verbose : print a line after every unit.
    """

    def __init__(self, console: Console, *, quiet: bool = False, verbose: bool = False) -> None:
        self._console, self._quiet, self._last = console, quiet, -LINE_INTERVAL
        self._interval = 0.0 if verbose else LINE_INTERVAL
        self._live = None
        if console.is_terminal and not (quiet or verbose):
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
            from rich.progress import Progress as Bar

            parts = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
            self._live = Bar(*parts, console=console, transient=True)
            self._task = self._live.add_task("starting", total=None)

    def __enter__(self) -> SweepConsole:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a message."""
        if not self._quiet:
            self._console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def progress(self, now: SweepProgress) -> None:
        """Update the bar, or print a line if the last one was long enough ago."""
        text = f"{now.rate:.3g} a second, {words_for_time(now.remaining)} left"
        if now.failed:
            text += f", {now.failed} failed"
        if now.best is not None:
            text += f", best {now.best:.2f} N s (case {now.best_case})"
        if self._live is not None:
            self._live.update(self._task, completed=now.done, total=now.cases, description=text)
        elif time.perf_counter() - self._last >= self._interval:
            self._last = time.perf_counter()
            self.say(f"{now.done} of {now.cases}, {text}")


@contextlib.contextmanager
def receivers(report: Say | None, progress: Progress | bool | None) -> Iterator[tuple[Say, Progress]]:
    """Receivers of messages and of the progress; arguments as of :func:`impactopt.sweep`."""
    console = None
    if progress is True or (progress is None and report is None):
        console = _console(always=progress is True)
    if console is None:
        yield report or _log.info, progress if callable(progress) else _ignore
        return
    with SweepConsole(console) as shown:
        yield report or shown.say, shown.progress


def words_for_time(seconds: float) -> str:
    """Text for a time, such as "12.3 s" or "3 min 20 s"; "?" for nan."""
    if not seconds < float("inf"):
        return "?"
    hours, rest = divmod(round(seconds), 3600)
    if not hours and rest < 60:
        return f"{seconds:.3g} s"
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60} min {rest % 60} s"


def _console(*, always: bool) -> Console | None:
    """Console of a terminal or a notebook; None elsewhere, unless `always`."""
    from rich.console import Console

    terminal = Console(stderr=True)
    if Console().is_jupyter:  # plain lines, as a live display would need one more package
        return Console(force_jupyter=False, force_terminal=False)
    return terminal if terminal.is_terminal or always else None


def _ignore(_: SweepProgress) -> None:
    pass
