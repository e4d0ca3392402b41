"""Single collision of a problem, as `impactopt collide` shows it: [at_contact], collision model, measures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from pydantic import Field, ValidationError

from impactopt.arrays import Array, Index
from impactopt.collide.contact_states import ContactStates, States
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.rigid import RigidImpact
from impactopt.collision.sdc import frozen_model
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact.friction import tangential_outcome
from impactopt.contact.targets import Target
from impactopt.errors import InputError, check_choice
from impactopt.files.record import Record, load_record, plain, replay_name
from impactopt.files.sections.collision import CollisionSections
from impactopt.files.sections.diagnostics import mistakes_of, report_mistakes
from impactopt.files.sections.reading import CollisionFile
from impactopt.files.sections.values import Positive, Section
from impactopt.files.toml import read_toml
from impactopt.kinematics.stance import Free, Stance, margin, zmp
from impactopt.problem.checks import MOST_FREEZES
from impactopt.robots.loads import weight_of
from impactopt.robots.robot import Robot
from impactopt.solvers.program import Status

NOT_ENDED = (
    "the contact has not ended at the horizon; raise it: at_contact.horizon_s, or --horizon of `impactopt "
    "collide`"
)
_FULL_DYNAMICS_STEP = 1e-4  # [s] between instants of its histories
_IMPULSE_TOLERANCE = 1e-4  # relative, of the full dynamics


class AtContact(Section):
    """Section [at_contact] of a sweep of collisions.

    The state at contact is that of `result`, a directory of `impactopt solve` or `strike`; or of `posture`:
    "reach" for the problem's start posture with the striking point moved to the problem's point, or a
    posture of the robot by name, with the target at its hand, and its soles where it has them, whatever steps
    [[stances]] has. `joints` are added to it. The striking point moves along the normal at `speed`: a
    result's velocity is scaled; a posture gets the `velocity` of least kinetic energy, or that of the least
    sum of squares of joint velocities over their limits. The feed-forward torque keeps the joint velocities.
    Scales multiply the robot's gains and torque limits.
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
    freezes: int = Field(default=0, ge=0, le=MOST_FREEZES)
    horizon: Positive = Field(default=0.2, alias="horizon_s")


def full_names(given: Mapping[str, Any]) -> dict[str, Any]:
    """Table with units added to its keys, which may omit them: `speed` is `speed_m_s`."""
    names = {name: info.alias for name, info in AtContact.model_fields.items() if info.alias}
    return {names[k] if k in names and names[k] not in given else k: value for k, value in given.items()}


