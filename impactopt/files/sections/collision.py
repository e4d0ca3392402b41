"""Sections that a collision needs: robot, target, contact, and how the robot stands.

A problem file has them, and others that make a plan of them (`impactopt.files.problem_file`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

from pydantic import ConfigDict, Field, PlainValidator, create_model

from impactopt.arrays import Array
from impactopt.bodies.world import TargetBody
from impactopt.contact import laws, targets
from impactopt.contact.friction import ContactFriction
from impactopt.errors import InputError
from impactopt.files.sections.robot import RobotSection
from impactopt.files.sections.values import (
    AtLeastOne,
    ContactDuration,
    Duration,
    Fractions,
    HandNames,
    Positive,
    Posture,
    Preset,
    Restitution,
    Section,
    UnitVector,
    Vector,
    one_of,
    optional,
    required,
    section_of,
    usual,
)
from impactopt.kinematics.stance import USUAL_POSTURE, BothSoles, FixedBase, Free, OneSole, Stance
from impactopt.problem.checks import MOST_FREEZES, MOST_TOUCHES
from impactopt.problem.phases import Phase, StancePhase, impact_phase, phase_coordinates, stance_at_impact
from impactopt.robots.robot import Robot

TargetKind: Any = one_of(kind.word for kind in targets.TARGETS)
LawKind: Any = one_of(kind.word for kind in laws.LAWS)
Body: Any = section_of(TargetBody)


class Target(Section):
    """Target of the impact; the keys depend on its kind."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "target_kind"
    apart: ClassVar[tuple[str, ...]] = ("body",)
    target_kind: TargetKind = usual(targets.TARGETS[0].word, "kind of target", "kind")
    body: Body = optional("")


class _KnownTarget(Target):
    """Target of a known kind, without other keys."""

    model_config = ConfigDict(extra="forbid")


