"""Keys that a sweep of collisions can vary, and the role of each in a collision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from impactopt.collide.single_collision import AtContact
from impactopt.errors import InputError, did_you_mean
from impactopt.files.problem_file import key_place
from impactopt.files.problem_file.toml import Place

__all__ = ["SERVO", "Role", "role_of", "setting_of", "sweep_place"]

# a number of its own in each row; one that makes another posture; one that makes another model
Role = Literal["number", "point", "structure"]

SERVO = {
    ("robot", "kp_N_m_rad"): "kp",
    ("robot", "kd_N_m_s_rad"): "kd",
    ("robot", "torque_limit_N_m"): "torque_limit",
    ("at_contact", "kp_scale"): "kp",
    ("at_contact", "kd_scale"): "kd",
    ("at_contact", "torque_limit_scale"): "torque_limit",
}
_KINDS = {"target": "kind", "contact": "law"}
_STATE = (("at_contact", "speed_m_s"), ("at_contact", "joints_rad"))


def sweep_place(data: Mapping[str, Any], key: str) -> Place:
    """Place of a key path in the problem file's data, or in [at_contact]; units may be left out.

    Raises
    ------
    InputError : there is no such key, or one that no collision depends on.
    """
    if key.partition(".")[0] != "at_contact":
        place = key_place(data, key)
    else:
        place = ("at_contact", *_in_section(key))
    role_of(place)
    return place


def role_of(place: Place) -> Role:
    """Role of a key at this place in a collision; InputError if it has none."""
    table, *rest = place
    if table in _KINDS:
        return "structure" if rest == [_KINDS[str(table)]] else "number"
    if place[:2] in SERVO or place[:2] in _STATE:
        return "number"
    if place[:2] == ("problem", "point_m"):
        return "point"
    if table in ("problem", "robot", "stance", "at_contact") and rest != ["name"]:
        return "structure"
    key = ".".join(map(str, place))
    raise InputError(
        f"{key}: no collision depends on it; vary it in a sweep of solves, or vary a key of [target], "
        "[contact], [at_contact], [robot], [stance] or [problem]"
    )


def setting_of(place: Place, content: Any) -> str:
    """Name of a collision's setting (`Settings`) that a number of [target] or [contact] is."""
    table, key = str(place[0]), str(place[1])
    section = getattr(content, table)
    fields = {info.alias or name: name for name, info in type(section).model_fields.items()}
    return f"{table}_{fields[key]}"


def _in_section(key: str) -> tuple[str, ...]:
    _, *parts = key.split(".")
    known = {info.alias or name: name for name, info in AtContact.model_fields.items()}
    for alias, name in known.items():
        if parts and parts[0] in (alias, name):
            table = alias == "joints_rad"
            if len(parts) != 1 + table:
                raise InputError(
                    f"{key}: name one joint, as at_contact.{alias}.<joint>"
                    if table
                    else f"{key}: has no parts"
                )
            return (alias, *parts[1:])
    near = did_you_mean(parts[0] if parts else "", known)
    raise InputError(f"{key}: [at_contact] has no such key{near}; known are {', '.join(known)}")
