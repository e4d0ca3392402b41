"""Base class of sections of files, types of their values, and sections made from dataclasses.

Validators raise ValueError, which pydantic collects, with the value and the fix in the message. Their
docstrings are the descriptions of the values in the reference.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
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
from impactopt.errors import check_choice
from impactopt.robots.presets import robot_names


def _known_robot(name: str) -> str:
    """A preset's name."""
    check_choice("there is no robot", name, robot_names())
    return name


def _duration(value: Any) -> list[float]:
    """A number > 0, or [shortest, longest]."""
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(_is_number(x) and 0 < x < np.inf for x in pair):
        raise ValueError(f"{value}; give a number > 0 [s], or [shortest, longest]")
    return _ascending([float(x) for x in pair])


def _contact_duration(value: Any) -> list[float]:
    """A number > 0, or [shortest, longest], of which the shortest may be 0."""
    if isinstance(value, list) and len(value) == 2 and _is_number(value[0]) and value[0] == 0:
        return [0.0, _duration([value[1], value[1]])[1]]
    return _duration(value)


def _factor(value: Any) -> Any:
    """A number > 0, or [least, largest]."""
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(_is_number(x) and 0 < x < np.inf for x in pair):
        raise ValueError(f"{value}; give a number > 0, or [least, largest] for the plan to choose")
    if pair is value and not pair[0] < pair[1]:
        raise ValueError(f"{value}; the first of two has to be less than the second")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _fractions(value: list[float]) -> list[float]:
    """Numbers > 0 that sum to 1."""
    if abs(sum(value) - 1) > 1e-9:
        raise ValueError(f"{value} sum to {sum(value):g}; give fractions that sum to 1")
    return value


def _ascending(value: list[float]) -> list[float]:
    """[lower, upper]."""
    if not value[0] <= value[1]:
        raise ValueError(f"{value}; the first must not exceed the second")
    return value


def unit_vector(value: list[float]) -> list[float]:
    """A unit vector."""
    length = float(np.linalg.norm(value))
    if abs(length - 1) > 1e-6:
        meant = f"; did you mean {np.round(np.array(value) / length, 6).tolist()}?" if length else ""
        raise ValueError(f"{value} has the length {length:.6g}; give a unit vector{meant}")
    return value


def per_joint(value: Any) -> Any:
    """A number >= 0, or a table."""
    numbers = value.values() if isinstance(value, dict) else [value]
    if not all(_is_number(x) and 0 <= x < np.inf for x in numbers):
        raise ValueError(f"{value}; give a number >= 0, or a table of such numbers by joint")
    return value


def _limit_per_joint(value: Any) -> Any:
    """A number > 0, or a table."""
    numbers = value.values() if isinstance(value, dict) else [value]
    if not all(_is_number(x) and 0 < x < np.inf for x in numbers):
        raise ValueError(f"{value}; give a number > 0, or a table of such numbers by joint")
    return value


def _joint_names(value: list[str]) -> list[str]:
    """Names, at least one."""
    if not value:
        raise ValueError("it is empty; name a joint, or give a pattern")
    return value


def _hand_names(value: list[str]) -> list[str]:
    """Names, each once."""
    if len(set(value)) != len(value):
        raise ValueError(f"{value}; give each name once")
    return value


def _posture(value: Any) -> Any:
    """A name, or a list of numbers."""
    if not (isinstance(value, str) or (value and _numbers(value))):
        raise ValueError(f"{value!r}; give the name of a posture, or a configuration: a list of numbers")
    return value


def any_margin(value: Any) -> float | None:
    """A number >= 0, or "anywhere"."""
    if value == "anywhere":
        return None
    if not _is_number(value) or not 0 <= value < np.inf:
        raise ValueError(f'{value!r}; give a number >= 0, or "anywhere"')
    return float(value)


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(_is_number(x) and np.isfinite(x) for x in value)


def _three(value: Any) -> bool:
    return _numbers(value) and len(value) == 3


def _matrix(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_three, value))


def _rotation(value: Any) -> Any:
    """Three rows of three numbers."""
    if not _matrix(value) or not (
        np.allclose(np.array(value) @ np.transpose(value), np.eye(3), rtol=0, atol=1e-6)
        and np.linalg.det(value) > 0
    ):
        raise ValueError(f"{value}; give a rotation matrix: three rows of three numbers")
    return value


def _inertia(value: Any) -> Any:
    """Three numbers, or three rows of three."""
    if not (_three(value) or _matrix(value)):
        raise ValueError(f"{value}; give three numbers, or three rows of three numbers")
    return value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
