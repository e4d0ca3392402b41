"""Hash of a problem, which is the same for all ways of writing the same problem."""

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

# Fields that are not hashed: the name, and the factor by which the planner has reduced the prices.
_NOT_HASHED = ("name", "price_scale")
DIGITS = 16  # 64 bits: the probability that two of a million problems share a hash is 1 in 40 million


def problem_hash(problem: Any) -> str:
    """Hexadecimal hash of what an `ImpactProblem`'s solution depends on, but for the collision shapes of the
    robot's links (`RobotBodies.hash`), the same in every process.

    It does not depend on the names of problem and robot, the order of terms and objectives, the names of
    postures, or on whether a default is given or left out. Numbers count to the last digit.
    """
    data = {
        f.name: getattr(problem, f.name) for f in dataclasses.fields(problem) if f.name not in _NOT_HASHED
    }
    second = data.pop("second")
    # features that a problem does not use are left out, so that problems without them keep their hashes
    for name in ("stances", "friction"):
        if not data[name]:
            data.pop(name)
    if (friction := data.get("friction")) is not None and not friction.moves_target:
        rubs = vars(friction)
        data["friction"] = type(friction).__name__, {key: rubs[key] for key in rubs if key != "moves_target"}
    data.pop("ground")
    if not problem.stands:
        data["ground"] = problem.ground_height
    if gains := data.pop("gains"):
        each = zip(problem.gain_joints, gains, strict=True)
        data["gains"] = sorted((joints, gain.factor) for joints, gain in each)
    if data.pop("near_contact") is not None:
        data["near_contact"] = problem.posture_near_contact
    if second is not None:
        other = problem.robot.striker(second.striker)
        data["second"] = (other.frame, other.point, second.point)
    terms = {type(term): term for term in (*DEFAULT_TERMS, *ON_DEMAND_TERMS, *problem.terms)}
    data |= {
        "robot": _robot(problem.robot, problem.striker) | _drives(problem) | _hands(problem),
        "law": _contact(problem.law),
        "target": _contact(problem.target),
        "start": problem.start_posture,
        "terms": sorted(canonical(_plain(term)) for term in terms.values()),
        "objectives": sorted(canonical(_plain(objective)) for objective in problem.objectives),
    }
    return hashlib.sha256(canonical(_plain(data)).encode()).hexdigest()[:DIGITS]


def _robot(robot: Robot, striker: str) -> dict[str, Any]:
    """Data of a robot and one of its strikers."""
    parameters = ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper")
    own = robot.striker(striker)
    return {
        "model": model_hash(robot.model, robot.springs),
        **{name: getattr(robot, name) for name in parameters},
        "soles": [(sole.name, sole.frame, sole.polygon) for sole in robot.soles],
        "striker": (own.frame, own.point),
        "disable_collisions": sorted(map(sorted, robot.disable_collisions)),
        **({"passive": robot.passive} if robot.passive.any() else {}),
        **({"tendons": robot.tendons} if robot.tendons else {}),
    }


def _drives(problem: Any) -> dict[str, Any]:
    """Motors and gears, if the problem depends on them."""
    if problem.of_drives:
        return {"actuators": problem.robot.actuators}
    return {"gear_limit": problem.robot.gear_limit} if problem.gear_load.active else {}


def _hands(problem: Any) -> dict[str, Any]:
    """Supporting hands, if there are any."""
    hands = problem.stance.held_hands(problem.robot)
    return {"hands": [(hand.frame, hand.point) for hand in hands]} if hands else {}


def _contact(thing: Any) -> tuple[Any, ...]:
    """Class and parameters of a law or a target; a user's own also by its formula."""
    kind = type(thing)
    users_own = isinstance(thing, CustomLaw) or not kind.__module__.startswith("impactopt.contact.")
    return kind.__name__, thing.parameters, thing.formula() if users_own else ()


def _plain(item: Any) -> Any:
    """Item in a form that is the same for equal values: 5 and 5.0, 0.0 and -0.0, arrays and tuples."""
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
    if hasattr(item, "__dict__") and not callable(item):  # a user's own stance, which need not be a dataclass
        return type(item).__name__, _plain(vars(item))
    raise TypeError(f"a problem holds {item!r}, which has no hash")
