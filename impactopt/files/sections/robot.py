"""The section [robot]: a preset with changes, or a URDF or MJCF with soles, strikers, gains and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from pydantic import model_validator

from impactopt.errors import InputError
from impactopt.files.sections.values import (
    Factor,
    Inertia,
    JointNames,
    Pair,
    PerJoint,
    Point2,
    Positive,
    Preset,
    Range,
    Rotation,
    Section,
    Vector,
    optional,
    required,
    section_of,
)
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip
from impactopt.robots.build import add_frame, check_count, lock_joints
from impactopt.robots.checks import check_legs
from impactopt.robots.gains import GainFactor, scaled_gains
from impactopt.robots.mjcf import read_mjcf
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot, Sole, Striker, Tool
from impactopt.robots.tools import hinged
from impactopt.robots.urdf import read_urdf


class SoleSection(Section):
    """A flat, convex sole, on a frame of the model or on a new one."""

    kind = Sole
    name: str = required("its name in [stance] and messages")
    frame: str = required("frame at the sole, z up out of the ground, x forward")
    polygon: list[Point2] = required("corners in its x-y plane, counter-clockwise [m]", "polygon_m")
    parent: str = optional("frame of the model in which a new `frame` is placed")
    position: Vector = optional("its position in the parent [m]", "position_m")
    rotation: Rotation = optional("its rotation: a matrix by rows; left out: none")

    hinge: Literal["x", "y", "z"] = optional(
        "of a leg of five joints: axis about which the foot may turn on the sole"
    )
    hinge_range: Positive = optional("how far a plan may turn it, either way [rad]", "hinge_range_rad")

    @model_validator(mode="after")
    def _placed_on_a_parent(self) -> SoleSection:
        if "parent" not in self.model_fields_set and {"position", "rotation"} & self.model_fields_set:
            raise ValueError("position_m and rotation place a new frame: name its parent")
        if "hinge_range" in self.model_fields_set and "hinge" not in self.model_fields_set:
            raise ValueError("hinge_range_rad is of a hinge: name its axis")
        return self

    def build(self) -> Any:
        given = self.given()
        position, rotation = given.pop("position", np.zeros(3)), given.pop("rotation", np.eye(3))
        if "parent" in given:
            given["placement"] = pin.SE3(np.array(rotation), np.array(position))
        return Sole(**given)


class StrikerSection(Section):
    """A striking point of the robot."""

    kind = Striker
    name: str = required("its name in [problem]")
    frame: str = required("frame of the model")
    point: Vector = required("position in the frame [m]", "point_m")


class GripSection(Section):
    """A compliant grip: a spring and a damper about one axis between hand and tool."""

    kind = SoftGrip
    axis: Vector = required("unit vector, in the frame")
    stiffness: Positive = required("stiffness of the spring [N m/rad]", "stiffness_N_m_rad")
    damping: Positive = required("damping of the damper [N m s/rad]", "damping_N_m_s_rad")
    point: Vector = optional("a point on the axis, in the frame [m]", "point_m")
    range: Positive = optional("how far the tool may turn either way [rad]", "range_rad")


class ToolSection(Section):
    """A rigid body that a link holds, with a striker."""

    kind = Tool
    name: str = required("name of the tool and of its striker")
    frame: str = required("frame at the link that holds the tool")
    mass: Positive = required("mass [kg]", "mass_kg")
    center: Vector = required("centre of mass in the frame [m]", "center_m")
    inertia: Inertia = required("about the centre of mass [kg m2]", "inertia_kg_m2")
    head: Vector = required("the striking point, in the frame [m]", "head_m")
    bar: Vector = optional("of a hammer: from the bar's back to its striking face [m]", "bar_m")
    bar_width: Positive = optional("of that bar [m]", "bar_width_m")


_OfActuator: Any = section_of(Actuator)


class ActuatorSection(_OfActuator):
    """A motor with its gear; the last section that names a joint holds. Left out: the robot's own."""

    joints: JointNames = required("names, or patterns such as `arm_*_4_joint`")

    def build(self) -> Any:
        return Actuator(**{name: value for name, value in self.given().items() if name != "joints"})


