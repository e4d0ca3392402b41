"""Rows of a bench that takes hours, in a file as they come: a JSON object a line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from impactopt.codegen.files import open_own, write_atomically
from impactopt.errors import InputError
from impactopt.files.output import make_directory
from impactopt.files.record import plain


class Kept:
    """The rows in a file, and `found`: those that are there, by their values of `keys`.

    resume : go on with the rows that the file has; else it begins anew.

    Raises
    ------
    InputError : the file cannot be written or read, or has other lines.
    """

    def __init__(self, path: Path, keys: tuple[str, ...], *, resume: bool) -> None:
        self._path, self._keys = path, keys
        self.found: dict[tuple[Any, ...], dict[str, Any]] = {}
        make_directory(path.parent)
        try:
            if resume and path.exists():
                for line in path.read_text(encoding="utf-8").splitlines():
                    row = dict(json.loads(line))
                    self.found[tuple(row[key] for key in keys)] = row
            else:
                write_atomically(path, lambda _file: None)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} cannot be used for the rows: {error}") from error

    def add(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """The row as it is kept: plain numbers, and None for nan."""
        kept: dict[str, Any] = plain(row)
        line = json.dumps(kept, allow_nan=False)
        with open(self._path, "a", encoding="utf-8", opener=open_own) as file:
            file.write(line + "\n")
        self.found[tuple(kept[key] for key in self._keys)] = kept
        return kept
