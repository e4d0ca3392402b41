"""Tables by key paths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

__all__ = ["flat", "put"]


def flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Key paths and what they hold; TOML's own dots make tables in tables."""
    for key, what in table.items():
        if isinstance(what, Mapping) and not what.keys() & {"from", "to"}:
            yield from flat(what, f"{above}{key}.")
        else:
            yield f"{above}{key}", what


def put(table: dict[str, Any], key: str, value: Any) -> None:
    """Write a value in place of what a key path holds, in tables that are made where there are none."""
    name, _, below = key.partition(".")
    if key in table or not below:  # a key of the table may have dots in quotes
        table[key] = value
        return
    inner = table.get(name)
    table[name] = dict(inner) if isinstance(inner, Mapping) else {}
    put(table[name], below, value)
