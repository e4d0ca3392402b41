"""Metadata of dataclass fields, and expressions that laws and targets are written with.

A field's metadata describe it once: the class checks its values with them, its docstring lists them, and
the sections of problem files are made from them (`impactopt.files.sections.values`).
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from impactopt.errors import MOST, InputError, check_number, counted

T = TypeVar("T")
_METADATA = "about"


@dataclass(frozen=True, kw_only=True)
class About:
    """Description of a field.

    what : text; the unit is inserted before its first semicolon.
    unit : such as "N m/s", "" for none.
    above, least, most : range of a number: > above, >= least, <= most; None: no such bound.
    endless : a number may be infinite, for no limit.
    direction : it is a unit vector.
    by_joint : it is one number for all joints, or a table by joint.
    none : word for None in a file, if None is not the default; "": None is left out.
    choices : the permitted values of a text; (): any.
    key : its key in a file, if it is not the field's name and its unit.
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
        """Description with the unit in brackets."""
        words, semicolon, rest = self.what.partition(";")
        return f"{words} [{self.unit}]".lstrip() + semicolon + rest if self.unit else self.what

    @property
    def range(self) -> str:
        """Range of a number as text: "> 0 and <= 1"; "" for any."""
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
        """Value as a float; InputError, which begins with ``name``, if it is no number or out of range."""
        number = check_number(name, value, most=MOST)
        if not self.allows(number):
            raise InputError(f"{name}: {number:g}; give a number {self.range}")
        return number

    def key_of(self, field: str) -> str:
        """Key of a field in a file: `stiffness` in [N/m^1.5] is `stiffness_N_m1_5`."""
        unit = re.sub(r"[ /.]", "_", self.unit.replace("^", ""))
        return self.key or f"{field}_{unit}".rstrip("_")


_NUMBER = About(what="")  # of fields without metadata


def about(what: str, **more: Any) -> dict[str, About]:
    """Metadata of a field, ``mass: float = field(metadata=about("of it", unit="kg", above=0))``.

    what, more : as of `About`.
    """
    return {_METADATA: About(what=what, **more)}


def described(default: Any, what: str, **more: Any) -> Any:
    """Field with a default and a description, ``margin: float = described(0.02, "distance", unit="m")``.

    what, more : as of `About`.
    """
    return dataclasses.field(default=default, metadata=about(what, **more))


def abouts(kind: type) -> Iterator[tuple[dataclasses.Field[Any], About]]:
    """Fields of a dataclass that have a description."""
    for field in dataclasses.fields(kind):
        if (description := field.metadata.get(_METADATA)) is not None:
            yield field, description


class Described:
    """Base of dataclasses with described fields, which their docstrings list."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = {name: value for name, value in vars(cls).items() if isinstance(value, dataclasses.Field)}
        lines = [
            f"{name} : " + "; ".join(filter(None, (description.text, description.range))) + "."
            for name, field in own.items()
            if (description := field.metadata.get(_METADATA)) is not None
        ]
        if lines and cls.__doc__:
            parts = [inspect.cleandoc(cls.__doc__), "", "Attributes", "----------", *lines]
            raises = ["", "Raises", "------", "InputError : a number out of its range."]
            cls.__doc__ = "\n".join([*parts, *raises])


def snake_case(name: str) -> str:
    """Name of a class in files: `TorqueRate` as `torque_rate`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


def in_order(parts: Iterable[T], kinds: Sequence[type]) -> tuple[T, ...]:
    """Parts of a problem in the order of their classes in files, those of a user's own classes last."""
    return tuple(sorted(parts, key=lambda p: kinds.index(type(p)) if type(p) in kinds else len(kinds)))


Parameters = Mapping[str, Any]

# [m] Below this, powers are zero: at zero their derivatives by base and by exponent would be NaN.
_TINY = 1e-30


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """Elementwise `yes` if the condition holds, else `no`; of floats, arrays or CasADi expressions."""
    if isinstance(condition, (bool, np.bool_)):
        return yes if condition else no
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return ca.if_else(condition, yes, no)


def function(name: str, *values: Any) -> Any:
    """Function of numpy's name, such as "exp", of floats, arrays or CasADi expressions."""
    symbolic = any(isinstance(value, (ca.SX, ca.MX, ca.DM)) for value in values)
    return getattr(ca if symbolic else np, name)(*values)


def power(base: Any, exponent: Any) -> Any:
    """Power max(base, 0)^exponent for contact laws, of floats, arrays and CasADi expressions.

    For exponents >= 1 all first derivatives are finite everywhere.
    """
    inside = base > _TINY
    safe = choose(inside, base, _TINY)
    return choose(inside, safe**exponent, 0.0 * safe)


