"""The same function for many inputs, on several processes; a process that dies costs its own input only.

Processes are spawned, not forked: a fork copies the locks that CasADi's and BLAS's threads hold, not the
threads. Each gets what all inputs share once, when it starts, and ends with the process that started it,
however that ends. The pools of `concurrent.futures` do not do: a worker that is killed breaks the whole pool,
which says neither whose input it was nor with which exit code.
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

__all__ = ["Died", "each_on_workers", "map_on_workers"]

_Shared = TypeVar("_Shared")
_Input = TypeVar("_Input")
_Output = TypeVar("_Output")

AWAKE = 1.0  # [s]: the longest that Ctrl-C is overlooked for which comes between two looks and the wait
STARTS = 3  # that may fail one after another, if it was a signal that ended them
_LINUX = sys.platform.startswith("linux")
_PR_SET_PDEATHSIG = 1  # of its prctl


@dataclass(frozen=True, kw_only=True)
class Died:
    """Stand-in for a result: the exit code of the input's last process (-9: SIGKILL), and their number."""

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
    """``function(shared, input)`` of every input, in the order of the inputs.

    function : of a module, and so are its results, as they go from process to process.
    workers : processes; 1 computes here, where a crash takes all along.
    crashed : the result of an input whose process died, from the exit code (-11: segmentation fault).
    progress : called with how many are done, of how many.

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
    """Indices and results as they come, in any order; inputs are taken one by one, when a process is free.

    function : as of `map_on_workers`.  workers : processes, 1 or more.
    again : whether an input whose process died is tried once more; None: never.

    Closing the iterator ends the processes.

    Raises
    ------
    InputError : the processes do not start.
    """
    context = multiprocessing.get_context("spawn")
    source, back = iter(inputs), list[_Task]()
    pool: list[_Worker] = []
    failed = 0

    def task() -> _Task | None:
        if back:
            return back.pop()
        given = next(source, None)
        return None if given is None else _Task(*given)

    try:
        waiting = task()
        while waiting is not None or pool:
            # as many as there are inputs, at most; each is given its input when it says that it is ready
            while waiting is not None and len(pool) < workers:
                pool.append(_Worker(context, function, shared, waiting))
                waiting = task()
            pipes: Any = wait([worker.pipe for worker in pool], timeout=AWAKE)
            for worker in [w for w in pool if w.pipe in pipes]:
                try:
                    index, result = worker.pipe.recv()
                except (EOFError, OSError):
                    pool.remove(worker)
                    code, mine = worker.end(), worker.task
                    if not worker.ready:
                        failed += 1
                        if code >= 0 or failed >= STARTS:
                            raise InputError(
                                f"the worker processes do not start (exit code {code}); put the call of your "
                                'script under `if __name__ == "__main__":`, or ask for workers=1'
                            ) from None
                        back.append(mine)
                    else:
                        mine.tries += 1
                        died = Died(code=code, tries=mine.tries)
                        if again is not None and again(died):
                            back.append(mine)
                        else:
                            yield mine.index, died
                    waiting = task() if waiting is None else waiting
                    continue
                if index is None:
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
    """An input, and how many processes died of it."""

    index: int
    given: Any
    tries: int = 0


class _Worker:
    """A process, the pipe to it, and its input; ``ready`` once it has said so."""

    def __init__(self, context: Any, function: Any, shared: Any, task: _Task) -> None:
        self.task, self.ready = task, False
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(theirs, function, shared, os.getpid()), daemon=True
        )
        with _interrupts_held_back():
            self.process.start()
        theirs.close()  # so that its end is seen here

    def give(self) -> None:
        """Hand it its input; that it has died in the meantime shows when its answer is read."""
        self.ready = True
        with contextlib.suppress(OSError):
            self.pipe.send((self.task.index, self.task.given))

    def end(self) -> int:
        """End the process; its exit code."""
        self.pipe.close()
        self.process.join(0.2)  # it ends by itself where it waits for input, or is dead already
        if self.process.is_alive():
            self.process.terminate()
        self.process.join()
        return int(self.process.exitcode or 0)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Ctrl-C waits. Processes started here never see it, from their first instant on: who asked for them
    does, and ends them.
    """
    resource_tracker.ensure_running()  # started with the first process, it would let SIGINT in again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, function: Callable[[Any, Any], Any], shared: Any, parent: int) -> None:
    _end_with(parent)
    try:
        pipe.send((None, None))  # ready
        for done in itertools.count():
            index, given = pipe.recv()
            pipe.send((index, function(shared, given)))
            if not done:  # what it loaded stays, and need not be gone through for garbage again and again
                gc.collect()
                gc.freeze()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # nobody asks any more


def _end_with(parent: int) -> None:
    """Let this process end when its parent does, even if that is killed while this one computes."""
    if _LINUX:  # the kernel does it, in the middle of compiled code too
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it was gone before
            os._exit(1)
        return
    process: Any = multiprocessing.parent_process()

    def watch() -> None:
        wait([process.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
