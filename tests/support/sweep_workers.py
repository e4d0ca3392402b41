"""What workers of tests do: a module of its own, as each of them imports it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any


def unlucky(folder: Path, number: int) -> Any:
    """Of three inputs one dies always, and one once."""
    first = folder / f"tried {number}"
    if number == 0 or (number == 1 and not first.exists()):
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def slow(limit: float, _: int) -> None:
    import numpy as np

    from impactopt.sweeps.evaluate import Watchdog

    watchdog = Watchdog(limit, 0.1)
    for _ in range(3):  # news put it off
        time.sleep(0.8 * limit)
        watchdog.iteration(None)
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    while True:  # no Python between: as compiled code does not come back
        np.linalg.matrix_power(np.eye(400), 10**9)


def pools(_: None, number: int) -> int:
    from threadpoolctl import threadpool_info

    from impactopt.sweeps import evaluate
    from impactopt.sweeps.design import Unit, Work
    from impactopt.sweeps.sections import SweepSection

    def count(*_: Any) -> Any:
        return {"reason": [""], "threads": [max(pool["num_threads"] for pool in threadpool_info())]}, {}

    evaluate.CASE_KINDS["solve"] = count
    unit = Unit(index=number, first=0, count=1, columns={})
    found = evaluate.evaluate(Work(data={}, path=Path("p"), settings=SweepSection(problem="p")), unit)
    return int(found.columns["threads"][0])
