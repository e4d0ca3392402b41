"""TOML text from and to plain data: tables, lists, numbers, text."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.errors import has_control

_tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
TOMLError: type[ValueError] = _tomllib.TOMLDecodeError
_BARE = re.compile(r"[A-Za-z0-9_-]+")
LONGEST_TEXT = 1 << 22  # bytes: 400 times the longest of our files, and read in a few seconds
DEEPEST = 32  # nested tables and lists; our files have five levels
_COMMENT_COLUMN = 32  # of comments behind short lines

Place = tuple[str | int, ...]


def read_toml(text: str) -> dict[str, Any]:
    """The data of a TOML text.

    Raises
    ------
    TOMLError : it is no TOML, too long, nested too deeply, or has whole numbers beyond 64 bits.
    """
    if len(text) > LONGEST_TEXT:
        raise TOMLError(f"longer than {LONGEST_TEXT / 2**20:g} MiB")
    try:
        data = dict(_tomllib.loads(text))
    except TOMLError:
        raise
    except RecursionError:
        raise TOMLError(f"nested deeper than {DEEPEST}") from None
    except ValueError as error:  # Python's, for numbers with thousands of digits
        raise TOMLError(str(error)) from None
    check_plain(data)
    return data


def check_plain(data: Any) -> None:
    """TOMLError for data that are nested deeper than `DEEPEST`, or have whole numbers beyond 64 bits."""
    level: list[Any] = [data]
    for _ in range(DEEPEST + 1):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, Mapping):
                inner += value.values()
            elif isinstance(value, (list, tuple)):
                inner += value
            elif isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise TOMLError("a whole number has more than 64 bits; write it with a decimal point")
        if not inner:
            return
        level = inner
    raise TOMLError(f"nested deeper than {DEEPEST}")


def write_toml(
    data: Mapping[str, Any],
    comment: Callable[[Place], str] = lambda place: "",
    hidden: Callable[[Place], Mapping[str, Any]] = lambda place: {},
) -> str:
    """Data as TOML text, which `read_toml` reads back exactly; numbers have all digits.

    comment : comment on the key or the table at a place, "" for none; it is behind a key, above a table.
    hidden : additional keys of the table at a place, which are commented out.

    Raises
    ------
    TOMLError : the data have something else than tables, lists, numbers and text.
    """
    lines: list[str] = []
    _Writer(lines, comment, hidden).table(data, ())
    return "\n".join(lines).strip("\n") + "\n"


def plain_value(value: Any) -> Any:
    """A value in the types of TOML: NumPy's numbers and arrays, tuples and mappings become Python's own."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(item) for item in value]
    return value


def text_with_control(data: Any) -> str:
    """The first key or text with control characters, which a terminal would execute; "" if there is none."""
    if isinstance(data, str):
        return data if has_control(data) else ""
    if isinstance(data, Mapping):
        return next(filter(None, map(text_with_control, (*data, *data.values()))), "")
    if isinstance(data, (list, tuple)):
        return next(filter(None, map(text_with_control, data)), "")
    return ""


@dataclass(frozen=True)
class _Writer:
    """Writer of tables; arguments as of `write_toml`."""

    lines: list[str]
    comment: Callable[[Place], str]
    hidden: Callable[[Place], Mapping[str, Any]]

    def table(self, table: Mapping[str, Any], place: Place) -> None:
        below = {key: value for key, value in table.items() if _is_table(value) or _is_list_of_tables(value)}
        self._keys({key: value for key, value in table.items() if key not in below}, place)
        for key, value in below.items():
            inner = (*place, key)
            if isinstance(value, list):
                for i, entry in enumerate(value):
                    self._header(f"[[{_key_path(inner)}]]", self.comment(inner) if i == 0 else "")
                    self._keys(entry, (*inner, i))
                continue
            # a table that contains only tables has no header; its comment is above the first of them
            if not value or not all(_is_table(v) or _is_list_of_tables(v) for v in value.values()):
                self._header(f"[{_key_path(inner)}]", self.comment(inner))
            elif self.comment(inner):
                self.lines.extend(["", f"# {self.comment(inner)}"])
            self.table(value, inner)

    def _keys(self, table: Mapping[str, Any], place: Place) -> None:
        shown = [("", key, value) for key, value in table.items()]
        for mark, key, value in [*shown, *(("# ", *item) for item in self.hidden(place).items())]:
            line, comment = f"{mark}{_key(key)} = {_value(value)}", self.comment((*place, key))
            self.lines.append(f"{line:<{_COMMENT_COLUMN}} # {comment}" if comment else line)

    def _header(self, header: str, comment: str) -> None:
        comments = [f"# {comment}"] if comment else []
        # no empty line below the comment of a table of tables
        commented = self.lines[-2:-1] == [""] and self.lines[-1].startswith("# ")
        self.lines.extend([*([] if commented else [""]), *comments, header])


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def _key_path(place: Place) -> str:
    return ".".join(_key(str(part)) for part in place)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + "}"
    raise TOMLError(f"{value!r} is of type {type(value).__name__}, which TOML does not have")
