"""One solve in a process of its own: whatever becomes of it, it is an attempt with numbers.

A solver that crashes, eats all memory or does not look at the clock costs its own attempt only.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from impactopt.solvers.program import (
    NonlinearProgram,
    SolverResult,
    Vector,
    complementarity,
    max_violation,
    stationarity,
)

Make = Callable[[int], tuple[NonlinearProgram, Vector]]  # number of the start -> program and start
MEMORY = 8 << 30  # [bytes] of address space; a dense solver on a large program fails before it takes all
GRACE = 5.0  # [s] beyond the limit, for solvers that look at the clock seldom
BUILD_LIMIT = 900.0  # [s] for making the program; compiling its functions may be part of it


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """What one solve gave; nan is what is not known.

    Attributes
    ----------
    status : value of `Status`, or "killed", "crashed", "out of memory", "error".
    message : a sentence.
    seconds, seconds_functions, seconds_qp : [s] of the solver, of the program's functions, of QPs.
    iterations : of the solver.
    objective, max_violation, kkt : at the point given back, all evaluated anew; kkt: the larger of scaled
        stationarity and scaled complementarity.
    """

    status: str
    message: str = ""
    seconds: float = np.nan
    seconds_functions: float = np.nan
    seconds_qp: float = np.nan
    iterations: float = np.nan
    objective: float = np.nan
    max_violation: float = np.nan
    kkt: float = np.nan


def attempt(make: Make, start: int, solver: str, time_limit: float) -> Attempt:
    """Solve by the solver of that label in `SOLVERS`, in a process of its own.

    make : makes program and start over there; picklable.  time_limit [s] : from when the program is made.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, make, start, solver, time_limit), daemon=True)
    with _one_thread():
        process.start()
    theirs.close()
    try:
        if not ours.poll(BUILD_LIMIT):
            return Attempt(status="killed", message="the program was not made in time")
        found = _receive(ours)
        if found is None:  # made; the clock runs
            if not ours.poll(1.2 * time_limit + GRACE):
                return Attempt(
                    status="killed", message="it did not stop at the time limit", seconds=time_limit
                )
            found = _receive(ours)
        return found if found is not None else Attempt(status="error")
    except EOFError:
        process.join()
        return Attempt(status="crashed", message=f"exit code {process.exitcode}")
    finally:
        ours.close()
        process.kill()
        process.join()


def judged(program: NonlinearProgram, result: SolverResult) -> Attempt:
    """A solver's result, with violation and KKT residual evaluated anew."""
    x = result.x
    g, gradient, jacobian = program.constraints(x), program.gradient(x), program.jacobian(x)
    # a trace of a multiplier where there is no bound is no multiplier
    y = _of_bounds(result.multipliers, program.g_lower, program.g_upper)
    z = _of_bounds(result.bound_multipliers, program.x_lower, program.x_upper)
    scale = max(100.0, float(np.mean(np.abs(np.concatenate([y, z]))))) / 100.0
    gap = complementarity(program, x, g, y, z) / scale
    return Attempt(
        status=result.status.value,
        message=result.message,
        seconds=result.seconds,
        seconds_functions=result.seconds_functions,
        seconds_qp=result.seconds_qp,
        iterations=result.iterations,
        objective=float(program.objective(x)),
        max_violation=max_violation(program, x, g),
        kkt=max(stationarity(gradient, jacobian, y, z), gap),
    )


def _of_bounds(y: Vector, lower: Vector, upper: Vector) -> Vector:
    return np.where((y > 0) & (upper == np.inf) | (y < 0) & (lower == -np.inf), 0.0, y)


def _receive(pipe: Connection) -> Attempt | None:
    """What was found; None: the program is made."""
    found: Any = pipe.recv()
    return found if isinstance(found, Attempt) else None


def _serve(pipe: Connection, make: Make, start: int, solver: str, time_limit: float) -> None:
    from benchmarks.solvers import SOLVERS

    # banners and iterations of compiled solvers, which no option silences
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    try:
        program, x0 = make(start)
        pipe.send(None)
        _limit_memory()
        found = judged(program, SOLVERS[solver].run(program, x0, time_limit))
    except MemoryError:
        found = Attempt(status="out of memory", seconds=time_limit)
    except Exception as error:  # whatever a solver of others raises is its own row
        found = Attempt(status="error", message=f"{type(error).__name__}: {error}")
    pipe.send(found)
    pipe.close()


def _limit_memory() -> None:
    with contextlib.suppress(ImportError, ValueError, OSError):  # not everywhere
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


@contextlib.contextmanager
def _one_thread() -> Any:
    """Processes started here have one thread for linear algebra, so that times are of one core."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
