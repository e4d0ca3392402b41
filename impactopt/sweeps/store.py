"""The directory of a sweep: what it holds, that only one sweep writes there, and that it is the same sweep.

* sweep.json      which sweep this is: its file's and its problem's data, and the versions that make its rows
* sweep.toml      the sweep's file as it was
* units.sqlite    every finished unit (`impactopt.sweeps.journal`)
* solved/N/       a plan that others start from, where cases start from their neighbours
* cases/N/        the whole result of case N, as of `impactopt solve`, where trajectories are kept
* table.parquet   the rows of all finished cases; made from the journal at the end of every run
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from impactopt.codegen.files import open_own
from impactopt.errors import InputError
from impactopt.files.output import make_directory, save_record, write_file
from impactopt.planning.solution import versions
from impactopt.sweeps.definition import Sweep
from impactopt.sweeps.journal import Entry, Journal
from impactopt.sweeps.units import Found

__all__ = ["Store"]

FORMAT = 2  # of sweep.json and the journal
UNITS, BEFORE = "units.sqlite", "units.journal"  # the second until format 1
SAID = 5  # so many changes are named


class Store:
    """A sweep's directory, open for this process alone; `close` gives it free.

    journal : its finished units.

    Raises
    ------
    InputError : another process has it; it holds another sweep, or rows of other versions; it cannot be
        written.
    """

    def __init__(self, sweep: Sweep, out: Path) -> None:
        self.path = make_directory(out)
        self._lock = _lock(self.path)
        try:
            self._claim(sweep)
            self.journal = Journal(self.path / UNITS)
        except BaseException:
            os.close(self._lock)
            raise

    @property
    def table(self) -> Path:
        return self.path / "table.parquet"

    @property
    def solved(self) -> Path:
        return self.path / "solved"

    def keep(self, unit: int, found: Found) -> None:
        """Put a unit on disk: whole results first, then the rows that say that they are there."""
        for case, record in found.records.items():
            save_record(record, self.path / "cases" / f"{case:06d}")
        self.journal.add(Entry(unit=unit, peak_mb=found.peak_mb, columns=found.columns))

    def close(self) -> None:
        self.journal.close()
        os.close(self._lock)

    def _claim(self, sweep: Sweep) -> None:
        place = self.path / "sweep.json"
        now: dict[str, Any] = {
            "format": FORMAT,
            "hash": sweep.hash,
            "versions": versions(),
            "sweep": sweep.content,
            "problem": sweep.problem.data,
        }
        try:
            there = json.loads(place.read_text(encoding="utf-8"))
        except FileNotFoundError:
            if any((self.path / name).exists() for name in (UNITS, BEFORE)):
                raise InputError(
                    f"{self.path} holds rows of a sweep, but {place.name}, which says of which, is gone; put "
                    "it back, or give another directory"
                ) from None
            write_file(self.path / "sweep.toml", lambda file: file.write(sweep.text.encode()))
            write_file(place, lambda file: file.write(json.dumps(now, indent=1).encode()))
            return
        except (OSError, ValueError) as error:
            raise InputError(f"{place} cannot be read ({error}); give another directory") from error
        if not isinstance(there, dict) or there.get("format") != FORMAT:
            raise InputError(
                f"{self.path} keeps its finished cases as another version of impactopt does; end this "
                "sweep with the version that began it, or give another --out (its table.parquet can be read "
                "as before)"
            )
        if there.get("hash") != now["hash"]:
            raise InputError(
                f"{self.path} holds another sweep{_changes(there, now)}; give another --out, or change the "
                "sweep back to go on with it"
            )
        if there["versions"] != now["versions"]:
            names = [n for n, v in now["versions"].items() if there["versions"].get(n) != v]
            old, new = (
                ", ".join(f"{n} {of[n]}" for n in names) for of in (there["versions"], now["versions"])
            )
            raise InputError(
                f"the rows in {self.path} were made with {old}, and this is {new}; rows of both would mix: "
                "install the same again, or give another --out"
            )


def _lock(path: Path) -> int:
    """A lock on the directory; it is free when the process ends, in whatever way."""
    import fcntl  # POSIX only

    try:
        handle = open_own(path / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise InputError(
            f"cannot lock {path}: {path / '.lock'}: {error.strerror}; remove it, or give another --out"
        ) from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        raise InputError(
            f"another process is at work on {path}; wait for it, or give another --out"
        ) from error
    return handle


def _changes(there: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Differences in words; settings that only one of them has included."""
    before, after = (
        {**_flat(of.get("sweep", {})), **_flat(of.get("problem", {}), "problem file: ")}
        for of in (there, now)
    )
    none = "not given"
    changed = [
        f"{key} was {before.get(key, none)}, is {after.get(key, none)}"
        for key in {**before, **after}
        if before.get(key, none) != after.get(key, none)
    ]
    if not changed:
        return ""
    more = f", and {len(changed) - SAID} more" if len(changed) > SAID else ""
    return ": " + "; ".join(changed[:SAID]) + more


def _flat(data: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in data.items():
        out |= _flat(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
    return out
