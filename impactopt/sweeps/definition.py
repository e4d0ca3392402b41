"""Sweep files: the problem, the keys of it that vary, and the kind of case."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, cycle, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import ValidationError

from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.named_problems import problem_file, sweep_file
from impactopt.files.problem_file import ProblemFile, key_place, read_problem_file, read_toml, write_toml
from impactopt.files.record import NUMBERS
from impactopt.files.sections.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.files.sections.reading import read_text
from impactopt.files.toml import Place, TOMLError, check_plain, plain_value, text_with_control
from impactopt.problem.problem import ImpactProblem
from impactopt.sweeps.collisions import Collisions, sweep_place
from impactopt.sweeps.design import Axis, Column, Design, Draws, Span, column
from impactopt.sweeps.sections import (
    Figure,
    SpanSection,
    SweepFile,
    SweepSection,
    flat,
    of_other_kinds,
    put,
    unused_in_figure,
)
from impactopt.sweeps.table import PLAN_COLUMNS, PLAN_PREFIXES

_TRIED_CASES = 8  # at most, for a problem that can be built


class VariedKeys:
    """Reader of the varied keys, which adds what is wrong with them to a list of mistakes.

    base : the problem file whose keys vary.  place : place of a key path in the file's data.
    """

    def __init__(
        self, base: ProblemFile, mistakes: list[Mistake], place: Callable[[Mapping[str, Any], str], Place]
    ) -> None:
        self._base, self._mistakes, self._place = base, mistakes, place
        self._seen: dict[Place, Place] = {}  # place in the sweep file, by place in the problem file

    def name(self, table: tuple[str, ...], key: str) -> str | None:
        """Full name of a key of the problem file; None, and a mistake, if there is none or it varies
        twice.
        """
        at = (*table, *key.split("."))
        try:
            place = self._place(self._base.data, key)
        except InputError as error:
            self._wrong(at, str(error))
            return None
        for other, other_at in self._seen.items():
            # a key and a part of it, such as a point and one of its coordinates, exclude each other
            if place[: len(other)] == other or other[: len(place)] == place:
                self._wrong(at, f"is also given by {'.'.join(map(str, other_at))}")
                return None
        self._seen[place] = at
        return ".".join(map(str, place))

    def check_constants(self, section: str, given: Iterable[tuple[str, str]]) -> None:
        """Checks that no key with one value for all cases varies too.

        section : of the sweep file, "set" or "at_contact".  given : keys in it, each with its key path.
        """
        for key, path in given:
            try:
                place = self._place(self._base.data, path)
            except InputError:  # no key that could vary
                continue
            for varied, at in self._seen.items():
                # a part of a constant may vary, as a coordinate of a point
                if place[: len(varied)] == varied:
                    text = f"varies in {'.'.join(map(str, at))}; leave it out"
                    self._wrong((section, *key.split(".")), text)

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the keys read so far."""
        return tuple(".".join(map(str, place)) for place in self._seen)

    def full_name(self, key: str) -> str:
        """Full name of a varied key; another name, such as that of an output column, as it is."""
        try:
            name = ".".join(map(str, self._place(self._base.data, key)))
        except InputError:
            return key
        return name if name in self.names else key

    def axis(self, table: str, key: str, what: Any) -> Axis | None:
        """Axis of a key of [grid] or [list]; None, and a mistake, if it is wrong.

        what : the file's value, which should be a list or a table with from, to and count.
        """
        name, at = self.name((table,), key), (table, *key.split("."))
        if isinstance(what, Mapping):
            section = self._span(at, what)
            if section is None:
                return None
            if section.count is None:
                self._wrong(at, "how many? give count")
                return None
            if section.count == 1 and section.first != section.last:
                self._wrong(at, "count = 1 leaves out to; give a list of one value, or a larger count")
                return None
            values: Column = _span_of(section).spread(section.count)
        elif isinstance(what, Sequence) and not isinstance(what, str) and what:
            values = column(what)
        else:
            self._wrong(at, f"{what!r}; give a list of values, or {{from, to, count}}")
            return None
        return None if name is None else Axis(key=name, values=values)

    def drawn(self, key: str, what: Any) -> Span | Column | None:
        """Range or list of a key of [draw.over]; None, and a mistake, if it is wrong."""
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

    def check_lengths(self, listed: Sequence[Axis]) -> None:
        """Checks that all keys of [list] have as many values."""
        for one, two in combinations(listed, 2):
            if len(one.values) != len(two.values):
                text = f"{len(two.values)} values, but {one.key} has {len(one.values)}; give as many"
                self._wrong(("list", *two.key.split(".")), text)
                return

    def check_values(
        self, grid: Sequence[Axis], listed: Sequence[Axis], over: Mapping[str, Span | Column]
    ) -> None:
        """Checks values by the problem file: each value of a key with the first ones of the others."""
        tested = {axis.key: _test_values(axis.values) for axis in grid}
        tested |= {
            k: [what.first, what.last] if isinstance(what, Span) else _test_values(what)
            for k, what in over.items()
        }
        first = {key: values[0] for key, values in tested.items()}
        first |= {axis.key: axis.values[0] for axis in listed}
        if self._refusal(first) is not None:
            # either some values are refused alone, or their combination is
            accepted_alone = [self._accepted({key: value}, key) for key, value in first.items()]
            if all(accepted_alone):
                self._accepted(first, next(iter(first)))
            return
        for key, values in tested.items():
            for value in values[1:]:
                if not self._accepted({**first, key: value}, key):
                    break
        for k in _test_indices(listed):
            if not self._accepted({**first, **{axis.key: axis.values[k] for axis in listed}}, listed[0].key):
                break

    def _accepted(self, settings: Mapping[str, Any], key: str) -> bool:
        """True if the problem file accepts these values; if not, the mistake is added at the key."""
        refusal = self._refusal(settings)
        if refusal is not None:
            reason = refusal.removeprefix(f"{self._base.path}, as set, ")
            places = {".".join(map(str, place)): at for place, at in self._seen.items()}
            self._wrong(places[key], f"with {key} = {settings[key]}: {reason}")
        return refusal is None

    def _refusal(self, settings: Mapping[str, Any]) -> str | None:
        """Message of the problem file's error with these values; None if it accepts them."""
        try:
            self._base.changed(settings)
        except InputError as error:
            return str(error)
        return None

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


