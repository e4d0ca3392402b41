"""The kinds of values that keys of a problem file have: ranges, and what is said of a value outside.

Validators raise ValueError, which pydantic collects, with the value and the fix in the message. Their
docstrings are what the reference says of such values.
"""

from __future__ import annotations

from typing import Annotated, Any

import casadi as ca
import numpy as np
from pydantic import AfterValidator, Field, PlainValidator

from impactopt.errors import did_you_mean, shortened
from impactopt.files.problem_file.ipopt_options import ALLOWED
from impactopt.problem.checks import MOST_FREEZES
from impactopt.robots.presets import robot_names
from impactopt.solvers.ipopt import IPOPT_DEFAULTS


def _known_robot(name: str) -> str:
    """A preset's name."""
    if name not in robot_names():
        near = did_you_mean(name, robot_names())
        raise ValueError(
            f"there is no robot {shortened(name)!r}{near}; presets are {', '.join(robot_names())}"
        )
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
    """A number >= 0, or a table by joint."""
    numbers = value.values() if isinstance(value, dict) else [value]
    if not all(_is_number(x) and 0 <= x < np.inf for x in numbers):
        raise ValueError(f"{value}; give a number >= 0, or a table of such numbers by joint")
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


def _ipopt_options(options: dict[str, Any]) -> dict[str, Any]:
    """A table."""
    # IPOPT itself is asked about each value, with a program of one variable
    if len(options) > len(ALLOWED):
        raise ValueError(f"has {len(options)} keys; there are {len(ALLOWED)} to give")
    x, wrong = ca.MX.sym("x"), []
    for name, value in options.items():
        if name not in ALLOWED:
            near = did_you_mean(name, ALLOWED)
            wrong.append(
                f"{name} is not among the options of IPOPT that problem files set: those with which it loads "
                f"no library and writes no file{near}"
            )
            continue
        if not isinstance(value, (bool, int, float, str)):
            wrong.append(f"{name} = {value!r}; give a number or text")
            continue
        trial = {**IPOPT_DEFAULTS, "print_level": 0, name: value}
        try:
            ca.nlpsol("trial", "ipopt", {"x": x, "f": x**2}, {"ipopt": trial})
        except (RuntimeError, NotImplementedError):
            wrong.append(f"IPOPT refuses {name} = {value!r}")
    if wrong:
        raise ValueError("; ".join(wrong))
    return options


Positive = Annotated[float, Field(gt=0)]
Freezes = Annotated[int, Field(ge=0, le=MOST_FREEZES)]
NotNegative = Annotated[float, Field(ge=0)]
NotNegativeOrAny = Annotated[float, Field(ge=0, allow_inf_nan=True)]  # inf: any; nan is refused by ge
AtLeastOne = Annotated[float, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, le=1)]
Restitution = Annotated[float, Field(ge=0, le=1)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Point2 = Annotated[list[float], Field(min_length=2, max_length=2)]
UnitVector = Annotated[Vector, AfterValidator(unit_vector)]
Bound = Annotated[float, Field(allow_inf_nan=True)]  # inf: none
Range = Annotated[list[Bound], Field(min_length=2, max_length=2), AfterValidator(_ascending)]
Margin = Annotated[Any, PlainValidator(any_margin)]
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
IpoptOptions = Annotated[dict[str, Any], AfterValidator(_ipopt_options)]
