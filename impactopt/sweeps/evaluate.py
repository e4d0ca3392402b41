"""Evaluation of a sweep's units by kind of case, in this process or in local worker processes."""

from __future__ import annotations

import gc
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from impactopt import __version__
from impactopt.errors import InputError
from impactopt.files.output import record_of, record_of_strike, summary_of
from impactopt.files.problem_file import ProblemFile
from impactopt.files.record import Record, plain
from impactopt.files.solution_library import SolvedFolder
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.planning.strike import StrikeSolution, optimize_strike
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.sweeps.collisions import Collisions
from impactopt.sweeps.design import Columns, Found, Unit, Work, failed_columns
from impactopt.sweeps.table import START, SUMMARY_COLUMNS, UNITS

ENDED_BY_WATCHDOG = -int(signal.SIGALRM)  # exit code of a process that the watchdog has ended
MAX_BUILD_STEP = 900.0  # [s] for one step of building functions


class Watchdog:
    """Timer that ends this process if a case takes much longer than its time limit; each iteration restarts
    it.

    The kernel sends SIGALRM, as nothing else stops compiled code.

    limit [s] : None: no limit.  grace [s] : time beyond the limit.
    """

    def __init__(self, limit: float | None, grace: float) -> None:
        self._seconds = 0.0 if limit is None else limit + grace
        self._set(self._seconds)

    def building(self, line: str) -> None:
        """`report` of a solve: functions may be compiled, which is not part of a case's time."""
        self._set(max(MAX_BUILD_STEP, self._seconds))

    def iteration(self, record: Any) -> None:
        """`callback` of a solve."""
        self._set(self._seconds)

    def off(self) -> None:
        self._set(0.0)

    def _set(self, seconds: float) -> None:
        if self._seconds:  # without a limit, a timer that the caller has set stays
            signal.setitimer(signal.ITIMER_REAL, seconds)


Evaluated = tuple[Columns, Mapping[int, Record]]


def _plan(work: Work, unit: Unit, watchdog: Watchdog) -> Evaluated:
    """Columns and record of a solve or a strike, which is a unit by itself."""
    settings = {key: values[0] for key, values in unit.columns.items()}
    file = ProblemFile.from_data(work.data, work.path).changed(settings)
    problem = file.build()
    options = {
        "starts": work.settings.starts,
        "seed": work.settings.seed,
        "report": watchdog.building,
        "callback": watchdog.iteration,
        **_arguments(file, work),
    }
    solution: Solution | StrikeSolution
    started: dict[str, str] = {}  # the column of the case that this one starts from
    if work.settings.case_kind == "strike":
        solution = optimize_strike(problem, **options)
    elif work.solved is not None:
        folder = SolvedFolder(work.solved)
        solution, near = folder.solve(problem, file, **options)
        folder.keep(solution, file, f"{unit.first:06d}")
        started = {START: near.path.name if near is not None else ""}
    else:
        solution = solve(problem, start=work.settings.start, **options)
    if not work.settings.trajectories:
        return _columns({**summary_of(solution), **started}, problem), {}
    from_file: Any = {"problem": file.text, "problem_path": file.path}
    if isinstance(solution, StrikeSolution):
        record = record_of_strike(solution, **from_file)
    else:
        record = record_of(solution, **from_file)
    return _columns({**record.summary, **started}, problem), {unit.first: record}


def _collide(work: Work, unit: Unit, watchdog: Watchdog) -> Evaluated:
    """Columns of a unit of collisions."""
    global _kept
    if _kept is None or _kept[0] != work:
        file = ProblemFile.from_data(work.data, work.path)
        keys, folder = tuple(unit.columns), work.folder
        _kept = work, Collisions(file, work.at_contact, work.settings.outputs, keys=keys, folder=folder)
    columns = _kept[1](unit.columns, threads=1)
    return {"reason": columns.pop("reason").tolist(), **columns}, {}


# robots, models and postures of a sweep of collisions, made once in each worker
_kept: tuple[Work, Collisions] | None = None
CASE_KINDS: dict[str, Callable[[Work, Unit, Watchdog], Evaluated]] = {
    "solve": _plan,
    "strike": _plan,
    "collision": _collide,
}