def check_at_contact(given: Mapping[str, Any]) -> AtContact:
    """Section from its table, whose keys may omit their units.

    Raises
    ------
    InputError : one message with all mistakes. It names no file, as the table may come from a sweep or a
        call.
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


def servo_settings(robot: Robot, section: AtContact, **scales: Array) -> dict[str, Array]:
    """Stiffness ``kp`` [N m/rad], damping ``kd`` [N m s/rad] and ``torque_limit`` [N m] of the servo.

    Joints without a motor keep theirs: a grip's spring and damper are no servo's.

    scales (N, 1) : by setting, in the place of the section's scale.

    Returns settings (n), or (N, n) with a scale.
    """
    given = {"kp": section.kp_scale, "kd": section.kd_scale, "torque_limit": section.torque_limit_scale}
    return {
        name: getattr(robot, name) * np.where(robot.passive, 1.0, scale)
        for name, scale in (given | scales).items()
    }


def collision_model(
    content: CollisionSections, robot: Robot, stance: Stance, section: AtContact, accuracy: float = 1e-2
) -> CollisionModel:
    """Collision model that [at_contact] names, for a problem file; accuracy as of `SDC`."""
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
        from impactopt.simulation.reference import FullDynamics  # loads MuJoCo

        options |= {"step": _FULL_DYNAMICS_STEP, "tolerance": _IMPULSE_TOLERANCE}
        return FullDynamics(**options, contact_friction=friction)
    if section.model == "rigid":
        if friction is not None:
            raise InputError("[friction]: a rigid impact has none: take another model, or leave it out")
        e = content.collision.given().get("coefficient_of_restitution", 0.0) if content.collision else 0.0
        return RigidImpact(**options, coefficient_of_restitution=e)
    options["contact_friction"] = friction
    return frozen_model(section.model, section.freezes, accuracy=accuracy, **options)


# instants that histories have of a contact at least: with fewer they miss its peak by more than 1 %
_INSTANTS = 10


def finer(model: CollisionModel, durations: Array) -> Iterator[tuple[CollisionModel, Index]]:
    """Models with `_INSTANTS` in contacts of these durations (N) [s], each with the indices of its contacts.

    There are none for contacts in which the model itself has so many.
    """
    # Full dynamics have more, Runge-Kutta's steps resolve the contact, an impact takes no time, and a point
    # mass has no histories.
    if not isinstance(model, SymbolicModel) or model.stepping != "implicit" or not model.n_servos:
        return
    # powers of ten, as compiled functions depend on the step
    with np.errstate(divide="ignore", invalid="ignore"):
        powers = np.floor(np.log10(durations / _INSTANTS))
    for power in np.unique(powers[np.isfinite(powers)]):
        if 10.0**power < model.step_length:
            yield _with_step(model, 10.0**power), np.flatnonzero(powers == power)


@lru_cache(maxsize=32)  # a model holds its loaded functions
def _with_step(model: SymbolicModel, step: float) -> SymbolicModel:
    # `finer`'s contacts last less than a hundred steps; histories have as many columns as a horizon has steps
    return replace(model, step=step, horizon=min(model.horizon, 200 * step))


LEAST_LOAD = 1e-3  # vertical force on the ground over the weight; with less the ZMP is undefined


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionResults:
    """Results of N collisions of a robot, from which measures are computed.

    found : outputs by name, as of `SymbolicModel.batch`.  states : at contact.  robot : that collides.
    torque_limit (N, n) or (1, n) [N m].  polygon (k, 2) [m] : support polygon.
    """

    found: Mapping[str, Array]
    states: States
    robot: Robot
    torque_limit: Array
    polygon: Array


@dataclass(frozen=True)
class Measure:
    """Column of the table of collisions: required outputs, and its values (N) from a batch."""

    outputs: tuple[str, ...]
    of: Callable[[CollisionResults], Array]


def _torque_ratio(batch: CollisionResults) -> Array:
    demand = np.abs(batch.found["demand"])
    return np.asarray((demand.max(axis=1) / batch.torque_limit).max(axis=1))


def _velocity_ratio(batch: CollisionResults) -> Array:
    joints = np.abs(batch.states.v[:, -batch.robot.n :])
    return np.asarray((joints / batch.robot.velocity_limit).max(axis=1))


def zmp_margins(robot: Robot, polygon: Array, ground: Array) -> Array:
    """Distances (k) [m] of the ZMP from the edges of a support polygon, positive inside.

    Minus infinity where the ground carries no load, or would have to pull.

    polygon (c, 2) [m].  ground (k, 6) : wrenches as of `Collision`.
    """
    out = np.full(len(ground), -np.inf)
    stands = ground[:, 2] > LEAST_LOAD * weight_of(robot)
    out[stands] = margin(polygon, zmp(ground[stands]))
    return out


def _zmp_margin(batch: CollisionResults) -> Array:
    ground = batch.found["ground_wrench"]
    inside = zmp_margins(batch.robot, batch.polygon, ground.reshape(-1, 6))
    return np.asarray(inside.reshape(ground.shape[:2]).min(axis=1))


# Least and largest values are over every millisecond of contact, and ten instants at least.
MEASURES: Mapping[str, Measure] = {
    "impulse_Ns": Measure(("impulse",), lambda b: b.found["impulse"]),
    "peak_force_N": Measure(("peak_force",), lambda b: b.found["peak_force"]),
    "contact_ms": Measure(("duration",), lambda b: 1e3 * b.found["duration"]),
    "energy_J": Measure(("energy",), lambda b: b.found["energy"]),
    "torque_ratio": Measure(("demand",), _torque_ratio),
    "zmp_margin_m": Measure(("ground_wrench",), _zmp_margin),
    "sole_force_N": Measure(("sole_wrench",), lambda b: b.found["sole_wrench"][..., 2].min(axis=(1, 2))),
    "freeze_error_pct": Measure(("freeze_error",), lambda b: 100 * b.found["freeze_error"]),
    "hand_speed_m_s": Measure((), lambda b: b.states.speed),
    "effective_mass_kg": Measure((), lambda b: b.states.mass),
    "velocity_ratio": Measure((), _velocity_ratio),
}


def weightless(model: CollisionModel) -> bool:
    """True if forces on single soles lack the weight, as in a model without bias forces."""
    return isinstance(model, SymbolicModel) and not model.effects.bias


def chosen(names: Iterable[str], target: Target) -> dict[str, Measure]:
    """Measures by name, among them the target's results: target_speed_m_s, target_depth_m, target_broken.

    Raises
    ------
    InputError : an unknown name.
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
    def of(batch: CollisionResults) -> Array:
        result: Any = batch.found["target_result"]
        return np.asarray(result[:, k])

    return Measure(("target_result",), of)


