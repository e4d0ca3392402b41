"""Functions for laws and targets that work for floats, NumPy arrays and CasADi expressions alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from impactopt.contact.fields import abouts
from impactopt.errors import MOST, InputError, check_array

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
    return {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)}


def check_numbers(instance: Any) -> None:
    """InputError unless all numbers of a law or a target are such, and in their ranges.

    None may be too large, or so small that what is divided by it is.
    """
    for field, told in abouts(type(instance)):
        name = f"{type(instance).__name__}: {field.name}" + (f" [{told.unit}]" if told.unit else "")
        number = float(check_array(name, getattr(instance, field.name), (), most=MOST))
        if not told.allows(number):
            raise InputError(f"{name}: {number:g}; give a number {told.range}")
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
