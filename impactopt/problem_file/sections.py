"""The sections of a problem file: their keys and units.

Each model is a section; its fields are the keys, by their `alias` where a unit belongs to the name. `build`
makes the class `kind` from the keys that are given: defaults and further checks are that class's own, and
stand nowhere twice.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast, get_type_hints

from pydantic import Field, create_model, model_validator

from impactopt import extra_terms, objectives, terms
from impactopt.errors import InputError
from impactopt.presets import load_robot
from impactopt.problem import ImpactProblem, Phase
from impactopt.problem_file.contacts import Contact, Target
from impactopt.problem_file.section import Section, optional
from impactopt.problem_file.values import (
    Duration,
    Fraction,
    Fractions,
    IpoptOptions,
    NotNegative,
    PerJoint,
    Point2,
    Positive,
    Preset,
    Range,
    Restitution,
    UnitVector,
    Vector,
)
from impactopt.robot import Robot, Sole, Striker, Tool
from impactopt.scenario import Scenario
from impactopt.shapes import Capsule
from impactopt.sqp import SQPOptions
from impactopt.stance import BothSoles, FixedBase, OneSole
from impactopt.stance import Stance as Stances


class Problem(Section):
    name: str = optional()
    robot: Preset = optional()
    striker: str
    point: Vector = Field(alias="point_m")
    normal: UnitVector
    start: str = cast(str, ImpactProblem.start)


class Stance(Section):
    soles: str = "both"


class PhaseSection(Section):
    kind = Phase
    duration: Duration = Field(alias="duration_s")
    intervals: int = optional()
    grading: float = optional()


class Collision(Section):
    """`compression`, `restitution`: lengths of their collocation elements, as fractions; `stages` in each.

    `model`: "dynamics", or an impact without duration, to compare with: "rigid", "virtual mass".
    """

    collision: Literal["dynamics", "rigid", "virtual mass"] = optional("model")
    coefficient_of_restitution: Restitution = optional()
    contact_duration: Duration = optional("duration_s")
    collision_stages: Literal[2, 3] = optional("stages")
    compression: Fractions = optional()
    restitution: Fractions = optional()


class ScenarioSection(Section):
    kind = Scenario
    name: str
    mass: Positive = optional()
    stiffness: Positive = optional()
    damping: NotNegative = optional()
    missing: bool = optional()
    brake_after: Positive = optional("brake_after_s")
    torque: Positive = optional()
    cone_margin: NotNegative = optional("cone_margin_m")
    capture_margin: NotNegative = optional("capture_margin_m")


class Objective(Section):
    smoothness: NotNegative = optional()
    wrench_price: NotNegative = optional()
    return_price: NotNegative = optional()


class Weighted(Section):
    weight: float = optional()


class Impulse(Weighted):
    kind = objectives.Impulse


class PeakForce(Weighted):
    kind = objectives.PeakForce


class TargetEnergy(Weighted):
    kind = objectives.TargetEnergy


class Penetration(Weighted):
    kind = objectives.Penetration


class AngularMomentum(Weighted):
    kind = objectives.AngularMomentum


class Effort(Weighted):
    kind = objectives.Effort


class Objectives(Section):
    """What is maximized; if there are any, only those that are given."""

    impulse: Impulse = optional()
    peak_force: PeakForce = optional()
    target_energy: TargetEnergy = optional()
    penetration: Penetration = optional()
    angular_momentum: AngularMomentum = optional()
    effort: Effort = optional()


class TorqueLimit(Section):
    kind = terms.TorqueLimit
    fraction: Fraction = optional()
    collision: Fraction = optional()


class VelocityLimit(Section):
    kind = terms.VelocityLimit
    fraction: Fraction = optional()


class PositionLimit(Section):
    kind = terms.PositionLimit
    margin: NotNegative = optional("margin_rad")


class ContactWrenchCone(Section):
    kind = terms.ContactWrenchCone
    friction: Positive = optional()
    margin: NotNegative = optional("margin_m")
    collision_margin: NotNegative = optional("collision_margin_m")
    minimum_force: NotNegative = optional("minimum_force_N")


class Balance(Section):
    kind = terms.Balance
    capture_margin: NotNegative = optional("capture_margin_m")
    vertical_speed: NotNegative = optional("vertical_speed_m_s")
    angular_momentum: NotNegative = optional("angular_momentum_N_m_s")


class Incidence(Section):
    kind = terms.Incidence
    speed: NotNegative = optional("speed_m_s")


class LegExtension(Section):
    kind = terms.LegExtension
    minimum: Fraction = optional()


class Shape(Section):
    kind = Capsule
    frame: str
    radius: NotNegative = Field(alias="radius_m")
    start: Vector = optional("start_m")
    end: Vector = optional("end_m")


class Pair(Section):
    first: Shape
    second: Shape

    def build(self) -> tuple[Any, Any]:
        return self.first.build(), self.second.build()


class TorqueRate(Section):
    kind = extra_terms.TorqueRate
    limit: PerJoint = Field(alias="limit_N_m_s")


class SelfCollision(Section):
    kind = extra_terms.SelfCollision
    pairs: list[Pair] = optional()
    margin: NotNegative = optional("margin_m")

    def build(self) -> Any:
        pairs = None if self.pairs is None else tuple(pair.build() for pair in self.pairs)
        return self.kind(**{**self.given(), "pairs": pairs})


class KeepOut(Section):
    kind = extra_terms.KeepOut
    shapes: list[Shape]
    size: Vector = optional("size_m")
    margin: NotNegative = optional("margin_m")

    def build(self) -> Any:
        return self.kind(**{**self.given(), "shapes": tuple(shape.build() for shape in self.shapes)})


class HandOrientation(Section):
    kind = extra_terms.HandOrientation
    axis: UnitVector
    direction: UnitVector = optional()
    angle: Positive = optional("angle_rad")


class Gaze(Section):
    kind = extra_terms.Gaze
    frame: str
    axis: UnitVector
    angle: Positive = optional("angle_rad")
    since: NotNegative = optional()


class HitRegion(Section):
    kind = extra_terms.HitRegion
    radius: Positive = optional("radius_m")
    size: Point2 = optional("size_m")


class HitCone(Section):
    kind = extra_terms.HitCone
    angle: Positive = optional("angle_rad")


class Terms(Section):
    torque_limit: TorqueLimit = optional()
    velocity_limit: VelocityLimit = optional()
    position_limit: PositionLimit = optional()
    contact_wrench_cone: ContactWrenchCone = optional()
    balance: Balance = optional()
    incidence: Incidence = optional()
    leg_extension: LegExtension = optional()
    torque_rate: TorqueRate = optional()
    self_collision: SelfCollision = optional()
    keep_out: KeepOut = optional()
    hand_orientation: HandOrientation = optional()
    gaze: Gaze = optional()
    hit_region: HitRegion = optional()
    hit_cone: HitCone = optional()


_SQP_KEYS: dict[str, Any] = {
    name: (hint, optional()) for name, hint in get_type_hints(SQPOptions).items() if name != "time_limit"
}
SQP: Any = create_model("SQP", __base__=Section, **_SQP_KEYS)
SQP.kind = SQPOptions


class Solver(Section):
    name: Literal["ipopt", "sqp"] = optional()
    time_limit: Positive = optional("time_limit_s")
    ipopt: IpoptOptions = optional()
    sqp: SQP = optional()


class SoleSection(Section):
    kind = Sole
    name: str
    frame: str
    polygon: list[Point2] = Field(alias="polygon_m")


class StrikerSection(Section):
    kind = Striker
    name: str
    frame: str
    point: Vector = Field(alias="point_m")


class ToolSection(Section):
    kind = Tool
    name: str
    frame: str
    mass: Positive = Field(alias="mass_kg")
    center: Vector = Field(alias="center_m")
    inertia: Vector = Field(alias="inertia_kg_m2")
    head: Vector = Field(alias="head_m")


class RobotSection(Section):
    """A preset with changes, or a URDF; files are relative to the problem file.

    A preset keeps its own strikers beside the section's. A tool's inertia is its diagonal.
    """

    preset: Preset = optional()
    urdf: str = optional()
    srdf: str = optional()
    name: str = optional()
    floating: bool = optional()
    locked: dict[str, float] = optional("locked_rad")
    armature: PerJoint = optional("armature_kg_m2")
    kp: PerJoint = optional("kp_N_m_rad")
    kd: PerJoint = optional("kd_N_m_s_rad")
    torque_limit: PerJoint = optional("torque_limit_N_m")
    velocity_limit: PerJoint = optional("velocity_limit_rad_s")
    position_limit: dict[str, Range] = optional("position_limit_rad")
    soles: list[SoleSection] = optional()
    strikers: list[StrikerSection] = optional()
    tools: list[ToolSection] = optional()
    postures: dict[str, dict[str, float]] = optional("postures_rad")

    @model_validator(mode="after")
    def _one_source(self) -> RobotSection:
        if ("preset" in self.model_fields_set) == ("urdf" in self.model_fields_set):
            raise ValueError("give either preset or urdf")
        return self

    def make(self, folder: Path) -> Robot:
        """The robot; relative files are in `folder`."""
        options = self.given()
        for file in ("urdf", "srdf"):
            if file in options:
                options[file] = folder / options[file]
        if "soles" in options:
            options["soles"] = [sole.build() for sole in self.soles]
        if "position_limit" in options:
            options["position_limit"] = {j: (a, b) for j, (a, b) in options["position_limit"].items()}
        strikers = [striker.build() for striker in self.strikers] if options.pop("strikers", None) else []
        tools = [tool.build() for tool in self.tools] if options.pop("tools", None) else []
        if "urdf" in options:
            robot = Robot.from_urdf(options.pop("urdf"), **options)
        else:
            robot = load_robot(options.pop("preset"), **options)
        for striker in strikers:
            robot = robot.with_striker(striker)
        for tool in tools:
            robot = robot.with_tool(tool)
        return robot


class File(Section):
    """A whole problem file; its [target] and [contact] are of a kind (`with_kinds`)."""

    problem: Problem
    robot: RobotSection = optional()
    target: Target
    contact: Contact
    stance: Stance = optional()
    swing: PhaseSection = optional()
    follow: PhaseSection = optional()
    collision: Collision = optional()
    scenarios: list[ScenarioSection] = optional()
    objective: Objective = optional()
    objectives: Objectives = optional()
    terms: Terms = optional()
    solver: Solver = optional()

    def make_robot(self, folder: Path) -> Robot:
        """The robot of [robot], or the preset that [problem] names."""
        return self.robot.make(folder) if self.robot is not None else load_robot(self.problem.robot)

    def make_stance(self, robot: Robot) -> Stances:
        """What [stance] says of a robot; InputError for what it cannot stand on."""
        soles = self.stance.soles if self.stance else "both"
        stance: Stances = BothSoles() if soles == "both" else OneSole(soles)
        if not robot.floating:
            if self.stance:
                raise InputError(f"robot {robot.name!r} has a fixed base: leave [stance] out")
            stance = FixedBase()
        stance.soles(robot)
        return stance

    def arguments(self) -> dict[str, Any]:
        """Arguments of `ImpactProblem` but the robot and the stance, as far as the file gives them."""
        out = {name: value for name, value in self.problem.given().items() if name != "robot"}
        out |= {"law": self.contact.build(), "target": self.target.build()}
        out |= {name: getattr(self, name).build() for name in ("swing", "follow") if getattr(self, name)}
        out |= self.objective.given() if self.objective else {}
        if self.collision is not None:
            given = self.collision.given()
            first, second = ImpactProblem.collision_elements
            elements = given.pop("compression", first), given.pop("restitution", second)
            if "contact_duration" in given:
                given["contact_duration"] = tuple(given["contact_duration"])
            out |= {**given, "collision_elements": tuple(tuple(lengths) for lengths in elements)}
        if self.scenarios is not None:
            out["scenarios"] = tuple(scenario.build() for scenario in self.scenarios)
        for name, section in (("terms", self.terms), ("objectives", self.objectives)):
            if section is not None:
                found = (getattr(section, field) for field in type(section).model_fields)
                out[name] = tuple(part.build() for part in found if part is not None)
        return out
