"""One collision in numbers, as `impactopt collide` shows it: [at_contact], collision model, measures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError

from impactopt.collide.contact_states import ContactStates, States
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.rigid import RigidImpact
from impactopt.collision.sdc import frozen_model
from impactopt.contact.targets import Target
from impactopt.errors import InputError, check_choice
from impactopt.files.output import Record, load_record, plain, replay_name
from impactopt.files.problem_file import ProblemFile, parse_problem_file
from impactopt.files.problem_file.diagnostics import mistakes_of, report_mistakes
from impactopt.files.problem_file.sections import File
from impactopt.files.problem_file.values import Positive, Section
from impactopt.kinematics.stance import Stance
from impactopt.kinematics.support import margin, zmp
from impactopt.robots.robot import Robot
from impactopt.simulation.reference import FullDynamics

__all__ = [
    "MEASURES",
    "NOT_ENDED",
    "AtContact",
    "Blow",
    "Measure",
    "check_at_contact",
    "chosen",
    "collide_once",
    "collision_model",
    "full_names",
    "one_collision",
    "planned_numbers",
    "problem_of_result",
]

NOT_ENDED = "the contact has not ended at the horizon; raise at_contact.horizon_s"
_STEP = 1e-4  # [s] between instants of the full dynamics


class AtContact(Section):
    """Section [at_contact] of a sweep of collisions.

    The state at contact is that of `result`, a directory of `impactopt solve` or `strike`; or of `posture`:
    "reach" for the problem's start with the striking point moved to the problem's point, or a posture of the
    robot by name, which hits where its hand is. `joints` are added to it. The striking point moves along the
    normal at `speed`: a result's velocity is scaled, a posture gets the `velocity` of least kinetic energy,
    or the one whose joint speeds over their limits have the least sum of squares. The feed-forward torque
    lets the robot coast. Scales are of the robot's own gains and torque limits.
    """

    posture: str = "reach"
    result: str | None = None
    speed: Positive | None = Field(default=None, alias="speed_m_s")
    velocity: Literal["least energy", "least rates"] = "least energy"
    joints: dict[str, float] = Field(default_factory=dict, alias="joints_rad")
    kp_scale: Positive = 1.0
    kd_scale: Positive = 1.0
    torque_limit_scale: Positive = 1.0
    model: Literal["rigid", "virtual-mass", "sdc-paper", "sdc", "full"] = "sdc"
    freezes: int = Field(default=0, ge=0)
    horizon: Positive = Field(default=0.2, alias="horizon_s")


def full_names(given: Mapping[str, Any]) -> dict[str, Any]:
    """The table with the units that its keys may leave out: `speed` is `speed_m_s`."""
    names = {name: info.alias for name, info in AtContact.model_fields.items() if info.alias}
    return {names[k] if k in names and names[k] not in given else k: value for k, value in given.items()}


def check_at_contact(given: Mapping[str, Any]) -> AtContact:
    """The section from its table, whose keys may leave out their units.

    Raises
    ------
    InputError : one message with all mistakes. It names no file: the table may be a sweep's, or from a call.
    """
    try:
        section = AtContact.model_validate(full_names(given))
    except ValidationError as error:
        raise InputError(report_mistakes("[at_contact]", {}, mistakes_of(error, AtContact))) from None
    if section.result is not None and "posture" in section.model_fields_set:
        raise InputError("[at_contact] posture, result: give one of them")
    if section.result is None and section.speed is None:
        raise InputError("[at_contact] speed_m_s: missing; only a result has a speed of its own")
    if section.freezes and section.model != "sdc":
        raise InputError(f"[at_contact] freezes: only of the model 'sdc', not of {section.model!r}")
    return section


def collision_model(
    content: File, robot: Robot, stance: Stance, section: AtContact, accuracy: float = 1e-2
) -> CollisionModel:
    """The model that [at_contact] names, for a problem file's blow; accuracy: as of `SDC`."""
    content.check_one_striker()
    options: dict[str, Any] = {
        "robot": robot,
        "striker": content.problem.striker,
        "normal": content.problem.normal,
        "law": content.contact.build(),
        "target": content.target.build(),
        "stance": stance,
        "horizon": section.horizon,
    }
    friction = None if content.friction is None else content.friction.build()
    if section.model == "full":
        return FullDynamics(**options, step=_STEP, contact_friction=friction)
    if section.model == "rigid":
        if friction is not None:
            raise InputError("[friction]: a rigid impact has none: take another model, or leave it out")
        e = content.collision.given().get("coefficient_of_restitution", 0.0) if content.collision else 0.0
        return RigidImpact(**options, coefficient_of_restitution=e)
    options["contact_friction"] = friction
    return frozen_model(section.model, section.freezes, accuracy=accuracy, **options)


Array = NDArray[np.float64]

