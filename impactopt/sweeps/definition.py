"""Sweep files: which problem, which of its keys vary, and what is done with each case."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from impactopt.errors import InputError
from impactopt.problem_file import ProblemFile, key_place, read_problem_file, read_toml
from impactopt.problem_file.mistakes import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.problem_file.names import problem_file
from impactopt.problem_file.section import Section, optional
from impactopt.problem_file.toml import Place, TOMLError
from impactopt.problem_file.values import Positive
from impactopt.sweeps.design import Axis, Column, Design, Draws, Span, column

__all__ = ["Sweep", "parse_sweep", "read_sweep_file", "sweep_from_data"]

Grain = Literal["solve", "strike", "collision"]
AtLeastOne = Annotated[int, Field(ge=1)]


class SweepSection(Section):
    problem: str
    name: str = ""
    grain: Grain = "solve"
    seed: Annotated[int, Field(ge=0)] = 0
    start: Literal["reach", "strike"] = "reach"
    starts: AtLeastOne = 1
    time_limit: Positive = optional("time_limit_s")
    trajectories: bool = False


class SpanSection(Section):
    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: AtLeastOne | None = optional()
    scale: Literal["linear", "log"] = "linear"


class DrawSection(Section):
    method: Literal["random", "sobol", "latin hypercube"] = "sobol"
    count: AtLeastOne
    over: dict[str, Any]


class File(Section):
    """A sweep file; keys below [set], [grid], [list] and [draw.over] are the problem file's."""

    sweep: SweepSection
    set: dict[str, Any] = Field(default_factory=dict)
    grid: dict[str, Any] = Field(default_factory=dict)
    list: dict[str, Any] = Field(default_factory=dict)
    draw: DrawSection = optional()


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """A sweep whose file is sound.

    path, text : where it was read, and what it said.  content : the same as tables.
    problem : the problem's file with the sweep's [set], which every case changes.
    grain : what a case is: "solve" (a whole motion), "strike" or "collision".
    design : the values of the cases.  name : for people.
    seed, start, starts : of a case's solves, as of :func:`impactopt.solve`.
    time_limit [s] : of a case; None for none.  trajectories : whether each case's result is kept whole.
    """

    path: Path
    text: str
    content: Mapping[str, Any] = field(repr=False)
    problem: ProblemFile = field(repr=False)
    design: Design = field(repr=False)
    name: str
    grain: Grain
    seed: int
    start: str
    starts: int
    time_limit: float | None
    trajectories: bool

    @property
    def hash(self) -> str:
        """Hexadecimal hash of the sweep's file and its problem's, by their data: comments do not count."""
        both = json.dumps([self.content, self.problem.data], sort_keys=True)
        # the values too: another SciPy might draw others
        return hashlib.sha256(both.encode() + self.design.content()).hexdigest()[:16]


def read_sweep_file(path: str | os.PathLike[str]) -> Sweep:
    """The sweep of a file.

    Raises
    ------
    InputError : the file cannot be read, or it is wrong; one message with all mistakes and their lines.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise InputError(f"cannot read {path}: {reason}") from error
    return parse_sweep(text, path)


def parse_sweep(text: str, path: Path) -> Sweep:
    """The sweep of a file's text; the problem's file is named relative to the folder of `path`."""
    try:
        data = read_toml(text)
    except TOMLError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return _checked(data, path, text)


def sweep_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str] = "sweep") -> Sweep:
    """The sweep that the data of a file describe; see `parse_sweep`."""
    return _checked(json.loads(json.dumps(data)), Path(where), "")


def _checked(data: dict[str, Any], path: Path, text: str) -> Sweep:
    lines, mistakes = key_lines(text), list[Mistake]()

    def raise_if_any() -> None:
        if mistakes:
            raise InputError(report_mistakes(str(path), lines, mistakes))

    try:
        content = File.model_validate(data)
    except ValidationError as error:
        mistakes += mistakes_of(error, File)
    raise_if_any()
    given = content.sweep
    base = read_problem_file(_near(given.problem, path)).changed(dict(_flat(content.set)))
    reader = _Reader(base, mistakes)
    grid = [a for key, what in _flat(content.grid) if (a := reader.axis("grid", key, what)) is not None]
    rows = [a for key, what in _flat(content.list) if (a := reader.axis("list", key, what)) is not None]
    reader.check_lengths(rows)
    over = {}
    for key, what in _flat(content.draw.over if content.draw else {}):
        name, drawn = reader.name(("draw", "over"), key), reader.drawn(key, what)
        if name is not None and drawn is not None:
            over[name] = drawn
    if content.draw and not over and not mistakes:
        mistakes.append(Mistake(place=("draw", "over"), sections=2, text="empty; name a key to draw"))
    raise_if_any()
    reader.check_values(grid, rows, over)
    raise_if_any()
    draws = None
    if content.draw:
        draws = Draws(method=content.draw.method, count=content.draw.count, seed=given.seed, over=over)
    return Sweep(
        path=path,
        text=text,
        content=data,
        problem=base,
        design=Design(grid=grid, rows=rows, draws=draws),
        name=given.name or path.stem,
        grain=given.grain,
        seed=given.seed,
        start=given.start,
        starts=given.starts,
        time_limit=given.time_limit,
        trajectories=given.trajectories,
    )


def _near(problem: str, path: Path) -> Path:
    """The problem's file: by name, or relative to the sweep's."""
    beside = path.parent / problem
    return beside if beside.is_file() else problem_file(problem)


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and what they hold; TOML's own dots make tables in tables."""
    for key, what in table.items():
        if isinstance(what, Mapping) and not what.keys() & {"from", "to"}:
            yield from _flat(what, f"{above}{key}.")
        else:
            yield f"{above}{key}", what


class _Reader:
    """Reads the varied keys, and gathers what is wrong with them."""

    def __init__(self, base: ProblemFile, mistakes: list[Mistake]) -> None:
        self._base, self._mistakes = base, mistakes
        self._seen: dict[Place, Place] = {}  # by the problem's key, where it is in the sweep's file

    def name(self, table: tuple[str, ...], key: str) -> str | None:
        """The full name of a key of the problem's; None if it has none such, or if it is there twice."""
        at = (*table, *key.split("."))
        try:
            place = key_place(self._base.data, key)
        except InputError as error:
            self._wrong(at, str(error))
            return None
        for other, there in self._seen.items():
            if place[: len(other)] == other or other[: len(place)] == place:
                self._wrong(at, f"is also given by {'.'.join(map(str, there))}")
                return None
        self._seen[place] = at
        return ".".join(map(str, place))

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
        """What the problem's file would refuse; each value with the first ones of the other keys."""
        alone = {axis.key: _telling(axis.values) for axis in grid}
        alone |= {
            k: [what.first, what.last] if isinstance(what, Span) else _telling(what)
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
        """Whether the problem's file takes these values; if not, that is the mistake of one of the keys."""
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


def _telling(values: Column) -> list[Any]:
    """Of numbers the first, the least and the largest, as ranges are intervals; all values of other kinds."""
    if isinstance(values, np.ndarray):
        return [values[0].item(), values.min().item(), values.max().item()]
    return list(values)


def _telling_rows(rows: Sequence[Axis]) -> list[int]:
    """Which rows of the list to look at, as of `_telling`."""
    if not all(isinstance(axis.values, np.ndarray) for axis in rows):
        return list(range(len(rows[0].values)))
    numbers = [np.asarray(axis.values) for axis in rows]
    return sorted({int(k) for x in numbers for k in (x.argmin(), x.argmax())})
