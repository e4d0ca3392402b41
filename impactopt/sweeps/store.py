"""Directory of a sweep: its journal of finished units, and its lock. It belongs to one sweep, and one process
writes to it at a time.

SQLite handles kills and full disks: a record is there as a whole or not at all, and is on disk when
`Journal.add` returns. Records have a checksum: a unit whose record is damaged is evaluated again. A file that
is not a journal, or whose pages are damaged, is refused, and nothing in it is changed.

* sweep.json      data of the sweep file and the problem file, hashes of the files that they name, and the
                  versions that compute the results
* sweep.toml      the sweep file
* units.sqlite    every finished unit (`Journal`)
* solved/N/       plans that others start from, if cases start from their neighbours
* cases/N/        the full result of case N, as of `impactopt solve`, if trajectories are kept
* table.parquet   one row for each finished case; made from the journal at the end of every run
"""

from __future__ import annotations

import contextlib
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

from impactopt.codegen.files import UnsafePath, locked, open_own
from impactopt.errors import InputError
from impactopt.files.output import make_directory, save_record, write_file
from impactopt.planning.solution import versions
from impactopt.sweeps.definition import Sweep
from impactopt.sweeps.design import Columns, Found
from impactopt.sweeps.sections import flat

MAGIC = b"SQLite format 3\x00"  # first bytes of an SQLite file
APPLICATION = 0x696D7061  # SQLite's application_id of these files: "impa"
FIX = "put back a copy of it, or give another --out"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A finished unit."""

    unit: int
    peak_mb: float
    columns: Columns


class Journal:
    """Journal of finished units, open; the file is made if there is none.

    units : numbers of the finished units.  damaged : number of records that fail their checksum, which do not
    count.

    Raises
    ------
    InputError : the file is not a journal, its pages are damaged, or it cannot be opened, read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damaged, self.units = path, 0, set[int]()
        try:
            # as a plain file, not through a link, and made if it does not exist
            with open(path, "rb", opener=lambda name, flags: open_own(name, flags | os.O_CREAT)) as file:
                head = file.read(len(MAGIC))
            # SQLite would overwrite a short file of another kind. After a kill it may have to repair the
            # first bytes from its own journal.
            if head not in (b"", MAGIC) and not path.with_name(f"{path.name}-journal").exists():
                raise InputError(f"{path} is no journal of a sweep; move it away, or give another --out")
            self._file = sqlite3.connect(path, isolation_level=None)  # each statement is a transaction
        except (OSError, sqlite3.Error) as error:
            raise InputError(f"cannot open {path}: {getattr(error, 'strerror', None) or error}") from error
        try:
            self._claim()
            for unit, crc, content in self._records():
                if isinstance(content, bytes) and zlib.crc32(content) == crc:
                    self.units.add(unit)
                else:
                    self.damaged += 1
        except BaseException as error:
            self._file.close()
            if isinstance(error, sqlite3.Error):
                raise InputError(f"cannot read {path}: {error}; {FIX}") from error
            raise

    def close(self) -> None:
        self._file.close()

    def add(self, entry: Entry) -> None:
        """Write a unit; it is on disk when this returns.

        Raises
        ------
        InputError : the disk is full, or fails; earlier units stay.
        """
        content = _pack(entry)
        record = (entry.unit, zlib.crc32(content), content)
        try:
            self._file.execute("INSERT OR REPLACE INTO units VALUES (?, ?, ?)", record)
        except sqlite3.Error as error:
            raise InputError(
                f"cannot write {self.path}: {error}; finished cases are kept, and the same command resumes "
                "the sweep when the disk can be written and has room"
            ) from error
        self.units.add(entry.unit)

    def read(self) -> Iterator[Entry]:
        """All finished units in their order, one by one."""
        for unit, _, content in self._records():
            if unit in self.units:
                yield _unpack(content)

    def _claim(self) -> None:
        """Make a new file a journal; InputError for a file of another kind."""
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
            raise InputError(f"{self.path} is damaged ({' '.join(found.split())}); {FIX}")

    def _records(self) -> Iterator[tuple[Any, Any, Any]]:
        try:
            yield from self._file.execute("SELECT unit, crc, content FROM units ORDER BY unit")
        except sqlite3.Error as error:
            raise InputError(f"cannot read {self.path}: {error}; {FIX}") from error


def _pack(entry: Entry) -> bytes:
    """Record of a unit: a line of JSON with its lists, then the bytes of its arrays, one after the other."""
    arrays = {name: np.ascontiguousarray(x) for name, x in entry.columns.items() if isinstance(x, np.ndarray)}
    line = {
        "unit": entry.unit,
        "peak_mb": entry.peak_mb,
        "lists": {name: list(x) for name, x in entry.columns.items() if name not in arrays},
        "arrays": {name: [x.dtype.str, len(x)] for name, x in arrays.items()},
        "order": list(entry.columns),
    }
    return b"".join([json.dumps(line).encode(), b"\n", *(x.tobytes() for x in arrays.values())])


