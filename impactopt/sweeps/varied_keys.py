"""Varied keys of a sweep file, checked against its problem's file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from pydantic import ValidationError

from impactopt.errors import InputError
from impactopt.files.problem_file import ProblemFile
from impactopt.files.problem_file.diagnostics import Mistake, mistakes_of
from impactopt.files.problem_file.toml import Place
from impactopt.sweeps.design import Axis, Column, Span, column
from impactopt.sweeps.sections import SpanSection

__all__ = ["VariedKeys", "telling"]


class VariedKeys:
    """Reads the varied keys, and gathers what is wrong with them."""

    def __init__(
        self, base: ProblemFile, mistakes: list[Mistake], place: Callable[[Mapping[str, Any], str], Place]
    ) -> None:
        self._base, self._mistakes, self._place = base, mistakes, place
        self._seen: dict[Place, Place] = {}  # by the problem's key, where it is in the sweep's file

    def name(self, table: tuple[str, ...], key: str) -> str | None:
        """The full name of a key of the problem's; None if it has none such, or if it is there twice."""
        at = (*table, *key.split("."))
        try:
            place = self._place(self._base.data, key)
        except InputError as error:
            self._wrong(at, str(error))
            return None
        for other, there in self._seen.items():
            if place[: len(other)] == other or other[: len(place)] == place:
                self._wrong(at, f"is also given by {'.'.join(map(str, there))}")
                return None
        self._seen[place] = at
        return ".".join(map(str, place))

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the keys so far."""
        return tuple(".".join(map(str, place)) for place in self._seen)

    def full_name(self, key: str) -> str:
        """The full name of a key that varies; what is none, such as a column of results, as it is."""
        try:
            name = ".".join(map(str, self._place(self._base.data, key)))
        except InputError:
            return key
        return name if name in self.names else key

    def axis(self, table: str, key: str, what: Any) -> Axis | None:
        name, at = self.name((table,), key), (table, *key.split("."))
        if isinstance(what, Mapping):
            section = self._span(at, what)
            if section is None:
                return None
            if section.count is None:
                self._wrong(at, "how many? give count")
                return None
            values: Column = _span_of(section).spread(section.count)
        elif isinstance(what, Sequence) and not isinstance(what, str) and what:
            values = column(what)
        else:
            self._wrong(at, f"{what!r}; give a list of values, or {{from, to, count}}")
            return None
        return None if name is None else Axis(key=name, values=values)

    def drawn(self, key: str, what: Any) -> Span | Column | None:
        at = ("draw", "over", *key.split("."))
        if isinstance(what, Sequence) and not isinstance(what, str) and what:
            return column(what)
        if not isinstance(what, Mapping):
            self._wrong(at, f"{what!r}; give {{from, to}}, or a list of values to choose from")
            return None
        section = self._span(at, what)
        if section is not None and section.count is not None:
            self._wrong(at, "count is that of [draw]; leave it out here")
            return None
        return None if section is None else _span_of(section)

    def check_lengths(self, rows: Sequence[Axis]) -> None:
        for one, two in combinations(rows, 2):
            if len(one.values) != len(two.values):
                text = f"{len(two.values)} values, but {one.key} has {len(one.values)}; they go side by side"
                self._wrong(("list", *two.key.split(".")), text)
                return

    def check_values(
        self, grid: Sequence[Axis], rows: Sequence[Axis], over: Mapping[str, Span | Column]
    ) -> None:
        """Checks values by the problem's file; each value with the first ones of the other keys."""
        alone = {axis.key: telling(axis.values) for axis in grid}
        alone |= {
            k: [what.first, what.last] if isinstance(what, Span) else telling(what)
            for k, what in over.items()
        }
        first = {key: values[0] for key, values in alone.items()}
        first |= {axis.key: axis.values[0] for axis in rows}
        if not self._base_takes(first):
            # which of them it is shows alone, or else it is how they go together
            alone_accepted = [self._accepted({key: value}, key) for key, value in first.items()]
            if all(alone_accepted):
                self._accepted(first, next(iter(first)))
            return
        for key, values in alone.items():
            for value in values[1:]:
                if not self._accepted({**first, key: value}, key):
                    break
        for k in _telling_rows(rows):
            if not self._accepted({**first, **{axis.key: axis.values[k] for axis in rows}}, rows[0].key):
                break

    def _accepted(self, settings: Mapping[str, Any], key: str) -> bool:
        """True if the problem's file takes these values; if not, that is the mistake of one of the keys."""
        try:
            self._base.changed(settings)
        except InputError as error:
            reason = str(error).removeprefix(f"{self._base.path}, as set, ")
            places = {".".join(map(str, place)): at for place, at in self._seen.items()}
            self._wrong(places[key], f"with {key} = {settings[key]}: {reason}")
            return False
        return True

    def _base_takes(self, settings: Mapping[str, Any]) -> bool:
        try:
            self._base.changed(settings)
        except InputError:
            return False
        return True

    def _span(self, at: Place, what: Mapping[str, Any]) -> SpanSection | None:
        try:
            section = SpanSection.model_validate(what)
        except ValidationError as error:
            for mistake in mistakes_of(error, SpanSection):
                self._wrong((*at, *mistake.place), mistake.text)
            return None
        if section.scale == "log" and not (section.first > 0 and section.last > 0):
            self._wrong(at, f"from {section.first:g} to {section.last:g}: both must be > 0 for a log scale")
            return None
        return section

    def _wrong(self, at: Place, text: str) -> None:
        self._mistakes.append(Mistake(place=at, sections=2 if at[:2] == ("draw", "over") else 1, text=text))


def _span_of(section: SpanSection) -> Span:
    return Span(first=section.first, last=section.last, scale=section.scale)


def telling(values: Column) -> list[Any]:
    """Test values: of numbers the first, the least and the largest, as ranges are intervals; else all
    values.
    """
    if isinstance(values, np.ndarray):
        return [values[0].item(), values.min().item(), values.max().item()]
    return list(values)


def _telling_rows(rows: Sequence[Axis]) -> list[int]:
    """Rows of the list to test, as of `telling`."""
    if not all(isinstance(axis.values, np.ndarray) for axis in rows):
        return list(range(len(rows[0].values)))
    numbers = [np.asarray(axis.values) for axis in rows]
    return sorted({int(k) for x in numbers for k in (x.argmin(), x.argmax())})
