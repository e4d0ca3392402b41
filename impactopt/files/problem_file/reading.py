"""Reading of problem files: from text to a problem, all mistakes in one message; other values by key paths.

A key may leave its unit out: `target.mass` is `target.mass_kg`. A part of a list is named by its index from 0
(`problem.point.1`), an entry of a list of tables by its index or its name.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import ValidationError

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.problem_file.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.files.problem_file.names import problem_file
from impactopt.files.problem_file.sections import File, SolverSettings, with_kinds
from impactopt.files.problem_file.toml import (
    LONGEST_TEXT,
    Place,
    TOMLError,
    check_plain,
    plain_value,
    read_toml,
    text_with_control,
    write_toml,
)
from impactopt.files.problem_file.values import Section
from impactopt.kinematics.stance import Stance
from impactopt.problem.checks import MANY, check_names
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.checks import check_legs
from impactopt.robots.robot import Robot
from impactopt.simulation.controller import ControllerSettings

__all__ = [
    "LONGEST_KEY",
    "ProblemFile",
    "SolverSettings",
    "change_data",
    "key_paths",
    "key_place",
    "load_problem",
    "parse_problem_file",
    "parse_settings",
    "problem_file_from_data",
    "problem_from_data",
    "read_problem_file",
]

LONGEST_KEY = 1000  # characters, dots included
_WORD = re.compile(r"[A-Za-z_][\w -]*")


def change_data(data: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a problem file's data with other values, which are not checked yet; the keys are.

    Parameters
    ----------
    data : of a problem file, a table in tables, as `impactopt.files.problem_file.read_toml` gives it.
    settings : values by key path, set one after the other. A key of [robot] where the file names a preset
        in [problem] makes a section [robot] of it.

    Raises
    ------
    InputError : one message for all keys that there are not, with what was meant.
    """
    return change_and_place(data, settings)[0]


def key_place(data: Mapping[str, Any], key: str) -> Place:
    """Place of a key path in a problem file's data, by the keys' full names and the entries' indices.

    Raises
    ------
    InputError : there is no such key.
    """
    try:
        return _find(with_kinds(File, data), data, key)
    except KeyError as error:
        raise InputError(str(error.args[0])) from None


def key_paths(data: Mapping[str, Any]) -> Iterator[str]:
    """Key paths that a file may have beside these data; entries of lists are those that it has."""
    yield from _paths(with_kinds(File, data), data, "")


def _paths(section: type[Section], value: Any, above: str) -> Iterator[str]:
    for name, info in section.model_fields.items():
        key, inner = info.alias or name, info.annotation
        held = value.get(key) if isinstance(value, Mapping) else None
        entries = [(f"{above}{key}", held)]
        if get_origin(inner) is list:
            (inner,) = get_args(inner)
            if isinstance(inner, type) and issubclass(inner, Section):
                rows = enumerate(held if isinstance(held, list) else ())
                named = ((row.get("name", k) if isinstance(row, Mapping) else k, row) for k, row in rows)
                entries = [(f"{above}{key}.{entry}", row) for entry, row in named]
        for path, there in entries:
            if isinstance(inner, type) and issubclass(inner, Section):
                yield from _paths(inner, there, f"{path}.")
            else:
                yield path


def parse_settings(texts: Iterable[str]) -> dict[str, Any]:
    """Settings as a command line has them: KEY=VALUE, the value as in TOML; a bare word is text.

    Raises
    ------
    InputError : one message for all that are no settings.
    """
    settings, wrong = {}, []
    for text in texts:
        key, equals, value = (part.strip() for part in text.partition("="))
        try:
            parsed = read_toml(f"value = {value}")
        except TOMLError:
            parsed = {"value": value} if _WORD.fullmatch(value) else {}
        if not (key and equals and parsed.keys() == {"value"}):
            wrong.append(
                f"{shortened(text)!r} is no setting; give KEY=VALUE with a value as in TOML, as target.mass=8"
            )
            continue
        settings[key] = parsed["value"]
    _raise(wrong)
    return settings


def change_and_place(
    data: Mapping[str, Any], settings: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[Place, ...]]:
    """`change_data`, and where the values are."""
    changed, places, wrong = copy.deepcopy(dict(data)), list[Place](), list[str]()
    for key, value in settings.items():
        if key.split(".")[0] == "robot" and "robot" not in changed:
            named = changed.get("problem", {})
            if isinstance(named, dict) and "robot" in named:
                changed["robot"] = {"preset": named.pop("robot")}
        try:
            place = _find(with_kinds(File, changed), changed, key)
        except KeyError as error:
            wrong.append(str(error.args[0]))
            continue
        node: Any = changed
        for part in place[:-1]:
            node = node.setdefault(part, {}) if isinstance(node, dict) else node[part]
        node[place[-1]] = plain_value(value)
        places.append(place)
    _raise(wrong)
    return changed, tuple(places)