_CONTACT_DOES_NOT_END = (
    "the contact of the result does not end with this model: its freezes are placed by the duration that the "
    "first one predicts, which is far too short here; take the full dynamics (--model full)"
)
# causes of differences between a model and the plan, and which of the two to trust
_MODEL_ERRORS = {
    "sdc": "H, J, the bias and the acceleration of the servo's reference are frozen {}; its differences from "
    "the plan and the replays are errors of this model",
    "sdc-paper": "it has no servo stiffness, no feed-forward torque, no bias and no dJ/dt v: for ZMP, "
    "forces on soles and torques trust the plan and its replays",
    "virtual-mass": "a point mass without servo: trust the plan and its replays",
    "rigid": "an impact without duration, servo and contact law: trust the plan and its replays",
    "full": "nothing is frozen; it differs from the replay on fixed soles by the steps of both, and from "
    "the plan by the plan's error between collocation points",
}
_NOT_SOLVED = (
    "the plan is not solved ({}): its numbers violate constraints, and this collision only begins in its "
    "state at contact"
)


def problem_of_result(result: Path) -> CollisionFile:
    """Problem file that is stored in a directory of `impactopt solve` or `strike`.

    Raises
    ------
    InputError : there is no record, or it was made in Python, without a problem file.
    """
    record = load_record(result)
    if not record.problem:
        raise InputError(f"{result} holds no problem file: collide with its problem, and give --speed")
    return CollisionFile.parse(record.problem, record.problem_path or result / "problem.toml")


def planned_numbers(record: Record) -> dict[str, dict[str, Any]]:
    """Measures of a saved result's contact, by source and by the keys of `collide_once`.

    Sources are ``planned``, ``simulated`` on fixed soles, and ``free soles``, as far as the result has them.
    """
    a, summary = record.arrays, record.summary
    if "collision_time" not in a:
        return {}
    torque, ground = a["collision_torque"], a["collision_ground"]
    keys = ("impulse_Ns", "peak_force_N", "contact_ms", "hand_speed_m_s", "target")
    planned = {key: summary[key] for key in keys if key in summary}
    if len(torque) > 1:  # an impact without duration has neither
        planned["torque_ratio"] = float(np.abs(torque / a["torque_limit"]).max())
    if len(ground) and len(a["polygon"]):
        planned["zmp_margin_m"] = float(margin(a["polygon"], zmp(ground)).min())
        soles = sum(name.startswith("sole_") for name in a)  # wrenches of supporting hands come after theirs
        planned["sole_force_N"] = float(a["collision_sole_wrench"][:, 2 : 6 * soles : 6].min())
    out = {"planned": planned}
    names = {"torque_ratio": "torque_ratio_by_phase", "zmp_margin_m": "zmp_margin_by_phase_m"}
    for name, by_phase in (("simulated", {key: key for key in names}), ("replayed", names)):
        report = summary.get(name) or {}
        numbers = {key: report[key] for key in keys if key in report}
        for key, source in by_phase.items():
            found = report.get(source) or {}
            numbers |= {key: found["collision"]} if "collision" in found else {}
        if numbers:
            out["simulated" if name == "simulated" else replay_name(summary)] = numbers
    return out