def _test_values(values: Column) -> list[Any]:
    """Values to test: the first, the smallest and the largest number, as allowed numbers are intervals; or
    all values that are not numbers.
    """
    if isinstance(values, np.ndarray):
        return [values[0].item(), values.min().item(), values.max().item()]
    return list(values)


def _test_indices(listed: Sequence[Axis]) -> list[int]:
    """Indices of the values of [list] to test, by the same rule as `_test_values`."""
    if not all(isinstance(axis.values, np.ndarray) for axis in listed):
        return list(range(len(listed[0].values)))
    numbers = [np.asarray(axis.values) for axis in listed]
    return sorted({int(k) for x in numbers for k in (x.argmin(), x.argmax())})


@dataclass(frozen=True, kw_only=True, eq=False)
class Sweep:
    """Checked contents of a sweep file.

    path, text : of the file.  content : its data but for [figure], which no result depends on.
    problem : the problem file with the sweep's [set]; every case changes it.
    design : the values of the cases.  settings : of all cases, the section [sweep].
    at_contact : of collisions, as of :func:`impactopt.collide_many`.
    figure : of the table, with full names of the keys; None: no figure.
    """

    path: Path
    text: str
    content: Mapping[str, Any] = field(repr=False)
    problem: ProblemFile = field(repr=False)
    design: Design = field(repr=False)
    settings: SweepSection
    at_contact: Mapping[str, Any]
    figure: Figure | None

    @property
    def name(self) -> str:
        """Name for reports."""
        return self.settings.name or self.path.stem

    @cached_property
    def built(self) -> ImpactProblem:
        """The problem without varied keys; if only these complete it, that of the first case that can be
        built, of a few from the whole design.

        Raises
        ------
        InputError : none can be built.
        """
        try:
            return self.problem.build()
        except InputError as error:
            # a sweep may have a million cases, of which each is tried for a second
            for k in np.unique(np.linspace(0, self.design.cases - 1, _TRIED_CASES).astype(int)).tolist():
                case = {key: values[0] for key, values in self.design.columns(k, k + 1).items()}
                with contextlib.suppress(InputError):
                    return self.problem.changed(case).build()
            raise error

    @cached_property
    def files(self) -> Mapping[str, str]:
        """Hashes of the robots' files and the saved results that cases read, by key and path."""
        data = {"robot": self.problem.data.get("robot", {}), "at_contact": self.at_contact}
        paths: dict[str, Column] = {key: [value] for key, value in flat(data)}
        paths |= {axis.key: axis.values for axis in self.design.axes}
        folders = dict.fromkeys(("robot.urdf", "robot.mjcf", "robot.srdf"), self.problem.path.parent)
        out = {}
        for key, folder in (folders | {"at_contact.result": self.path.parent}).items():
            for path in paths.get(key, ()):
                # a missing file is a case's mistake
                for place in filter(is_plain_file, (folder / path, folder / path / NUMBERS)):
                    out[f"{key} {path}"] = hashlib.sha256(place.read_bytes()).hexdigest()[:16]
        return out

    @property
    def hash(self) -> str:
        """Hexadecimal hash of the data of the sweep file and its problem file, without their comments, and of
        the files that they name.
        """
        # the built problem has what they do not name, such as the files of a preset, or of an MJCF's includes
        data = [self.content, self.problem.data, self.built.hash, self.files]
        # with all values, as another version of SciPy might draw other ones
        content = json.dumps(data, sort_keys=True).encode() + self.design.content()
        return hashlib.sha256(content).hexdigest()[:16]


