"""Sections of classes whose fields say what they are (`impactopt.contact.fields`): keys, ranges, comments."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, Field, PlainValidator, create_model

from impactopt.contact.fields import About, abouts
from impactopt.files.problem_file.section import Section, optional, required
from impactopt.files.problem_file.values import any_margin, per_joint, unit_vector

__all__ = ["one_of", "section_of", "sections_of"]


def section_of(kind: type, base: type[Section] = Section) -> Any:
    """The section that describes a dataclass: a key for each field that says what it is.

    What the section is about is the first sentence of the class's docstring.
    """
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {}
    for field, told in abouts(kind):
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        key = told.key_of(field.name)
        alias = None if key == field.name else key
        give = required if needed else optional
        keys[field.name] = (_value(hints[field.name], told), give(told.text, alias))
    made = create_model(kind.__name__, __base__=base, __doc__=kind.__doc__, **keys)
    made.kind = kind
    return made


def sections_of(name: str, doc: str, kinds: Mapping[str, type]) -> Any:
    """A section with one for each of these classes below it, all of which may be left out."""
    parts: dict[str, Any] = {key: (section_of(kind), optional("")) for key, kind in kinds.items()}
    return create_model(name, __base__=Section, __doc__=doc, **parts)


def one_of(words: Iterable[str]) -> Any:
    """Type annotation for one of these words."""
    return Literal[tuple(words)]


def _value(hint: Any, told: About) -> Any:
    """Type annotation of a field for pydantic: its own without None, with its range."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    kind = next(k for k in kinds if k is not type(None))
    if told.by_joint:
        return Annotated[Any, PlainValidator(per_joint)]
    if told.none:
        return Annotated[Any, PlainValidator(any_margin)]
    if told.choices:
        return one_of(told.choices)
    bounds = {"gt": told.above, "ge": told.least, "le": told.most}
    limits: dict[str, Any] = {name: bound for name, bound in bounds.items() if bound is not None}
    if get_args(kind) == (float, ...):
        return list[Annotated[float, Field(**limits)]]
    if get_origin(kind) is tuple:
        size = len(get_args(kind))
        numbers = Annotated[list[float], Field(min_length=size, max_length=size)]
        return Annotated[numbers, AfterValidator(unit_vector)] if told.direction else numbers
    if kind is float:
        return Annotated[float, Field(**limits, allow_inf_nan=True if told.endless else None)]
    return cast(Any, kind)
