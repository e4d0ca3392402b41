"""The page of all sections and keys, docs/problem_files.md, and problem files with a comment to each key."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import AfterValidator, BaseModel, PlainValidator
from pydantic.fields import FieldInfo

from impactopt.errors import MOST
from impactopt.files.named_problems import problem_file, problem_summary
from impactopt.files.problem_file.reading import read_problem_file
from impactopt.files.problem_file.sections import File, TermSections, about_section, comment_at, defaults_of
from impactopt.files.sections.collision import LAWS, TARGETS, with_kinds
from impactopt.files.sections.diagnostics import range_of, section_at, section_in
from impactopt.files.sections.values import Section
from impactopt.files.toml import Place, plain_value, write_toml


def problem_template(name: str) -> str:
    """The text of a named problem's file, with all keys of its sections.

    Keys that the problem does not set are commented out, with their defaults: without the # it is the same
    problem.

    Raises
    ------
    InputError : there is no problem of that name.
    """
    read = read_problem_file(problem_file(name))
    given = {"terms": {}, **read.data}
    data = {section: given[section] for section in File.model_fields if section in given}

    def hidden(place: Place) -> dict[str, Any]:
        section, sections = section_at(with_kinds(File, data), place)
        if sections != len(place) or not issubclass(section, Section):
            return {}
        table: Any = data
        for part in place:
            table = table[part]
        defaults = defaults_of(section)
        keys = {f: info.alias or f for f, info in section.model_fields.items() if f != section.choice}
        left = {f: key for f, key in keys.items() if key not in table and defaults.get(f) not in (None, ())}
        return {key: _short(f, plain_value(defaults[f])) for f, key in left.items() if _is_value(defaults[f])}

    head = (
        f"# {problem_summary(name)}.",
        f"# From `impactopt new {name}`; `impactopt check FILE` says what is wrong in a changed file.",
        "# A key that is commented out shows its default.",
    )
    text = write_toml(data, lambda place: comment_at(data, place), hidden)
    return "\n".join([*head, "", text.rstrip("\n"), "", *_left_out(data), ""])


def _short(field: str, value: Any) -> Any:
    """A value of a field, where a duration of equal ends is one number."""
    return value[0] if field == "duration" and value[0] == value[1] else value


def _is_value(value: Any) -> bool:
    return isinstance(value, (bool, int, float, str, tuple, list))


def _left_out(data: dict[str, Any]) -> list[str]:
    """Comment lines about the sections that a file does not have."""
    found = [(name, info) for name, info in File.model_fields.items() if name not in data]
    found += [
        (f"terms.{name}", info)
        for name, info in TermSections.model_fields.items()
        if name not in data["terms"]
    ]
    lines = ["# There may be more sections; `impactopt new --reference` says what is in them:"]
    for name, info in found:
        header = f"[[{name}]]" if get_origin(info.annotation) is list else f"[{name}]"
        if name != "robot":
            lines.append(f"#   {header}  {about_section(section_in(info.annotation))}")
    return lines


_INTRODUCTION = """\
# Problem files

