"""Metadata of a dataclass's fields: descriptions, units, ranges, keys in a file.

It is said once, in the field's own metadata. The class checks its numbers by it, its docstring lists it, and
the sections of problem files are made of it (`impactopt.files.problem_file.field_sections`).
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

__all__ = ["About", "Described", "about", "abouts", "snake_case"]

_METADATA = "about"


@dataclass(frozen=True, kw_only=True)
class About:
    """Description of a field.

    what : in words; its unit is put before the first semicolon.
    unit : such as "N m/s", "" for none.
    above, least, most : range of a number: > above, >= least, <= most; None: no such bound.
    endless : a number may be infinite, where anything is allowed.
    direction : it is a unit vector.
    by_joint : it is one number for all joints, or a table by joint.
    none : the word that a file has for None, where that is no default; "": None is left out.
    choices : all values that a text may have, if there are but some.
    key : in a file, if it is not the field's name and its unit.
    """

    what: str
    unit: str = ""
    above: float | None = None
    least: float | None = None
    most: float | None = None
    endless: bool = False
    direction: bool = False
    by_joint: bool = False
    none: str = ""
    choices: tuple[str, ...] = ()
    key: str = ""

    @property
    def text(self) -> str:
        """Description in words, with the unit in brackets."""
        words, semicolon, rest = self.what.partition(";")
        return f"{words} [{self.unit}]".lstrip() + semicolon + rest if self.unit else self.what

    @property
    def range(self) -> str:
        """Range of a number in words: "> 0 and <= 1"; "" for any."""
        bounds = ((">", self.above), (">=", self.least), ("<=", self.most))
        return " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)

    def allows(self, number: float) -> bool:
        """True if a number is in the range; NaN never is."""
        return not math.isnan(number) and (
            (self.above is None or number > self.above)
            and (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
        )

    def key_of(self, field: str) -> str:
        """The key of a field in a file: `stiffness` in [N/m^1.5] is `stiffness_N_m1_5`."""
        unit = re.sub(r"[ /.]", "_", self.unit.replace("^", ""))
        return self.key or f"{field}_{unit}".rstrip("_")


def about(what: str, **more: Any) -> dict[str, About]:
    """Metadata of a field, ``mass: float = field(metadata=about("of it", unit="kg", above=0))``.

    what, more : as of `About`.
    """
    return {_METADATA: About(what=what, **more)}


def abouts(kind: type) -> Iterator[tuple[dataclasses.Field[Any], About]]:
    """The fields of a dataclass that say what they are."""
    for field in dataclasses.fields(kind):
        if (told := field.metadata.get(_METADATA)) is not None:
            yield field, told


class Described:
    """Base of dataclasses whose fields say what they are: their docstrings list it."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = {name: value for name, value in vars(cls).items() if isinstance(value, dataclasses.Field)}
        lines = [
            f"{name} : " + "; ".join(filter(None, (told.text, told.range))) + "."
            for name, field in own.items()
            if (told := field.metadata.get(_METADATA)) is not None
        ]
        if lines and cls.__doc__:
            parts = [inspect.cleandoc(cls.__doc__), "", "Attributes", "----------", *lines]
            raises = ["", "Raises", "------", "InputError : a number out of its range."]
            cls.__doc__ = "\n".join([*parts, *raises])


def snake_case(name: str) -> str:
    """`TorqueRate` as `torque_rate`: what a file calls a class."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
