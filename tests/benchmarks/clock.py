"""Times of calls, measured in one way: warmed up, in turns, medians.

In turns, so that the machine's moods meet all alike: ratios within one run hold where times do not. What else
runs cuts long measurements up more often than short ones; where the two are compared, it is the thread's own
time on a core that counts (`time.thread_time`), and for several threads the best time of day.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

REPEATS = 51
_LONG_ENOUGH = 1e-3  # [s] of one measurement; longer ones are cut up by what else runs
_LEAST = 3  # measurements of what takes long


def runner(function: Any, arguments: list[Any]) -> Callable[[], Any]:
    """Calls a CasADi function through buffers: nothing is copied or allocated."""
    buffer, evaluate = function.buffer()
    kept: list[Any] = [np.asfortranarray(x, dtype=np.float64).ravel(order="F") for x in arguments]
    kept += [np.zeros(max(function.nnz_out(i), 1)) for i in range(function.n_out())]
    for i in range(function.n_in()):
        buffer.set_arg(i, memoryview(kept[i]))
    for i in range(function.n_out()):
        buffer.set_res(i, memoryview(kept[function.n_in() + i]))

    def run(_alive: Any = (buffer, kept)) -> None:
        evaluate()

    return run


def medians(
    runs: Mapping[str, Callable[[], Any]],
    *,
    repeats: int = REPEATS,
    longest: float = np.inf,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """[s] of one call each.

    longest : [s] after which a run is measured no more, once it has been three times.
    clock : gives the time [s].
    """
    found = _samples(runs, repeats, longest, clock)
    return {name: float(np.median(some)) for name, some in found.items()}


def shortest(
    runs: Mapping[str, Callable[[], Any]], *, repeats: int = REPEATS, warm: bool = False
) -> dict[str, float]:
    """[s] of the fastest call of each: as on a machine that does nothing else.

    warm : call once more before each measurement, of code so large that the others' drives it out of the
        caches.
    """
    found = _samples(runs, repeats, np.inf, time.perf_counter, warm=warm)
    return {name: min(some) for name, some in found.items()}


def _samples(
    runs: Mapping[str, Callable[[], Any]],
    repeats: int,
    longest: float,
    clock: Callable[[], float],
    *,
    warm: bool = False,
) -> dict[str, list[float]]:
    counts = {}
    for name, run in runs.items():
        run()
        began = time.perf_counter()
        run()
        counts[name] = max(1, int(_LONG_ENOUGH / max(time.perf_counter() - began, 1e-7)))
    samples: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            spent = sum(samples[name]) * counts[name]
            if spent > longest and len(samples[name]) >= _LEAST:
                continue
            if warm:
                run()
            began = clock()
            for _ in range(counts[name]):
                run()
            samples[name].append((clock() - began) / counts[name])
    return samples
