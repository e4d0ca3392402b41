"""The sections [target] and [contact]: which keys they have depends on the kind of target and of law."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar, Literal, TypeVar, cast

from pydantic import ConfigDict, Field, create_model

from impactopt import contact
from impactopt.bodies.shapes import TargetBody
from impactopt.files.problem_file.section import Section, optional, required
from impactopt.files.problem_file.values import AtLeastOne, NotNegative, Positive

TargetKind = Literal["free mass", "wall", "nail", "board"]
LawKind = Literal["spring damper", "Kelvin-Voigt", "Hunt-Crossley", "Hertz"]


class Body(Section):
    """What the target looks like; its face's middle is the hit point."""

    kind = TargetBody
    shape: Literal["box", "ball", "none"] = optional("left out: what fits the target's kind")
    size: list[Positive] = optional("of a box [across, up, deep], of a ball [diameter] [m]", "size_m")


class Target(Section):
    """What is hit; the keys depend on its kind."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "target_kind"
    apart: ClassVar[tuple[str, ...]] = ("body",)
    target_kind: TargetKind = Field(default="free mass", alias="kind", description="what it is")
    body: Body = optional("")


class FreeMass(Target):
    """A mass that moves freely along the normal."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.FreeMass
    mass: Positive = required("[kg]", "mass_kg")


class Wall(Target):
    """A wall that never moves."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.RigidWall


class Nail(Target):
    """A nail in wood, which resists with resistance + hardening x depth."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.Nail
    mass: Positive = required("[kg]", "mass_kg")
    resistance: Positive = required("of the wood at its surface [N]", "resistance_N")
    hardening: NotNegative = optional("growth of the resistance with depth [N/m]", "hardening_N_m")
    depth: NotNegative = optional("in the wood before the blow [m]", "depth_m")


class Board(Target):
    """A board held at its edges: a modal mass on a spring that breaks."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.Board
    mass: Positive = required("modal mass where it is hit [kg]", "mass_kg")
    stiffness: Positive = required("of the bending [N/m]", "stiffness_N_m")
    breaking_force: Positive = required("of the spring [N]", "breaking_force_N")
    damping: NotNegative = optional("of the bending [N s/m]", "damping_N_s_m")


class Contact(Section):
    """What is between hand and target; the keys depend on the law."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "law"
    law: LawKind = Field(default="spring damper", description="what gives the force")


class SpringDamper(Contact):
    """A spring, and a damper that acts in compression only."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.SpringDamper
    stiffness: Positive = required("k [N/m]", "stiffness_N_m")
    damping: NotNegative = required("d [N s/m]", "damping_N_s_m")


class KelvinVoigt(Contact):
    """A spring and a damper, in compression and restitution."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.KelvinVoigt
    stiffness: Positive = required("k [N/m]", "stiffness_N_m")
    damping: NotNegative = required("d [N s/m]", "damping_N_s_m")


class HuntCrossley(Contact):
    """f = k x^p (1 + 1.5 alpha dx/dt)."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.HuntCrossley
    stiffness: Positive = required("k [N/m^p], p the exponent", "stiffness_N_mp")
    dissipation: NotNegative = required("alpha [s/m]", "dissipation_s_m")
    exponent: AtLeastOne = optional("p; 1.5 for a sphere on a plane")


class Hertz(Contact):
    """f = k x^1.5 + d x^0.25 dx/dt."""

    model_config = ConfigDict(extra="forbid")
    kind = contact.HertzDamped
    stiffness: Positive = required("k [N/m^1.5]", "stiffness_N_m1_5")
    damping: NotNegative = required("d [N s/m^1.25]", "damping_N_s_m1_25")


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