A problem file has all arguments of `impactopt.ImpactProblem`, in [TOML](https://toml.io); nothing
in it is executed. Units are SI, and part of a key's name. Keys and sections that are left out keep their
defaults. In parentheses below: what is permitted, and the default.

```sh
impactopt new                                 # lists the problems that come with the package
impactopt new punch > my.toml                 # copies one, with all keys and comments
impactopt check my.toml                       # names all mistakes
impactopt solve my.toml --set target.mass=8   # changes a value; a key's unit may be left out
```

`--set` takes a key path and a value as in TOML. An entry of a list has its index from 0
(`--set problem.point.1=-0.2`), one of several sections its index or its name
(`--set scenarios.missing.abort_after=0.03`).

In Python `impactopt.load_problem("my.toml")` reads a file, and `impactopt.write_problem(problem)` gives the
text of one without defaults, unless the problem has functions or models made in Python.

This page is made by `impactopt new --reference`.
"""
_TYPES = {float: "number", int: "whole number", bool: "true or false", str: "text"}


def reference() -> str:
    """The page, in Markdown."""
    parts, listed = [_INTRODUCTION], dict[str, list[str]]()
    several: dict[str, Mapping[str, type[Section]]] = {"target": TARGETS, "contact": LAWS}
    for name, info in File.model_fields.items():
        kinds = several.get(name, {})
        for kind, section in kinds.items():
            (choice,) = (i.alias or n for n, i in section.model_fields.items() if n == section.choice)
            note = ". The default" if kind == section.model_fields[section.choice].default else ""
            parts.append(_part(f"[{name}] {choice} = {_show(kind)}", section, listed, note))
        below = _sections(name, info)
        if kinds:
            next(below)  # the section itself, whose keys are all listed by kind
        parts += [_part(header, section, listed) for header, section in below]
    return "\n".join(parts)


def _sections(place: str, info: FieldInfo) -> Iterator[tuple[str, type[BaseModel]]]:
    """A section and its subsections, with their headers."""
    section, form = section_in(info.annotation), get_origin(info.annotation)
    if section is None:
        return
    place = f"{place}.NAME" if form is dict else place
    yield (f"[[{place}]]" if form is list else f"[{place}]"), section
    for name, inner in section.model_fields.items():
        yield from _sections(f"{place}.{name}", inner)


def _part(header: str, section: type[BaseModel], listed: dict[str, list[str]], note: str = "") -> str:
    """Markdown of a section and its keys.

    listed : lines of the keys of the sections before, by header: several alike are named only.
    """
    lines, keys = [f"## `{header}`", "", f"{about_section(section)}{note}."], list(_keys(section))
    for other, known in listed.items():
        if len(alike := [key for key in keys if key in known]) >= 3:
            names = ", ".join(key.split()[1] for key in alike)
            keys = [f"- {names}: as in `{other}`", *(key for key in keys if key not in alike)]
            break
    listed[header] = keys
    return "\n".join([*lines, *(["", *keys] if keys else []), ""])


def _keys(section: type[BaseModel]) -> Iterator[str]:
    """A line for each key of the section itself."""
    defaults = defaults_of(section) if issubclass(section, Section) else {}
    for name, info in section.model_fields.items():
        if section_in(info.annotation) is not None or name == getattr(section, "choice", ""):
            continue  # a subsection, or in the header
        if info.is_required():
            default = "**needed**"
        else:
            value = defaults.get(name, info.default)
            default = "" if value is None or np.size(value) == 0 else f"`{_show(value)}`"
        values = "; ".join(part for part in (_allowed(info, bool(default)), default) if part)
        yield f"- `{info.alias or name}` ({values}): {info.description}"


def _allowed(info: FieldInfo, defaulted: bool = False) -> str:
    """Permitted values of a key; "" if they are all numbers, texts or truth values, as its default shows."""
    for check in reversed(info.metadata):
        if isinstance(check, (AfterValidator, PlainValidator)) and check.func.__doc__:
            return _sentence(check.func.__doc__)
    if get_origin(info.annotation) is Literal:
        return ", ".join(f"`{_show(choice)}`" for choice in get_args(info.annotation))
    if info.annotation in _TYPES:
        limits = range_of(info).removesuffix(f" and <= {MOST:g}")
        if defaulted and not info.is_required() and not limits:
            return ""
        limits = re.sub(r"^>= (\S+) and <= (\S+)$", r"\1 to \2", limits)
        return (
            limits if limits and info.annotation is float else f"{_TYPES[info.annotation]} {limits}".strip()
        )
    if get_origin(info.annotation) is dict:
        return "table by name" if str in get_args(info.annotation) else "table"
    length = next((m.min_length for m in info.metadata if hasattr(m, "min_length")), None)
    if length:
        return f"{length} numbers"
    entry = get_args(info.annotation)[0]
    kind, *_ = get_args(entry) or (entry,)  # type of the list's elements
    pairs = "pairs of " if get_origin(kind) is list else ""
    return f"list of {pairs}{'names' if kind is str or get_args(kind) == (str,) else 'numbers'}"


def _sentence(text: str) -> str:
    """First line of a validator's docstring, as a part of a sentence."""
    words = text.split("\n")[0].rstrip(".").removeprefix("A ").replace("number >", ">")
    return words[0].lower() + words[1:]


def _show(value: Any) -> str:
    value = plain_value(value)
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
