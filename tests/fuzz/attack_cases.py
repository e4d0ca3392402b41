"""One case of an attack: what is done, and what came of it."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

import impactopt
from impactopt.errors import InputError

Generator = np.random.Generator

SLOW = 5.0  # [s]: an answer that comes later is late
FINE, REFUSED = "fine", "refused"
TRACEBACK, LATE, UNSOUND = "traceback", "slow", "unsound"


@dataclass(frozen=True, kw_only=True)
class Found:
    """What became of a case.

    verdict : "fine", "refused" (an `InputError`), "traceback", "slow" or "unsound".  reason : why, with the
    place in our code for a traceback.  case : what was done.  seconds : until the answer, without those that
    it stood in line for a processor, where the system tells them.
    """

    kind: str
    verdict: str
    reason: str = ""
    case: str = ""
    seconds: float = 0.0


def attempt(kind: str, case: str, work: Callable[[], str]) -> Found:
    """A case's outcome.

    work : does it, and says what is unsound in what it has got, or "". What is late is done once more: the
    first time may have imported or compiled what a case needs.
    """
    verdict, reason, seconds = _once(work)
    if verdict != TRACEBACK and seconds > SLOW:
        again, why, seconds = _once(work)
        if seconds > SLOW:
            verdict, reason = LATE, f"{seconds:.1f} s: {why or again}"
    return Found(kind=kind, verdict=verdict, reason=reason, case=case, seconds=seconds)


def _once(work: Callable[[], str]) -> tuple[str, str, float]:
    began = _clock()
    try:
        wrong = work()
        verdict, reason = (UNSOUND, wrong) if wrong else (FINE, "")
    except InputError as error:
        verdict, reason = REFUSED, str(error)[:200]
    except Exception as error:  # what is looked for
        verdict, reason = TRACEBACK, _told(error)
    return verdict, reason, _clock() - began


def _clock() -> float:
    """[s] that pass while this thread runs or sleeps, not while others' work keeps it from running: a late
    answer is to be ours, not the machine's. Linux tells; elsewhere it is the clock on the wall."""
    now = time.perf_counter()
    try:
        _ran, waited, _slices = Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return now
    return now - 1e-9 * int(waited)


def _told(error: BaseException) -> str:
    """An error in one line, with the last place in this package that it went through."""
    ours = Path(impactopt.__file__).parent
    frames = traceback.extract_tb(error.__traceback__)
    mine = [f for f in frames if ours in Path(f.filename).parents]
    where = f"{Path(mine[-1].filename).relative_to(ours)}:{mine[-1].lineno}: " if mine else ""
    return f"{where}{type(error).__name__}: {error}"[:300]


# ------------------------------------------------------------ odd numbers
_EDGES = (0.0, -0.0, 1.0, -1.0, 1e-3, 1e3, 1e-9, 1e9, 1e-300, 1e300, 5e-324, 1.7e308)
_NONE = (float("nan"), float("inf"), -float("inf"))


def odd_number(rng: Generator, near: float = 1.0) -> float:
    """A number: one at an edge, none at all, or one of any size and sign near another."""
    kind = rng.integers(4)
    if kind == 0:
        return pick(rng, _EDGES) * float(rng.choice([1.0, -1.0]))
    if kind == 1:
        return pick(rng, _NONE)
    decades = 3.0 if kind == 2 else 300.0
    size = (abs(near) or 1.0) * 10.0 ** rng.uniform(-decades, decades) if decades < 10 else 1.0
    size = size if decades < 10 else 10.0 ** rng.uniform(-decades, decades)
    return float(size * rng.choice([1.0, -1.0]))


def pick(rng: Generator, things: Any) -> Any:
    """One of them."""
    return things[int(rng.integers(len(things)))]


# ------------------------------------------------------------ what there is of numbers
def numbers_in(thing: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of plain data, arrays, and dataclasses, with the names of where they are."""
    if isinstance(thing, (bool, str, bytes)) or thing is None:
        return
    if isinstance(thing, (int, float, np.integer, np.floating)):
        yield name, float(thing)
    elif isinstance(thing, np.ndarray):
        if thing.dtype.kind in "fiu":
            yield from ((name, float(x)) for x in thing.ravel())
    elif isinstance(thing, Mapping):
        for key, value in thing.items():
            yield from numbers_in(value, f"{name}.{key}")
    elif isinstance(thing, (list, tuple, set, frozenset)):
        for i, value in enumerate(thing):
            yield from numbers_in(value, f"{name}[{i}]")
    elif is_dataclass(thing):
        for part in fields(thing):
            if not part.name.startswith("_"):
                yield from numbers_in(getattr(thing, part.name), f"{name}.{part.name}")
