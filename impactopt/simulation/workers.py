"""Pool of worker processes for a function of many inputs; a process that dies loses its own input only.

Processes are spawned, not forked: a fork copies the locks that CasADi's and BLAS's threads hold, but not the
threads. Each process receives the shared data once, when it starts, and ends with its parent, however that
ends. The pools of `concurrent.futures` do not suffice: a killed worker breaks the whole pool, which reports
neither the input nor the exit code.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from impactopt.errors import InputError

_Shared = TypeVar("_Shared")
_Input = TypeVar("_Input")
_Output = TypeVar("_Output")

POLL = 1.0  # [s] timeout of a wait; a Ctrl-C that comes just before the wait is seen after it
MAX_FAILED_STARTS = 3  # in a row, of processes that a signal ended while they started
_LINUX = sys.platform.startswith("linux")
_PR_SET_PDEATHSIG = 1  # option of prctl: signal to a process whose parent dies


@dataclass(frozen=True, kw_only=True)
class Died:
    """Stand-in for the result of an input whose process died.

    code : exit code of the last process (-9: SIGKILL).  tries : number of processes that died.
    """

    code: int
    tries: int


def map_on_workers(
    function: Callable[[_Shared, _Input], _Output],
    shared: _Shared,
    inputs: Sequence[_Input],
    *,
    workers: int,
    crashed: Callable[[int], _Output],
    progress: Callable[[int, int], None] | None = None,
) -> list[_Output]:
    """Results ``function(shared, input)`` of all inputs, in their order.

    function : defined at the top level of a module, with results that can be pickled.
    workers : number of processes; 1 computes in this process, which a crash ends.
    crashed : makes the result of an input whose process died, from the exit code (-11: segmentation fault).
    progress : called with the number of finished inputs, and of all.

    Ctrl-C ends the processes and is raised here.

    Raises
    ------
    InputError : the processes do not start.
    """
    results: dict[int, _Output] = {}
    found: Iterable[tuple[int, _Output | Died]]
    if workers == 1:
        found = ((index, function(shared, given)) for index, given in enumerate(inputs))
    else:
        found = each_on_workers(function, shared, enumerate(inputs), workers=min(workers, len(inputs)))
    for done, (index, result) in enumerate(found, start=1):
        results[index] = crashed(result.code) if isinstance(result, Died) else result
        if progress is not None:
            progress(done, len(inputs))
    return [results[k] for k in range(len(inputs))]


def each_on_workers(
    function: Callable[[_Shared, _Input], _Output],
    shared: _Shared,
    inputs: Iterable[tuple[int, _Input]],
    *,
    workers: int,
    again: Callable[[Died], bool] | None = None,
) -> Iterator[tuple[int, _Output | Died]]:
    """Yields indices and results as they come, in any order; takes an input when a process is free.

    function : as in `map_on_workers`.  workers : number of processes, 1 or more.
    again : decides if an input whose process died is tried once more; None: never.

    Closing the iterator ends the processes.

    Raises
    ------
    InputError : the processes do not start.
    """
    context = multiprocessing.get_context("spawn")
    source, returned = iter(inputs), list[_Task]()  # the latter are tried again
    pool: list[_Worker] = []
    failed = 0

    def task() -> _Task | None:
        if returned:
            return returned.pop()
        given = next(source, None)
        return None if given is None else _Task(*given)

    try:
        waiting = task()
        while waiting is not None or pool:
            # at most as many processes as inputs; each receives its input once it is ready
            while waiting is not None and len(pool) < workers:
                pool.append(_Worker(context, function, shared, waiting))
                waiting = task()
            pipes: Any = wait([worker.pipe for worker in pool], timeout=POLL)
            for worker in [w for w in pool if w.pipe in pipes]:
                try:
                    index, result = worker.pipe.recv()
                except (EOFError, OSError):
                    pool.remove(worker)
                    code, mine = worker.end(), worker.task
                    if not worker.ready:
                        failed += 1
                        # an exit code >= 0 is an error in the script, which every process would repeat
                        if code >= 0 or failed >= MAX_FAILED_STARTS:
                            raise InputError(
                                f"the worker processes do not start (exit code {code}); put the call into a "
                                'script\'s file, under `if __name__ == "__main__":`'
                            ) from None
                        returned.append(mine)
                    else:
                        mine.tries += 1
                        died = Died(code=code, tries=mine.tries)
                        if again is not None and again(died):
                            returned.append(mine)
                        else:
                            yield mine.index, died
                    waiting = task() if waiting is None else waiting
                    continue
                if index is None:  # the process is ready
                    failed = 0
                    worker.give()
                    continue
                if waiting is not None:
                    worker.task, waiting = waiting, task()
                    worker.give()
                else:
                    pool.remove(worker)
                    worker.end()
                yield index, result
    finally:
        for worker in pool:
            worker.end()


@dataclass(kw_only=False)
class _Task:
    """An input, and the number of processes that died of it."""

    index: int
    given: Any
    tries: int = 0


class _Worker:
    """A process, the pipe to it, and its input; ``ready`` once it has started."""

    def __init__(self, context: Any, function: Any, shared: Any, task: _Task) -> None:
        self.task, self.ready = task, False
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(theirs, function, shared, os.getpid()), daemon=True
        )
        with _interrupts_blocked():
            self.process.start()
        theirs.close()  # so that reading the pipe fails when the process ends

    def give(self) -> None:
        """Sends the input. If the process has died in the meantime, reading its result will fail."""
        self.ready = True
        with contextlib.suppress(OSError):
            self.pipe.send((self.task.index, self.task.given))

    def end(self) -> int:
        """Ends the process, and returns its exit code."""
        self.pipe.close()
        self.process.join(0.2)  # a process that waits for input ends by itself
        if self.process.is_alive():
            self.process.terminate()
        self.process.join()
        return int(self.process.exitcode or 0)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Blocks Ctrl-C. Processes started meanwhile never receive it: the parent does, and ends them."""
    resource_tracker.ensure_running()  # its start with the first process would unblock SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, function: Callable[[Any, Any], Any], shared: Any, parent: int) -> None:
    """Main function of a worker process."""
    _end_with(parent)
    try:
        pipe.send((None, None))  # ready
        for done in itertools.count():
            index, given = pipe.recv()
            pipe.send((index, function(shared, given)))
            if not done:  # loaded modules stay: exclude them from garbage collection
                gc.collect()
                gc.freeze()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent has closed the pipe


def _end_with(parent: int) -> None:
    """Makes this process end when its parent does, even if the parent is killed while this one computes."""
    if _LINUX:  # the kernel kills it, even within compiled code
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before the call
            os._exit(1)
        return
    process: Any = multiprocessing.parent_process()

    def watch() -> None:
        wait([process.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