def _raise(wrong: list[str]) -> None:
    if wrong:
        raise InputError(wrong[0] if len(wrong) == 1 else "\n  ".join([f"{len(wrong)} mistakes:", *wrong]))


def _find(model: type[Section], data: Mapping[str, Any], key: str) -> Place:
    """The place of a key path; KeyError with a message if there is none."""
    if len(key) > LONGEST_KEY:
        raise KeyError(f"{shortened(key)}: no key is so long")
    place: list[str | int] = []
    kind: Any = model  # what is described here
    value: Any = data  # what the file has of it
    for part in key.split("."):
        where = ".".join(map(str, place))
        if isinstance(kind, type) and issubclass(kind, Section):
            if not isinstance(value, Mapping):
                raise KeyError(f"{key}: {where} is no table in the file")
            name, kind = _field(kind, part, key, where)
            place.append(name)
            value = value.get(name)
            if value is None and isinstance(kind, type) and issubclass(kind, Section):
                value = {}
        elif get_origin(kind) is list or isinstance(value, list):
            index = _index(value, part, key, where)
            place.append(index)
            (kind, *_) = get_args(kind) or (None,)
            value = value[index]
        elif get_origin(kind) is dict or (kind is Any and (value is None or isinstance(value, Mapping))):
            place.append(part)
            (_, kind, *_) = get_args(kind) or (None, None)
            value = value.get(part) if isinstance(value, Mapping) else None
        else:
            raise KeyError(f"{key}: {where} has no parts; set {where} itself")
    return tuple(place)


def _field(section: type[Section], part: str, key: str, where: str) -> tuple[str, Any]:
    """The key of a section with or without its unit, and what it holds."""
    names = {info.alias or name: (name, info) for name, info in section.model_fields.items()}
    for known, (name, info) in names.items():
        if part in (known, name):
            return known, info.annotation
    near = did_you_mean(part, [*names, *section.model_fields])
    table = f"[{where}]" if where else "a problem file"
    raise KeyError(f"{key}: {table} has no key {part!r}{near or '; known are ' + ', '.join(names)}")


def _index(value: Any, part: str, key: str, where: str) -> int:
    if not isinstance(value, list):
        raise KeyError(f"{key}: {where} is not in the file; set {where} itself")
    names = [str(entry.get("name", "")) if isinstance(entry, Mapping) else "" for entry in value]
    if part.isdecimal() and int(part) < len(value):
        return int(part)
    if part in names:
        return names.index(part)
    known = ", ".join(filter(None, names))
    near = did_you_mean(part, filter(None, names))
    raise KeyError(
        f"{key}: {where} has no entry {part!r}{near}; give an index from 0 to {len(value) - 1}"
        f"{f', or one of {known}' if known else ''}"
    )


_T = TypeVar("_T")
# each entry is checked by itself, and most are part of the program: of thousands a file could say too much
_LISTS = (
    ("stances",),
    ("scenarios",),
    ("obstacles",),
    ("robot", "soles"),
    ("robot", "strikers"),
    ("robot", "tools"),
)

# what stands for required keys that are missing or wrong, while the others' names are looked up
_STAND_INS: Mapping[str, dict[str, Any]] = {
    "problem": {"striker": "-", "point_m": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]},
    "contact": {"stiffness_N_m": 1.0, "damping_N_s_m": 1.0},
    "target": {"mass_kg": 1.0},
    "swing": {"duration_s": 1.0},
    "follow": {"duration_s": 1.0},
}
_ROUNDS = 4  # of mending what was found and looking again


@dataclass(frozen=True, kw_only=True)
class ProblemFile:
    """A problem file whose text is sound.

    path, text : where it was read, and what it said, or says with its changes.  data : the same as tables.
    solver : its [solver] section.  controller : its [controller] section, or the defaults.
    """

    path: Path
    text: str
    data: Mapping[str, Any] = field(repr=False)
    solver: SolverSettings
    controller: ControllerSettings
    content: File = field(repr=False)
    lines: Mapping[Place, int] = field(repr=False, default_factory=dict)

    def changed(self, settings: Mapping[str, Any], *, names: bool = False) -> ProblemFile:
        """The file with other values, by key paths (`change_data`); names : as of `read_problem_file`.

        Raises
        ------
        InputError : unknown keys; values that are wrong, as in a file.
        """
        if not settings:
            return self
        try:
            data, places = change_and_place(self.data, settings)
            text = write_toml(data)
        except (InputError, TOMLError) as error:
            raise InputError(f"{self.path}: {error}") from error
        return _checked(data, self.path, text, {**self.lines, **dict.fromkeys(places, 0)}, names)

    def build(self) -> ImpactProblem:
        """The problem, with its robot.

        Raises
        ------
        InputError : what only shows with the robot: a URDF that is missing or not sound, an unknown joint or
            frame; then an unknown striker, posture and sole, all at once; then a point out of reach.
        """
        content, mistakes = self.content, _Collector(self.lines)
        robot, stance = _named(content, self.path.parent, mistakes)
        mistakes.raise_if_any(self.path)
        assert robot is not None and stance is not None
        given = content.arguments()
        try:
            return ImpactProblem(robot=robot, stance=stance, **given)
        except InputError as error:
            mistakes.add((), error)
            raise InputError(mistakes.report(self.path)) from error


