"""Run of a sweep: evaluates the cases that are not finished, and writes the table."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from impactopt.errors import InputError, check_number
from impactopt.planning.solution import versions
from impactopt.problem.problem import ImpactProblem
from impactopt.sweeps.cluster import connected, on_cluster
from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.design import Found, Unit, Work
from impactopt.sweeps.evaluate import evaluate, on_processes
from impactopt.sweeps.progress import ProgressCounter, SweepProgress, receivers
from impactopt.sweeps.store import Store
from impactopt.sweeps.table import Part, merge_kinds, pyarrow, write_table
from impactopt.transcription.transcription import block_functions

RETRIED = {"crashed", "error", "time_limit"}  # statuses of cases that may succeed in another run
Engine = Generator[tuple[Unit, Found], None, None]
MAX_UNIT = {"collision": 16384}  # cases in a unit by kind; 1 for other kinds
MIN_UNITS = 64  # of a sweep, if it has so many cases, so that all workers finish at about the same time


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """Result of a sweep.

    cases : of the sweep.  done : rows in the table.  failed : rows without a usable result.  resumed : rows
    from earlier runs.  seconds, rate_per_second : duration of this run, and its cases per second.
    peak_worker_mb [MB] : peak memory of a worker, in any run.  table : the Parquet file.
    best [N s], best_case : largest impulse of the usable rows, and its case; None if there is none.
    reasons : number of rows without a usable result by reason, the most frequent first; numbers are left out
        of the reasons.
    iterations : mean iterations of usable rows by their start, "neighbour" or "reach", in a sweep whose cases
        start from their neighbours.
    """

    cases: int
    done: int
    failed: int
    resumed: int
    seconds: float
    rate_per_second: float
    peak_worker_mb: float
    table: Path
    best: float | None = None
    best_case: int | None = None
    reasons: Mapping[str, int] = field(default_factory=dict)
    iterations: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """JSON form, as `impactopt sweep --json` prints it."""
        names = ("cases", "done", "failed", "resumed", "seconds", "rate_per_second", "peak_worker_mb")
        out = {**{name: getattr(self, name) for name in names}, "table": str(self.table)}
        return {**out, "iterations": dict(self.iterations)} if self.iterations else out


def sweep(
    source: Sweep | Mapping[str, Any] | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    client: Any = None,
    again: bool = False,
    report: Callable[[str], None] | None = None,
    progress: Callable[[SweepProgress], None] | bool | None = None,
) -> SweepResult:
    """Evaluate all cases of a sweep and write them to one table. Called again, it resumes an unfinished
    sweep.

    source : a sweep file, its data, or a result of :func:`impactopt.sweeps.read_sweep_file`.
    out : directory of the results: see `impactopt.sweeps.store`. Every finished case is on disk at once.
    workers : number of processes; None: as many as cores. A script needs `if __name__ == "__main__":`.
    scheduler, client : address of a Dask scheduler, tcp://host:port, or a `distributed.Client`, whose workers
        evaluate the cases. They need this version of impactopt, one thread each, and access to the files that
        the problem file names.
    again : repeat cases that crashed, raised an internal error or exceeded their time limit in an earlier
        run.
    report : called with messages.  progress : called after every unit. With True messages and progress are
        printed, with False they are not, with None on a terminal or in a notebook, unless `report` is given.
        Other messages go to the logger "impactopt".

    A case that fails has a row with the reason. Ctrl-C ends the processes, writes the table of the finished
    cases, and raises KeyboardInterrupt.

    Raises
    ------
    InputError : the sweep or its problem is wrong; another process uses the directory, or it holds another
        sweep; the disk is full; pyarrow is not installed.
    """
    if sum(x is not None for x in (workers, scheduler, client)) > 1:
        raise InputError("give one of workers, scheduler and client: a cluster brings its own workers")
    if workers is not None and check_number("workers", workers) < 1:
        raise InputError(f"{workers} workers; ask for at least 1")
    pyarrow()
    chosen = _read(source)
    problem = chosen.built
    store = Store(chosen, Path(out))
    try:
        with (
            receivers(report, progress) as (say, count),
            contextlib.nullcontext(client) if scheduler is None else connected(scheduler) as cluster,
        ):

            def engine(work: Work, units: Iterator[Unit]) -> Engine:
                if cluster is not None:
                    return on_cluster(work, units, cluster, say)
                return on_processes(work, units, workers=_cores() if workers is None else workers)

            return _run(chosen, problem, store, engine, again, say, count)
    finally:
        store.close()


def _run(
    chosen: Sweep,
    problem: ImpactProblem,
    store: Store,
    engine: Callable[[Work, Iterator[Unit]], Engine],
    again: bool,
    say: Callable[[str], None],
    progress: Callable[[SweepProgress], None],
) -> SweepResult:
    journal = store.journal
    # the same in every run, as units are numbered
    unit_size = min(MAX_UNIT.get(chosen.settings.case_kind, 1), -(-chosen.design.cases // MIN_UNITS))
    if journal.damaged:
        say(f"{journal.damaged} units in {journal.path} are damaged, and evaluated again")
    counter, finished = ProgressCounter(chosen.design.cases), set[int]()
    for entry in journal.read():
        if again and not RETRIED.isdisjoint(entry.columns.get("status", ())):
            continue
        finished.add(entry.unit)
        counter.add(entry.unit * unit_size, entry.columns, entry.peak_mb)
    counter.begin()
    if counter.resumed:
        say(f"{counter.resumed} of {counter.cases} cases are finished already")
    work = _work(chosen, store)
    if counter.done < counter.cases:
        _compile(chosen, problem, work, say)
    left = _units(chosen, unit_size, finished)
    with contextlib.closing(engine(work, left)) as found:
        try:
            for unit, result in found:
                store.keep(unit.index, result)
                counter.add(unit.first, result.columns, result.peak_mb)
                progress(counter.progress())
        except KeyboardInterrupt:
            found.close()
            _write(chosen, problem, store, unit_size, counter)
            raise
    _write(chosen, problem, store, unit_size, counter)
    seconds = counter.seconds
    return SweepResult(
        **counter.counts,
        seconds=seconds,
        rate_per_second=(counter.done - counter.resumed) / seconds,
        peak_worker_mb=counter.peak_mb,
        table=store.table,
        reasons=dict(counter.reasons.most_common()),
        iterations=counter.iterations,
    )


def _read(source: Sweep | Mapping[str, Any] | str | os.PathLike[str]) -> Sweep:
    if isinstance(source, Sweep):
        return source
    return sweep_from_data(source) if isinstance(source, Mapping) else read_sweep_file(source)


def _compile(chosen: Sweep, problem: ImpactProblem, work: Work, say: Callable[[str], None]) -> None:
    """Compile functions once, in this process; workers load them from disk."""
    if chosen.settings.case_kind == "collision":
        say("building the collision (compiles the first time)")
        evaluate(work, Unit(index=0, first=0, count=1, columns=chosen.design.columns(0, 1)))
    else:
        block_functions(problem, say)


def _work(chosen: Sweep, store: Store) -> Work:
    return Work(
        data=chosen.problem.data,
        path=chosen.problem.path.resolve(),
        settings=chosen.settings,
        at_contact=chosen.at_contact,
        folder=chosen.path.parent.resolve(),
        solved=store.solved.resolve() if chosen.settings.start == "neighbour" else None,
    )


def _units(chosen: Sweep, unit_size: int, finished: set[int]) -> Iterator[Unit]:
    """Units that are not finished, in their order."""
    cases = chosen.design.cases
    for index in range(-(-cases // unit_size)):
        if index not in finished:
            first, last = index * unit_size, min((index + 1) * unit_size, cases)
            columns = chosen.design.columns(first, last)
            yield Unit(index=index, first=first, count=last - first, columns=columns)


def _write(
    chosen: Sweep, problem: ImpactProblem, store: Store, unit_size: int, counter: ProgressCounter
) -> None:
    """Write the table of all finished cases."""

    def parts() -> Iterator[Part]:
        for entry in store.journal.read():
            first = entry.unit * unit_size
            count = len(entry.columns["reason"])
            yield first, {**chosen.design.columns(first, first + count), **entry.columns}

    kinds: dict[str, str] = {}
    for axis in chosen.design.axes:
        merge_kinds(kinds, {axis.key: axis.values})
    metadata = {
        "name": chosen.name,
        "case_kind": chosen.settings.case_kind,
        "cases": str(counter.cases),
        "done": str(counter.done),
        "sweep_hash": store.hash,
        "problem_hash": problem.hash,
        "versions": json.dumps(versions()),
        "sweep": chosen.text,
        "problem": chosen.problem.text,
    }
    robot = problem.robot
    prismatic = [name for name, slides in zip(robot.joint_names, robot.prismatic, strict=True) if slides]
    write_table(store.table, parts(), {**kinds, **counter.kinds}, metadata, prismatic)


def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
