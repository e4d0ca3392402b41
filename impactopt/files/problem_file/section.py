"""Base class of all sections of a problem file, and sections made from the fields of dataclasses."""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    create_model,
    model_validator,
)

from impactopt.contact.fields import About, abouts
from impactopt.files.problem_file.values import any_margin, per_joint, unit_vector

__all__ = ["Section", "attribute_docs", "one_of", "optional", "required", "section_of", "sections_of"]


def optional(about: str, key: str | None = None) -> Any:
    """A key that may be left out; the class that is built has the default.

    about : what it is, with its unit in brackets.  key : its name in the file, if a unit belongs to it.
    """
    return Field(default=None, alias=key, description=about)


def required(about: str, key: str | None = None) -> Any:
    """A key that has to be there; see `optional`."""
    return Field(alias=key, description=about)


def attribute_docs(kind: type) -> dict[str, str]:
    """Description of each attribute in the docstrings of a class and its bases, on one line; `a, b : text`
    describes both.
    """
    out: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        said = inspect.cleandoc(each.__doc__ or "")  # Python 3.13 takes the margin away, older ones keep it
        section = re.split(r"\nAttributes\n-+\n", said)[-1]
        entries = re.split(r"\n(?=[a-z_]+(?: \[\w+\])?(?:, [a-z_]+(?: \[\w+\])?)* : )", "\n" + section)
        for entry in entries[1:]:
            names, _, text = entry.partition(" : ")
            for name in names.split(","):
                out[name.split()[0]] = " ".join(text.split()).rstrip(".")
    return out


class Section(BaseModel):
    """A section; unknown keys, NaN, infinity and text where a number belongs are refused.

    Of a class below, the docstring's first sentence says in the reference what the section is about.
    kind : the class that it describes.  choice : the field that only says which kind of section this is.
    apart : fields that are sections of something else.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None
    choice: ClassVar[str] = ""
    apart: ClassVar[tuple[str, ...]] = ()

    def given(self) -> dict[str, Any]:
        """The keys that the file has, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True, exclude={self.choice, *self.apart})

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Default values of optional keys, by field; a field without a default is not in it."""
        if not is_dataclass(cls.kind):
            return {}
        made = {f.name: f.default_factory() for f in fields(cls.kind) if f.default_factory is not MISSING}
        return made | {f.name: f.default for f in fields(cls.kind) if f.default is not MISSING}

    @model_validator(mode="after")
    def _can_be_built(self) -> Section:
        if self.kind is not None:
            self.build()
        return self


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