def read_sweep_file(
    path: str | os.PathLike[str], settings: Mapping[str, Any] = MappingProxyType({})
) -> Sweep:
    """Sweep of a file, or of the package by name.

    settings : other values, by key paths of the sweep file, such as "draw.count".

    Raises
    ------
    InputError : an unknown name; the file cannot be read, or is wrong. One message has all mistakes, with
        their lines.
    """
    path = sweep_file(path)
    return parse_sweep(read_text(path), path, settings)


def parse_sweep(text: str, path: Path, settings: Mapping[str, Any] = MappingProxyType({})) -> Sweep:
    """Sweep of a file's text, with settings as of `read_sweep_file`. The problem file is relative to the
    folder of `path`.
    """
    try:
        data = read_toml(text)
    except TOMLError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    for key, value in settings.items():
        put(data, key, value)
    lines = key_lines(text) | {tuple(key.split(".")): 0 for key in settings}
    return _checked(data, path, _written(data) if settings else text, lines)


def sweep_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str] = "sweep") -> Sweep:
    """Sweep of a file's data; see `parse_sweep`."""
    try:
        check_plain(data)
        plain: dict[str, Any] = plain_value(data)
        text = _written(plain)
    except TOMLError as error:
        raise InputError(f"{where}: {error}") from error
    return _checked(plain, Path(where), text, {})


def _written(data: Mapping[str, Any]) -> str:
    """Text of a sweep file. Varied keys are written as key paths, as their order matters, and TOML writes
    tables last.
    """

    def with_flat(table: Any, *names: str) -> Any:
        if not isinstance(table, Mapping):  # a mistake, which is reported later
            return table
        tables = {name: table[name] for name in names if isinstance(table.get(name), Mapping)}
        return {**table, **{name: dict(flat(inner)) for name, inner in tables.items()}}

    out = with_flat(data, "grid", "list", "set")
    return write_toml({**out, "draw": with_flat(data["draw"], "over")} if "draw" in data else out)


