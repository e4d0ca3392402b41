"""The journal of a sweep: an SQLite file with a row for every finished unit.

SQLite sees to kills and full disks: a row is there whole or not at all, and on disk when `add` returns. Rows
carry a checksum, so that a unit whose numbers the disk has changed is done again. A file that is no journal,
or whose pages are damaged, is refused, and nothing in it is changed.
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
from impactopt.sweeps.units import Columns

__all__ = ["Entry", "Journal"]

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
