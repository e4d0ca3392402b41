"""Does anything break it, or make it silently wrong? Seeded attacks, each judged by something independent.

Mutated problem files, URDFs, command lines with damaged results, and public calls with odd numbers: an answer
is an `InputError` or is sound, and comes within five seconds. Random collisions and replays: as the same
physics by another way says, or refused; collisions by several compilers or none: the same. A case depends on
the seed and its number alone: `case` does it again.
"""

from __future__ import annotations

import signal
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.report import Report, Say, make_table

from fuzz.attack_calls import attack_call
from fuzz.attack_cases import FINE, LATE, REFUSED, TRACEBACK, UNSOUND, Found, pick
from fuzz.attack_collisions import FLOATING, ROBOTS, Struck, pairs_of, strike
from fuzz.attack_commands import attack_command, make_result
from fuzz.attack_compilers import BUILDS, Compared, builds, compare
from fuzz.attack_compilers import ROBOTS as COMPILED
from fuzz.attack_files import attack_file, texts
from fuzz.attack_replays import Replayed, replay_one
from fuzz.attack_urdfs import URDFS, attack_urdf
from impactopt.simulation.workers import map_on_workers

# files, URDFs, command lines, calls; collisions a robot, and of those by several compilers; replayed plans
COUNTS = {
    "file": 20_000,
    "urdf": 2500,
    "command": 1000,
    "call": 5000,
    "collision": 1000,
    "compiled": 200,
    "replay": 200,
}
QUICK = {"file": 300, "urdf": 60, "command": 20, "call": 200, "collision": 16, "compiled": 16, "replay": 2}
NAMES = {"file": "files", "urdf": "urdfs", "command": "commands", "call": "calls"}
_KINDS = tuple(NAMES)
_CHUNK = {"file": 50, "urdf": 50, "command": 10, "call": 50}  # cases of one job
HUNG = 60.0  # [s] after which a case is given up, and its process with it
_SHOWN = 50


def case(
    kind: str,
    seed: int,
    number: int,
    *,
    folder: Path,
    result: Path | None = None,
) -> Found:
    """One case: "file", "urdf", "command" or "call" of a seed and a number.

    folder : to work in.  result : a saved one, for command lines; None: none of them has one.
    """
    rng = np.random.default_rng([seed, _KINDS.index(kind), number])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # odd numbers overflow
        if kind == "file":
            return attack_file(pick(rng, texts()), folder, rng)
        if kind == "urdf":
            return attack_urdf(pick(rng, URDFS), folder, rng)
        if kind == "command":
            return attack_command(folder / "none" if result is None else result, folder, rng)
        return attack_call(rng)


def run(
    say: Say,
    *,
    quick: bool = False,
    seed: int = 0,
    workers: int = 2,
    counts: dict[str, int] | None = None,
) -> Report:
    """How many cases there were, and how many of them ended as none may.

    counts : of cases by kind, of collisions a robot, and of replays, in place of the usual ones.
    """
    many = {**(QUICK if quick else COUNTS), **(counts or {})}
    with tempfile.TemporaryDirectory(prefix="impactopt-attack-") as scratch:
        folder = Path(scratch)
        result = None
        if many["command"] or many["replay"]:
            say("planning what is to be damaged")
            result = make_result(folder)
        jobs = [
            (kind, seed, first, min(_CHUNK[kind], many[kind] - first))
            for kind in _KINDS
            for first in range(0, many[kind], _CHUNK[kind])
        ]
        found = _all(jobs, (folder, result), workers, say)
        drawn = [(result, seed, number) for number in range(many["replay"])]
        replayed = _each(_replay, drawn, Replayed(replays=1, off=1), workers, say, "plans replayed")
    # humanoids' models compile for minutes
    hit, made = ([r for r in robots if not (quick and r in FLOATING)] for robots in (ROBOTS, COMPILED))
    blows = _models(hit, many["collision"], seed)
    struck = _each(_strike, blows, Struck(collisions=1, off=1), workers, say, "models struck")
    blows = _models(made, many["compiled"], seed)
    compiled = _each(_compare, blows, Compared(collisions=1, off=1), workers, say, "models made otherwise")
    return report(found, struck, compiled, replayed)


# ------------------------------------------------------------ on several processes
def _all(jobs: Sequence[tuple[str, int, int, int]], shared: Any, workers: int, say: Say) -> list[Found]:
    def told(done: int, of: int) -> None:
        say(f"{done} of {of} parts of the attack")

    watchdog = workers > 1
    parts = map_on_workers(
        _job, (*shared, watchdog), jobs, workers=workers, crashed=lambda code: None, progress=told
    )
    found = [one for part in parts if part is not None for one in part]
    # of a part whose process has died or hung, each case in a process of its own
    lost = [job for job, part in zip(jobs, parts, strict=True) if part is None]
    single = [(kind, seed, first + k, 1) for kind, seed, first, count in lost for k in range(count)]
    if single:
        again = map_on_workers(
            _job, (*shared, watchdog), single, workers=workers, crashed=lambda code: [_dead(code)]
        )
        for job, part in zip(single, again, strict=True):
            found += [_placed(one, job) for one in part or []]
    return found


def _job(shared: Any, job: tuple[str, int, int, int]) -> list[Found] | None:
    folder, result, watchdog = shared
    kind, seed, first, count = job
    found = []
    with tempfile.TemporaryDirectory(dir=folder) as own:
        for number in range(first, first + count):
            if watchdog:  # the kernel's: nothing else stops compiled code
                signal.setitimer(signal.ITIMER_REAL, HUNG)
            one = case(kind, seed, number, folder=Path(own), result=result)
            found.append(_placed(one, (kind, seed, number, 1)))
    if watchdog:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return found


