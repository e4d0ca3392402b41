"""Reading of files with sections: text to checked sections, all mistakes in one message; key paths.

The unit of a key may be left out: `target.mass` is `target.mass_kg`. An element of a list has its index from
0 (`problem.point.1`), an entry of a list of tables its index or its name.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_origin

from pydantic import ValidationError

from impactopt.codegen.files import read_plain
from impactopt.errors import MANY, InputError, did_you_mean, shortened
from impactopt.files.named_problems import problem_file
from impactopt.files.sections.collision import CollisionSections, with_kinds
from impactopt.files.sections.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes, section_in
from impactopt.files.sections.values import Section
from impactopt.files.toml import (
    LONGEST_TEXT,
    Place,
    TOMLError,
    check_plain,
    plain_value,
    read_toml,
    text_with_control,
    write_toml,
)

LONGEST_KEY = 1000  # characters, dots included
_WORD = re.compile(r"[A-Za-z_][\w -]*")
_T = TypeVar("_T")
_F = TypeVar("_F", bound="CollisionFile")


@dataclass(frozen=True, kw_only=True)
class CollisionFile:
    """A problem file whose sections for a collision have been checked.

    path, text : of the file; the text has its changed values.  data : the same as nested tables.
    content : its sections.  source : text in which messages count lines.  changes : places of values that
        were changed after it.
    """

    sections: ClassVar[type[CollisionSections]] = CollisionSections
    path: Path
    text: str
    data: Mapping[str, Any] = field(repr=False)
    content: CollisionSections = field(repr=False)
    source: str = field(repr=False, default="")
    changes: tuple[Place, ...] = field(repr=False, default=())

    @classmethod
    def read(cls: type[_F], path: str | os.PathLike[str], settings: Mapping[str, Any] | None = None) -> _F:
        """A file, by path or name, checked as far as possible without its robot.

        settings : values by key path that replace the file's (`change_and_place`).

        Raises
        ------
        InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
        """
        path = problem_file(path)
        return cls.parse(read_text(path), path, settings)

    @classmethod
    def parse(cls: type[_F], text: str, path: Path, settings: Mapping[str, Any] | None = None) -> _F:
        """A text, checked like a file at `path`, to whose folder paths in it are relative; as `read`."""
        try:
            data = read_toml(text)
        except TOMLError as error:
            raise InputError(f"{path} is not TOML: {error}") from error
        return cls._checked(data, path, text, text).changed(settings or {})

    @classmethod
    def from_data(cls: type[_F], data: Mapping[str, Any], path: Path) -> _F:
        """Data, checked like the text of a file at `path`, with that text; as `read`."""
        try:
            check_plain(data)
            data = plain_value(data)
            text = write_toml(data)
        except TOMLError as error:
            raise InputError(f"{path}: {error}") from error
        return cls._checked(data, path, text)

    def changed(self: _F, settings: Mapping[str, Any]) -> _F:
        """The file with changed values, by key paths (`change_and_place`).

        Raises
        ------
        InputError : unknown keys; wrong values.
        """
        if not settings:
            return self
        try:
            data, places = change_and_place(self.sections, self.data, settings)
            text = write_toml(data)
        except (InputError, TOMLError) as error:
            raise InputError(f"{self.path}: {error}") from error
        return self._checked(data, self.path, text, self.source, (*self.changes, *places))

    @classmethod
    def _checked(
        cls: type[_F],
        data: Mapping[str, Any],
        path: Path,
        text: str,
        source: str = "",
        changes: tuple[Place, ...] = (),
    ) -> _F:
        for place in _LISTS:
            entries: Any = data
            for key in place:
                entries = entries.get(key) if isinstance(entries, Mapping) else None
            if isinstance(entries, list) and len(entries) > MANY:
                raise InputError(
                    f"{path}: there are {len(entries)} [[{'.'.join(place)}]]; give at most {MANY}"
                )
        if wrong := text_with_control(data):
            found = shortened(repr(wrong))
            raise InputError(f"{path}: the text {found} has control characters; take them out")
        mistakes, model = _robot_given_once(data), with_kinds(cls.sections, data)
        try:
            content = model.model_validate(data)
        except ValidationError as error:
            mistakes += mistakes_of(error, model)
            mistakes += _further(cls, data, mistakes, path.parent)
        if mistakes:
            raise InputError(report_mistakes(str(path), _lines(source, changes), mistakes))
        return cls(path=path, text=text, data=data, content=content, source=source, changes=changes)

    @classmethod
    def wrong_names(cls, content: Any, folder: Path) -> list[Mistake]:
        """Mistakes in the names of the robot's parts, where a subclass looks for them."""
        return []

    def report(self, mistakes: Iterable[Mistake]) -> str:
        """One message for mistakes that are found later, with their lines."""
        return report_mistakes(str(self.path), _lines(self.source, self.changes), mistakes)


