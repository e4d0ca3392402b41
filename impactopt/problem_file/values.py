"""The kinds of values that keys of a problem file have: ranges, and what is said of a value outside.

Validators raise ValueError, which pydantic collects, with the value and the mend in the message.
"""

from __future__ import annotations

from typing import Annotated, Any

import casadi as ca
import numpy as np
from pydantic import AfterValidator, Field, PlainValidator

from impactopt.errors import did_you_mean
from impactopt.presets import robot_names


def _known_robot(name: str) -> str:
    if name not in robot_names():
        near = did_you_mean(name, robot_names())
        raise ValueError(f"there is no robot {name!r}{near}; presets are {', '.join(robot_names())}")
    return name


def _duration(value: Any) -> list[float]:
    """A positive number, or the shortest and the longest."""
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(_is_number(x) and 0 < x < np.inf for x in pair):
        raise ValueError(f"{value}; give a number > 0 [s], or [shortest, longest]")
    return _ascending([float(x) for x in pair])


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _fractions(value: list[float]) -> list[float]:
    if abs(sum(value) - 1) > 1e-9:
        raise ValueError(f"{value} sum to {sum(value):g}; give fractions that sum to 1")
    return value


def _ascending(value: list[float]) -> list[float]:
    if value[0] > value[1]:
        raise ValueError(f"{value}; the first must not exceed the second")
    return value


def _unit(value: list[float]) -> list[float]:
    length = float(np.linalg.norm(value))
    if abs(length - 1) > 1e-6:
        meant = f"; did you mean {np.round(np.array(value) / length, 6).tolist()}?" if length else ""
        raise ValueError(f"{value} has the length {length:.6g}; give a unit vector{meant}")
    return value


def _per_joint(value: Any) -> Any:
    """A number for all joints, or a table of numbers by joint."""
    numbers = value.values() if isinstance(value, dict) else [value]
    if not all(_is_number(x) and 0 <= x < np.inf for x in numbers):
        raise ValueError(f"{value}; give a number >= 0, or a table of such numbers by joint")
    return value


def _ipopt_options(options: dict[str, Any]) -> dict[str, Any]:
    """IPOPT itself is asked about each, with a program of one variable."""
    x, wrong = ca.MX.sym("x"), []
    for name, value in options.items():
        trial = {"print_level": 0, "sb": "yes", name: value}
        try:
            ca.nlpsol("trial", "ipopt", {"x": x, "f": x**2}, {"ipopt": trial})
        except (RuntimeError, NotImplementedError) as error:
            known = "No such IPOPT option" not in str(error)
            wrong.append(f"IPOPT refuses {name} = {value!r}" if known else f"IPOPT has no option {name}")
    if wrong:
        raise ValueError("; ".join(wrong))
    return options


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
AtLeastOne = Annotated[float, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, le=1)]
Restitution = Annotated[float, Field(ge=0, le=1)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Point2 = Annotated[list[float], Field(min_length=2, max_length=2)]
UnitVector = Annotated[Vector, AfterValidator(_unit)]
Range = Annotated[Point2, AfterValidator(_ascending)]
Duration = Annotated[Any, PlainValidator(_duration)]
Fractions = Annotated[list[Positive], AfterValidator(_fractions)]
PerJoint = Annotated[Any, PlainValidator(_per_joint)]
Preset = Annotated[str, AfterValidator(_known_robot)]
IpoptOptions = Annotated[dict[str, Any], AfterValidator(_ipopt_options)]
