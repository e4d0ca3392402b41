"""One collision in numbers, as `impactopt collide` shows it."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collide.at_contact import NOT_ENDED, AtContact, check_at_contact, collision_model
from impactopt.collide.contact_states import ContactStates, States
from impactopt.collide.measures import MEASURES, Blow
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError
from impactopt.files.output import Record, load_record, plain
from impactopt.files.problem_file import ProblemFile, parse_problem_file
from impactopt.kinematics.support import margin, zmp
from impactopt.robots.robot import Robot

__all__ = ["collide_once", "planned_numbers", "problem_of_result"]

Array = NDArray[np.float64]

_TOLERANCE = 1e-4  # relative, of the full dynamics' impulse
_STAYS = (
    "by this model the contact of the result does not end: its freezes go by the duration that the first one "
    "predicts, which is far too short here; take the full dynamics (--model full)"
)
# what of a model's difference from the plan is the model's
_OWN_ERRORS = {
    "sdc": "H, J, the bias and the acceleration of the servo's reference are frozen {}; what it differs by "
    "from the plan and its replays is its own error",
    "sdc-paper": "it has no servo stiffness, no feed-forward torque, no bias and no dJ/dt v: of ZMP, "
    "forces on soles and torques believe the plan and its replays",
    "virtual-mass": "a point mass, which no servo pushes on: believe the plan and its replays",
    "full": "nothing is frozen; it differs from the replay on held soles by their steps, and from "
    "the plan by what that has between its collocation points",
}


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


def planned_numbers(record: Record) -> dict[str, dict[str, Any]]:
    """Contact figures of a result by their source: ``planned``, ``simulated`` on fixed soles, and ``free
    soles``, as far as there are any; keys as of `collide_once`.
    """
    a, told = record.arrays, record.summary
    if "collision_time" not in a:
        return {}
    torque, ground = a["collision_torque"], a["collision_ground"]
    keys = ("impulse_Ns", "peak_force_N", "contact_ms", "hand_speed_m_s", "target")
    planned = {key: told[key] for key in keys if key in told}
    if len(torque) > 1:  # an impact without duration has neither
        planned["torque_ratio"] = float(np.abs(torque / a["torque_limit"]).max())
    if len(ground) and len(a["polygon"]):
        planned["zmp_margin_m"] = float(margin(a["polygon"], zmp(ground)).min())
        soles = sum(name.startswith("sole_") for name in a)  # hands that hold on come after them
        planned["sole_force_N"] = float(a["collision_sole_wrench"][:, 2 : 6 * soles : 6].min())
    out = {"planned": planned}
    names = {"torque_ratio": "torque_ratio_by_phase", "zmp_margin_m": "zmp_margin_by_phase_m"}
    for name, by_phase in (("simulated", {key: key for key in names}), ("replayed", names)):
        report = told.get(name) or {}
        numbers = {key: report[key] for key in keys if key in report}
        for key, source in by_phase.items():
            found = report.get(source) or {}
            numbers |= {key: found["collision"]} if "collision" in found else {}
        if numbers:
            out["simulated" if name == "simulated" else "free soles"] = numbers
    return out


def collide_once(
    file: ProblemFile, at_contact: Mapping[str, Any], *, accuracy: float = 1e-2
) -> dict[str, Any]:
    """One collision of a problem's robot with its target, as plain numbers with units in their names.

    at_contact : the state at contact and the model, by the keys of docs/sweeps.md.
    accuracy : relative, of the impulse: freezing that may have cost more is reported.

    Returns the measures of docs/sweeps.md; ``target``, what it says after the blow; ``joints``, the largest
    torque demand [N m] and the limit of each, hardest first; or ``reason``, why there is no such collision.
    ``caution`` says what to do where freezing may have cost more of the impulse than was asked for.
    Of a result whose contact is as it was saved also ``saved`` (`planned_numbers`), and ``believe``: which of
    its numbers and the model's are right where they differ.

    Raises
    ------
    InputError : a value that the problem file or [at_contact] refuses.
    """
    section, content = check_at_contact(at_contact), file.content
    record = None if section.result is None else load_record(section.result)
    if record is not None and "horizon" not in section.model_fields_set:
        section = section.model_copy(update={"horizon": _horizon(record, section.horizon)})
    robot = content.make_robot(file.path.parent)
    stance, striker = content.make_stance(robot), content.problem.striker
    states = ContactStates(
        robot=robot, striker=striker, stance=stance, start=content.make_start(robot), folder=Path()
    )
    model = collision_model(content, robot, stance, section, accuracy)
    told: dict[str, Any] = {"problem": content.problem.name or file.path.stem, "robot": robot.name}
    told |= {"model": section.model}
    told |= {"freezes": section.freezes} if section.model == "sdc" else {}
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
        own = record is not None and section.model == "sdc"
        return {**told, "reason": _STAYS if own else NOT_ENDED}
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
    target = model.target.with_units(collision.target_result.values())
    found = {**told, **numbers, "target": target, "joints": _joints(collision, robot, limit)}
    found |= {"caution": collision.caution} if collision.caution else {}
    return plain(found | ({} if record is None else _saved(file, section, record)))


def _horizon(record: Record, usual: float) -> float:
    """[s] by which a saved contact is over by any model: in steps, as each makes functions of its own."""
    lasts = float(record.arrays["collision_time"][-1]) if "collision_time" in record.arrays else 0.0
    return usual * max(1, ceil(1.5 * lasts / usual))


def _saved(file: ProblemFile, section: AtContact, record: Record) -> dict[str, Any]:
    """Saved figures to show beside a collision of the same state."""
    given = section.model_fields_set - {"result", "model", "freezes", "horizon"}
    # of another blow they would mislead
    same = record.problem and parse_problem_file(record.problem, file.path).data == file.data
    saved = planned_numbers(record) if same and not given else {}
    if not saved:
        return {}
    often = f"at contact and {section.freezes} times on the way" if section.freezes else "at contact"
    return {"saved": saved, "believe": _OWN_ERRORS[section.model].format(often)}


def _joints(collision: Collision, robot: Robot, limit: Array) -> list[dict[str, Any]]:
    """Each joint's largest torque demand and its limit [N m], hardest first."""
    if collision.demand is None:
        return []
    peaks = zip(robot.joint_names, np.abs(collision.demand).max(axis=0), limit, strict=True)
    rows = [{"joint": j, "torque_Nm": tau, "limit_Nm": most, "ratio": tau / most} for j, tau, most in peaks]
    return sorted(rows, key=lambda row: -row["ratio"])


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
    settings |= {name: x[0] for name, x in rows.bend.items()}
    # a point mass has no servo, and the paper's SDC no stiffness
    known = getattr(model, "settings", settings)
    given = {name: x for name, x in settings.items() if name in known}
    q, v, torque = rows.q[0], rows.v[0], rows.torque[0]
    if isinstance(model, SymbolicModel):
        return model.collide(q, v, torque, require_separation=False, **given)
    full: Any = model
    return full.converged(q, v, torque, tolerance=_TOLERANCE, require_separation=False, **given)[0]
