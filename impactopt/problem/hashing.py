"""A problem as a short hash: the same for the same problem, however it was written down."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from impactopt.codegen.cache import canonical, model_hash
from impactopt.contact.laws import CustomLaw
from impactopt.problem.terms import DEFAULT_TERMS, ON_DEMAND_TERMS
from impactopt.robots.robot import Robot

__all__ = ["problem_hash"]

_UNSHAPED = ("name", "price_scale")  # how far a plan has reduced its prices is the plan's
DIGITS = 16  # 64 bits: two of a million problems share a hash once in 40 million times


def problem_hash(problem: Any) -> str:
    """Hexadecimal hash of all that shapes an `ImpactProblem`'s solution, the same in every process.

    Names of the problem and the robot, the order of terms and objectives, postures that it does not start
    from, and whether a default was given or left out make no difference. Numbers count to the last digit.
    """
    shape = {f.name: getattr(problem, f.name) for f in dataclasses.fields(problem) if f.name not in _UNSHAPED}
    second = shape.pop("second")
    for name in ("stances", "friction"):
        if not shape[name]:
            shape.pop(name)
    shape.pop("ground")
    if not problem.stands:
        shape["ground"] = problem.ground_height
    if gains := shape.pop("gains"):
        each = zip(problem.gain_joints, gains, strict=True)
        shape["gains"] = sorted((joints, gain.factor) for joints, gain in each)
    if second is not None:
        other = problem.robot.striker(second.striker)
        shape["second"] = (other.frame, other.point, second.point)
    own = {type(term): term for term in (*DEFAULT_TERMS, *ON_DEMAND_TERMS, *problem.terms)}
    shape |= {
        "robot": _robot(problem.robot, problem.striker) | _drives(problem) | _hands(problem),
        "law": _contact(problem.law),
        "target": _contact(problem.target),
        "start": problem.start_posture,
        "terms": sorted(canonical(_plain(term)) for term in own.values()),
        "objectives": sorted(canonical(_plain(objective)) for objective in problem.objectives),
    }
    return hashlib.sha256(canonical(_plain(shape)).encode()).hexdigest()[:DIGITS]


def _robot(robot: Robot, striker: str) -> dict[str, Any]:
    numbers = ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper")
    hits = robot.striker(striker)
    return {
        "model": model_hash(robot.model, robot.springs),
        **{name: getattr(robot, name) for name in numbers},
        "soles": [(sole.name, sole.frame, sole.polygon) for sole in robot.soles],
        "striker": (hits.frame, hits.point),
        "disable_collisions": sorted(map(sorted, robot.disable_collisions)),
        **({"passive": robot.passive} if robot.passive.any() else {}),
        **({"tendons": robot.tendons} if robot.tendons else {}),
    }


def _drives(problem: Any) -> dict[str, Any]:
    """Motors and gears, as far as the problem depends on them."""
    if problem.of_drives:
        return {"actuators": problem.robot.actuators}
    return {"gear_limit": problem.robot.gear_limit} if problem.gear_load.active else {}


def _hands(problem: Any) -> dict[str, Any]:
    """The hands that hold on, where one does."""
    held = problem.stance.held_hands(problem.robot)
    return {"hands": [(hand.frame, hand.point) for hand in held]} if held else {}


def _contact(thing: Any) -> tuple[Any, ...]:
    """A law or a target by its kind and numbers; one of a user's own by its formula too."""
    kind = type(thing)
    own = isinstance(thing, CustomLaw) or not kind.__module__.startswith("impactopt.contact.")
    return kind.__name__, thing.parameters, thing.formula() if own else ()


def _plain(item: Any) -> Any:
    """An item in which equal numbers look the same: 5 and 5.0, 0.0 and -0.0, arrays and tuples."""
    if isinstance(item, (np.ndarray, np.generic)):
        item = item.tolist()
    if isinstance(item, (bool, str)) or item is None:
        return item
    if isinstance(item, (int, float)):
        return float(item) + 0.0
    if isinstance(item, Mapping):
        return {key: _plain(value) for key, value in item.items()}
    if isinstance(item, (list, tuple)):
        return tuple(map(_plain, item))
    if dataclasses.is_dataclass(item):
        fields = {f.name: _plain(getattr(item, f.name)) for f in dataclasses.fields(item)}
        return type(item).__name__, fields
    if hasattr(item, "__dict__") and not callable(item):  # a stance of a user's own, which is no dataclass
        return type(item).__name__, _plain(vars(item))
    raise TypeError(f"a problem holds {item!r}, which has no hash")
