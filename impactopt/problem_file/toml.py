"""TOML text from and to plain data: tables, lists, numbers, text."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

__all__ = ["TOMLError", "plain_value", "read_toml", "write_toml"]

_tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
TOMLError: type[ValueError] = _tomllib.TOMLDecodeError
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_COMMENTS_FROM = 32  # column, where lines are shorter

Place = tuple[str | int, ...]


def read_toml(text: str) -> dict[str, Any]:
    """The data of a TOML text; TOMLError if it is none."""
    return dict(_tomllib.loads(text))


def write_toml(data: Mapping[str, Any], comment: Callable[[Place], str] = lambda place: "") -> str:
    """Data as TOML that `read_toml` gives back exactly; numbers keep all their digits.

    comment : of a key or a table at a place, "" for none; a key's stands behind it, a table's above.
    """
    lines: list[str] = []
    _write_table(lines, dict(data), (), comment)
    return "\n".join(lines).strip("\n") + "\n"


def plain_value(value: Any) -> Any:
    """A value as TOML knows it: NumPy's numbers and arrays, tuples and mappings become Python's own."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(item) for item in value]
    return value


def _write_table(
    lines: list[str], table: Mapping[str, Any], place: Place, comment: Callable[[Place], str]
) -> None:
    tables = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    lists = {key: value for key, value in table.items() if _is_list_of_tables(value)}
    for key, value in table.items():
        if key not in tables and key not in lists:
            line, said = f"{_key(key)} = {_value(value)}", comment((*place, key))
            lines.append(f"{line:<{_COMMENTS_FROM}} # {said}" if said else line)
    for key, value in tables.items():
        inner = (*place, key)
        # a table of tables alone needs no line of its own
        if not value or not all(isinstance(v, Mapping) or _is_list_of_tables(v) for v in value.values()):
            _write_header(lines, f"[{_dotted(inner)}]", comment(inner))
        _write_table(lines, value, inner, comment)
    for key, value in lists.items():
        inner = (*place, key)
        for i, entry in enumerate(value):
            _write_header(lines, f"[[{_dotted(inner)}]]", comment(inner) if i == 0 else "")
            for name, item in entry.items():
                line, said = f"{_key(name)} = {_value(item)}", comment((*inner, i, name))
                lines.append(f"{line:<{_COMMENTS_FROM}} # {said}" if said else line)


def _write_header(lines: list[str], header: str, comment: str) -> None:
    lines += ["", *([f"# {comment}"] if comment else []), header]


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def _dotted(place: Place) -> str:
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
    raise TypeError(f"TOML has no {type(value).__name__}")