def _arguments(file: ProblemFile, work: Work) -> dict[str, Any]:
    """Arguments of `solve` in the problem file, with the shorter time limit of file and sweep."""
    own = file.solver.time_limit
    limits = [seconds for seconds in (own, work.settings.time_limit) if seconds is not None]
    return file.solver.arguments(time_limit=min(limits, default=None))


def _columns(summary: Mapping[str, Any], problem: ImpactProblem) -> Columns:
    """Numbers of a summary as columns of one row, with units in their names."""
    usable = summary["status"] in ("solved", "acceptable") and "note" not in summary
    row = {
        "status": summary["status"],
        "reason": "" if usable else " ".join(filter(None, (summary["message"], summary.get("note")))),
    }
    row |= {name: summary[name] for name in SUMMARY_COLUMNS if name in summary}
    row |= {f"target_{name}": value for name, value in (summary.get("target") or {}).items()}
    row |= {f"torque_ratio_{phase}": x for phase, x in summary.get("torque_ratio", {}).items()}
    row |= {f"zmp_margin_{phase}_m": x for phase, x in summary.get("zmp_margin_m", {}).items()}
    endings = {unit: end for end, unit in UNITS.items()}
    units = {objective.name: endings.get(objective.unit, "") for objective in problem.objectives}
    for name, value in summary.get("objectives", {}).items():
        row[f"objective_{name.replace(' ', '_')}{units[name]}"] = value
    for scenario in summary.get("scenarios", ()):
        name = str(scenario["name"]).replace(" ", "_")
        row |= {f"{name}_{key}": x for key, x in scenario.items() if isinstance(x, (int, float))}
    return {name: [value] for name, value in plain(row).items()}


# A process evaluates one unit at a time, in a Dask worker with several threads too, as it has one timer.
_LOCK = threading.Lock()


def evaluate(work: Work, unit: Unit) -> Found:
    """Result of a unit; an error in a case is the reason that its row has no result.

    BLAS gets one thread, as the other cores are for other workers.

    Raises
    ------
    InputError : the sweep was begun with another version of impactopt.
    """
    if work.version != __version__:
        raise InputError(f"a worker has impactopt {__version__}, the sweep {work.version}; install the same")
    with _LOCK, threadpool_limits(1):
        return _evaluate(work, unit)


def _evaluate(work: Work, unit: Unit) -> Found:
    began, watchdog = time.perf_counter(), Watchdog(work.settings.time_limit, work.grace)
    records: Mapping[int, Record] = {}
    try:
        columns, records = CASE_KINDS[work.settings.case_kind](work, unit, watchdog)
    except InputError as error:
        columns = failed_columns(unit.count, "refused", str(error))
    except Exception as error:  # the other units go on
        columns = failed_columns(unit.count, "error", f"{type(error).__name__}: {error}")
    finally:
        watchdog.off()
        gc.collect()  # solves leave reference cycles, with which the worker's memory would grow
    if work.settings.case_kind != "collision":
        columns = {**columns, "seconds": [time.perf_counter() - began]}
    return Found(columns=columns, records=records, peak_mb=_peak_memory())


def _peak_memory() -> float:
    """Peak memory of this process [MB]."""
    if sys.platform.startswith("linux"):  # getrusage includes the parent's memory at the fork
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    unit = 1 if sys.platform == "darwin" else 1024  # bytes of ru_maxrss
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


TRIES = 3  # of a unit whose process dies: it may have been killed for the memory of another one


def on_processes(
    work: Work, units: Iterable[Unit], *, workers: int
) -> Generator[tuple[Unit, Found], None, None]:
    """Results of units on local processes, in the order in which they are finished.

    A unit whose process died is tried again, `TRIES` times in all, unless it took too long.
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
    """Result of a unit whose process died: its rows have the reason."""
    if died.code == ENDED_BY_WATCHDOG:
        reason = f"it took longer than {work.settings.time_limit:g} s and did not stop by itself"
        columns = failed_columns(unit.count, "time_limit", reason)
    else:
        how = f"exit code {died.code}" if died.code >= 0 else f"killed by {_signal(-died.code)}"
        columns = failed_columns(unit.count, "crashed", f"its process died {died.tries} times ({how})")
    return Found(columns=columns, peak_mb=0.0)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