def collide_once(
    file: CollisionFile, at_contact: Mapping[str, Any], *, accuracy: float = 1e-2
) -> dict[str, Any]:
    """One collision of a problem's robot with its target, as a table with units in its keys.

    at_contact : state at contact and collision model, by the keys of docs/sweeps.md.
    accuracy : required relative accuracy of the impulse; a larger estimated error of freezing is reported.

    Returns the measures of docs/sweeps.md; ``target``, its results after the collision; ``joints``, the
    largest torque demand [N m] and the limit of each, by decreasing ratio; and ``caution`` if the estimated
    error of freezing is too large, ``again`` if the target is touched again, which no measure has, and
    ``drifts`` if a robot that floats freely has momentum. If the collision is impossible there is only
    ``reason``.
    For a saved result with unchanged contact also ``saved`` (`planned_numbers`), and ``believe``, which of
    its numbers and the model's to trust if they differ.

    Raises
    ------
    InputError : a value that the problem file or [at_contact] refuses.
    """
    section, content = check_at_contact(at_contact), file.content
    record = None if section.result is None else load_record(section.result)
    # A horizon of the caller's may be shorter than the saved contact.
    extended = record is not None and "horizon" not in section.model_fields_set
    if record is not None and extended:
        section = section.model_copy(update={"horizon": _horizon(record, section.horizon)})
    robot = content.make_robot(file.path.parent)
    striker, (stance, start) = content.problem.striker, content.stance_at_impact(robot)
    states = ContactStates(robot=robot, striker=striker, stance=stance, start=start, folder=Path())
    model = collision_model(content, robot, stance, section, accuracy)
    head: dict[str, Any] = {"problem": content.problem.name or file.path.stem, "robot": robot.name}
    head |= {"model": section.model}
    head |= {"freezes": section.freezes} if section.model == "sdc" else {}
    if isinstance(model, RigidImpact):
        head["coefficient_of_restitution"] = model.coefficient_of_restitution
    point = tuple(map(float, content.problem.point))
    posture = states.posture(section.posture, section.result, point)
    if isinstance(posture, str):
        return {**head, "reason": posture}
    speed = None if section.speed is None else np.array([section.speed])
    joints = {name: np.array([angle]) for name, angle in section.joints.items()}
    normal = np.asarray(model.normal)
    state = states.compute(posture, joints, speed, normal, 1, velocity=section.velocity)
    state = state.approaching(model.target.speed_before())
    if state.reason[0]:
        return {**head, "reason": str(state.reason[0])}
    collision = _collide(model, state, section)
    for resolving, _ in finer(model, np.array([collision.duration])):
        collision = _collide(resolving, state, section)
    if not collision.separated:
        return {**head, "reason": _CONTACT_DOES_NOT_END if extended and section.freezes else NOT_ENDED}
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for m in MEASURES.values() for name in m.outputs):
        value = getattr(collision, name)
        found[name] = None if value is None else np.asarray(value, dtype=float)[None]
    limit = servo_settings(robot, section)["torque_limit"]
    batch = CollisionResults(
        found=found,
        states=state,
        robot=robot,
        torque_limit=limit[None],
        polygon=posture.polygon,
    )
    available = {name: m for name, m in MEASURES.items() if all(found[o] is not None for o in m.outputs)}
    if weightless(model):
        available.pop("sole_force_N", None)
    numbers = {name: float(measure.of(batch)[0]) for name, measure in available.items()}
    target = model.target.with_units(collision.target_result.values())
    if collision.tangential_velocity is not None:
        target |= tangential_outcome(collision.tangential_velocity)
    found = {**head, **numbers, "target": target, "joints": _joints(collision, robot, limit)}
    found |= {"caution": collision.caution} if collision.caution else {}
    again = meets_again(model.target, collision)
    found |= {"again": again} if again else {}
    if record is None and (drifts := _drifts(robot, stance, state.q[0], state.v[0])):
        found |= {"drifts": drifts}
    return plain(found | ({} if record is None else _saved(file, section, record)))