class GainSection(Section):
    """A factor on the stiffness of some joints; their damping gets its root, so the ratio is constant."""

    joints: JointNames = required("names, or patterns; NAME_grip: a tool in a soft grip")
    factor: Factor = required("a range is optimized over")

    @property
    def open(self) -> bool:
        """True if the factor is optimized."""
        return isinstance(self.factor, list)

    def build(self) -> Any:
        """Range of an optimized factor; None for a given one."""
        if not self.open:
            return None
        return GainFactor(joints=tuple(self.joints), factor=tuple(self.factor))

    @model_validator(mode="after")
    def _range_is_valid(self) -> GainSection:
        self.build()
        return self


class RobotSection(Section):
    """A preset with changes, or a URDF or MJCF; files are relative to the problem file.

    A preset keeps its own strikers and postures, and the numbers of other joints, beside the section's.
    """

    preset: Preset = optional("see `impactopt robots`; tables by joint or name add to its own")
    urdf: str = optional("the robot's URDF, in place of a preset")
    mjcf: str = optional("the robot's MJCF, in place of a preset")
    srdf: str = optional("named postures and rotors of the URDF")
    name: str = optional("what reports call it")
    floating: bool = optional("false: the root link is fixed to the ground")
    gravity: Vector = optional("gravity, by default the model's: 9.81 down [m/s2]", "gravity_m_s2")
    locked: dict[str, float] = optional("joints to remove, and their angles [rad]", "locked_rad")
    inertias: Literal["given", "repaired"] = optional(
        '"repaired": impossible ones are changed; `check` lists them'
    )
    armature: PerJoint = optional("reflected rotor inertia, of all or by joint [kg m2]", "armature_kg_m2")
    kp: PerJoint = optional("servo stiffness, of all or by joint [N m/rad]", "kp_N_m_rad")
    kd: PerJoint = optional("servo damping, of all or by joint [N m s/rad]", "kd_N_m_s_rad")
    torque_limit: PerJoint = optional("torque limit, of all or by joint [N m]", "torque_limit_N_m")
    velocity_limit: PerJoint = optional("velocity limit, of all or by joint [rad/s]", "velocity_limit_rad_s")
    position_limit: dict[str, Range] = optional("limits [lower, upper] by joint [rad]", "position_limit_rad")
    disable_collisions: list[Pair] = optional("pairs of links that may pass through each other")
    soles: list[SoleSection] = optional("flat feet; a preset's own ones are replaced")
    strikers: list[StrikerSection] = optional("striking points")
    tools: list[ToolSection] = optional("tools that the robot holds")
    grips: dict[str, GripSection] = optional("compliant grips, by the tool's name")
    actuators: list[ActuatorSection] = optional("motors and gears; other joints keep the preset's")
    gains: list[GainSection] = optional("factors on gains of servos, and on springs of soft grips")
    postures: dict[str, dict[str, float]] = optional(
        "named postures, angles by joint; others 0 or the SRDF's [rad]", "postures_rad"
    )

    @model_validator(mode="after")
    def _one_source(self) -> RobotSection:
        if len(self.model_fields_set & {"preset", "urdf", "mjcf"}) != 1:
            raise ValueError("give one of preset, urdf and mjcf")
        for key, of in (("srdf", {"urdf"}), ("inertias", {"urdf", "mjcf"})):
            if key in self.model_fields_set and not self.model_fields_set & of:
                raise ValueError(f"{key} belongs to {' or '.join(sorted(of))}: leave it out")
        return self

    def make(self, folder: Path) -> Robot:
        """The robot; paths are relative to `folder`."""
        for key in ("soles", "strikers", "tools"):
            check_count(key.removesuffix("s"), getattr(self, key) or ())
        options = self.given()
        for file in ("urdf", "mjcf", "srdf"):
            if file in options:
                options[file] = folder / options[file]
        if "soles" in options:
            options["soles"] = [sole.build() for sole in self.soles]
        if "position_limit" in options:
            options["position_limit"] = {j: (a, b) for j, (a, b) in options["position_limit"].items()}
        for part in ("strikers", "tools", "grips", "actuators", "gains"):  # are added to the robot below
            options.pop(part, None)
        strikers = [striker.build() for striker in self.strikers or ()]
        tools = [tool.build() for tool in self.tools or ()]
        grips = {name: section.build() for name, section in (self.grips or {}).items()}
        drives = {joint: each.build() for each in self.actuators or () for joint in each.joints}
        factors = {joint: g.factor for g in self.gains or () if not g.open for joint in g.joints}
        kind = next((key for key in ("urdf", "mjcf") if key in options), None)
        if kind is not None:
            read = Robot.from_urdf if kind == "urdf" else Robot.from_mjcf
            options |= {"actuators": drives} if drives else {}
            robot = read(options.pop(kind), **options)
        else:
            robot = load_robot(options.pop("preset"), **options)
            robot = robot.with_actuators(drives) if drives else robot
        for striker in strikers:
            robot = robot.with_striker(striker)
        for tool in tools:
            robot = robot.with_tool(tool)
        for name, grip in grips.items():
            robot = robot.with_grip(name, grip)
        return scaled_gains(robot, factors) if factors else robot

    @property
    def choices(self) -> tuple[GainFactor, ...]:
        """The optimized gains."""
        return tuple(section.build() for section in self.gains or () if section.open)

    def leg_mistake(self, folder: Path, fixed: str) -> InputError | None:
        """Mistake in the legs of the fixed soles, "both" or one by its name, regardless of other mistakes."""
        try:
            model = self._model(folder)
            chosen = [s for s in self.soles or () if fixed in ("both", s.name)]
            built = [section.build() for section in chosen]
            for sole in built:
                if sole.parent is not None:
                    add_frame(model, sole.frame, sole.parent, sole.placement, f"sole {sole.name!r}")
            model = hinged(model, built)
        except (InputError, AttributeError):
            return None  # it has no soles, or there is a mistake that is reported elsewhere
        try:
            check_legs(model, [(sole.name, sole.frame) for sole in built])
        except InputError as error:
            return error
        return None

    def _model(self, folder: Path) -> Any:
        """The pin.Model alone; InputError for a preset, which is sound."""
        locked = self.locked or {}
        if "urdf" in self.model_fields_set:
            floating = self.floating if "floating" in self.model_fields_set else True
            read = read_urdf(folder / self.urdf, floating=floating, repaired=True)
            return lock_joints(read.model, locked)
        if "mjcf" in self.model_fields_set:
            return lock_joints(read_mjcf(folder / self.mjcf, floating=self.floating).model, locked)
        raise InputError("a preset")

    def mistakes(self, folder: Path, error: InputError) -> list[tuple[tuple[str, ...], InputError]]:
        """All errors of `make`, with their keys; error : the first one.

        Each key is tried alone, on the robot of its file or preset.
        """
        bare = {key: getattr(self, key) for key in self.model_fields_set & _BARE}
        if _error_with(bare, folder):
            return [((), error)]
        found: list[tuple[tuple[str, ...], InputError]] = []
        for key, info in type(self).model_fields.items():
            if key in self.model_fields_set - _BARE:
                tried = {key, *_NEEDED.get(key, ())} & self.model_fields_set
                wrong = _error_with({**bare, **{k: getattr(self, k) for k in tried}}, folder)
                found += [((info.alias or key,), wrong)] if wrong else []
        return found or [((), error)]


_BARE = {"preset", "urdf", "mjcf", "srdf", "floating", "locked", "inertias"}  # of the model without changes
_NEEDED = {"grips": ("tools",), "gains": ("tools", "grips")}  # keys whose joints or tools a key refers to


def _error_with(keys: dict[str, Any], folder: Path) -> InputError | None:
    """Error of a robot with these keys alone, if there is one."""
    try:
        RobotSection.model_construct(_fields_set=set(keys), **keys).make(folder)
    except InputError as error:
        return error
    return None
