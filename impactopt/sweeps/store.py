"""The directory of a sweep: what it holds, that only one sweep writes there, and that it is the same sweep.

SQLite sees to kills and full disks: a row is there whole or not at all, and on disk when `add` returns. Rows
carry a checksum, so that a unit whose numbers the disk has changed is done again. A file that is no journal,
or whose pages are damaged, is refused, and nothing in it is changed.

* sweep.json      which sweep this is: its file's and its problem's data, and the versions that make its rows
* sweep.toml      the sweep's file as it was
* units.sqlite    every finished unit (`impactopt.sweeps.store`)
* solved/N/       a plan that others start from, where cases start from their neighbours
* cases/N/        the whole result of case N, as of `impactopt solve`, where trajectories are kept
* table.parquet   the rows of all finished cases; made from the journal at the end of every run
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.codegen.files import open_own
from impactopt.errors import InputError
from impactopt.files.output import make_directory, save_record, write_file
from impactopt.planning.solution import versions
from impactopt.sweeps.definition import Sweep
from impactopt.sweeps.design import Columns, Found

__all__ = ["Entry", "Journal", "Store"]

MAGIC = b"SQLite format 3\x00"  # what such a file begins with
APPLICATION = 0x696D7061  # SQLite's application_id of these files: "impa"
MEND = "put back a copy of it, or give another --out"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A finished unit."""

    unit: int
    peak_mb: float
    columns: Columns


class Journal:
    """An open journal; the file is made if it is not there.

    units : those that are finished.  damaged : rows that are not as they were written, and do not count.

    Raises
    ------
    InputError : the file is no journal, its pages are damaged, or it cannot be opened, read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damaged, self.units = path, 0, set[int]()
        try:
            with open(path, "rb", opener=_made) as file:  # no link, pipe or directory
                head = file.read(len(MAGIC))
            # SQLite takes a few bytes for an empty file; after a kill it may have its head to fix
            if head not in (b"", MAGIC) and not path.with_name(f"{path.name}-journal").exists():
                raise InputError(f"{path} is no journal of a sweep; move it away, or give another --out")
            self._file = sqlite3.connect(path, isolation_level=None)  # each statement is a transaction
        except (OSError, sqlite3.Error) as error:
            raise InputError(f"cannot open {path}: {getattr(error, 'strerror', None) or error}") from error
        try:
            self._claim()
            for unit, crc, content in self._rows():
                if isinstance(content, bytes) and zlib.crc32(content) == crc and _unit(content) == unit:
                    self.units.add(unit)
                else:
                    self.damaged += 1
        except BaseException as error:
            self._file.close()
            if isinstance(error, sqlite3.Error):
                raise InputError(f"cannot read {path}: {error}; {MEND}") from error
            raise

    def close(self) -> None:
        self._file.close()

    def add(self, entry: Entry) -> None:
        """Put a unit on disk; when this returns, it is there.

        Raises
        ------
        InputError : the disk is full, or fails; what was there before still is.
        """
        content = _pack(entry)
        row = (entry.unit, zlib.crc32(content), content)
        try:
            self._file.execute("INSERT OR REPLACE INTO units VALUES (?, ?, ?)", row)
        except sqlite3.Error as error:
            raise InputError(
                f"cannot write {self.path}: {error}; what was finished before is kept, and the same command "
                "goes on from there when the disk can be written and has room"
            ) from error
        self.units.add(entry.unit)

    def read(self) -> Iterator[Entry]:
        """All finished units in their order, one by one."""
        for unit, _, content in self._rows():
            if unit in self.units:
                yield _unpack(content)

    def _claim(self) -> None:
        """Make a new file a journal; refuse a file that is none."""
        (kind,) = self._file.execute("PRAGMA application_id").fetchone()
        (tables,) = self._file.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if kind != APPLICATION and (kind or tables):
            raise InputError(f"{self.path} is no journal of a sweep; move it away, or give another --out")
        # EXTRA: a commit is on disk when it returns, in the directory too
        self._file.execute("PRAGMA synchronous = EXTRA")
        if not tables:
            self._file.executescript(
                f"BEGIN IMMEDIATE; PRAGMA application_id = {APPLICATION};"
                "CREATE TABLE units (unit INTEGER PRIMARY KEY, crc INTEGER NOT NULL, content BLOB NOT NULL);"
                "COMMIT"
            )
        (found,) = self._file.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise InputError(f"{self.path} is damaged ({' '.join(found.split())}); {MEND}")

    def _rows(self) -> Iterator[tuple[Any, Any, Any]]:
        try:
            yield from self._file.execute("SELECT unit, crc, content FROM units ORDER BY unit")
        except sqlite3.Error as error:
            raise InputError(f"cannot read {self.path}: {error}; {MEND}") from error


def _made(path: str, flags: int) -> int:
    """A handle of the file, which is made if it is not there."""
    return open_own(path, flags | os.O_CREAT)


def _pack(entry: Entry) -> bytes:
    """A line of JSON, then the numbers of the arrays one after the other; lists stay in the line."""
    arrays = {name: np.ascontiguousarray(x) for name, x in entry.columns.items() if isinstance(x, np.ndarray)}
    line = {
        "unit": entry.unit,
        "peak_mb": entry.peak_mb,
        "lists": {name: list(x) for name, x in entry.columns.items() if name not in arrays},
        "arrays": {name: [x.dtype.str, len(x)] for name, x in arrays.items()},
        "order": list(entry.columns),
    }
    return b"".join([json.dumps(line).encode(), b"\n", *(x.tobytes() for x in arrays.values())])


def _unit(content: bytes) -> int | None:
    """The unit of a record's content; None where it is none that `_pack` writes, whatever its checksum."""
    try:
        return _unpack(content).unit
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _unpack(content: bytes) -> Entry:
    line, _, numbers = content.partition(b"\n")
    given: Mapping[str, Any] = json.loads(line)
    unit, peak = given["unit"], float(given["peak_mb"])
    columns: dict[str, Any] = dict(given["lists"])
    at = 0
    for name, (kind, count) in given["arrays"].items():
        dtype = np.dtype(str(kind))
        if dtype.kind not in "biuf" or not isinstance(count, int) or count < 0:
            raise ValueError(f"{name} is no column of numbers")
        x: NDArray[Any] = np.frombuffer(numbers, dtype=dtype, count=count, offset=at)
        columns[name], at = x, at + x.nbytes
    ordered = {str(name): columns[name] for name in given["order"]}
    lengths = {len(x) for x in ordered.values()}
    cells = (cell for x in ordered.values() if isinstance(x, list) for cell in x)
    if isinstance(unit, bool) or not isinstance(unit, int) or unit < 0 or at != len(numbers):
        raise ValueError("not a unit's number, or more numbers than columns")
    if len(ordered) != len(columns) or len(lengths) > 1 or any(isinstance(c, (list, dict)) for c in cells):
        raise ValueError("columns of different lengths, or of no numbers and texts")
    return Entry(unit=unit, peak_mb=peak, columns=ordered)


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
