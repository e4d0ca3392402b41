"""Diagnostics of a TOML file: place of a mistake, its probable intention, and permitted values."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from impactopt.errors import did_you_mean, shortened
from impactopt.files.toml import Place

# No two parts of these patterns match the same character, so that matching takes linear time.
_HEADER = re.compile(r"""^\s*(\[\[?)([\w."'\s-]+)\]\]?\s*(?:#.*)?$""")
_KEY = re.compile(r"""^\s*([\w."'-]+)\s*=""")

_KINDS = {
    "finite_number": "give a finite number",
    "float_type": "give a number",
    "int_type": "give a whole number",
    "int_from_float": "give a whole number",
    "string_type": "give text in quotes",
    "bool_type": "give true or false",
    "list_type": "give a list, [..., ...]",
    "dict_type": "give a table, {key = value, ...}",
    "model_type": "give a section of its own",
    "model_attributes_type": "give a section of its own",
}
_MAX_MISTAKES, _MAX_LENGTH = 100, 1000  # mistakes in a message, and characters of each
_SIGNS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """A mistake at a place in the file.

    place : path of keys and indices, whose first `sections` parts are the table.
    first : report it before the others, as it should be fixed first.
    meant : probable intention for a misspelt key, or "".
    """

    place: Place
    sections: int
    text: str
    first: bool = False
    meant: str = ""

    def __str__(self) -> str:
        table = ".".join(str(part) for part in self.place[: self.sections] if isinstance(part, str))
        key = ""
        for part in self.place[self.sections :]:
            key += f"[{part}]" if isinstance(part, int) else f"{'.' if key else ''}{part}"
        where = " ".join(filter(None, (f"[{table}]" if table else "", key)))
        return f"{where}: {self.text}" if where else self.text


def report_mistakes(where: str, lines: Mapping[Place, int], mistakes: Iterable[Mistake]) -> str:
    """One message for all mistakes, in the order of the file, with line numbers.

    where : name of the file or of another source.  lines : by key (`key_lines`); 0 for changed values.
    """
    found = []
    for mistake in mistakes:
        place = mistake.place
        # the line of the key, or of the nearest table above, for keys that are missing or inside a value
        line = next((lines[place[:k]] for k in range(len(place), 0, -1) if place[:k] in lines), None)
        if place and any(not number and key[: len(place)] == place for key, number in lines.items()):
            line = 0  # of a table with a changed value
        at = "" if line is None else f"line {line}, " if line else "as set, "
        found.append((not mistake.first, line is None, line or 0, f"{at}{mistake}"))
    texts = list(dict.fromkeys(shortened(text, _MAX_LENGTH) for *_, text in sorted(found)))
    if len(texts) == 1:
        return f"{where}, {texts[0]}" if texts[0].startswith(("line", "as set")) else f"{where}: {texts[0]}"
    more = len(texts) - _MAX_MISTAKES
    shown = texts[:_MAX_MISTAKES] + ([f"... and {more} more"] if more > 0 else [])
    return "\n".join([f"{where} has {len(texts)} mistakes:", *(f"  {text}" for text in shown)])


def mistakes_of(error: ValidationError, model: type[BaseModel]) -> list[Mistake]:
    """Mistakes of a pydantic error, for a file that `model` describes."""
    out, meant = [], set()
    for e in error.errors(include_url=False):
        if e["type"] == "extra_forbidden":
            section, sections = section_at(model, e["loc"][:-1])
            key, known = str(e["loc"][-1]), [_key(section, name) for name in section.model_fields]
            near = did_you_mean(key, known)
            name = next((name for name in known if near and repr(name) in near), "")
            meant.add((e["loc"][:-1], name))
            what = "section" if isinstance(e["input"], Mapping) else "key"
            text = f"unknown {what}{near or '; known are ' + ', '.join(known)}"
            out.append(Mistake(place=e["loc"], sections=sections, text=text, meant=name))
        elif e["type"] != "missing":
            out.append(_mistake(model, e))
    for e in error.errors(include_url=False):
        # a key whose misspelling is reported is not reported as missing, too
        if e["type"] == "missing" and (e["loc"][:-1], e["loc"][-1]) not in meant:
            _, sections = section_at(model, e["loc"])
            out.append(Mistake(place=e["loc"], sections=sections, text="missing"))
    return out


def _mistake(model: type[BaseModel], e: Mapping[str, Any]) -> Mistake:
    """Mistake of a wrong value, from an entry of a pydantic error."""
    section, sections = section_at(model, e["loc"])
    context, value = e.get("ctx", {}), _show(e["input"])
    if e["type"] == "value_error":
        text = str(context["error"])
    elif e["type"] in ("too_short", "too_long"):
        wanted = context.get("min_length", context.get("max_length"))
        text = f"has {context['actual_length']} values; give {wanted}"
    elif e["type"] in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        bound = " and ".join(f"{_SIGNS[key]} {bound:g}" for key, bound in context.items() if key in _SIGNS)
        text = f"{value}; give a number {_range(section, e['loc'][sections:]) or bound}"
    elif e["type"] == "literal_error":
        near = did_you_mean(str(e["input"]), re.findall(r"'([^']*)'", str(context["expected"])))
        text = f"{value} is unknown{near}; give {context['expected']}"
    else:
        text = f"{value}; {_KINDS.get(e['type'], e['msg'])}"
    return Mistake(place=e["loc"], sections=sections, text=text)


def section_in(annotation: Any) -> Any:
    """Model of a section in a type annotation, also of the entries of a list or a table; None for others."""
    kinds = (kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type))
    return next((kind for kind in kinds if issubclass(kind, BaseModel)), None)


def section_at(model: type[BaseModel], place: Place) -> tuple[type[BaseModel], int]:
    """Model of the innermost table that contains `place`, and how many of the place's parts name it."""
    depth = 0
    while depth < len(place):
        fields: dict[str | int, Any] = {_key(model, name): info for name, info in model.model_fields.items()}
        annotation = fields[place[depth]].annotation if place[depth] in fields else None
        inner = section_in(annotation)
        by_name = get_origin(annotation) is dict
        if inner is None or (by_name and depth + 1 == len(place)):
            break
        model, depth = inner, depth + 1
        if depth < len(place) and (isinstance(place[depth], int) or by_name):
            depth += 1
    return model, depth


def _key(model: type[BaseModel], name: str) -> str:
    return model.model_fields[name].alias or name


def _range(section: type[BaseModel], keys: Sequence[str | int]) -> str:
    """The allowed range of a number, "> 0 and <= 1"; "" if the model has none."""
    for name, info in section.model_fields.items():
        if len(keys) == 1 and _key(section, name) == keys[0]:
            return range_of(info)
    return ""


def range_of(info: FieldInfo) -> str:
    """The allowed range of a field's numbers, "> 0 and <= 1"; "" for any."""
    limits = [m for m in info.metadata if isinstance(m, (Gt, Ge, Lt, Le))]
    bounds = [(key, getattr(m, key)) for m in limits for key in _SIGNS if hasattr(m, key)]
    return " and ".join(f"{_SIGNS[key]} {bound:g}" for key, bound in bounds)


def _show(value: Any) -> str:
    text = repr(value) if not isinstance(value, Mapping) else "a table"
    return text if len(text) <= 40 else text[:37] + "..."


def key_lines(text: str) -> dict[Place, int]:
    """The line (from 1) of the sections and keys of a TOML text.

    It is found by patterns, as TOML parsers give no positions. Keys inside inline tables and multi-line
    values are not found.
    """
    lines: dict[Place, int] = {}
    table: Place = ()
    entries: Counter[Place] = Counter()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _split(header.group(2))
            if header.group(1) == "[[":
                lines.setdefault(table, number)
                entries[table] += 1
                table = (*table, entries[table] - 1)
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault((*table, *_split(key.group(1))), number)
    return lines


def _split(path: str) -> Place:
    return tuple(part.strip().strip("\"'") for part in path.split("."))
