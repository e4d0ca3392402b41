"""Keeps the good result of a directory: a failed one goes beside it, never in its place."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError
from impactopt.files.output import (
    DERIVED,
    LARGEST,
    NUMBERS,
    SUMMARY,
    Record,
    load_record,
    plain,
    save_record,
    write_file,
)
from impactopt.solvers.program import Status

__all__ = ["keep_record", "keep_series", "set_aside"]

FAILED = "failed"  # in a result's directory: what would have taken a good result's place
SERIES = "blows.json"


def keep_record(record: Record, directory: Path) -> tuple[Path, Path]:
    """Saves a record (`save_record`); one that is not solved leaves a good one in the directory as it is.

    It is in the directory's own directory `failed` then, and its summary says so in `set_aside`. A good one
    takes the place of all that there was, a failed one that it makes up for included.

    Raises
    ------
    InputError : they cannot be written.
    """
    good = _good(record.summary.get("status"))
    place = _place(directory, good, _good(_status_in(directory)), record.summary)
    written = save_record(record, place)
    if good:
        _forget(directory / FAILED, NUMBERS, SUMMARY, *DERIVED)
    return written


def keep_series(done: dict[str, Any], directory: Path) -> Path:
    """The same of a series of blows, in `blows.json`: good is one whose nail is in.

    done : `Series.describe`.

    Raises
    ------
    InputError : it cannot be written.
    """
    place = _place(directory, done["done"], bool(_read(directory / SERIES).get("done")), done)
    text = f"{json.dumps(plain(done), indent=2)}\n".encode()
    place.mkdir(exist_ok=True)
    write_file(place / SERIES, lambda file: file.write(text))
    if done["done"]:
        _forget(directory / FAILED, SERIES)
    return place / SERIES


def set_aside(summary: Mapping[str, Any]) -> str:
    """Message about a result that has not replaced a good one; "" for others."""
    found = summary.get("set_aside")
    if found is None:
        return ""
    return (
        f"{found['kept']} holds a good result, which is left as it is; this one came to nothing, and is in "
        f"{found['directory']}"
    )


def _place(directory: Path, good: bool, held: bool, summary: dict[str, Any]) -> Path:
    """Directory for a result; `held`: there is a good one. Its summary notes if that is another directory."""
    if good or not held:
        return directory
    place = directory / FAILED
    summary["set_aside"] = {"directory": str(place), "kept": str(directory)}
    return place


def _good(status: Any) -> bool:
    """True if a record's status is that of a result to keep; a newer version's status is."""
    known = [s.value for s in Status if not s.usable]
    return isinstance(status, str) and status not in known


def _status_in(directory: Path) -> Any:
    with contextlib.suppress(InputError):
        return load_record(directory).summary.get("status")
    return _read(directory / SUMMARY).get("status")  # numbers of a newer version


def _read(path: Path) -> dict[str, Any]:
    """A file of ours; nothing where it is none."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        found = json.loads(read_plain(path, LARGEST))
        return found if isinstance(found, dict) else {}
    return {}


def _forget(directory: Path, *names: str) -> None:
    """Remove files of ours, and the directory if nothing else is in it."""
    with contextlib.suppress(OSError):
        for name in names:
            (directory / name).unlink(missing_ok=True)
        directory.rmdir()
