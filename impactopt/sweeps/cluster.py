"""Evaluation of a sweep's units on a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import uuid
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any

from impactopt.errors import InputError, missing_package
from impactopt.sweeps.design import Found, Unit, Work, failed_columns
from impactopt.sweeps.evaluate import evaluate

UNITS_PER_THREAD = 3  # that the scheduler has at once, for each thread of its workers
COUNT_INTERVAL = 5.0  # [s] between counts of the workers' threads
CONNECT_TIMEOUT = 10.0  # [s]


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Client of the scheduler at an address, tcp://host:port.

    Raises
    ------
    InputError : Dask is not installed; nothing answers at the address.
    """
    distributed = _distributed()
    # If the scheduler is lost, `_found` raises one sentence. Dask would log many pages.
    loggers = [logging.getLogger(f"distributed.{name}") for name in ("client", "utils")]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        try:
            # in another thread, as a notebook's runs an event loop already
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _check_scheduler(address)).result()
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError, asyncio.TimeoutError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}: {str(error) or f'nothing in {CONNECT_TIMEOUT:g} s'}"
            ) from error
        with client:
            yield client
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


async def _check_scheduler(address: str) -> None:
    """Raise OSError or TimeoutError if no scheduler answers.

    A `Client` would wait for ever for another server that accepts its connection.
    """
    distributed = _distributed()
    security = distributed.Security().get_connection_args("client")
    connection = distributed.comm.connect(address, timeout=CONNECT_TIMEOUT, **security)
    comm = await asyncio.wait_for(connection, CONNECT_TIMEOUT)
    comm.abort()


def on_cluster(
    work: Work, units: Iterable[Unit], client: Any, report: Callable[[str], None]
) -> Generator[tuple[Unit, Found], None, None]:
    """Results of units on a cluster, in the order in which they are finished.

    client : a `distributed.Client`. Workers may come and go. If a worker dies, the scheduler gives its unit
        to another one, as often as `distributed.scheduler.allowed-failures` says; then the unit's cases fail.
    report : called with a message if there are no workers at first.

    Closing the generator cancels the units that are not finished.

    Raises
    ------
    InputError : the workers are threads of this process; a worker has another version of impactopt; the
        scheduler is lost.
    """
    distributed = _distributed()
    pool = _Pool(client, report)
    name, source = uuid.uuid4().hex[:8], iter(units)
    pending: dict[Any, Unit] = {}
    done = distributed.as_completed()

    def submit() -> None:
        while len(pending) < UNITS_PER_THREAD * pool.threads and (unit := next(source, None)) is not None:
            # A key of its own makes each unit a new task. Dask would else identify tasks by their arguments.
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
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise InputError(
            "the Dask scheduler is lost, or has forgotten these tasks; finished cases are kept, and the same "
            "command resumes the sweep"
        ) from error
    finally:
        if pending:
            with contextlib.suppress(Exception):  # the scheduler may be lost
                client.cancel([*pending], force=True)


class _Pool:
    """Present number of the workers' threads."""

    def __init__(self, client: Any, report: Callable[[str], None]) -> None:
        self._client, self._next, self._threads = client, 0.0, 1
        workers = client.scheduler_info(n_workers=-1)["workers"]
        if any(str(address).startswith("inproc") for address in workers):
            raise InputError(
                "the workers of this Dask cluster are threads of this process, which a case that crashes "
                "would end; give LocalCluster(processes=True, threads_per_worker=1)"
            )
        if not workers:
            report("the scheduler has no worker yet; waiting for one")

    @property
    def threads(self) -> int:
        if time.monotonic() >= self._next:
            self._threads = max(sum(self._client.nthreads().values()), 1)
            self._next = time.monotonic() + COUNT_INTERVAL
        return self._threads


def _found(unit: Unit, future: Any) -> Found:
    """Result of a task, made again if it has died with its worker; InputError if the workers cannot do it."""
    try:
        found: Found = future.result()
        return found
    except _distributed().scheduler.KilledWorker:
        reason = "every worker that had it died: crashed, killed, out of memory, or far beyond its time"
        return Found(columns=failed_columns(unit.count, "crashed", reason), peak_mb=0.0)
    except (InputError, CancelledError, _distributed().comm.CommClosedError):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"the workers cannot do it ({what}); do they have the same impactopt?") from error


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise missing_package("a Dask cluster", "distributed", "cluster") from error
    return distributed
