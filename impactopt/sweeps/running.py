"""A sweep from its file to its table."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from impactopt.errors import InputError
from impactopt.planning.solution import versions
from impactopt.problem.problem import ImpactProblem
from impactopt.sweeps.cluster import connected, on_cluster
from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.design import Found, Unit, Work
from impactopt.sweeps.evaluate import evaluate, on_processes
from impactopt.sweeps.progress import ProgressCounter, SweepProgress, told
from impactopt.sweeps.store import Store
from impactopt.sweeps.table import Part, merge_kinds, pyarrow, write_table
from impactopt.transcription.transcription import block_functions

__all__ = ["SweepResult", "sweep"]

ACCIDENTS = {"crashed", "error", "time_limit"}  # what another run may do better
Engine = Generator[tuple[Unit, Found], None, None]
TOGETHER = {"collision": 16384}  # the most cases in a unit; one of the other kinds
UNITS = 64  # at least, where there are cases for them, so that workers end together


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """Result of a sweep.

    cases : of the sweep.  done : rows in the table; failed : of these, without a usable result.  resumed :
    of these, from runs before this one.  seconds : of this run, and rate_per_second : its cases.
    peak_worker_mb : the most memory that a worker had, in any run [MB].  table : the Parquet file.
    best, best_case : the largest impulse [N s] of usable rows, and where; None if there is none.
    reasons : why rows have no usable result, and how often, most often first; numbers in them are left out.
    iterations : mean of usable rows, by what they started from: "neighbour" and "reach", of a sweep whose
        cases start from their neighbours.
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
    """Do every case of a sweep and write one table. If it is called again, it resumes what was not finished.

    source : a sweep file, its data as tables, or what :func:`impactopt.sweeps.read_sweep_file` gave.
    out : directory of the results: see `impactopt.sweeps.store`. Every finished case is on disk at once.
    workers : processes; None: as many as there are cores. A script needs `if __name__ == "__main__":`.
    scheduler : address of a Dask scheduler, tcp://host:port, whose workers do the cases; client : or a
        `distributed.Client`. Workers need this version of impactopt, one thread each, and to see the files
        that the problem's file names.
    again : do cases once more that crashed, met an error of ours or ran out of time in an earlier run.
    report : told in words what is going on.  progress : told after every unit; True: both are shown, False:
        not; None: where a person looks, on a terminal or in a notebook, unless `report` is given.
        Messages without a receiver go to the logger "impactopt".

    A case that fails is a row with its reason. Ctrl-C ends the processes, writes the table of what is
    finished, and is raised.

    Raises
    ------
    InputError : the sweep or its problem is wrong; another process is at work in the directory, or it holds
        another sweep; the disk is full; pyarrow is not installed.
    """
    if sum(x is not None for x in (workers, scheduler, client)) > 1:
        raise InputError("give one of workers, scheduler and client: a cluster brings its own workers")
    if workers is not None and workers < 1:
        raise InputError(f"{workers} workers; ask for at least 1")
    pyarrow()
    chosen = _read(source)
    problem = chosen.problem.build()
    store = Store(chosen, Path(out))
    try:
        with (
            told(report, progress) as (tell, count),
            contextlib.nullcontext(client) if scheduler is None else connected(scheduler) as cluster,
        ):

            def engine(work: Work, units: Iterator[Unit]) -> Engine:
                if cluster is not None:
                    return on_cluster(work, units, cluster, tell)
                return on_processes(work, units, workers=_cores() if workers is None else workers)

            return _run(chosen, problem, store, engine, again, tell, count)
    finally:
        store.close()