LEAST_WEIGHT = 1.0  # [N] on the ground; with less there is no ZMP


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """N collisions: outputs by name as of `SymbolicModel.batch`, their states, torque limits (N, n) or (1, n)
    [N m], and the support polygon (k, 2) [m]."""

    found: Mapping[str, Array]
    states: States
    torque_limit: Array
    velocity_limit: Array
    polygon: Array


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of the table: the outputs of a collision that it takes, what it is, and how it is had."""

    outputs: tuple[str, ...]
    what: str
    of: Callable[[Blow], Array]


def _torque_ratio(blow: Blow) -> Array:
    demand = np.abs(blow.found["demand"])
    return np.asarray((demand.max(axis=1) / blow.torque_limit).max(axis=1))


def _velocity_ratio(blow: Blow) -> Array:
    joints = np.abs(blow.states.v[:, -blow.velocity_limit.size :])
    return np.asarray((joints / blow.velocity_limit).max(axis=1))


def _zmp_margin(blow: Blow) -> Array:
    ground = blow.found["ground_wrench"]
    flat = ground.reshape(-1, 6)
    out = np.full(len(flat), -np.inf)
    stands = flat[:, 2] > LEAST_WEIGHT
    out[stands] = margin(blow.polygon, zmp(flat[stands]))
    return out.reshape(ground.shape[:2]).min(axis=1)


MEASURES: Mapping[str, Measure] = {
    "impulse_Ns": Measure(
        outputs=("impulse",), what="delivered to the target", of=lambda b: b.found["impulse"]
    ),
    "peak_force_N": Measure(
        outputs=("peak_force",), what="largest contact force", of=lambda b: b.found["peak_force"]
    ),
    "contact_ms": Measure(
        outputs=("duration",), what="from contact to separation", of=lambda b: 1e3 * b.found["duration"]
    ),
    "energy_J": Measure(outputs=("energy",), what="given to the target", of=lambda b: b.found["energy"]),
    "torque_ratio": Measure(
        outputs=("demand",),
        what="largest torque demand over its joint's limit, at every millisecond of contact",
        of=_torque_ratio,
    ),
    "zmp_margin_m": Measure(
        outputs=("ground_wrench",),
        what="least distance of the ZMP from the soles' hull, positive inside, at every millisecond of "
        "contact; minus infinity where the soles would have to pull",
        of=_zmp_margin,
    ),
    "sole_force_N": Measure(
        outputs=("sole_wrench",),
        what="least vertical force of the ground on one sole, at every millisecond of contact",
        of=lambda b: b.found["sole_wrench"][..., 2].min(axis=(1, 2)),
    ),
    "freeze_error_pct": Measure(
        outputs=("freeze_error",),
        what="what freezing may have cost of the impulse, as an estimate; 0 of full dynamics, nan of models "
        "whose error is another",
        of=lambda b: 100 * b.found["freeze_error"],
    ),
    "hand_speed_m_s": Measure(
        outputs=(), what="of the striking point along the normal, at contact", of=lambda b: b.states.speed
    ),
    "effective_mass_kg": Measure(
        outputs=(),
        what="of the held robot at the striking point along the normal",
        of=lambda b: b.states.mass,
    ),
    "velocity_ratio": Measure(
        outputs=(), what="largest joint speed at contact over its limit", of=_velocity_ratio
    ),
}


def chosen(names: Iterable[str], target: Target) -> dict[str, Measure]:
    """Measures by name; of a target its results too: target_speed_m_s, target_depth_m, target_broken.

    Raises
    ------
    InputError : a name that there is not.
    """
    results = {f"target_{name}": _result(k) for k, name in enumerate(target.result_names)}
    known = {**MEASURES, **results}
    out = {}
    for name in names:
        check_choice("a sweep of collisions has no output", name, known)
        out[name] = known[name]
    if not out:
        raise InputError(f"outputs: name at least one of {', '.join(known)}")
    return out


def _result(k: int) -> Measure:
    def of(blow: Blow) -> Array:
        result: Any = blow.found["target_result"]
        return np.asarray(result[:, k])

    return Measure(outputs=("target_result",), what="of the target after the blow", of=of)


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
    "rigid": "an impact in no time, which neither servo nor contact law has a part in: believe the plan and "
    "its replays",
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
            out["simulated" if name == "simulated" else replay_name(told)] = numbers
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
    return one_collision(model, q, v, torque, **given)


def one_collision(
    model: CollisionModel, q: Array, v: Array, torque: Array, **settings: ArrayLike
) -> Collision:
    """A collision of any model, that of full dynamics with steps so short that they change nothing."""
    if isinstance(model, FullDynamics):
        return model.converged(q, v, torque, tolerance=_TOLERANCE, require_separation=False, **settings)[0]
    return model.collide(q, v, torque, require_separation=False, **settings)
