"""State at contact and collision model of a sweep of collisions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, ValidationError

from impactopt.collision import CollisionModel
from impactopt.collision.frozen_models import frozen_model
from impactopt.errors import InputError
from impactopt.files.problem_file.diagnostics import mistakes_of, report_mistakes
from impactopt.files.problem_file.section import Section
from impactopt.files.problem_file.sections import File
from impactopt.files.problem_file.values import Positive
from impactopt.kinematics.stance import Stance
from impactopt.robots.robot import Robot
from impactopt.simulation.reference import FullDynamics

__all__ = ["NOT_ENDED", "AtContact", "check_at_contact", "collision_model", "full_names"]

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
    model: Literal["virtual-mass", "sdc-paper", "sdc", "full"] = "sdc"
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
    if section.model == "full":
        return FullDynamics(**options, step=_STEP)
    return frozen_model(section.model, section.freezes, accuracy=accuracy, **options)
