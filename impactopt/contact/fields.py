"""Fields of laws and targets: their metadata, values, factors, and functions that are written of them.

It is said once, in the field's own metadata. The class checks its numbers by it, its docstring lists it, and
the sections of problem files are made of it (`impactopt.files.problem_file.values`).
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from impactopt.errors import MOST, InputError, check_number

__all__ = [
    "About",
    "Described",
    "Parameters",
    "about",
    "abouts",
    "check_numbers",
    "choose",
    "numbers_of",
    "power",
    "snake_case",
    "text_of",
]


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

    def checked(self, name: str, value: object) -> float:
        """A number as a float; InputError, which begins with ``name``, if it is none or out of its range."""
        number = check_number(name, value, most=MOST)
        if not self.allows(number):
            raise InputError(f"{name}: {number:g}; give a number {self.range}")
        return number

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


Parameters = Mapping[str, Any]

# [m] below this a power is taken as zero: where its slopes, by base and by exponent, would be no numbers
_TINY = 1e-30


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, else `no`."""
    if isinstance(condition, (bool, np.bool_)):
        return yes if condition else no
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return ca.if_else(condition, yes, no)


def power(base: Any, exponent: Any) -> Any:
    """max(base, 0)^exponent, of floats, arrays and CasADi expressions: what laws write powers with.

    For exponents >= 1 all first derivatives are finite everywhere.
    """
    inside = base > _TINY
    safe = choose(inside, base, _TINY)
    return choose(inside, safe**exponent, 0.0 * safe)


def numbers_of(instance: Any) -> dict[str, float]:
    """The fields of a dataclass by name."""
    if not dataclasses.is_dataclass(instance):
        kind = type(instance).__name__
        raise InputError(f"{kind} is no dataclass: write @dataclass(frozen=True, kw_only=True) above it")
    return {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)}


def check_numbers(instance: Any) -> None:
    """InputError unless all numbers of a law or a target are such, and in their ranges.

    None may be too large, or so small that what is divided by it is.
    """
    for field, told in abouts(type(instance)):
        name = f"{type(instance).__name__}: {field.name}" + (f" [{told.unit}]" if told.unit else "")
        number = told.checked(name, getattr(instance, field.name))
        if 0 < number < 1 / MOST and not told.allows(-1.0):
            zero = "0, or " if told.allows(0.0) else ""
            raise InputError(f"{name}: {number:g}; give {zero}a number of at least {1 / MOST:g}")


def text_of(expressions: Sequence[Any]) -> str:
    """Expressions as text that tells any two of them apart: with all digits of their constants."""
    digits = ca.SX.get_precision()
    ca.SX.set_precision(17)
    try:
        return ", ".join(str(ca.SX(expression)) for expression in expressions)
    finally:
        ca.SX.set_precision(digits)
