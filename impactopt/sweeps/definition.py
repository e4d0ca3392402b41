"""Sweep files: which problem, which of its keys vary, and what is done with each case."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from impactopt.codegen.files import is_plain_file, read_plain
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.problem_file import ProblemFile, key_place, read_problem_file, read_toml, write_toml
from impactopt.files.problem_file.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.files.problem_file.names import problem_file, sweep_file
from impactopt.files.problem_file.toml import (
    LONGEST_TEXT,
    TOMLError,
    check_plain,
    plain_value,
    text_with_control,
)
from impactopt.sweeps.collision_keys import sweep_place
from impactopt.sweeps.collisions import Collisions
from impactopt.sweeps.design import Design, Draws, column
from impactopt.sweeps.figure import Figure
from impactopt.sweeps.key_paths import flat, put
from impactopt.sweeps.sections import CaseKind, SweepFile, of_other_kinds
from impactopt.sweeps.varied_keys import VariedKeys, telling

__all__ = ["Sweep", "parse_sweep", "read_sweep_file", "sweep_from_data"]


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