_STILL_APPROACHES = 0.05  # speed after a touch over the speed of approach; less is a push of the servo


def meets_again(target: Target, collision: Collision) -> str:
    """Caution about a nail or a board that the striker, still on its way, touches again; "" if it does not.

    They slow down after the touch, which ends as soon as they are ahead of the striker.
    """
    if not (target.met_again and collision.separated) or collision.target_result.get("broken"):
        return ""
    before, *_, after = collision.hand_speed - float(target.speed_before())
    if not after > _STILL_APPROACHES * before:
        return ""
    return (
        f"the striker goes on at {collision.hand_speed[-1]:.3g} m/s and touches the {target.word} again: "
        "this is the first touch alone, and the replays of a plan (impactopt solve) have all of them"
    )


def _drifts(robot: Robot, stance: Stance, q: Array, v: Array) -> str:
    """Caution about momentum of a robot that floats without gravity at q (nq,), v (nv,); "" on a stance."""
    if not isinstance(stance, Free) or robot.model.gravity.linear.any():
        return ""
    momentum = pin.computeCentroidalMomentum(robot.model, robot.model.createData(), q, v)
    return (
        f"the floating robot has a momentum of {np.linalg.norm(momentum.linear):.3g} N s and "
        f"{np.linalg.norm(momentum.angular):.3g} N m s at contact: one that begins at rest has none, and "
        "needs faster joints; take a result of impactopt solve"
    )


def _horizon(record: Record, default: float) -> float:
    """Horizon [s] by which a saved contact is over in any model.

    It is a multiple of the default, as compiled functions depend on it.
    """
    duration = float(record.arrays["collision_time"][-1]) if "collision_time" in record.arrays else 0.0
    return default * max(1, ceil(1.5 * duration / default))


def _saved(file: CollisionFile, section: AtContact, record: Record) -> dict[str, Any]:
    """Saved measures to show beside those of a collision from the same state."""
    given = section.model_fields_set - {"result", "model", "freezes", "horizon"}
    # for another problem or state they would mislead
    same = record.problem and read_toml(record.problem) == file.data
    saved = planned_numbers(record) if same and not given else {}
    if not saved:
        return {}
    # an unknown status is of a newer version, as in `keep_record`
    if (status := record.summary.get("status")) in [s.value for s in Status if not s.usable]:
        return {"saved": saved, "believe": _NOT_SOLVED.format(status)}
    often = f"at contact and {section.freezes} times during it" if section.freezes else "at contact"
    return {"saved": saved, "believe": _MODEL_ERRORS[section.model].format(often)}


def _joints(collision: Collision, robot: Robot, limit: Array) -> list[dict[str, Any]]:
    """Largest torque demand and limit of each joint, in its `unit`, by decreasing ratio."""
    if collision.demand is None:
        return []
    units = np.where(robot.prismatic, "N", "N m").tolist()
    peaks = zip(robot.joint_names, units, np.abs(collision.demand).max(axis=0), limit, strict=True)
    rows = [
        {"joint": joint, "unit": unit, "torque_Nm": tau, "limit_Nm": most, "ratio": tau / most}
        for joint, unit, tau, most in peaks
    ]
    return sorted(rows, key=lambda row: -row["ratio"])


def _collide(model: CollisionModel, state: States, section: AtContact) -> Collision:
    settings = servo_settings(model.robot, section)
    settings |= {name: x[0] for name, x in state.reference_settings.items()}
    # a point mass has no servo, and the paper's SDC no stiffness
    known = getattr(model, "settings", settings)
    given = {name: x for name, x in settings.items() if name in known}
    q, v, torque = state.q[0], state.v[0], state.torque[0]
    return model.collide(q, v, torque, require_separation=False, **given)