class Contact(Section):
    """Contact between hand and target; the keys depend on the law."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "law"
    law: LawKind = usual(laws.LAWS[0].word, "contact law")


class _KnownContact(Contact):
    """Contact of a known law, without other keys."""

    model_config = ConfigDict(extra="forbid")


TARGETS: dict[str, type[Target]] = {kind.word: section_of(kind, _KnownTarget) for kind in targets.TARGETS}
LAWS: dict[str, type[Contact]] = {kind.word: section_of(kind, _KnownContact) for kind in laws.LAWS}

AnyFile = TypeVar("AnyFile", bound=Section)


def with_kinds(file: type[AnyFile], data: Mapping[str, Any]) -> type[AnyFile]:
    """The model of a file, with [target] and [contact] of the kinds in its data."""
    target = _section_of_kind(data.get("target"), Target, TARGETS)
    contact = _section_of_kind(data.get("contact"), Contact, LAWS)
    return cast(type[AnyFile], _file_with(file, target, contact))


@cache  # a sweep reads thousands of files
def _file_with(file: type[Section], target: type[Section], contact: type[Section]) -> type[Section]:
    fields: dict[str, Any] = {"target": (target, ...), "contact": (contact, ...)}
    return create_model(file.__name__, __base__=file, **fields)


def _section_of_kind(given: Any, unknown: type[Section], kinds: Mapping[str, type[Section]]) -> type[Section]:
    """The section of the kind that is given, or of the default; `unknown` for another word."""
    choice = unknown.model_fields[unknown.choice]
    word = choice.default
    if isinstance(given, Mapping):
        word = given.get(choice.alias or unknown.choice, word)
    return kinds.get(word, unknown) if isinstance(word, str) else unknown


class ProblemSection(Section):
    """The robot, its striker, and the hit point."""

    name: str = optional("name of the problem in reports")
    robot: Preset = optional("see `impactopt robots`; else a section [robot]")
    striker: str = required("the robot's striker")
    point: Vector = required(
        "hit point: x forward, y left, z up from the ground, or from a fixed base [m]", "point_m"
    )
    normal: UnitVector = required("direction in which the target is pushed")
    start: Posture = usual(USUAL_POSTURE, "start posture: its name, or a configuration of Pinocchio")
    near_contact: Posture = optional(
        "posture near which the first initial guess is at contact, given likewise"
    )


class StanceSection(Section):
    """Fixed soles, and supporting hands."""

    soles: str = usual("both", '"both", or one; "none": the robot floats freely')
    hands: HandNames = usual(
        [], "strikers that are fixed at their places in the start posture; see [terms.grip]"
    )


class StancePhaseSection(Section):
    """A stance phase, in which the same soles stand."""

    soles: list[str] = required("names of the soles that stand")
    duration: Duration = optional(
        "duration [s]; the phase with the impact has those of [swing] and [follow]",
        "duration_s",
    )
    intervals: int = optional("intervals of the spline, at least 6, by default 12")
    grading: AtLeastOne = optional(
        "longest over shortest interval, the short ones at the contact, by default 3"
    )
    steps: dict[str, list[float]] = optional(
        "by sole that touches down: forward and to the left [m], such as { left = [0.3, 0.0] }",
        "steps_m",
    )

    def build(self) -> StancePhase:
        given = self.given()
        soles, steps = tuple(given.pop("soles")), given.pop("steps", {})
        if "duration" not in given and given:
            raise InputError(
                f"[[stances]]: the phase on {' and '.join(soles)} has no duration_s: give it one, or leave "
                f"{' and '.join(given)} out, as for the phase with the impact"
            )
        return StancePhase(soles=soles, phase=Phase(**given) if given else None, steps=steps)


FrictionSection: Any = section_of(ContactFriction)


def touches_or_order(value: Any) -> Any:
    """A whole number from 1 to 4, or a list of names."""
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return tuple(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_TOUCHES:
        raise ValueError(f"give a whole number from 1 to {MOST_TOUCHES}, or a list of names")
    return value


Touches = Annotated[Any, PlainValidator(touches_or_order)]


class CollisionSection(Section):
    """Model and discretization of the collision."""

    collision: Literal["rigid", "virtual-mass", "sdc-paper", "sdc", "full", "auto"] = optional(
        '"full": the whole equation of motion; "sdc": frozen at contact; "sdc-paper": frozen, by the paper; '
        '"auto": the cheapest that is accurate enough; "virtual-mass", "rigid": no duration',
        "model",
    )
    freezes: Annotated[int, Field(ge=0, le=MOST_FREEZES)] = optional('of the model "sdc", during contact')
    auto_impulse_pct: Positive = optional('of "auto": largest change of the impulse by full dynamics [%]')
    auto_zmp_mm: Positive = optional('of "auto": largest change of the ZMP [mm]')
    coefficient_of_restitution: Restitution = optional('of "rigid": speed of separation over approach')
    contact_duration: ContactDuration = optional(
        "time of compression and of restitution [s]",
        "duration_s",
    )
    collision_stages: Literal[2, 3] = optional("Radau IIA stages of each collocation element", "stages")
    touches: Touches = optional(
        "number of contacts with a board or a nail, or the ends of the contact's phases; left out: as of "
        "point masses, of a nail one"
    )
    compression: Fractions = optional("lengths of its collocation elements")
    restitution: Fractions = optional("lengths of its collocation elements")


# a rigid impact needs one key: the others are a plan's, and are not checked
_UNCHECKED: dict[str, Any] = {
    name: (object, optional("", info.alias))
    for name, info in CollisionSection.model_fields.items()
    if name != "coefficient_of_restitution"
}
RigidSection: Any = create_model(
    "RigidSection",
    __base__=CollisionSection,
    __doc__="[collision], of which only the coefficient of restitution is checked.",
    **_UNCHECKED,
)


class CollisionSections(Section):
    """A problem file as a collision needs it: the content of a plan's sections, of the type `object`, is not
    checked.

    `with_kinds` sets the classes of [target] and [contact].
    """

    problem: ProblemSection
    robot: RobotSection = optional("")
    target: Target
    contact: Contact
    friction: FrictionSection = optional("")
    second: object = optional("")
    stance: StanceSection = optional("")
    stances: list[StancePhaseSection] = optional("")
    swing: object = optional("")
    follow: object = optional("")
    collision: RigidSection = optional("")
    scenarios: object = optional("")
    obstacles: object = optional("")
    ground: object = optional("")
    objectives: object = optional("")
    objective: object = optional("")
    terms: object = optional("")
    solver: object = optional("")
    controller: object = optional("")

    def make_robot(self, folder: Path) -> Robot:
        """The robot of [robot], or the preset in [problem]."""
        section = RobotSection(preset=self.problem.robot) if self.robot is None else self.robot
        return section.make(folder)

    def robot_mistakes(self, folder: Path, error: InputError) -> list[tuple[tuple[str, ...], InputError]]:
        """All errors of `make_robot`, with their places; error : the first one."""
        if "robot" not in self.model_fields_set:
            return [(("problem", "robot"), error)]
        return [(("robot", *place), wrong) for place, wrong in self.robot.mistakes(folder, error)]

    def leg_mistake(self, folder: Path) -> InputError | None:
        """Mistake in the legs of a robot that cannot be built, if its model can be."""
        if "robot" not in self.model_fields_set:
            return None
        return self.robot.leg_mistake(folder, self.stance.soles if self.stance else "both")

    def make_stance(self, robot: Robot) -> Stance:
        """Stance of a robot by [stance]; InputError if the robot cannot have it."""
        if self.stance and self.stances:
            raise InputError("[stance] is one stance for the whole motion: leave it or [[stances]] out")
        soles = self.stance.soles if self.stance else "both"
        hands = tuple(self.stance.hands) if self.stance else ()
        stance: Stance = BothSoles(hands=hands) if soles == "both" else OneSole(soles, hands=hands)
        if soles == "none":
            if hands:
                raise InputError(
                    "[stance]: a robot that floats freely has no supporting hands: leave hands out"
                )
            stance = Free()
        if not robot.floating:
            if self.stance:
                raise InputError(f"robot {robot.name!r} has a fixed base: leave [stance] out")
            stance = FixedBase()
        stance.constraint_frames(robot)
        return stance

    def stance_at_impact(self, robot: Robot) -> tuple[Stance, Array]:
        """Stance of a robot at the impact, and a posture (nq,) in which its soles stand where they do then.

        They are those of the phase with the impact in [[stances]], after its steps, or of [stance] and the
        start posture.

        Raises
        ------
        InputError : the robot cannot have the stance or the posture, or the phases are not a possible
            sequence.
        """
        stance, start = self.make_stance(robot), self.make_start(robot)
        if not self.stances:
            return stance, start
        phases = [section.build() for section in self.stances]
        stance = stance_at_impact(robot, phases)
        return stance, phase_coordinates(robot, phases, start)[impact_phase(phases)].posture

    def check_one_striker(self) -> None:
        """InputError if there are two strikers, for commands that compute a collision alone."""
        if self.second is not None:
            raise InputError(
                "[second]: a collision model has one striker: leave the section out, or solve the problem"
            )

    def make_start(self, robot: Robot) -> Array:
        """The start posture (nq,); InputError for one that the robot cannot have."""
        return robot.given_posture(self.problem.start, name="start")
