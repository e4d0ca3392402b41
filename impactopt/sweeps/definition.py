"""Sweep files: which problem, which of its keys vary, and what is done with each case."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, cycle, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import ValidationError

from impactopt.codegen.files import is_plain_file, read_plain
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.problem_file import ProblemFile, key_place, read_problem_file, read_toml, write_toml
from impactopt.files.problem_file.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.files.problem_file.names import problem_file, sweep_file
from impactopt.files.problem_file.toml import (
    LONGEST_TEXT,
    Place,
    TOMLError,
    check_plain,
    plain_value,
    text_with_control,
)
from impactopt.sweeps.collisions import Collisions, sweep_place
from impactopt.sweeps.design import Axis, Column, Design, Draws, Span, column
from impactopt.sweeps.sections import CaseKind, Figure, SpanSection, SweepFile, flat, of_other_kinds, put

__all__ = ["Sweep", "VariedKeys", "parse_sweep", "read_sweep_file", "sweep_from_data", "telling"]


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """A sweep whose file is sound.

    path, text : where it was read, and what it said.  content : the same as tables, but for [figure], which
        no row depends on.
    problem : the problem's file with the sweep's [set], which every case changes.
    case_kind : what a case is: "solve" (a whole motion), "strike" or "collision".
    design : the values of the cases.  name : for people.
    seed, start, starts : of a case's solves, as of :func:`impactopt.solve`.
    time_limit [s] : of a case; None for none.  trajectories : whether each case's result is kept whole.
    at_contact, outputs : of collisions, as of :func:`impactopt.collide_many`.
    figure : of the table, with full names of the keys; None for none.
    """

    path: Path
    text: str
    content: Mapping[str, Any] = field(repr=False)
    problem: ProblemFile = field(repr=False)
    design: Design = field(repr=False)
    name: str
    case_kind: CaseKind
    seed: int
    start: str
    starts: int
    time_limit: float | None
    trajectories: bool
    at_contact: Mapping[str, Any]
    outputs: tuple[str, ...]
    figure: Figure | None

    @property
    def hash(self) -> str:
        """Hexadecimal hash of the sweep's file and its problem's, by their data: comments do not count."""
        both = json.dumps([self.content, self.problem.data], sort_keys=True)
        # the values too: another SciPy might draw others
        return hashlib.sha256(both.encode() + self.design.content()).hexdigest()[:16]


def read_sweep_file(
    path: str | os.PathLike[str], settings: Mapping[str, Any] = MappingProxyType({})
) -> Sweep:
    """The sweep of a file, or by name one that comes with the package.

    settings : other values, by key paths of the sweep's file, such as "draw.count".

    Raises
    ------
    InputError : an unknown name; the file cannot be read, or is wrong; one message with all mistakes and
        their lines.
    """
    path = sweep_file(path)
    try:
        text = read_plain(path, LONGEST_TEXT).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise InputError(f"cannot read {shortened(str(path), 300)}: {reason}") from error
    return parse_sweep(text, path, settings)


def parse_sweep(text: str, path: Path, settings: Mapping[str, Any] = MappingProxyType({})) -> Sweep:
    """The sweep of a file's text, with settings as of `read_sweep_file`; the problem's file is named relative
    to the folder of `path`.
    """
    try:
        data = read_toml(text)
    except TOMLError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    for key, value in settings.items():
        put(data, key, value)
    return _checked(data, path, _written(data) if settings else text)


def sweep_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str] = "sweep") -> Sweep:
    """The sweep that the data of a file describe; see `parse_sweep`."""
    try:
        check_plain(data)
    except TOMLError as error:
        raise InputError(f"{where}: {error}") from error
    plain: dict[str, Any] = plain_value(data)
    return _checked(plain, Path(where), _written(plain))


def _written(data: Mapping[str, Any]) -> str:
    """Text of the file. Varied keys are written by key paths: their order counts, and TOML has tables
    last.
    """

    def with_flat(table: Any, *names: str) -> Any:
        if not isinstance(table, Mapping):  # a mistake, which is reported later
            return table
        tables = {name: table[name] for name in names if isinstance(table.get(name), Mapping)}
        return {**table, **{name: dict(flat(inner)) for name, inner in tables.items()}}

    out = with_flat(data, "grid", "list", "set")
    return write_toml({**out, "draw": with_flat(data["draw"], "over")} if "draw" in data else out)


def _checked(data: dict[str, Any], path: Path, text: str) -> Sweep:
    if found := text_with_control(data):
        raise InputError(f"{path}: the text {shortened(repr(found))} has control characters; take them out")
    lines, mistakes = key_lines(text), list[Mistake]()

    def raise_if_any() -> None:
        if mistakes:
            raise InputError(report_mistakes(str(path), lines, mistakes))

    try:
        content = SweepFile.model_validate(data)
    except ValidationError as error:
        mistakes += mistakes_of(error, SweepFile)
    raise_if_any()
    given = content.sweep
    mistakes += of_other_kinds(content)
    base = read_problem_file(_near(given.problem, path)).changed(dict(flat(content.set)))
    reader = VariedKeys(base, mistakes, sweep_place if given.case_kind == "collision" else key_place)
    grid = [a for key, what in flat(content.grid) if (a := reader.axis("grid", key, what)) is not None]
    rows = [a for key, what in flat(content.list) if (a := reader.axis("list", key, what)) is not None]
    reader.check_lengths(rows)
    over = {}
    for key, what in flat(content.draw.over if content.draw else {}):
        name, drawn = reader.name(("draw", "over"), key), reader.drawn(key, what)
        if name is not None and drawn is not None:
            over[name] = drawn
    if content.draw and not over and not mistakes:
        mistakes.append(Mistake(place=("draw", "over"), sections=2, text="empty; name a key to draw"))
    raise_if_any()
    draws = None
    if content.draw:
        draws = Draws(method=content.draw.method, count=content.draw.count, seed=given.seed, over=over)
    design = Design(grid=grid, rows=rows, draws=draws)
    if given.case_kind == "collision":
        _check_collisions(path, base, content, design)
    else:
        reader.check_values(grid, rows, over)
    if content.figure is not None and given.case_kind == "collision":
        known = [*reader.names, *given.outputs]
        for name in content.figure.renamed(reader.full_name).columns:
            if name not in known:
                text = f"{name!r} is neither varied nor among the outputs{did_you_mean(name, known)}"
                mistakes.append(Mistake(place=("figure",), sections=1, text=text))
    raise_if_any()
    return Sweep(
        path=path,
        text=text,
        content={name: dict(flat(table)) for name, table in data.items() if name != "figure"},
        problem=base,
        design=design,
        name=given.name or path.stem,
        case_kind=given.case_kind,
        seed=given.seed,
        start=given.start,
        starts=given.starts,
        time_limit=given.time_limit,
        trajectories=given.trajectories,
        at_contact=content.at_contact,
        outputs=given.outputs,
        figure=None if content.figure is None else content.figure.renamed(reader.full_name),
    )


def _check_collisions(path: Path, base: ProblemFile, content: SweepFile, design: Design) -> None:
    """InputError for what collisions of the first values, and of the bounds of numbers, refuse."""
    bounds = {axis.key: telling(axis.values) for axis in design.axes}
    longest = max(map(len, bounds.values()), default=1)
    columns = {key: column([*islice(cycle(values), longest)]) for key, values in bounds.items()}
    try:
        Collisions(
            base, content.at_contact, content.sweep.outputs, keys=[*columns], folder=path.parent
        ).check(columns)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _near(problem: str, path: Path) -> Path:
    """The problem's file: by name, or relative to the sweep's."""
    beside = path.parent / problem
    return beside if is_plain_file(beside) else problem_file(problem)