def _placed(found: Found, job: tuple[str, int, int, int]) -> Found:
    """With the numbers that make it again, and without what cannot be of use any more."""
    kind, seed, number, _ = job
    kept = found.case if found.verdict not in (FINE, REFUSED) else ""
    return Found(
        kind=kind,
        verdict=found.verdict,
        reason=f"{found.reason} (seed {seed}, number {number})" if kept or not found.kind else "",
        case=kept,
        seconds=found.seconds,
    )


def _dead(code: int) -> Found:
    if code == -signal.SIGALRM:
        return Found(kind="", verdict=LATE, reason=f"no answer within {HUNG:g} s")
    return Found(kind="", verdict=TRACEBACK, reason=f"the process died ({code})")


def _models(robots: Sequence[str], count: int, seed: int) -> list[tuple[str, str, str, int, int]]:
    """Robot, law, target, and a share of so many collisions a robot."""
    jobs = []
    for robot in robots:
        pairs = pairs_of(robot)
        shares = [count // len(pairs) + (k < count % len(pairs)) for k in range(len(pairs))]
        jobs += [(robot, *pair, share, seed) for pair, share in zip(pairs, shares, strict=True) if share]
    return jobs


def _each(work: Any, jobs: Sequence[Any], died: Any, workers: int, say: Say, what: str) -> list[Any]:
    """Of each job what `work` finds, or `died` with the reason."""

    def crashed(code: int) -> Any:
        return replace(died, faults=(f"the process died ({code})",))

    def told(done: int, of: int) -> None:
        say(f"{done} of {of} {what}")

    return map_on_workers(work, None, jobs, workers=workers, crashed=crashed, progress=told)


def _quietly(work: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the equation's solver tries what overflows
        return work(*job)


def _strike(_shared: None, job: tuple[str, str, str, int, int]) -> Struck:
    found: Struck = _quietly(strike, job)
    return found


def _compare(_shared: None, job: tuple[str, str, str, int, int]) -> Compared:
    found: Compared = _quietly(compare, job)
    return found


def _replay(_shared: None, job: tuple[Path, int, int]) -> Replayed:
    found: Replayed = _quietly(replay_one, job)
    return found


# ------------------------------------------------------------ what came out
def report(
    found: Sequence[Found],
    struck: Sequence[Struck],
    compiled: Sequence[Compared] = (),
    replayed: Sequence[Replayed] = (),
) -> Report:
    """Counts for JSON; for the screen also every fault, with what makes it again."""
    counts = Counter((one.kind, one.verdict) for one in found)
    cases = Counter(one.kind for one in found)
    numbers: dict[str, Any] = {name: cases[kind] for kind, name in NAMES.items()}
    numbers["tracebacks"] = sum(counts[kind, TRACEBACK] for kind in NAMES)
    numbers["slow"] = sum(counts[kind, LATE] for kind in NAMES)
    numbers["unsound"] = sum(counts[kind, UNSOUND] for kind in NAMES)
    numbers |= _sums(struck, "collisions")
    absent = [build for build in BUILDS if build not in builds()]
    numbers["compilers"] = {"builds": list(builds()), "absent": absent, **_sums(compiled, "collisions")}
    numbers["replays"] = _sums(replayed, "replays")
    verdicts = (FINE, REFUSED, TRACEBACK, LATE, UNSOUND)
    rows = [
        [name, str(cases[kind]), *(str(counts[kind, v]) for v in verdicts)] for kind, name in NAMES.items()
    ]
    tables = [make_table("attacks", ["of", "cases", *verdicts], rows)]
    heads = ["", "cases", "off", "refused", "too slow to judge", "largest error"]
    by_compilers = f"collisions by {', '.join(builds())}; absent: {', '.join(absent) or 'none'}"
    by_another_way: dict[str, Sequence[Any]] = {
        "collisions by an equation": struck,
        by_compilers: compiled,
        "replays by an equation": replayed,
    }
    rows = [[name, *_cells(parts)] for name, parts in by_another_way.items() if parts]
    tables.append(make_table("by another way", heads, rows))
    faults = [
        [one.kind, one.verdict, one.reason, one.case[:300]]
        for one in found
        if one.verdict not in (FINE, REFUSED)
    ]
    for kind, parts in (("collision", struck), ("compiler", compiled), ("replay", replayed)):
        faults += [[kind, "off", "", text] for one in parts for text in one.faults]
    if faults:
        shown = f"faults ({len(faults)})" + (f", the first {_SHOWN}" if len(faults) > _SHOWN else "")
        tables.append(make_table(shown, ["of", "verdict", "what", "case"], faults[:_SHOWN]))
    return Report(name="attack", numbers=numbers, tables=tables)


def _sums(parts: Sequence[Any], cases: str) -> dict[str, int]:
    """How many cases there were, were off, and were refused."""
    return {name: sum(getattr(one, name) for one in parts) for name in (cases, "off", "refused")}


def _cells(parts: Sequence[Any]) -> list[str]:
    cases = "replays" if isinstance(parts[0], Replayed) else "collisions"
    unjudged = sum(getattr(one, "unjudged", 0) for one in parts)
    counts = [*_sums(parts, cases).values(), unjudged]
    return [*map(str, counts), f"{max(one.largest for one in parts):.0e}"]
