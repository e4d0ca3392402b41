"""The same sweep on a Dask cluster of separate worker processes, one of which is killed in the middle."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.sweep_workers import unlucky

from impactopt import InputError, sweep
from impactopt.sweeps import SweepProgress, sweep_from_data
from impactopt.sweeps.cluster import on_cluster
from impactopt.sweeps.design import Unit, Work
from impactopt.sweeps.evaluate import evaluate
from impactopt.sweeps.sections import SweepSection

TIMES = ("seconds", "solve_seconds", "build_seconds")
RESISTANCES = [500.0, 650.0, 700.0, 600.0, 800.0]
SWEEP = {
    "sweep": {"problem": "arm_planar", "case_kind": "strike"},
    "set": {"solver.ipm.max_iterations": 34},  # too few for some
    "grid": {"target.resistance": RESISTANCES},
}


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    import dask  # by each test that needs it: the quick ones collect this file, too
    import distributed

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.mark.slow
def test_a_worker_of_the_cluster_that_is_killed_costs_nothing(tmp_path: Path, client: Any) -> None:
    chosen = sweep_from_data(SWEEP)
    work = Work(data=chosen.problem.data, path=chosen.problem.path, settings=chosen.settings)
    told: list[SweepProgress] = []

    def kill_one(now: SweepProgress) -> None:
        told.append(now)
        if len(told) == 1:
            busy = next(address for address, tasks in client.processing().items() if tasks)
            os.kill(client.run(os.getpid, workers=[busy])[busy], signal.SIGKILL)

    address = client.scheduler.address
    result = sweep(SWEEP, tmp_path / "out", scheduler=address, progress=kill_one)
    assert (result.cases, result.done, len(told)) == (5, 5, 5)
    for row in pq.read_table(result.table).to_pylist():
        case = row.pop("case")
        unit = Unit(index=0, first=0, count=1, columns={"target.resistance_N": [RESISTANCES[case]]})
        assert row.pop("target.resistance_N") == RESISTANCES[case]
        alone = evaluate(work, unit).columns
        assert {n: x for n, x in row.items() if n not in TIMES} == {
            n: x[0] for n, x in alone.items() if n not in TIMES
        }
    again = sweep(SWEEP, tmp_path / "out", client=client)
    assert (again.resumed, again.done) == (5, 5)


@pytest.mark.slow
def test_units_that_kill_every_worker_are_rows_and_closing_forgets_the_rest(
    tmp_path: Path, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    units = [Unit(index=k, first=k, count=2, columns={}) for k in (0, *range(2, 20))]
    monkeypatch.setattr("impactopt.sweeps.cluster.evaluate", lethal)
    found = on_cluster(tmp_path, units, client, print)  # type: ignore[arg-type]
    _, result = next((u, r) for u, r in found if u.index == 0)
    assert result.columns["status"] == ["crashed"] * 2 and "died" in result.columns["reason"][0]
    found.close()
    until = time.monotonic() + 10
    while any(client.processing().values()) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(client.processing().values())


def lethal(folder: Path, unit: Unit) -> Any:
    unlucky(folder, unit.index)
    time.sleep(0.1)
    from impactopt.sweeps.design import Found

    return Found(columns={"reason": ["", ""]}, peak_mb=0.0)


@pytest.mark.slow
def test_results_that_die_with_their_workers_are_computed_again(
    client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All workers are killed after they have finished, and before their results are taken."""
    import distributed

    following = distributed.as_completed.__next__
    lost: list[Any] = []

    def then_killed(finished: Any) -> Any:
        future = following(finished)
        if not lost:
            lost.append(future)
            for process in client.run(os.getpid).values():
                os.kill(process, signal.SIGKILL)
            until = time.monotonic() + 10
            while future.status == "finished" and time.monotonic() < until:
                time.sleep(0.001)
        return future

    monkeypatch.setattr(distributed.as_completed, "__next__", then_killed)
    # Dask's own number: with 1 a unit that begins anew on the second worker before its end is given up
    monkeypatch.setattr(client.cluster.scheduler, "allowed_failures", 3)
    monkeypatch.setattr("impactopt.sweeps.cluster.evaluate", harmless)
    units = [Unit(index=k, first=k, count=1, columns={}) for k in range(3)]
    found = {unit.index: result.peak_mb for unit, result in on_cluster("", units, client, print)}  # type: ignore[arg-type]
    assert lost and found == {0: 0.0, 1: 1.0, 2: 2.0}


@pytest.mark.slow
def test_a_scheduler_that_is_lost_while_it_gives_a_result_is_named(
    client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import distributed

    def broken(future: Any) -> None:
        raise distributed.comm.CommClosedError("Connection reset by peer")

    monkeypatch.setattr(distributed.Future, "result", broken)
    monkeypatch.setattr("impactopt.sweeps.cluster.evaluate", harmless)
    with pytest.raises(InputError, match="scheduler is lost"):
        list(on_cluster("", [Unit(index=0, first=0, count=1, columns={})], client, print))  # type: ignore[arg-type]


def harmless(_: str, unit: Unit) -> Any:
    from impactopt.sweeps.design import Found

    return Found(columns={"reason": [""]}, peak_mb=float(unit.index))


@pytest.mark.slow
def test_workers_of_another_version_are_refused(client: Any) -> None:
    work = Work(data={}, path=Path("p"), settings=SweepSection(problem="p"), version="0.0.0")
    with pytest.raises(InputError, match=r"a worker has impactopt .*, the sweep 0\.0\.0"):
        list(on_cluster(work, [Unit(index=0, first=0, count=1, columns={})], client, print))


@pytest.mark.slow
def test_what_cannot_be_used_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impactopt.sweeps.cluster.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        sweep(SWEEP, tmp_path / "out", scheduler="tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="one of workers, scheduler and client"):
        sweep(SWEEP, tmp_path / "out", scheduler="tcp://127.0.0.1:9", workers=2)
    inside = SimpleNamespace(scheduler_info=lambda n_workers: {"workers": {"inproc://10.0.0.1/2": {}}})
    with pytest.raises(InputError, match="threads of this process"):
        sweep(SWEEP, tmp_path / "out", client=inside)
