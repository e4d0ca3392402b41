"""A directory of exported files: it appears whole, takes an older export's place, and nothing else's."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError

__all__ = ["META", "write_directory"]

META = "meta.json"
MADE_BY = "impactopt export"
LARGEST = 1 << 24  # bytes of a meta.json


def write_directory(
    directory: Path, to: str, meta: Mapping[str, Any], write: Callable[[Path], object]
) -> list[Path]:
    """Let `write` fill a new directory that then takes the place of `directory`; the files, `META` first.

    to : the format's name.

    Raises
    ------
    InputError : it is there, and is no earlier export of this format; it cannot be written. What was there
        is still there then, and nothing beside it.
    """
    _check_replaceable(directory, to)
    directory = Path(os.path.abspath(directory))
    new, old = (
        directory.with_name(f".{directory.name[:64]}.{secrets.token_hex(8)}.{x}") for x in ("new", "old")
    )
    above = [folder for folder in directory.parents if not folder.exists()]  # the nearest first
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        write(new)
        names = sorted(str(p.relative_to(new)) for p in new.rglob("*") if p.is_file())
        whole = {"made_by": MADE_BY, "to": to, "files": [META, *names], **meta}
        (new / META).write_text(f"{json.dumps(whole, indent=2, allow_nan=False)}\n", encoding="utf-8")
        if directory.exists():
            directory.rename(old)
        new.rename(directory)
    except BaseException as error:
        shutil.rmtree(new, ignore_errors=True)
        with contextlib.suppress(OSError):
            if old.exists() and not directory.exists():
                old.rename(directory)
            for folder in above:
                folder.rmdir()
        if not isinstance(error, OSError):
            raise
        raise InputError(f"cannot write {directory}: {error.strerror or error}; give another one") from error
    shutil.rmtree(old, ignore_errors=True)
    return [directory / name for name in whole["files"]]


def _check_replaceable(directory: Path, to: str) -> None:
    """InputError for what is no directory, or one with something else in it than an export of this format."""
    if not os.path.lexists(directory):
        return
    if directory.is_symlink() or not directory.is_dir():
        raise InputError(f"{directory} is there, and no directory; give another one with --out")
    try:
        there = sorted(str(p.relative_to(directory)) for p in directory.rglob("*") if not p.is_dir())
    except OSError as error:
        raise InputError(f"cannot read {directory}: {error.strerror}; give another one") from error
    if not there:
        return
    made = _made(directory / META)
    own = made.get("files") if made.get("made_by") == MADE_BY else None
    if not isinstance(own, list):
        raise InputError(f"{directory} holds something else ({there[0]}); give another directory with --out")
    if made.get("to") != to:
        raise InputError(
            f"{directory} holds an export to {made.get('to')}; give another directory with --out"
        )
    others = [name for name in there if name not in own]
    if others:
        raise InputError(f"{directory} holds {others[0]} too, which no export made; give another directory")


def _made(path: Path) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError, RecursionError):
        found = json.loads(read_plain(path, LARGEST))
        return found if isinstance(found, dict) else {}
    return {}