def _run(
    chosen: Sweep,
    problem: ImpactProblem,
    store: Store,
    engine: Callable[[Work, Iterator[Unit]], Engine],
    again: bool,
    tell: Callable[[str], None],
    progress: Callable[[SweepProgress], None],
) -> SweepResult:
    journal = store.journal
    together = min(TOGETHER.get(chosen.case_kind, 1), -(-chosen.design.cases // UNITS))
    if journal.damaged:
        tell(f"{journal.damaged} units in {journal.path} are damaged; they are done again")
    counter, finished = ProgressCounter(chosen.design.cases), set[int]()
    for entry in journal.read():
        if again and not ACCIDENTS.isdisjoint(entry.columns.get("status", ())):
            continue
        finished.add(entry.unit)
        counter.add(entry.unit * together, entry.columns, entry.peak_mb)
    counter.begin()
    if counter.resumed:
        tell(f"{counter.resumed} of {counter.cases} cases are there from before")
    work = _work(chosen, store)
    if counter.done < counter.cases:
        _compile(chosen, problem, work, tell)
    left = _units(chosen, together, finished)
    with contextlib.closing(engine(work, left)) as found:
        try:
            for unit, result in found:
                store.keep(unit.index, result)
                counter.add(unit.first, result.columns, result.peak_mb)
                progress(counter.progress())
        except KeyboardInterrupt:
            found.close()
            _write(chosen, problem, store, together, counter)
            raise
    _write(chosen, problem, store, together, counter)
    seconds = counter.seconds
    return SweepResult(
        cases=counter.cases,
        done=counter.done,
        failed=counter.failed,
        resumed=counter.resumed,
        seconds=seconds,
        rate_per_second=(counter.done - counter.resumed) / seconds,
        peak_worker_mb=counter.peak_mb,
        table=store.table,
        best=counter.best,
        best_case=counter.best_case,
        reasons=dict(counter.reasons.most_common()),
        iterations=counter.iterations,
    )


def _read(source: Sweep | Mapping[str, Any] | str | os.PathLike[str]) -> Sweep:
    if isinstance(source, Sweep):
        return source
    return sweep_from_data(source) if isinstance(source, Mapping) else read_sweep_file(source)


def _compile(chosen: Sweep, problem: ImpactProblem, work: Work, tell: Callable[[str], None]) -> None:
    """Build functions here, so that it is done once, and said; workers find them on disk."""
    if chosen.case_kind == "collision":
        tell("building the collision (compiles the first time)")
        evaluate(work, Unit(index=0, first=0, count=1, columns=chosen.design.columns(0, 1)))
    else:
        block_functions(problem, problem.coordinates, tell)


def _work(chosen: Sweep, store: Store) -> Work:
    return Work(
        data=chosen.problem.data,
        path=chosen.problem.path.resolve(),
        case_kind=chosen.case_kind,
        seed=chosen.seed,
        start=chosen.start,
        starts=chosen.starts,
        time_limit=chosen.time_limit,
        trajectories=chosen.trajectories,
        at_contact=chosen.at_contact,
        outputs=chosen.outputs,
        folder=chosen.path.parent.resolve(),
        solved=store.solved.resolve() if chosen.start == "neighbour" else None,
    )


def _units(chosen: Sweep, together: int, finished: set[int]) -> Iterator[Unit]:
    """Units that are left, in their order."""
    cases = chosen.design.cases
    for index in range(-(-cases // together)):
        if index not in finished:
            first, last = index * together, min((index + 1) * together, cases)
            columns = chosen.design.columns(first, last)
            yield Unit(index=index, first=first, count=last - first, columns=columns)


def _write(
    chosen: Sweep, problem: ImpactProblem, store: Store, together: int, counter: ProgressCounter
) -> None:
    """The table of all that is finished."""

    def parts() -> Iterator[Part]:
        for entry in store.journal.read():
            first = entry.unit * together
            count = len(entry.columns["reason"])
            yield first, {**chosen.design.columns(first, first + count), **entry.columns}

    kinds: dict[str, str] = {}
    for axis in chosen.design.axes:
        merge_kinds(kinds, {axis.key: axis.values})
    metadata = {
        "name": chosen.name,
        "case_kind": chosen.case_kind,
        "cases": str(counter.cases),
        "done": str(counter.done),
        "sweep_hash": chosen.hash,
        "problem_hash": problem.hash,
        "versions": json.dumps(versions()),
        "sweep": chosen.text,
        "problem": chosen.problem.text,
    }
    write_table(store.table, parts(), {**kinds, **counter.kinds}, metadata)


def _cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
