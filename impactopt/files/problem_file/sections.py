"""The sections of a problem file: their keys and units.

Each model is a section; its fields are the keys, by their `alias` where a unit belongs to the name. `build`
makes the class `kind` from the keys that are given: defaults and further checks are that class's own, and
stand nowhere twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from impactopt.bodies.shapes import Ground, Obstacle
from impactopt.errors import InputError
from impactopt.files.problem_file.contacts import Contact, Target
from impactopt.files.problem_file.field_sections import section_of
from impactopt.files.problem_file.robot_sections import RobotSection
from impactopt.files.problem_file.section import Section, optional, required
from impactopt.files.problem_file.solver_sections import SolverSection
from impactopt.files.problem_file.term_sections import ObjectiveSections, TermSections
from impactopt.files.problem_file.values import (
    AtLeastOne,
    ContactDuration,
    Duration,
    Fractions,
    Freezes,
    HandNames,
    NotNegative,
    Positive,
    Posture,
    Preset,
    Restitution,
    UnitVector,
    Vector,
)
from impactopt.kinematics.stance import BothSoles, FixedBase, Free, OneSole, Stance
from impactopt.problem.problem import ImpactProblem, Phase
from impactopt.problem.scenario import Scenario
from impactopt.problem.second_striker import SecondStriker
from impactopt.robots.robot import Robot
from impactopt.simulation.controller import ControllerSettings

ELEMENTS = ("compression", "restitution")  # keys of ImpactProblem.collision_elements


def _of_problem(section: type[Section]) -> dict[str, Any]:
    """The defaults of the problem's own fields that a section sets."""
    known = {f.name: f.default for f in fields(ImpactProblem) if f.default is not MISSING}
    return {name: known[name] for name in section.model_fields if name in known}


class ProblemSection(Section):
    """The robot, its striker, and where it hits."""

    name: str = optional("what reports call the problem")
    robot: Preset = optional("see `impactopt robots`; or there is a section [robot]")
    striker: str = required("name of the robot's striker that hits")
    point: Vector = required(
        "where the striking point meets the target: x forward, y left, z up from the ground [m]", "point_m"
    )
    normal: UnitVector = required("direction in which the target is pushed")
    start: Posture = Field(
        default=ImpactProblem.start,
        description="posture to start from, at rest: its name, or a configuration, as Pinocchio has them",
    )

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return _of_problem(cls)


class SecondSection(Section):
    """Another striker that hits the same target at the same time."""

    kind = SecondStriker
    striker: str = required("name of the robot's other striker")
    point: Vector = required("where its striking point meets the target [m]", "point_m")


class StanceSection(Section):
    """The soles that are held, and the hands that hold on."""

    soles: str = Field(
        default="both",
        description='"both", or the name of the sole that is held; "none": the robot floats freely, in '
        "`impactopt collide` and sweeps of collisions",
    )
    hands: HandNames = Field(
        default=[],
        description="strikers that hold on, each to where it is in the start posture; see [terms.grip]",
    )


class PhaseSection(Section):
    """A phase of the motion: its duration and its spline."""

    kind = Phase
    duration: Duration = required(
        "one number, or [shortest, longest] for the solver to choose [s]", "duration_s"
    )
    intervals: int = optional(
        "number of the spline's intervals, at least 6; more make the motion freer and the solve longer"
    )
    grading: AtLeastOne = optional("longest over shortest interval, the short ones at the contact")


class SwingSection(PhaseSection):
    """Wind-up and strike, from rest to contact."""


class FollowSection(PhaseSection):
    """Follow-through, from the state after the impact to rest."""


class CollisionSection(Section):
    """Model and discretization of the collision."""

    collision: Literal["rigid", "virtual-mass", "sdc-paper", "sdc", "full", "auto"] = optional(
        '"full": the whole equation of motion; "sdc": frozen at contact; "sdc-paper": so, by the paper; '
        '"auto": the cheapest that is good enough; "virtual-mass", "rigid": no duration, to compare with',
        "model",
    )
    freezes: Freezes = optional('of the model "sdc", during contact')
    auto_impulse_pct: Positive = optional('of "auto": by how much full dynamics may change the impulse [%]')
    auto_zmp_mm: Positive = optional('of "auto": by how much they may change the ZMP [mm]')
    coefficient_of_restitution: Restitution = optional(
        'speed of separation over speed of approach, of the model "rigid"'
    )
    contact_duration: ContactDuration = optional(
        "[shortest, longest] time of compression and of restitution [s]; 0: no shortest time",
        "duration_s",
    )
    collision_stages: Literal[2, 3] = optional("Radau IIA stages of each collocation element", "stages")
    compression: Fractions = optional("lengths of its collocation elements, fractions that sum to 1")
    restitution: Fractions = optional("lengths of its collocation elements, fractions that sum to 1")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return _of_problem(cls) | dict(zip(ELEMENTS, ImpactProblem.collision_elements, strict=True))


ScenarioSection: Any = section_of(Scenario)
ObstacleSection: Any = section_of(Obstacle)
GroundSection: Any = section_of(Ground)
ControllerSection: Any = section_of(ControllerSettings)