def _checked(data: dict[str, Any], path: Path, text: str, lines: Mapping[Place, int]) -> Sweep:
    """Sweep of a file's data; InputError with all mistakes of one stage of the checks.

    lines : of the keys in the user's file; 0 for changed values.
    """
    if found := text_with_control(data):
        raise InputError(f"{path}: the text {shortened(repr(found))} has control characters; take them out")
    mistakes = list[Mistake]()

    # called after each stage: a later stage needs a file that has passed the earlier ones
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
    constants = dict(flat(content.set))
    mistakes += [
        Mistake(place=("set", *key.split(".")), sections=1, text="give it in the table [at_contact] instead")
        for key in constants
        if key.partition(".")[0] == "at_contact"
    ]
    raise_if_any()
    # every case is this problem with the values of its varied keys
    base = read_problem_file(_near(given.problem, path)).changed(constants)
    reader = VariedKeys(base, mistakes, sweep_place if given.case_kind == "collision" else key_place)
    grid = [a for key, what in flat(content.grid) if (a := reader.axis("grid", key, what)) is not None]
    listed = [a for key, what in flat(content.list) if (a := reader.axis("list", key, what)) is not None]
    reader.check_lengths(listed)
    over = {}
    for key, what in flat(content.draw.over if content.draw else {}):
        name, drawn = reader.name(("draw", "over"), key), reader.drawn(key, what)
        if name is not None and drawn is not None:
            over[name] = drawn
    reader.check_constants("set", ((key, key) for key in constants))
    reader.check_constants("at_contact", ((key, f"at_contact.{key}") for key, _ in flat(content.at_contact)))
    if content.draw and not over and not mistakes:
        mistakes.append(Mistake(place=("draw", "over"), sections=2, text="empty; name a key to draw"))
    raise_if_any()
    draws = None
    if content.draw:
        draws = Draws(method=content.draw.method, count=content.draw.count, seed=given.seed, over=over)
    design = Design(grid=grid, listed=listed, draws=draws)
    if given.case_kind == "collision":
        _check_collisions(path, base, content, design)
    else:
        reader.check_values(grid, listed, over)
    figure = None if content.figure is None else content.figure.renamed(reader.full_name)
    if figure is not None:
        mistakes += [*unused_in_figure(figure), *_cells_without_case(figure, design)]
        results, prefixes = given.outputs, tuple[str, ...]()
        if given.case_kind != "collision":
            names = (str(scenario["name"]) for scenario in base.data.get("scenarios", ()))
            scenarios = (f"{name.replace(' ', '_')}_" for name in names)
            results, prefixes = PLAN_COLUMNS, (*PLAN_PREFIXES, *scenarios)
        known = [*reader.names, *results]
        for name in figure.columns:
            if name not in known and not name.startswith(prefixes):
                text = f"{name!r} is neither varied nor among the outputs{did_you_mean(name, known)}"
                mistakes.append(Mistake(place=("figure",), sections=1, text=text))
    raise_if_any()
    return Sweep(
        path=path,
        text=text,
        content={name: dict(flat(table)) for name, table in data.items() if name != "figure"},
        problem=base,
        design=design,
        settings=given,
        at_contact=content.at_contact,
        figure=figure,
    )


def _check_collisions(path: Path, base: ProblemFile, content: SweepFile, design: Design) -> None:
    """Checks the test values of all keys by `Collisions.check`; InputError with the file's name."""
    tested = {axis.key: _test_values(axis.values) for axis in design.axes}
    longest = max(map(len, tested.values()), default=1)
    columns = {key: column([*islice(cycle(values), longest)]) for key, values in tested.items()}
    try:
        Collisions(
            base, content.at_contact, content.sweep.outputs, keys=[*columns], folder=path.parent
        ).check(columns)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _cells_without_case(figure: Figure, design: Design) -> list[Mistake]:
    """Mistake: a heatmap whose cells would have no case, or several."""
    values = {axis.key: axis.values for axis in design.axes}
    x, y = (values.get(name) for name in (figure.x, figure.y[0]))
    if figure.drawn_as != "heatmap" or not (isinstance(x, np.ndarray) and isinstance(y, np.ndarray)):
        return []  # a result's values are known after the sweep
    cells = len(np.unique(x)) * len(np.unique(y))
    if cells == design.cases:
        return []
    text = (
        f"{design.cases} cases for the heatmap's {cells} cells of {figure.x} and {figure.y[0]}; "
        "vary these two alone in [grid], or take a scatter"
    )
    return [Mistake(place=("figure", "kind"), sections=1, text=text)]


def _near(problem: str, path: Path) -> Path:
    """Problem file relative to the sweep file, or by name."""
    beside = path.parent / problem
    return beside if is_plain_file(beside) else problem_file(problem)
