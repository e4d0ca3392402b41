"""Progress of a sweep on the console: a live bar on a terminal, else a line now and then."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from impactopt.errors import printable
from impactopt.sweeps.progress import SweepProgress

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["SweepConsole", "told", "words_for_time"]

BETWEEN = 2.0  # seconds between lines about progress where lines cannot be rewritten

_log = logging.getLogger("impactopt")

Say = Callable[[str], None]
Progress = Callable[[SweepProgress], None]


class SweepConsole:
    """Lines about what is going on, and a live bar; where there is no terminal, a line now and then.

    quiet : nothing at all.  verbose : a line after every unit.
    """

    def __init__(self, console: Console, *, quiet: bool = False, verbose: bool = False) -> None:
        self._console, self._quiet, self._last = console, quiet, -BETWEEN
        self._between = 0.0 if verbose else BETWEEN
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
        """One more thing is done or begun."""
        if not self._quiet:
            self._console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def progress(self, now: SweepProgress) -> None:
        """Updates the bar's text."""
        text = f"{now.rate:.3g} a second, {words_for_time(now.remaining)} left"
        if now.failed:
            text += f", {now.failed} failed"
        if now.best is not None:
            text += f", best {now.best:.2f} N s (case {now.best_case})"
        if self._live is not None:
            self._live.update(self._task, completed=now.done, total=now.cases, description=text)
        elif time.perf_counter() - self._last >= self._between:
            self._last = time.perf_counter()
            self.say(f"{now.done} of {now.cases}, {text}")


@contextlib.contextmanager
def told(report: Say | None, progress: Progress | bool | None) -> Iterator[tuple[Say, Progress]]:
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
    """A time in words, as 12.3 s or 3 min 20 s; nan is "?"."""
    if not seconds < float("inf"):
        return "?"
    hours, rest = divmod(round(seconds), 3600)
    if not hours and rest < 60:
        return f"{seconds:.3g} s"
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60} min {rest % 60} s"


def _console(*, always: bool) -> Console | None:
    """A terminal's or a notebook's, where someone looks; None elsewhere, unless `always`."""
    from rich.console import Console

    terminal = Console(stderr=True)
    if Console().is_jupyter:  # plain lines: a live display would need a package more
        return Console(force_jupyter=False, force_terminal=False)
    return terminal if terminal.is_terminal or always else None


def _ignore(_: SweepProgress) -> None:
    pass
