"""Pool of processes on this machine that work on a sweep's units."""

from __future__ import annotations

import signal
from collections.abc import Generator, Iterable, Iterator

from impactopt.simulation.workers import Died, each_on_workers
from impactopt.sweeps.evaluate import evaluate
from impactopt.sweeps.units import Found, Unit, Work, failed_columns
from impactopt.sweeps.watchdog import ENDED_BY_WATCHDOG

__all__ = ["TRIES", "on_processes"]

TRIES = 3  # so many processes may die of a unit; one of them might have been killed for another's memory


def on_processes(
    work: Work, units: Iterable[Unit], *, workers: int
) -> Generator[tuple[Unit, Found], None, None]:
    """Results of units, in the order in which they are finished.

    A unit whose process died is tried again, then its rows say so; one that took too long is not.
    """
    given: dict[int, Unit] = {}

    def numbered() -> Iterator[tuple[int, Unit]]:
        for unit in units:
            given[unit.index] = unit
            yield unit.index, unit

    found = each_on_workers(
        evaluate,
        work,
        numbered(),
        workers=workers,
        again=lambda died: died.code != ENDED_BY_WATCHDOG and died.tries < TRIES,
    )
    for index, result in found:
        unit = given.pop(index)
        yield unit, _lost(work, unit, result) if isinstance(result, Died) else result


def _lost(work: Work, unit: Unit, died: Died) -> Found:
    if died.code == ENDED_BY_WATCHDOG:
        columns = failed_columns(
            unit.count, "time_limit", f"it took longer than {work.time_limit:g} s and did not stop by itself"
        )
    else:
        how = f"exit code {died.code}" if died.code >= 0 else f"killed by {_signal(-died.code)}"
        columns = failed_columns(unit.count, "crashed", f"its process died {died.tries} times ({how})")
    return Found(columns=columns, peak_mb=0.0)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