def load_problem(path: str | os.PathLike[str]) -> ImpactProblem:
    """The problem that a TOML file describes: its path, or the name of one that comes with the package.

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    return read_problem_file(path).build()


def problem_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str]) -> ImpactProblem:
    """The problem that a problem file's data describes, as `read_toml` or `change_data` gives them.

    where : what messages call it; files that it names are relative to the folder of that path.

    Raises
    ------
    InputError : the data are wrong; one message with all mistakes.
    """
    return problem_file_from_data(data, where=where).build()


def problem_file_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str]) -> ProblemFile:
    """Data checked like the text of a problem file, with that text; see `problem_from_data`."""
    try:
        check_plain(data)
        data = plain_value(data)
        text = write_toml(data)
    except TOMLError as error:
        raise InputError(f"{where}: {error}") from error
    return _checked(data, Path(where), text, {})


def read_problem_file(
    path: str | os.PathLike[str], settings: Mapping[str, Any] | None = None, *, names: bool = False
) -> ProblemFile:
    """A problem file, by path or name, checked as far as that is possible without its robot.

    settings : values by key path, in place of the file's (`change_data`).
    names : build the robot of a file with mistakes, too, so that names of its parts that are wrong are among
        them.

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    path = problem_file(path)
    return parse_problem_file(_read(path), path, settings, names=names)


def parse_problem_file(
    text: str, path: Path, settings: Mapping[str, Any] | None = None, *, names: bool = False
) -> ProblemFile:
    """A problem file's text, checked like the file; `path` is where it was: the place of the files it names.

    Raises
    ------
    InputError : the text is wrong; one message with all mistakes and their lines.
    """
    try:
        data = read_toml(text)
    except TOMLError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return _checked(data, path, text, key_lines(text), names).changed(settings or {}, names=names)


def _checked(
    data: Mapping[str, Any], path: Path, text: str, lines: Mapping[Place, int], names: bool = False
) -> ProblemFile:
    for place in _LISTS:
        there: Any = data
        for key in place:
            there = there.get(key) if isinstance(there, Mapping) else None
        if isinstance(there, list) and len(there) > MANY:
            raise InputError(f"{path}: there are {len(there)} [[{'.'.join(place)}]]; give at most {MANY}")
    if found := text_with_control(data):
        raise InputError(f"{path}: the text {shortened(repr(found))} has control characters; take them out")
    mistakes, model = _robot_given_once(data), with_kinds(File, data)
    try:
        content = model.model_validate(data)
    except ValidationError as error:
        mistakes += mistakes_of(error, model)
        mistakes += _besides(data, mistakes, _Collector(lines), path.parent if names else None)
    if mistakes:
        raise InputError(report_mistakes(str(path), lines, mistakes))
    given = content.solver.model_dump(exclude_unset=True) if content.solver else {}
    options: dict[str, Any] = {}
    for solver in {"ipm", "sqp", "ipopt"} & given.keys():
        options[solver] = given.pop(solver)
    settings = SolverSettings(**given, options=options)
    controller = content.controller.build() if content.controller else ControllerSettings()
    return ProblemFile(
        path=path, text=text, data=data, content=content, solver=settings, controller=controller, lines=lines
    )


