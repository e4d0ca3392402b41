"""Tables by dotted keys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

__all__ = ["flat"]


def flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and what they hold; TOML's own dots make tables in tables."""
    for key, what in table.items():
        if isinstance(what, Mapping) and not what.keys() & {"from", "to"}:
            yield from flat(what, f"{above}{key}.")
        else:
            yield f"{above}{key}", what
