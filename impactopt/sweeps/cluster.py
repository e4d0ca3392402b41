"""The units of a sweep on a Dask cluster: the same units, on whatever machines its workers are."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import uuid
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from impactopt.errors import InputError, missing_package
from impactopt.sweeps.design import Found, Unit, Work, failed_columns
from impactopt.sweeps.evaluate import evaluate

__all__ = ["connected", "on_cluster"]

AHEAD = 3  # units a worker's thread that are handed to the scheduler at once
LOOK = 5.0  # [s] between looks at how many workers there are
PATIENCE = 10.0  # [s] for a scheduler to answer


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """A client of the scheduler at an address, tcp://host:port.

    Raises
    ------
    InputError : Dask is not installed; nothing answers there.
    """
    distributed = _distributed()
    # of a scheduler that is lost `_found` says all in one sentence, Dask on many pages
    loggers = [logging.getLogger(f"distributed.{name}") for name in ("client", "utils")]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        try:
            with ThreadPoolExecutor(1) as apart:  # a notebook has a loop of its own
                apart.submit(asyncio.run, _greet(address)).result()
            client = distributed.Client(address, timeout=PATIENCE)
        except (OSError, ValueError, TypeError, asyncio.TimeoutError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}: {str(error) or f'nothing in {PATIENCE:g} s'}"
            ) from error
        with client:
            yield client
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


async def _greet(address: str) -> None:
    """OSError or TimeoutError where no scheduler answers.

    A `Client` waits for ever for what takes its connection and is none.
    """
    distributed = _distributed()
    given = distributed.Security().get_connection_args("client")
    comm = await asyncio.wait_for(distributed.comm.connect(address, timeout=PATIENCE, **given), PATIENCE)
    comm.abort()


def on_cluster(
    work: Work, units: Iterable[Unit], client: Any, tell: Callable[[str], None]
) -> Generator[tuple[Unit, Found], None, None]:
    """Results of units on a cluster, in the order in which they are finished.

    client : a `distributed.Client`. A unit whose worker dies is given to another one by the scheduler, as
        often as `distributed.scheduler.allowed-failures` says; then its rows say so. Workers come and go.
    tell : told if there are no workers to begin with.

    Closing the generator cancels what is not finished.

    Raises
    ------
    InputError : the workers are threads of this process; a worker has another impactopt; the scheduler is
        lost.
    """
    distributed = _distributed()
    pool = _Pool(client, tell)
    name, source = uuid.uuid4().hex[:8], iter(units)
    pending: dict[Any, Unit] = {}
    done = distributed.as_completed()

    def submit() -> None:
        while len(pending) < AHEAD * pool.threads and (unit := next(source, None)) is not None:
            # a unit is worth more than its arguments: a new task each, none that depends on another's data
            key = f"impactopt-{name}-{unit.index}"
            future = client.submit(evaluate, work, unit, key=key, pure=False)
            pending[future] = unit
            done.add(future)

    try:
        submit()
        while pending:
            future = next(done)
            unit = pending.pop(future)
            submit()
            yield unit, _found(unit, future)
            future.release()
    finally:
        if pending:
            with contextlib.suppress(Exception):  # of a scheduler that is gone
                client.cancel([*pending], force=True)


class _Pool:
    """Number of threads that the workers have at present."""

    def __init__(self, client: Any, tell: Callable[[str], None]) -> None:
        self._client, self._next, self._threads = client, 0.0, 1
        workers = client.scheduler_info(n_workers=-1)["workers"]
        if any(str(address).startswith("inproc") for address in workers):
            raise InputError(
                "the workers of this Dask cluster are threads of this process, which a case that crashes "
                "would take along; give LocalCluster(processes=True, threads_per_worker=1)"
            )
        if not workers:
            tell("no worker has come to the scheduler yet; waiting for one")

    @property
    def threads(self) -> int:
        if time.monotonic() >= self._next:
            self._threads = max(sum(self._client.nthreads().values()), 1)
            self._next = time.monotonic() + LOOK
        return self._threads


def _found(unit: Unit, future: Any) -> Found:
    if future.status == "finished":
        found: Found = future.result()
        return found
    if future.status == "error":
        error = future.exception()
        if isinstance(error, _distributed().scheduler.KilledWorker):
            reason = "every worker that had it died: crashed, killed, out of memory, or far beyond its time"
            return Found(columns=failed_columns(unit.count, "crashed", reason), peak_mb=0.0)
        if isinstance(error, InputError):
            raise error
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"the workers cannot do it ({what}); do they have the same impactopt?")
    raise InputError(
        "the Dask scheduler is lost, or has been told to forget these tasks; what was finished before is "
        "kept, and the same command goes on from there"
    )


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise missing_package("a Dask cluster", "distributed", "cluster") from error
    return distributed