AtLeastOne = Annotated[float, Field(ge=1)]
Restitution = Annotated[float, Field(ge=0, le=1)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Point2 = Annotated[list[float], Field(min_length=2, max_length=2)]
UnitVector = Annotated[Vector, AfterValidator(unit_vector)]
Bound = Annotated[float, Field(allow_inf_nan=True)]  # inf: none
Range = Annotated[list[Bound], Field(min_length=2, max_length=2), AfterValidator(_ascending)]
Posture = Annotated[Any, PlainValidator(_posture)]
Rotation = Annotated[Any, PlainValidator(_rotation)]
Inertia = Annotated[Any, PlainValidator(_inertia)]
Factor = Annotated[Any, PlainValidator(_factor)]
Duration = Annotated[Any, PlainValidator(_duration)]
ContactDuration = Annotated[Any, PlainValidator(_contact_duration)]
Fractions = Annotated[list[Positive], AfterValidator(_fractions)]
PerJoint = Annotated[Any, PlainValidator(per_joint)]
Preset = Annotated[str, AfterValidator(_known_robot)]
JointNames = Annotated[list[str], AfterValidator(_joint_names)]
HandNames = Annotated[list[str], AfterValidator(_hand_names)]
Pair = Annotated[list[str], Field(min_length=2, max_length=2)]


def optional(about: str, key: str | None = None) -> Any:
    """An optional key, whose default is that of the class that the section builds.

    about : description, with the unit in brackets.  key : its name in the file, if that has a unit.
    """
    return Field(default=None, alias=key, description=about)


def required(about: str, key: str | None = None) -> Any:
    """A required key; arguments as of `optional`."""
    return Field(alias=key, description=about)


def usual(default: Any, about: str, key: str | None = None) -> Any:
    """A key with a default of its own; other arguments as of `optional`."""
    return Field(default=default, alias=key, description=about)


def attribute_docs(kind: type) -> dict[str, str]:
    """Description of each attribute in the docstrings of a class and its bases, on one line; `a, b : text`
    describes both.
    """
    out: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        doc = inspect.cleandoc(each.__doc__ or "")  # Python 3.13 removes the indentation, older ones do not
        section = re.split(r"\nAttributes\n-+\n", doc)[-1]
        entries = re.split(r"\n(?=[a-z_]+(?: \[\w+\])?(?:, [a-z_]+(?: \[\w+\])?)* : )", "\n" + section)
        for entry in entries[1:]:
            names, _, text = entry.partition(" : ")
            for name in names.split(","):
                out[name.split()[0]] = " ".join(text.split()).rstrip(".")
    return out


class Section(BaseModel):
    """Base class of sections; unknown keys, NaN, infinity and text instead of numbers are refused.

    The first sentence of a subclass's docstring describes the section in the reference.

    kind : the class that it builds.  choice : the field that selects the kind of section.
    apart : fields that are sections of another class.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None
    choice: ClassVar[str] = ""
    apart: ClassVar[tuple[str, ...]] = ()

    def given(self) -> dict[str, Any]:
        """Values of the keys in the file, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True, exclude={self.choice, *self.apart})

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Default values by field; a field without a default is left out."""
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
    """The section of a dataclass: a key for each field with metadata (`about`), the class's docstring."""
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {}
    for field, description in abouts(kind):
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        key = description.key_of(field.name)
        alias = None if key == field.name else key
        make_key = required if needed else optional
        keys[field.name] = (_value(hints[field.name], description), make_key(description.text, alias))
    section = create_model(kind.__name__, __base__=base, __doc__=kind.__doc__, **keys)
    section.kind = kind
    return section


def sections_of(name: str, doc: str, kinds: Mapping[str, type]) -> Any:
    """A section with an optional subsection for each of these classes."""
    parts: dict[str, Any] = {key: (section_of(kind), optional("")) for key, kind in kinds.items()}
    return create_model(name, __base__=Section, __doc__=doc, **parts)


def one_of(words: Iterable[str]) -> Any:
    """Type annotation for one of these words."""
    return Literal[tuple(words)]


def _value(hint: Any, about: About) -> Any:
    """Type annotation of a field for pydantic: its own without None, with its range."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    kind = next(k for k in kinds if k is not type(None))
    if about.by_joint:
        return Annotated[Any, PlainValidator(_limit_per_joint)]
    if about.none:
        return Annotated[Any, PlainValidator(any_margin)]
    if about.choices:
        return one_of(about.choices)
    bounds = {"gt": about.above, "ge": about.least, "le": about.most}
    limits: dict[str, Any] = {name: bound for name, bound in bounds.items() if bound is not None}
    if get_args(kind) == (float, ...):
        return list[Annotated[float, Field(**limits)]]
    if get_origin(kind) is tuple:
        size = len(get_args(kind))
        numbers = Annotated[list[float], Field(min_length=size, max_length=size)]
        return Annotated[numbers, AfterValidator(unit_vector)] if about.direction else numbers
    if kind is float:
        return Annotated[float, Field(**limits, allow_inf_nan=True if about.endless else None)]
    return cast(Any, kind)
