"""The sections [target] and [contact]: which keys they have depends on the kind of target and of law."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar, Literal, TypeVar, cast

from pydantic import ConfigDict, Field, create_model

from impactopt import contact
from impactopt.problem_file.section import Section, optional
from impactopt.problem_file.values import AtLeastOne, NotNegative, Positive

TargetKind = Literal["free mass", "wall", "nail", "board"]
LawKind = Literal["spring damper", "Kelvin-Voigt", "Hunt-Crossley", "Hertz"]


class Target(Section):
    """What every target has: its kind. Of an unknown kind nothing else can be said."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "target_kind"
    target_kind: TargetKind = Field(default="free mass", alias="kind")


class FreeMass(Target):
    model_config = ConfigDict(extra="forbid")
    kind = contact.FreeMass
    mass: Positive = Field(alias="mass_kg")


class Wall(Target):
    model_config = ConfigDict(extra="forbid")
    kind = contact.RigidWall


class Nail(Target):
    model_config = ConfigDict(extra="forbid")
    kind = contact.Nail
    mass: Positive = Field(alias="mass_kg")
    resistance: Positive = Field(alias="resistance_N")
    hardening: NotNegative = optional("hardening_N_m")
    depth: NotNegative = optional("depth_m")


class Board(Target):
    model_config = ConfigDict(extra="forbid")
    kind = contact.Board
    mass: Positive = Field(alias="mass_kg")
    stiffness: Positive = Field(alias="stiffness_N_m")
    breaking_force: Positive = Field(alias="breaking_force_N")
    damping: NotNegative = optional("damping_N_s_m")


class Contact(Section):
    """What every contact has: its law. Of an unknown law nothing else can be said."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "law"
    law: LawKind = "spring damper"


class SpringDamper(Contact):
    model_config = ConfigDict(extra="forbid")
    kind = contact.SpringDamper
    stiffness: Positive = Field(alias="stiffness_N_m")
    damping: NotNegative = Field(alias="damping_N_s_m")


class KelvinVoigt(Contact):
    model_config = ConfigDict(extra="forbid")
    kind = contact.KelvinVoigt
    stiffness: Positive = Field(alias="stiffness_N_m")
    damping: NotNegative = Field(alias="damping_N_s_m")


class HuntCrossley(Contact):
    model_config = ConfigDict(extra="forbid")
    kind = contact.HuntCrossley
    stiffness: Positive = Field(alias="stiffness_N_mp")  # p is the exponent
    dissipation: NotNegative = Field(alias="dissipation_s_m")
    exponent: AtLeastOne = optional()


class Hertz(Contact):
    model_config = ConfigDict(extra="forbid")
    kind = contact.HertzDamped
    stiffness: Positive = Field(alias="stiffness_N_m1_5")  # N/m^1.5
    damping: NotNegative = Field(alias="damping_N_s_m1_25")  # N s/m^1.25


TARGETS: dict[str, type[Target]] = {"free mass": FreeMass, "wall": Wall, "nail": Nail, "board": Board}
LAWS: dict[str, type[Contact]] = {
    "spring damper": SpringDamper,
    "Kelvin-Voigt": KelvinVoigt,
    "Hunt-Crossley": HuntCrossley,
    "Hertz": Hertz,
}


File = TypeVar("File", bound=Section)


def with_kinds(file: type[File], data: Mapping[str, Any]) -> type[File]:
    """The model of a file whose [target] and [contact] are of the kinds that its data name."""
    found = {
        "target": _chosen(data, "target", "kind", TARGETS, Target, "free mass"),
        "contact": _chosen(data, "contact", "law", LAWS, Contact, "spring damper"),
    }
    return cast(type[File], _file_with(file, found["target"], found["contact"]))


@cache  # a sweep reads thousands
def _file_with(file: type[Section], target: type[Section], contact: type[Section]) -> type[Section]:
    fields: dict[str, Any] = {"target": (target, ...), "contact": (contact, ...)}
    return create_model(file.__name__, __base__=file, **fields)


def _chosen(
    data: Mapping[str, Any],
    section: str,
    key: str,
    kinds: Mapping[str, type[Section]],
    unknown: type[Section],
    default: str,
) -> type[Section]:
    given = data.get(section)
    name = given.get(key, default) if isinstance(given, Mapping) else default
    return kinds.get(name, unknown) if isinstance(name, str) else unknown
