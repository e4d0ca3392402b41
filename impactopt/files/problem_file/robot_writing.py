"""Writes a robot as section [robot]: its source, and the differences from that."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.contact.fields import abouts
from impactopt.errors import InputError
from impactopt.files.problem_file.robot_sections import RobotSection
from impactopt.files.problem_file.toml import plain_value
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip
from impactopt.robots.checks import GIVEN
from impactopt.robots.robot import Robot, Sole, Striker, Tool

__all__ = ["robot_data", "sole_data", "striker_data"]

BY_JOINT = {
    "armature": "armature_kg_m2",
    "torque_limit": "torque_limit_N_m",
    "velocity_limit": "velocity_limit_rad_s",
    "kd": "kd_N_m_s_rad",
    "kp": "kp_N_m_rad",
}
ROUNDS = 4  # a torque limit changes the default of kd, and that the one of kp


def robot_data(robot: Robot, folder: Path) -> tuple[dict[str, Any], Robot]:
    """The section [robot] of a file in `folder`, {"preset": name} where that says it all; and its robot.

    Raises
    ------
    InputError : the robot was made from a model in Python.
    """
    data = _source(robot, folder)
    for _ in range(ROUNDS):
        built = RobotSection.model_validate(data).make(folder)
        more = _differences(built, robot)
        if not more:
            break
        for key, value in more.items():
            old = data.get(key)
            if isinstance(value, dict) and isinstance(old, (int, float)):
                old = dict.fromkeys(robot.joint_names, old)
            data[key] = {**(old or {}), **value} if isinstance(value, dict) else value
    return data, built


def _source(robot: Robot, folder: Path) -> dict[str, Any]:
    source = robot.source
    if source is None:
        raise InputError(
            f"robot {robot.name!r} was made from a model in Python, which no file can name: make it with "
            "`load_robot` or `Robot.from_urdf`"
        )
    options = {name: value for name, value in source.options.items() if value is not None}
    data: dict[str, Any] = {} if source.preset is None else {"preset": source.preset}
    if source.urdf is not None:
        data["urdf"] = _relative(source.urdf, folder)
    if source.mjcf is not None:
        data["mjcf"] = _relative(source.mjcf, folder)
    if options.get("inertias", GIVEN) != GIVEN:
        data["inertias"] = options["inertias"]
    if "srdf" in options:
        data["srdf"] = _relative(options["srdf"], folder)
    if "name" in options:
        data["name"] = options["name"]
    if "floating" in options and (source.mjcf is not None or not options["floating"]):
        data["floating"] = options["floating"]
    locked = options.get("locked", ())
    angles = locked if isinstance(locked, Mapping) else dict.fromkeys(locked, 0.0)
    if angles or (locked != () and source.preset is not None):
        data["locked_rad"] = plain_value(angles)
    for name, key in BY_JOINT.items():
        if isinstance(options.get(name), (int, float, Mapping)):
            data[key] = plain_value(options[name])
    if "soles" in options:
        data["soles"] = [sole_data(sole) for sole in options["soles"]]
    if options.get("strikers") and source.preset is None:
        data["strikers"] = [striker_data(striker) for striker in options["strikers"]]
    if source.tools:
        data["tools"] = [_tool(tool) for tool in source.tools]
    grips = {tool.name: _grip(tool.grip) for tool in robot.tools if tool.grip is not None}
    if grips:
        data["grips"] = grips
    postures = options.get("postures", {})
    named = {name: plain_value(angles) for name, angles in postures.items() if isinstance(angles, Mapping)}
    return data | ({"postures_rad": named} if named else {})


def _differences(built: Robot, robot: Robot) -> dict[str, Any]:
    """Keys of [robot] that make `built` more like `robot`."""
    out: dict[str, Any] = {}
    if built.name != robot.name:
        out["name"] = robot.name
    if built.joint_names != robot.joint_names:
        return out
    joints = robot.joint_names
    for name, key in BY_JOINT.items():
        old, new = getattr(built, name), getattr(robot, name)
        changed = {joint: float(b) for joint, a, b in zip(joints, old, new, strict=True) if a != b}
        if changed:
            out[key] = changed
            return out  # the others' defaults may follow from it
    limits = zip(joints, built.lower, built.upper, robot.lower, robot.upper, strict=True)
    moved = {joint: [float(c), float(d)] for joint, a, b, c, d in limits if (a, b) != (c, d)}
    if moved:
        out["position_limit_rad"] = moved
    if built.actuators != robot.actuators:
        out["actuators"] = _actuators(robot)
    if [sole_data(sole) for sole in built.soles] != [sole_data(sole) for sole in robot.soles]:
        out["soles"] = [sole_data(sole) for sole in robot.soles]
    apart = [list(pair) for pair in robot.disable_collisions if pair not in built.disable_collisions]
    if apart:
        out["disable_collisions"] = apart
    made = {tool.name for tool in (robot.source.tools if robot.source else ())}
    strikers = [
        striker_data(striker)
        for name, striker in robot.strikers.items()
        if name not in built.strikers or striker_data(built.strikers[name]) != striker_data(striker)
        if name not in made
    ]
    return out | ({"strikers": strikers} if strikers else {})


def _actuators(robot: Robot) -> list[dict[str, Any]]:
    """A section for all joints whose motors and gears are alike."""
    alike: dict[Actuator, list[str]] = {}
    for joint, actuator in zip(robot.joint_names, robot.actuators, strict=True):
        alike.setdefault(actuator, []).append(joint)
    usual = Actuator()
    return [
        {"joints": joints}
        | {
            told.key_of(field.name): value
            for field, told in abouts(Actuator)
            if (value := getattr(actuator, field.name)) != getattr(usual, field.name)
        }
        for actuator, joints in alike.items()
    ]


def _relative(path: Any, folder: Path) -> str:
    """A path relative to the folder if it is in or below it, else the whole path."""
    whole, base = Path(path).expanduser().resolve(), folder.resolve()
    return str(whole.relative_to(base) if whole.is_relative_to(base) else whole)


def sole_data(sole: Sole) -> dict[str, Any]:
    data: dict[str, Any] = {"name": sole.name, "frame": sole.frame, "polygon_m": sole.polygon.tolist()}
    if sole.parent is not None:
        data |= {"parent": sole.parent, "position_m": sole.placement.translation.tolist()}
        rotation = sole.placement.rotation
        data |= {} if np.array_equal(rotation, np.eye(3)) else {"rotation": rotation.tolist()}
    if sole.hinge is not None:
        data |= {"hinge": sole.hinge, "hinge_range_rad": float(sole.hinge_range)}
    return data


def striker_data(striker: Striker) -> dict[str, Any]:
    return {"name": striker.name, "frame": striker.frame, "point_m": striker.point.tolist()}


def _tool(tool: Tool) -> dict[str, Any]:
    return {
        "name": tool.name,
        "frame": tool.frame,
        "mass_kg": float(tool.mass),
        "center_m": tool.center.tolist(),
        "inertia_kg_m2": tool.inertia.tolist(),
        "head_m": tool.head.tolist(),
        **({} if tool.bar is None else {"bar_m": tool.bar.tolist(), "bar_width_m": float(tool.bar_width)}),
    }


def _grip(grip: SoftGrip) -> dict[str, Any]:
    return {
        "axis": grip.axis.tolist(),
        "point_m": grip.point.tolist(),
        "stiffness_N_m_rad": grip.stiffness,
        "damping_N_m_s_rad": grip.damping,
        "range_rad": grip.range,
    }