def _named(content: File, folder: Path, mistakes: _Collector) -> tuple[Robot | None, Stance | None]:
    """The robot and its stance; mistakes that only show with them: in it, and in names of its parts."""
    try:
        robot = content.make_robot(folder)
    except InputError as error:
        legs = content.leg_mistake(folder)
        if legs is not None:
            mistakes.add(("robot", "soles"), legs, first=True)
        for place, wrong in content.robot_mistakes(folder, error):
            mistakes.add(place, wrong)
        return None, None
    mistakes.attempt(("problem", "striker"), lambda: robot.striker(content.problem.striker))
    mistakes.attempt(("problem", "start"), lambda: content.make_start(robot))
    for k, phase in enumerate(content.stances or ()):
        for sole in phase.soles:
            mistakes.attempt(("stances", k, "soles"), partial(robot.sole, sole))
    stance = mistakes.attempt(("stance", "soles"), lambda: content.make_stance(robot))
    if stance is not None:
        try:
            check_legs(robot.model, [(sole.name, sole.frame) for sole in stance.soles(robot)])
        except InputError as error:
            mistakes.add(("robot", "soles"), error, first=True)
    if mistakes or stance is None:
        # the rest of the problem cannot be put together, but what its terms name can be looked at
        for name, term in content.given_terms():
            mistakes.attempt(("terms", name), partial(check_names, robot, term))
    return robot, stance


def _besides(
    data: Mapping[str, Any], mistakes: list[Mistake], found: _Collector, folder: Path | None
) -> list[Mistake]:
    """Further mistakes of a file, which show once the others are mended: checks of whole sections, and with a
    folder names of the robot's parts, where neither robot nor stance is wrong.

    For that, misspelt keys get their probable names, wrong ones are left out, and what is required and not
    there has a stand-in.
    """
    rest: Any = {"problem": {}, **copy.deepcopy(dict(data))}
    further: list[Mistake] = []
    for _ in range(_ROUNDS):
        for mistake in [*mistakes, *further]:
            table, (*above, key) = rest, mistake.place
            for part in above:
                inside = part in table if isinstance(table, dict) else part in range(len(table))
                table = table[part] if inside else {}
            if isinstance(table, dict) and key in table:
                value = table.pop(key)
                table |= {mistake.meant: value} if mistake.meant and mistake.meant not in table else {}
        places = {mistake.place for mistake in (*mistakes, *further)}
        for section, values in _STAND_INS.items():
            known = isinstance(rest.get(section), dict) and section in data
            needed = {k: v for k, v in values.items() if not known or (section, k) in places}
            rest[section] = needed | rest.get(section, {})
        model = with_kinds(File, rest)
        try:
            content = model.model_validate(rest)
        except ValidationError as error:
            found_now = mistakes_of(error, model)
            new = [m for m in found_now if m.text != "missing" and m.place not in places]
            if not new:
                return further
            further += new
            continue
        wrong = {m.place[: 1 + (m.place[0] == "problem")] for m in [*mistakes, *further]}
        if folder is not None and not wrong & {("robot",), ("stance",), ("problem", "robot")}:
            _named(content, folder, found)
            if rest["problem"]["striker"] == _STAND_INS["problem"]["striker"]:
                found.mistakes = [m for m in found.mistakes if m.place != ("problem", "striker")]
        break
    return further + found.mistakes


class _Collector:
    """Gathers the mistakes of several attempts."""

    def __init__(self, lines: Mapping[Place, int]) -> None:
        self._lines, self.mistakes = lines, list[Mistake]()

    def __bool__(self) -> bool:
        return bool(self.mistakes)

    def add(self, place: Place, error: InputError, *, first: bool = False) -> None:
        sections = max(1, len(place) - 1) if place[:1] != ("terms",) else len(place)
        self.mistakes += [
            Mistake(place=place, sections=sections, text=text, first=first) for text in error.mistakes
        ]

    def attempt(self, place: Place, make: Callable[[], _T]) -> _T | None:
        """Result of `make`; None, and a mistake at `place`, if it raises an InputError."""
        try:
            return make()
        except InputError as error:
            self.add(place, error)
            return None

    def report(self, path: Path) -> str:
        return report_mistakes(str(path), self._lines, self.mistakes)

    def raise_if_any(self, path: Path) -> None:
        if self.mistakes:
            raise InputError(self.report(path))


def _robot_given_once(data: Mapping[str, Any]) -> list[Mistake]:
    section = data.get("problem")
    named, table = isinstance(section, Mapping) and "robot" in section, "robot" in data
    if named != table:
        return []
    text = "given twice: keep this, or the section [robot]" if named else "missing; name a preset"
    return [Mistake(place=("problem", "robot"), sections=1, text=text)]


def _read(path: Path) -> str:
    try:
        return read_plain(path, LONGEST_TEXT).decode()
    except FileNotFoundError as error:
        folder = path.parent
        near = (
            did_you_mean(path.name, [p.name for p in folder.glob("*.toml")]) if os.path.isdir(folder) else ""
        )
        raise InputError(f"there is no file {shortened(str(path), 300)}{near}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8: {error.reason} at byte {error.start}") from error
    except OSError as error:
        raise InputError(f"cannot read {shortened(str(path), 300)}: {error.strerror}") from error
