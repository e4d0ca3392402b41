"""The sections of a problem file: their keys and units.

Each model is a section; its fields are the keys, by their `alias` where a unit belongs to the name. `build`
makes the class `kind` from the keys that are given: defaults and further checks are that class's own, and
stand nowhere twice.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal, cast, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from impactopt import extra_terms, objectives, terms
from impactopt.contact.laws import SpringDamper
from impactopt.contact.targets import FreeMass
from impactopt.presets import load_robot
from impactopt.problem import ImpactProblem, Phase
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


def _optional(key: str | None = None) -> Any:
    """A key that may be left out; the class that is built has the default."""
    return Field(default=None, alias=key)


class Section(BaseModel):
    """A section; unknown keys, NaN, infinity and text where a number belongs are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None

    def given(self) -> dict[str, Any]:
        """The keys that the file has, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True)

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @model_validator(mode="after")
    def _can_be_built(self) -> Section:
        if self.kind is not None:
            self.build()
        return self


class Problem(Section):
    name: str = _optional()
    robot: Preset = _optional()
    striker: str
    point: Vector = Field(alias="point_m")
    normal: UnitVector
    start: str = cast(str, ImpactProblem.start)


class Target(Section):
    kind = FreeMass
    mass: Positive = Field(alias="mass_kg")


class Contact(Section):
    kind = SpringDamper
    stiffness: Positive = Field(alias="stiffness_N_m")
    damping: NotNegative = Field(alias="damping_N_s_m")


class Stance(Section):
    soles: str = "both"


class PhaseSection(Section):
    kind = Phase
    duration: Duration = Field(alias="duration_s")
    intervals: int = _optional()
    grading: float = _optional()


class Collision(Section):
    """`compression`, `restitution`: lengths of their collocation elements, as fractions; `stages` in each.

    `model`: "dynamics", or an impact without duration, to compare with: "rigid", "virtual mass".
    """

    collision: Literal["dynamics", "rigid", "virtual mass"] = _optional("model")
    coefficient_of_restitution: Restitution = _optional()
    contact_duration: Duration = _optional("duration_s")
    collision_stages: Literal[2, 3] = _optional("stages")
    compression: Fractions = _optional()
    restitution: Fractions = _optional()


class ScenarioSection(Section):
    kind = Scenario
    name: str
    mass: Positive = _optional()
    stiffness: Positive = _optional()
    damping: NotNegative = _optional()
    missing: bool = _optional()
    brake_after: Positive = _optional("brake_after_s")
    torque: Positive = _optional()
    cone_margin: NotNegative = _optional("cone_margin_m")
    capture_margin: NotNegative = _optional("capture_margin_m")


class Objective(Section):
    smoothness: NotNegative = _optional()
    wrench_price: NotNegative = _optional()
    return_price: NotNegative = _optional()


class Impulse(Section):
    kind = objectives.Impulse
    weight: float = _optional()


class PeakForce(Section):
    kind = objectives.PeakForce
    weight: float = _optional()


class TargetEnergy(Section):
    kind = objectives.TargetEnergy
    weight: float = _optional()


class Penetration(Section):
    kind = objectives.Penetration
    weight: float = _optional()


class AngularMomentum(Section):
    kind = objectives.AngularMomentum
    weight: float = _optional()


class Effort(Section):
    kind = objectives.Effort
    weight: float = _optional()


class Objectives(Section):
    """What is maximized; if there are any, only those that are given."""

    impulse: Impulse = _optional()
    peak_force: PeakForce = _optional()
    target_energy: TargetEnergy = _optional()
    penetration: Penetration = _optional()
    angular_momentum: AngularMomentum = _optional()
    effort: Effort = _optional()


class TorqueLimit(Section):
    kind = terms.TorqueLimit
    fraction: Fraction = _optional()
    collision: Fraction = _optional()


class VelocityLimit(Section):
    kind = terms.VelocityLimit
    fraction: Fraction = _optional()


class PositionLimit(Section):
    kind = terms.PositionLimit
    margin: NotNegative = _optional("margin_rad")


class ContactWrenchCone(Section):
    kind = terms.ContactWrenchCone
    friction: Positive = _optional()
    margin: NotNegative = _optional("margin_m")
    collision_margin: NotNegative = _optional("collision_margin_m")
    minimum_force: NotNegative = _optional("minimum_force_N")


class Balance(Section):
    kind = terms.Balance
    capture_margin: NotNegative = _optional("capture_margin_m")
    vertical_speed: NotNegative = _optional("vertical_speed_m_s")
    angular_momentum: NotNegative = _optional("angular_momentum_N_m_s")


class Incidence(Section):
    kind = terms.Incidence
    speed: NotNegative = _optional("speed_m_s")


class LegExtension(Section):
    kind = terms.LegExtension
    minimum: Fraction = _optional()


class Shape(Section):
    kind = Capsule
    frame: str
    radius: NotNegative = Field(alias="radius_m")
    start: Vector = _optional("start_m")
    end: Vector = _optional("end_m")


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
    pairs: list[Pair] = _optional()
    margin: NotNegative = _optional("margin_m")

    def build(self) -> Any:
        pairs = None if self.pairs is None else tuple(pair.build() for pair in self.pairs)
        return self.kind(**{**self.given(), "pairs": pairs})


class KeepOut(Section):
    kind = extra_terms.KeepOut
    shapes: list[Shape]
    size: Vector = _optional("size_m")
    margin: NotNegative = _optional("margin_m")

    def build(self) -> Any:
        return self.kind(**{**self.given(), "shapes": tuple(shape.build() for shape in self.shapes)})


class HandOrientation(Section):
    kind = extra_terms.HandOrientation
    axis: UnitVector
    direction: UnitVector = _optional()
    angle: Positive = _optional("angle_rad")


class Gaze(Section):
    kind = extra_terms.Gaze
    frame: str
    axis: UnitVector
    angle: Positive = _optional("angle_rad")
    since: NotNegative = _optional()


class HitRegion(Section):
    kind = extra_terms.HitRegion
    radius: Positive = _optional("radius_m")
    size: Point2 = _optional("size_m")


class HitCone(Section):
    kind = extra_terms.HitCone
    angle: Positive = _optional("angle_rad")


class Terms(Section):
    torque_limit: TorqueLimit = _optional()
    velocity_limit: VelocityLimit = _optional()
    position_limit: PositionLimit = _optional()
    contact_wrench_cone: ContactWrenchCone = _optional()
    balance: Balance = _optional()
    incidence: Incidence = _optional()
    leg_extension: LegExtension = _optional()
    torque_rate: TorqueRate = _optional()
    self_collision: SelfCollision = _optional()
    keep_out: KeepOut = _optional()
    hand_orientation: HandOrientation = _optional()
    gaze: Gaze = _optional()
    hit_region: HitRegion = _optional()
    hit_cone: HitCone = _optional()


_SQP_KEYS: dict[str, Any] = {
    name: (hint, _optional()) for name, hint in get_type_hints(SQPOptions).items() if name != "time_limit"
}
SQP: Any = create_model("SQP", __base__=Section, **_SQP_KEYS)
SQP.kind = SQPOptions


class Solver(Section):
    name: Literal["ipopt", "sqp"] = _optional()
    time_limit: Positive = _optional("time_limit_s")
    ipopt: IpoptOptions = _optional()
    sqp: SQP = _optional()


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

    preset: Preset = _optional()
    urdf: str = _optional()
    srdf: str = _optional()
    name: str = _optional()
    floating: bool = _optional()
    locked: dict[str, float] = _optional("locked_rad")
    armature: PerJoint = _optional("armature_kg_m2")
    kp: PerJoint = _optional("kp_N_m_rad")
    kd: PerJoint = _optional("kd_N_m_s_rad")
    torque_limit: PerJoint = _optional("torque_limit_N_m")
    velocity_limit: PerJoint = _optional("velocity_limit_rad_s")
    position_limit: dict[str, Range] = _optional("position_limit_rad")
    soles: list[SoleSection] = _optional()
    strikers: list[StrikerSection] = _optional()
    tools: list[ToolSection] = _optional()
    postures: dict[str, dict[str, float]] = _optional("postures_rad")

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
    """A whole problem file."""

    problem: Problem
    robot: RobotSection = _optional()
    target: Target
    contact: Contact
    stance: Stance = _optional()
    swing: PhaseSection = _optional()
    follow: PhaseSection = _optional()
    collision: Collision = _optional()
    scenarios: list[ScenarioSection] = _optional()
    objective: Objective = _optional()
    objectives: Objectives = _optional()
    terms: Terms = _optional()
    solver: Solver = _optional()

    def make_robot(self, folder: Path) -> Robot:
        """The robot of [robot], or the preset that [problem] names."""
        return self.robot.make(folder) if self.robot is not None else load_robot(self.problem.robot)

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
