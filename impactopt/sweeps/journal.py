"""The journal of a sweep: a file to which every finished unit is added, with a checksum, and nothing removed.

One writer adds a record and waits until it is on disk. Unlike a file a unit, a night's 100 000 solves are one
file, small units and large ones are kept alike, and a run that ends in the middle of a record leaves one torn
end, which the next run sees by length and checksum, and cuts off. What is damaged elsewhere costs its own
records only: each begins with the same mark.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.storage.files import open_own
from impactopt.sweeps.units import Columns

__all__ = ["Entry", "Journal"]

MARK = b"\nunit\x00\xff\n"
HEAD = struct.Struct("<QI")  # length and CRC-32 of what follows
MEMORY = 1 << 22  # bytes read at once where a mark is looked for


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A finished unit."""

    unit: int
    peak_mb: float
    columns: Columns


class Journal:
    """An open journal; the file is made if it is not there.

    torn : whether its end was cut off.  damaged : records elsewhere that are not as they were written.

    Raises
    ------
    InputError : the file cannot be opened, read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.torn, self.damaged = path, False, 0
        self._places: dict[int, int] = {}
        try:
            self._file = os.fdopen(open_own(path, os.O_RDWR | os.O_CREAT), "r+b", buffering=0)
            self._end = self._scan()
            if not self._places and not self._begins_as_ours():
                self._file.close()
                raise InputError(f"{path} is no journal of a sweep; move it away, or give another --out")
            self._file.truncate(self._end)
        except OSError as error:
            raise InputError(f"cannot open {path}: {error.strerror}") from error

    def close(self) -> None:
        self._file.close()

    @property
    def units(self) -> set[int]:
        """Those that are finished."""
        return set(self._places)

    def add(self, entry: Entry) -> None:
        """Put a unit on disk; when this returns, it is there.

        Raises
        ------
        InputError : the disk is full, or fails; what was there before still is.
        """
        content = _pack(entry)
        record = memoryview(MARK + HEAD.pack(len(content), zlib.crc32(content)) + content)
        try:
            self._file.seek(self._end)
            written = 0
            while written < len(record):
                written += self._file.write(record[written:]) or 0
            os.fsync(self._file.fileno())
        except OSError as error:
            self._file.truncate(self._end)
            raise InputError(
                f"cannot write {self.path}: {error.strerror}; what was finished before is kept, and the same "
                "command goes on from there when there is room again"
            ) from error
        self._places[entry.unit] = self._end
        self._end += len(record)

    def read(self) -> Iterator[Entry]:
        """All finished units in their order, one by one."""
        for unit in sorted(self._places):
            yield _unpack(self._record(self._places[unit]) or b"")

    def _begins_as_ours(self) -> bool:
        """Whether there is nothing, or the torn beginning of a record."""
        self._file.seek(0)
        return MARK.startswith(self._file.read(len(MARK)))

    def _scan(self) -> int:
        """Find the sound records; where the last one ends."""
        size, at, sound = os.fstat(self._file.fileno()).st_size, 0, 0
        lost = False
        while at < size:
            content = self._record(at)
            unit = None if content is None else _unit(content)
            if content is None or unit is None:
                lost, at = True, self._next_mark(at + 1, size)
                continue
            if lost:  # in the middle: records follow
                self.damaged, lost = self.damaged + 1, False
            self._places[unit] = at
            at += len(MARK) + HEAD.size + len(content)
            sound = at
        self.torn = sound < size
        return sound

    def _record(self, at: int) -> bytes | None:
        """The content of the record that begins here; None if there is none that is whole."""
        self._file.seek(at)
        head = self._file.read(len(MARK) + HEAD.size)
        if len(head) < len(MARK) + HEAD.size or not head.startswith(MARK):
            return None
        length, crc = HEAD.unpack(head[len(MARK) :])
        if length > os.fstat(self._file.fileno()).st_size - at:
            return None
        content = self._file.read(length)
        return content if len(content) == length and zlib.crc32(content) == crc else None

    def _next_mark(self, at: int, size: int) -> int:
        while at < size:
            self._file.seek(at)
            found = self._file.read(MEMORY).find(MARK)
            if found >= 0:
                return at + found
            at += MEMORY - len(MARK) + 1
        return size


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
