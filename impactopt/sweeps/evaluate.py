"""A unit's rows, on the worker that it went to: a process of one's own, or of a cluster."""

from __future__ import annotations

import gc
import resource
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from threadpoolctl import threadpool_limits

from impactopt import __version__
from impactopt.errors import InputError
from impactopt.files.output import Record
from impactopt.sweeps.case_kinds import CASE_KINDS
from impactopt.sweeps.units import Found, Unit, Work, failed_columns
from impactopt.sweeps.watchdog import Watchdog

__all__ = ["evaluate"]

_ONE_AT_A_TIME = threading.Lock()  # in a Dask worker of several threads: the watchdog is the process's


def evaluate(work: Work, unit: Unit) -> Found:
    """The rows of a unit; what goes wrong in a case is the reason in its row.

    BLAS gets one thread, as the other cores are for other workers.

    Raises
    ------
    InputError : this is not the version of impactopt that the sweep was begun with.
    """
    if work.version != __version__:
        raise InputError(f"a worker has impactopt {__version__}, the sweep {work.version}; install the same")
    with _ONE_AT_A_TIME, threadpool_limits(1):
        return _evaluate(work, unit)


def _evaluate(work: Work, unit: Unit) -> Found:
    began, watchdog = time.perf_counter(), Watchdog(work.time_limit, work.grace)
    records: Mapping[int, Record] = {}
    try:
        columns, records = CASE_KINDS[work.case_kind](work, unit, watchdog)
    except InputError as error:
        columns = failed_columns(unit.count, "refused", str(error))
    except Exception as error:  # of whatever kind: it is this unit's alone
        columns = failed_columns(unit.count, "error", f"{type(error).__name__}: {error}")
    finally:
        watchdog.off()
        gc.collect()  # a solve leaves cycles, which would make a worker of a long night ever larger
    if work.case_kind != "collision":
        columns = {**columns, "seconds": [time.perf_counter() - began]}
    return Found(columns=columns, records=records, peak_mb=_peak_memory())


def _peak_memory() -> float:
    """The most that this process has had in memory [MB]."""
    if sys.platform.startswith("linux"):  # getrusage counts what the parent had when it started this process
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