class ObjectiveSection(Section):
    """The motion's style, and small prices that make the optimum unique."""

    style: Literal["natural", "strongest"] = optional(
        '"natural": prices on jerk, on the travel of joints and on ending away from the start posture; '
        '"strongest": none'
    )
    motion_price: NotNegative = optional("largest share of the objective that the style's prices may take")
    price_scale: NotNegative = optional("factor on the style's prices, as a plan has reduced them")
    smoothness: NotNegative = optional("price of accelerations [N s per (rad/s^2)^2 s]")
    wrench_price: NotNegative = optional("price of the soles' wrenches")
    return_price: NotNegative = optional("price of ending away from the start posture [N s per rad^2]")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return _of_problem(cls)


class File(Section):
    """A whole problem file; its [target] and [contact] are of a kind (`with_kinds`)."""

    problem: ProblemSection
    robot: RobotSection = optional("")
    target: Target
    contact: Contact
    second: SecondSection = optional("")
    stance: StanceSection = optional("")
    swing: SwingSection = optional("")
    follow: FollowSection = optional("")
    collision: CollisionSection = optional("")
    scenarios: list[ScenarioSection] = optional("")
    obstacles: list[ObstacleSection] = optional("")
    ground: GroundSection = optional("")
    objectives: ObjectiveSections = optional("")
    objective: ObjectiveSection = optional("")
    terms: TermSections = optional("")
    solver: SolverSection = optional("")
    controller: ControllerSection = optional("")

    def make_robot(self, folder: Path) -> Robot:
        """The robot of [robot], or the preset that [problem] names."""
        section = RobotSection(preset=self.problem.robot) if self.robot is None else self.robot
        return section.make(folder)

    def robot_mistakes(self, folder: Path, error: InputError) -> list[tuple[tuple[str, ...], InputError]]:
        """All that keeps `make_robot` from making one, `error` being the first of it, and where it is."""
        if "robot" not in self.model_fields_set:
            return [(("problem", "robot"), error)]
        return [(("robot", *place), wrong) for place, wrong in self.robot.mistakes(folder, error)]

    def leg_mistake(self, folder: Path) -> InputError | None:
        """Mistake in the legs of a robot that cannot be built, as far as its model can be."""
        if "robot" not in self.model_fields_set:
            return None
        return self.robot.leg_mistake(folder, self.stance.soles if self.stance else "both")

    def given_terms(self) -> Iterator[tuple[str, Any]]:
        """The terms that the file has, by their sections' names."""
        for name in TermSections.model_fields if self.terms is not None else ():
            section = getattr(self.terms, name)
            if section is not None:
                yield name, section.build()

    def make_stance(self, robot: Robot) -> Stance:
        """Stance of a robot that [stance] describes; InputError for what it cannot stand on."""
        soles = self.stance.soles if self.stance else "both"
        hands = tuple(self.stance.hands) if self.stance else ()
        stance: Stance = BothSoles(hands=hands) if soles == "both" else OneSole(soles, hands=hands)
        if soles == "none":
            if hands:
                raise InputError(
                    "[stance]: a robot that floats freely holds on with no hand: leave hands out"
                )
            stance = Free()
        if not robot.floating:
            if self.stance:
                raise InputError(f"robot {robot.name!r} has a fixed base: leave [stance] out")
            stance = FixedBase()
        stance.constraint_frames(robot)
        return stance

    def check_one_striker(self) -> None:
        """InputError if there are two, which models of a collision alone have not."""
        if self.second is not None:
            raise InputError(
                "[second]: a collision model has one striker: leave the section out, or solve the problem"
            )

    def make_start(self, robot: Robot) -> NDArray[np.float64]:
        """The posture (nq,) to start from; InputError for one that the robot cannot have."""
        start = self.problem.start
        return (
            robot.posture(start) if isinstance(start, str) else robot.check_configuration(start, name="start")
        )

    def arguments(self) -> dict[str, Any]:
        """Arguments of `ImpactProblem` but the robot and the stance, as far as the file gives them."""
        out = {name: value for name, value in self.problem.given().items() if name != "robot"}
        out |= {"law": self.contact.build(), "target": self.target.build()}
        out |= {
            name: getattr(self, name).build() for name in ("second", "swing", "follow") if getattr(self, name)
        }
        out |= self.objective.given() if self.objective else {}
        if self.collision is not None:
            given = self.collision.given()
            usual = zip(ELEMENTS, ImpactProblem.collision_elements, strict=True)
            elements = [given.pop(name, lengths) for name, lengths in usual]
            if "contact_duration" in given:
                given["contact_duration"] = tuple(given["contact_duration"])
            out |= {**given, "collision_elements": tuple(tuple(lengths) for lengths in elements)}
        if self.robot is not None and self.robot.choices:
            out["gains"] = self.robot.choices
        if self.target.body is not None:
            out["body"] = self.target.body.build()
        if self.obstacles is not None:
            out["obstacles"] = tuple(obstacle.build() for obstacle in self.obstacles)
        if self.ground is not None:
            out["ground"] = self.ground.build()
        if self.scenarios is not None:
            out["scenarios"] = tuple(scenario.build() for scenario in self.scenarios)
        for name, section in (("terms", self.terms), ("objectives", self.objectives)):
            if section is not None:
                found = (getattr(section, field) for field in type(section).model_fields)
                out[name] = tuple(part.build() for part in found if part is not None)
        return out