def _unpack(content: bytes) -> Entry:
    """Unit of a record that `_pack` has written, as its checksum tells."""
    line, _, numbers = content.partition(b"\n")
    given: Mapping[str, Any] = json.loads(line)
    columns, at = dict[str, Any](given["lists"]), 0
    for name, (kind, count) in given["arrays"].items():
        x: NDArray[Any] = np.frombuffer(numbers, dtype=kind, count=count, offset=at)
        columns[name], at = x, at + x.nbytes
    ordered = {name: columns[name] for name in given["order"]}
    return Entry(unit=given["unit"], peak_mb=given["peak_mb"], columns=ordered)


FORMAT = 3  # of sweep.json and the journal
UNITS, UNITS_OLD = "units.sqlite", "units.journal"  # names of the journal: now, and in format 1
MAX_NAMED = 5  # changes in a message


class Store:
    """Directory of a sweep, locked for this process until `close`.

    journal : of the finished units.  hash : of the sweep.

    Raises
    ------
    InputError : another process has locked it; it holds another sweep, or results of other versions; it
        cannot be written.
    """

    def __init__(self, sweep: Sweep, out: Path) -> None:
        self.path = make_directory(out)

        def refuse() -> None:
            raise InputError(f"another process is working on {self.path}; wait for it, or give another --out")

        with contextlib.ExitStack() as held:
            try:
                held.enter_context(locked(self.path / ".lock", on_wait=refuse))
            except UnsafePath as error:
                raise InputError(f"{error}; remove it, or give another --out") from error
            self.hash = sweep.hash
            self._claim(sweep)
            self.journal = Journal(self.path / UNITS)
            self._lock = held.pop_all()

    @property
    def table(self) -> Path:
        return self.path / "table.parquet"

    @property
    def solved(self) -> Path:
        return self.path / "solved"

    def keep(self, unit: int, found: Found) -> None:
        """Write a unit's result: full results first, so that every unit in the journal has them."""
        for case, record in found.records.items():
            save_record(record, self.path / "cases" / f"{case:06d}")
        self.journal.add(Entry(unit=unit, peak_mb=found.peak_mb, columns=found.columns))

    def close(self) -> None:
        self.journal.close()
        self._lock.close()

    def _claim(self, sweep: Sweep) -> None:
        """Write sweep.json in a new directory; InputError if it is there and of another sweep or version."""
        place = self.path / "sweep.json"
        now: dict[str, Any] = {
            "format": FORMAT,
            "hash": self.hash,
            "versions": versions(),
            "sweep": sweep.content,
            "problem": sweep.problem.data,
            "files": sweep.files,
        }
        try:
            before = json.loads(place.read_text(encoding="utf-8"))
        except FileNotFoundError:
            if any((self.path / name).exists() for name in (UNITS, UNITS_OLD)):
                raise InputError(
                    f"{self.path} holds rows of a sweep, but {place.name}, which identifies it, is missing; "
                    "put it back, or give another directory"
                ) from None
            own = (self.table, self.solved, self.path / "cases", self.path / "figure.png")
            other, toml = next((path for path in own if path.exists()), None), self.path / "sweep.toml"
            if other is None and toml.exists() and toml.read_bytes() != sweep.text.encode():
                other = toml
            if other is not None:
                raise InputError(
                    f"{other} is of no sweep that is known here, and would be replaced; give another --out"
                ) from None
            write_file(toml, lambda file: file.write(sweep.text.encode()))
            write_file(place, lambda file: file.write(json.dumps(now, indent=1).encode()))
            return
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{place} cannot be read ({error}); give another directory") from error
        if not isinstance(before, dict) or before.get("format") != FORMAT:
            raise InputError(
                f"{self.path} keeps its finished cases as another version of impactopt does; end this "
                "sweep with the version that began it, or give another --out (its table.parquet can be read "
                "as before)"
            )
        if before.get("hash") != now["hash"]:
            raise InputError(
                f"{self.path} holds another sweep{_changes(before, now)}; give another --out, or change the "
                "sweep back to resume it"
            )
        if before.get("versions") != now["versions"]:
            known = before["versions"] if isinstance(before.get("versions"), dict) else {}
            names = [n for n in {**known, **now["versions"]} if known.get(n) != now["versions"].get(n)]
            old, new = (", ".join(f"{n} {of.get(n)}" for n in names) for of in (known, now["versions"]))
            raise InputError(
                f"the rows in {self.path} were computed with {old}, and this is {new}; rows of both would "
                "mix: install the same again, or give another --out"
            )


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Message with the settings that differ between two sweep.json, or that only one of them has."""
    old, new = (
        {
            **dict(flat(data.get("sweep", {}))),
            **dict(flat(data.get("problem", {}), "problem file: ")),
            **dict(flat(data.get("files", {}), "content of ")),
        }
        for data in (before, now)
    )
    none = "not given"
    changed = [
        f"{key} was {old.get(key, none)}, is {new.get(key, none)}"
        for key in {**old, **new}
        if old.get(key, none) != new.get(key, none)
    ]
    if not changed:
        return ""
    more = f", and {len(changed) - MAX_NAMED} more" if len(changed) > MAX_NAMED else ""
    return ": " + "; ".join(changed[:MAX_NAMED]) + more
