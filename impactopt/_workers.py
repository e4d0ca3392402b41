"""The same function for many inputs, on several processes; a process that dies costs its own input only.

Processes are spawned, not forked: a fork copies the locks that CasADi's and BLAS's threads hold, not the
threads. Each gets what all inputs share once, when it starts.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from impactopt.errors import InputError

__all__ = ["map_on_workers"]

_Shared = TypeVar("_Shared")
_Input = TypeVar("_Input")
_Output = TypeVar("_Output")


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
    done = 0
    results: dict[int, _Output] = {}

    def keep(index: int, result: _Output) -> None:
        nonlocal done
        results[index], done = result, done + 1
        if progress is not None:
            progress(done, len(inputs))

    if workers == 1:
        for index, given in enumerate(inputs):
            keep(index, function(shared, given))
        return [results[k] for k in range(len(inputs))]

    context = multiprocessing.get_context("spawn")
    waiting = list(enumerate(inputs))[::-1]
    crew: list[_Worker] = []
    try:
        for _ in range(min(workers, len(inputs))):
            crew.append(_Worker(context, function, shared))
        while crew:
            pipes: Any = wait([worker.pipe for worker in crew])
            for worker in [w for w in crew if w.pipe in pipes]:
                try:
                    index, result = worker.pipe.recv()
                except (EOFError, OSError):
                    crew.remove(worker)
                    code = worker.end()
                    if worker.at is None:
                        raise InputError(
                            f"the worker processes do not start (exit code {code}); put the call of your "
                            'script under `if __name__ == "__main__":`, or ask for workers=1'
                        ) from None
                    keep(worker.at, crashed(code))
                    if waiting:
                        crew.append(_Worker(context, function, shared))
                    continue
                if index is not None:
                    keep(index, result)
                if waiting:
                    worker.give(*waiting.pop())
                else:
                    crew.remove(worker)
                    worker.end()
    finally:
        for worker in crew:
            worker.end()
    return [results[k] for k in range(len(inputs))]


class _Worker:
    """A process and the pipe to it; ``at`` is the index of the input that it has, None before its first."""

    def __init__(self, context: Any, function: Any, shared: Any) -> None:
        self.at: int | None = None
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, function, shared), daemon=True)
        with _interrupts_held_back():
            self.process.start()
        theirs.close()  # so that its end is seen here

    def give(self, index: int, given: Any) -> None:
        self.at = index
        self.pipe.send((index, given))

    def end(self) -> int:
        """End the process; its exit code."""
        self.pipe.close()
        if self.at is None or self.process.is_alive():
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


def _serve(pipe: Connection, function: Callable[[Any, Any], Any], shared: Any) -> None:
    try:
        pipe.send((None, None))  # ready
        while True:
            index, given = pipe.recv()
            pipe.send((index, function(shared, given)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # nobody asks any more