def _lines(source: str, changes: Iterable[Place]) -> dict[Place, int]:
    """Lines by key, of changed values 0."""
    return {**key_lines(source), **dict.fromkeys(changes, 0)}


# lists of sections whose length is limited: each entry is checked, and most are part of the program
_LISTS = (
    ("stances",),
    ("scenarios",),
    ("obstacles",),
    ("robot", "soles"),
    ("robot", "strikers"),
    ("robot", "tools"),
)

# substitutes for required keys that are missing or wrong, so that the others can be checked
_STAND_INS: Mapping[str, dict[str, Any]] = {
    "problem": {"striker": "-", "point_m": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]},
    "contact": {"stiffness_N_m": 1.0, "damping_N_s_m": 1.0},
    "target": {"mass_kg": 1.0},
    "swing": {"duration_s": 1.0},
    "follow": {"duration_s": 1.0},
}
_ROUNDS = 4  # of correcting the mistakes found and checking again


def _further(
    kind: type[CollisionFile], data: Mapping[str, Any], mistakes: list[Mistake], folder: Path
) -> list[Mistake]:
    """Further mistakes of a file, which are found once the others are corrected: in checks of whole sections
    and, by `wrong_names`, in names of the robot's parts, unless robot or stance is wrong.

    For that, misspelt keys get their probable names, wrong keys are left out, and required ones that are
    missing are substituted.
    """
    corrected: Any = {"problem": {}, **copy.deepcopy(dict(data))}
    further: list[Mistake] = []
    for _ in range(_ROUNDS):
        for mistake in [*mistakes, *further]:
            table, (*above, key) = corrected, mistake.place
            for part in above:
                inside = part in table if isinstance(table, dict) else part in range(len(table))
                table = table[part] if inside else {}
            if isinstance(table, dict) and key in table:
                value = table.pop(key)
                table |= {mistake.meant: value} if mistake.meant and mistake.meant not in table else {}
        places = {mistake.place for mistake in (*mistakes, *further)}
        for section, values in _STAND_INS.items():
            given = isinstance(corrected.get(section), dict) and section in data
            needed = {k: v for k, v in values.items() if not given or (section, k) in places}
            corrected[section] = needed | corrected.get(section, {})
        model = with_kinds(kind.sections, corrected)
        try:
            content = model.model_validate(corrected)
        except ValidationError as error:
            found_now = mistakes_of(error, model)
            new = [m for m in found_now if m.text != "missing" and m.place not in places]
            if not new:
                return further
            further += new
            continue
        wrong = {m.place[: 1 + (m.place[0] == "problem")] for m in [*mistakes, *further]}
        if not wrong & {("robot",), ("stance",), ("problem", "robot")}:
            known = corrected["problem"]["striker"] != _STAND_INS["problem"]["striker"]
            found = kind.wrong_names(content, folder)
            further += [m for m in found if known or m.place != ("problem", "striker")]
        break
    return further


