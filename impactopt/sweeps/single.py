"""One collision in numbers, as `impactopt collide` shows it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collision import Collision, CollisionModel
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact.targets import UNITS
from impactopt.errors import InputError
from impactopt.output import load_record, plain
from impactopt.problem_file import ProblemFile, parse_problem_file
from impactopt.robot import Robot
from impactopt.sweeps.at_contact import AtContact, check_at_contact, collision_model
from impactopt.sweeps.measures import MEASURES, Blow
from impactopt.sweeps.scene import NOT_ENDED
from impactopt.sweeps.states import ContactStates, States

__all__ = ["collide_once", "problem_of_result"]

Array = NDArray[np.float64]

_TOLERANCE = 1e-4  # relative, of the full dynamics' impulse


def problem_of_result(result: Path) -> ProblemFile:
    """The problem file that a directory of `impactopt solve` or `strike` keeps.

    Raises
    ------
    InputError : there is no record, or it was made in Python, without a problem file.
    """
    record = load_record(result)
    if not record.problem:
        raise InputError(f"{result} holds no problem file: collide with its problem, and give --speed")
    return parse_problem_file(record.problem, record.problem_path or result / "problem.toml")


def collide_once(file: ProblemFile, at_contact: Mapping[str, Any]) -> dict[str, Any]:
    """One collision of a problem's robot with its target, as plain numbers with units in their names.

    at_contact : the state at contact and the model, by the keys of docs/sweeps.md.

    Returns the measures of docs/sweeps.md; ``target``, what it says after the blow; ``joints``, the largest
    torque demand [N m] and the limit of each, hardest first; or ``reason``, why there is no such collision.

    Raises
    ------
    InputError : a value that the problem file or [at_contact] refuses.
    """
    section, content = check_at_contact(at_contact, str(file.path)), file.content
    robot = content.make_robot(file.path.parent)
    stance, striker = content.make_stance(robot), content.problem.striker
    states = ContactStates(
        robot=robot, striker=striker, stance=stance, start=content.make_start(robot), folder=Path()
    )
    model = collision_model(content, robot, stance, section)
    told = {"problem": content.problem.name or file.path.stem, "robot": robot.name, "model": section.model}
    point = tuple(map(float, content.problem.point))
    posture = states.posture(section.posture, section.result, point)
    if isinstance(posture, str):
        return {**told, "reason": posture}
    speed = None if section.speed is None else np.array([section.speed])
    joints = {name: np.array([angle]) for name, angle in section.joints.items()}
    normal = np.asarray(model.normal)
    rows = states.rows(posture, joints, speed, normal, 1, velocity=section.velocity)
    if rows.reason[0]:
        return {**told, "reason": str(rows.reason[0])}
    collision = _collide(model, rows, section)
    if not collision.separated:
        return {**told, "reason": NOT_ENDED}
    found: dict[str, Any] = {name: _row(getattr(collision, name)) for name in _OUTPUTS}
    limit = robot.torque_limit * section.torque_limit_scale
    blow = Blow(
        found=found,
        states=rows,
        torque_limit=limit[None],
        velocity_limit=robot.velocity_limit,
        polygon=posture.polygon,
    )
    there = {name: m for name, m in MEASURES.items() if all(found[o] is not None for o in m.outputs)}
    numbers = {name: float(measure.of(blow)[0]) for name, measure in there.items()}
    target = {_with_unit(name): x for name, x in collision.target_result.items()}
    return plain({**told, **numbers, "target": target, "joints": _joints(collision, robot, limit)})


def _joints(collision: Collision, robot: Robot, limit: Array) -> list[dict[str, Any]]:
    """Each joint's largest torque demand and its limit [N m], hardest first."""
    if collision.demand is None:
        return []
    peaks = zip(robot.joint_names, np.abs(collision.demand).max(axis=0), limit, strict=True)
    rows = [{"joint": j, "torque_Nm": tau, "limit_Nm": most, "ratio": tau / most} for j, tau, most in peaks]
    return sorted(rows, key=lambda row: -row["ratio"])


def _with_unit(name: str) -> str:
    return f"{name}_{UNITS[name]}" if name in UNITS else name


_OUTPUTS = tuple(dict.fromkeys(name for m in MEASURES.values() for name in m.outputs))


def _row(value: Any) -> Any:
    """A number or a history as the only row of a column."""
    return None if value is None else np.asarray(value, dtype=float)[None]


def _collide(model: CollisionModel, rows: States, section: AtContact) -> Collision:
    robot = model.robot
    settings = {
        "kp": robot.kp * section.kp_scale,
        "kd": robot.kd * section.kd_scale,
        "torque_limit": robot.torque_limit * section.torque_limit_scale,
    }
    # a point mass has no servo, and the paper's SDC no stiffness
    known = getattr(model, "settings", settings)
    given = {name: x for name, x in settings.items() if name in known}
    q, v, torque = rows.q[0], rows.v[0], rows.torque[0]
    if isinstance(model, SymbolicModel):
        return model.collide(q, v, torque, require_separation=False, **given)
    full: Any = model
    return full.converged(q, v, torque, tolerance=_TOLERANCE, require_separation=False, **given)[0]