def numbers_of(instance: Any) -> dict[str, float]:
    """Values of a dataclass's fields by name."""
    if not dataclasses.is_dataclass(instance):
        kind = type(instance).__name__
        raise InputError(f"{kind} is no dataclass: write @dataclass(frozen=True, kw_only=True) above it")
    return {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)}


def check_numbers(instance: Any) -> None:
    """Makes floats of all parameters of a law or a target; InputError unless they are numbers in their
    ranges, or True or False.

    They may not be too large, nor so small that quotients are. Fields without a description are numbers too.
    """
    numbers_of(instance)  # refuses what is no dataclass
    for field in dataclasses.fields(instance):
        description = field.metadata.get(_METADATA, _NUMBER)
        unit = f" [{description.unit}]" if description.unit else ""
        name = f"{type(instance).__name__}: {field.name}{unit}"
        value = getattr(instance, field.name)
        if isinstance(field.default, bool) or (_METADATA not in field.metadata and isinstance(value, bool)):
            if not isinstance(value, bool):
                raise InputError(f"{name} is {value!r}; give True or False")
            continue
        number = description.checked(name, value)
        if 0 < number < 1 / MOST and not description.allows(-1.0):
            zero = "0, or " if description.allows(0.0) else ""
            raise InputError(f"{name}: {number:g}; give {zero}a number of at least {1 / MOST:g}")
        object.__setattr__(instance, field.name, number)


def with_symbols(instance: Any) -> Any:
    """Copy of a law or a target with a CasADi symbol ``self.<name>`` in the place of each of its fields."""
    copied = copy.copy(instance)
    for name in numbers_of(instance):
        object.__setattr__(copied, name, ca.SX.sym(f"self.{name}"))
    return copied


def expressions_of(
    where: str, call: str, method: Callable[[], Any], names: Sequence[object] | None = None
) -> list[Any]:
    """Expressions that a method of a law or a target gives, called with CasADi symbols.

    where, call : the method and its arguments, for messages.  method : calls it.
    names : of the list that it has to give; None: it gives one expression, without a list.

    Raises
    ------
    InputError : the call fails, or gives anything else.
    """
    try:
        given = method()
        listed = isinstance(given, (list, tuple))
        right = given is not None and listed == (names is not None) and not isinstance(given, np.ndarray)
        found = [ca.SX(part) for part in (given if listed else [given])] if right else []
    except Exception as error:
        raise InputError(
            f"{where}: cannot be called with CasADi expressions as {call}, with casadi.fmax and "
            f"casadi.if_else in the place of max and if: {error}"
        ) from error
    wanted = "one expression" if names is None else f"a list of {len(names)}"
    wanted += f": {', '.join(map(str, names))}" if names else ""
    if not right:
        array = "an array" if isinstance(given, np.ndarray) else "no list"
        kind = "nothing" if given is None else "a list" if listed else array
        raise InputError(f"{where}: {call} gives {kind}; give {wanted}")
    count = sum(part.numel() for part in found)
    if count != (1 if names is None else len(names)) or len(found) != count:
        raise InputError(f"{where}: {call} gives {counted(count, 'expression')}; give {wanted}")
    if has_nan(ca.veccat(*found)):
        raise InputError(f"{where}: {call} {IS_NAN}")
    return found


IS_NAN = (
    "has NaN in its expression: functions of Python's math make NaN of CasADi's symbols; write those of "
    "CasADi, such as casadi.sqrt"
)


def has_nan(expression: Any) -> bool:
    """True if NaN is a constant of an expression; `math.sqrt` of a CasADi symbol is NaN, not an error."""
    sx = ca.SX(expression)
    graph = ca.Function("expression", ca.symvar(sx), [sx])
    constants = (k for k in range(graph.n_instructions()) if graph.instruction_id(k) == ca.OP_CONST)
    return any(math.isnan(graph.instruction_constant(k)) for k in constants)


def check_parameters_taken(instance: Any, expressions: Iterable[Any]) -> None:
    """InputError unless expressions of a law or a target take its fields from the methods' `parameters`.

    expressions : of the methods of `with_symbols(instance)`, all of them.
    """
    used = {symbol.name() for symbol in ca.symvar(ca.SX(ca.veccat(*expressions)))}
    if missing := [name for name in numbers_of(instance) if name not in used or f"self.{name}" in used]:
        raise InputError(
            f"{type(instance).__name__}: expressions of its methods do not have {', '.join(missing)} from "
            "their argument `parameters`, so that a compiled function would not get a changed number: write "
            'parameters["..."], not self, and give no field that is in none of them'
        )


def text_of(expressions: Sequence[Any]) -> str:
    """Expressions as text with all digits of their constants, which distinguishes any two of them."""
    digits = ca.SX.get_precision()
    ca.SX.set_precision(17)
    try:
        return ", ".join(str(ca.SX(expression)) for expression in expressions)
    finally:
        ca.SX.set_precision(digits)
