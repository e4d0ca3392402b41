"""Changes of a problem file's data by key paths: `target.mass`, `scenarios.missing.capture_margin`.

A key may leave its unit out: `target.mass` is `target.mass_kg`. A part of a list is named by its index from 0
(`problem.point.1`), an entry of a list of tables by its index or its name.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_args, get_origin

from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.problem_file.section import Section
from impactopt.files.problem_file.sections import File, with_kinds
from impactopt.files.problem_file.toml import Place, TOMLError, plain_value, read_toml

__all__ = ["change_data", "key_paths", "key_place", "parse_settings"]

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