class Collector:
    """Gathers the mistakes of several attempts."""

    def __init__(self) -> None:
        self.mistakes = list[Mistake]()

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


def _robot_given_once(data: Mapping[str, Any]) -> list[Mistake]:
    """Mistake of a file with both or neither of a preset in [problem] and a section [robot]."""
    section = data.get("problem")
    named, table = isinstance(section, Mapping) and "robot" in section, "robot" in data
    if named != table:
        return []
    text = "given twice: keep this, or the section [robot]" if named else "missing; name a preset"
    return [Mistake(place=("problem", "robot"), sections=1, text=text)]


def read_text(path: Path) -> str:
    """Text of a TOML file; InputError if there is none, or it cannot be read."""
    try:
        return read_plain(path, LONGEST_TEXT).decode("utf-8-sig")
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


# ---------------------------------------------------------------- key paths
def parse_settings(texts: Iterable[str]) -> dict[str, Any]:
    """Settings of a command line, KEY=VALUE, with values as in TOML; a bare word is text.

    Raises
    ------
    InputError : one message for all texts that are no settings.
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
    sections: type[CollisionSections], data: Mapping[str, Any], settings: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[Place, ...]]:
    """A copy of a file's data with changed values, and their places. Keys are checked, values are not.

    Parameters
    ----------
    sections : the file's model.
    data : nested tables, as of `read_toml`.
    settings : values by key path, set one after the other. If the file names a preset in [problem], a key of
        [robot] replaces that name by a section [robot].

    Raises
    ------
    InputError : one message for all unknown keys, with the probable intentions.
    """
    changed, places, wrong = copy.deepcopy(dict(data)), list[Place](), list[str]()
    for key, value in settings.items():
        if key.split(".")[0] == "robot" and "robot" not in changed:
            named = changed.get("problem", {})
            if isinstance(named, dict) and "robot" in named:
                changed["robot"] = {"preset": named.pop("robot")}
        try:
            place = find_key(with_kinds(sections, changed), changed, key)
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


def paths_in(section: type[Section], value: Any, above: str) -> Iterator[str]:
    """Key paths of a section with this value; above : the section's own path, with a dot."""
    for name, info in section.model_fields.items():
        key, inner, form = info.alias or name, section_in(info.annotation), get_origin(info.annotation)
        part = value.get(key) if isinstance(value, Mapping) else None
        if inner is None or form is dict:
            yield f"{above}{key}"
        elif form is list:
            for k, table in enumerate(part if isinstance(part, list) else ()):
                entry = table.get("name", k) if isinstance(table, Mapping) else k
                yield from paths_in(inner, table, f"{above}{key}.{entry}.")
        else:
            yield from paths_in(inner, part, f"{above}{key}.")


def find_key(model: type[Section], data: Mapping[str, Any], key: str) -> Place:
    """The place of a key path; KeyError with a message if there is none."""
    if len(key) > LONGEST_KEY:
        raise KeyError(f"{shortened(key)}: no key is so long")
    place: list[str | int] = []
    kind: Any = model  # model or type at this place
    value: Any = data  # value in the file at this place
    for part in key.split("."):
        where = ".".join(map(str, place))
        if isinstance(kind, type) and issubclass(kind, Section):
            if not isinstance(value, Mapping):
                raise KeyError(f"{key}: {where} is no table in the file")
            name, kind = _field(kind, part, key, where)
            if kind is object:  # of a plan, in a file read for a collision
                told = f"{where}.{name}" if place else f"[{name}]"
                raise KeyError(f"{key}: no collision depends on {told}; leave it out")
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
    """The full name of a section's key, which may be given without its unit, and its type."""
    names = {info.alias or name: (name, info) for name, info in section.model_fields.items()}
    for known, (name, info) in names.items():
        if part in (known, name) or known in (f"{part}_{unit}" for unit in ("s", "mm", "pct")):
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
