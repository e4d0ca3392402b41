"""Writing of a problem and its robot to a file: differences from the defaults, with a comment to each key."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.bodies.world import TargetBody
from impactopt.contact.fields import abouts
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError
from impactopt.files.problem_file.reading import problem_file_from_data
from impactopt.files.problem_file.robot_sections import RobotSection
from impactopt.files.problem_file.sections import (
    ELEMENTS,
    LAWS,
    TARGETS,
    Body,
    CollisionSection,
    File,
    FollowSection,
    FrictionSection,
    GroundSection,
    ObjectiveSection,
    ObjectiveSections,
    ObstacleSection,
    ProblemSection,
    ScenarioSection,
    SecondSection,
    SolverSettings,
    StancePhaseSection,
    SwingSection,
    TermSections,
    comment_at,
)
from impactopt.files.problem_file.toml import plain_value, write_toml
from impactopt.files.problem_file.values import Section
from impactopt.kinematics.stance import OneSole
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import DEFAULT_TERMS
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip
from impactopt.robots.checks import GIVEN
from impactopt.robots.robot import Robot, Sole, Striker, Tool

__all__ = [
    "law_data",
    "problem_data",
    "robot_data",
    "sole_data",
    "striker_data",
    "target_data",
    "tool_data",
    "write_problem",
]

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
    if "gravity" in options:
        data["gravity_m_s2"] = plain_value(options["gravity"])
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
        data["tools"] = [tool_data(tool) for tool in source.tools]
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


def tool_data(tool: Tool) -> dict[str, Any]:
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


def write_problem(
    problem: ImpactProblem, *, solver: SolverSettings | None = None, folder: str | os.PathLike[str] = "."
) -> str:
    """A problem as the text of its file, which gives the same problem (`ImpactProblem.hash`) when read.

    Defaults are left out; each key has a comment with its unit.

    Parameters
    ----------
    problem : its robot is a preset or was read from a URDF, with or without changes.
    solver : the file's [solver] section.
    folder : that the file is to be in; a URDF in or below it is named relative to it.

    Raises
    ------
    InputError : what no file can say: a contact law, target or term of one's own; a robot built in Python.
    """
    data = problem_data(problem, folder=folder)
    if solver is not None:
        data["solver"] = _solver(solver)
    read = problem_file_from_data(data, where=Path(folder) / "problem.toml")
    if read.build().hash != problem.hash:
        raise InputError(
            f"the problem cannot be written to a file: its robot {problem.robot.name!r} is changed in what a "
            "file cannot say, such as links or frames of its model"
        )
    return write_toml(data, lambda place: comment_at(data, place))


def problem_data(problem: ImpactProblem, *, folder: str | os.PathLike[str] = ".") -> dict[str, Any]:
    """A problem as a problem file's data, without what is a default; see `write_problem`."""
    usual: dict[str, Any] = {f.name: f.default_factory for f in fields(ImpactProblem)}
    robot, built = robot_data(problem.robot, Path(folder))
    if problem.gains:
        robot["gains"] = [{"joints": list(g.joints), "factor": list(g.factor)} for g in problem.gains]
    named = robot.keys() == {"preset"}
    start = problem.start
    if not isinstance(start, str) or not _equal(built.postures.get(start), problem.start_posture):
        start = problem.start_posture.tolist()
    data: dict[str, Any] = {
        "problem": {
            **_different(ProblemSection, {"name": problem.name}),
            **({"robot": robot["preset"]} if named else {}),
            "striker": problem.striker,
            "point_m": problem.point.tolist(),
            "normal": problem.normal.tolist(),
            **_different(ProblemSection, {"start": start}),
        },
        **({} if named else {"robot": robot}),
        "target": target_data(problem.target),
        "contact": law_data(problem.law),
    }
    stance = problem.stance
    hands = {"hands": [hand.name for hand in held]} if (held := stance.held_hands(problem.robot)) else {}
    data["stances"] = [
        {"soles": list(each.soles)}
        | ({} if each.phase is None else _section(StancePhaseSection, each.phase, ("soles", "steps")))
        | ({"steps_m": {name: list(step) for name, step in each.steps.items()}} if each.steps else {})
        for each in problem.stances
    ]
    if problem.floats:
        data["stance"] = {"soles": "none"}
    if (isinstance(stance, OneSole) and not problem.stances) or hands:
        data["stance"] = ({"soles": stance.name} if isinstance(stance, OneSole) else {}) | hands
    if problem.second is not None:
        data["second"] = _section(SecondSection, problem.second)
    for name, section, phase in (
        ("swing", SwingSection, problem.swing),
        ("follow", FollowSection, problem.follow),
    ):
        if phase != usual[name]():
            data[name] = _section(section, phase)
    shape = dict(zip(ELEMENTS, problem.collision_elements, strict=True))
    for name, part in (("collision", CollisionSection), ("objective", ObjectiveSection)):
        values = {key: shape.get(key, getattr(problem, key, None)) for key in part.model_fields}
        data[name] = _different(part, values)
    data["scenarios"] = [_section(ScenarioSection, scenario) for scenario in problem.scenarios]
    if problem.objectives != ImpactProblem.objectives:
        data["objectives"] = _parts(ObjectiveSections, problem.objectives)
    data["terms"] = _parts(TermSections, [term for term in problem.terms if term not in DEFAULT_TERMS])
    if problem.body != TargetBody():
        data["target"]["body"] = _section(Body, problem.body)
    data["obstacles"] = [_section(ObstacleSection, obstacle) for obstacle in problem.obstacles]
    if problem.friction is not None:
        data["friction"] = {"coefficient": problem.friction.coefficient} | _section(
            FrictionSection, problem.friction
        )
    if problem.ground is not None:
        data["ground"] = {"height_m": 0.0} | _section(GroundSection, problem.ground)
    order = ["problem", *(name for name in File.model_fields if name != "problem")]
    return {name: data[name] for name in order if data.get(name)}


def _parts(section: type[Section], things: Any) -> dict[str, Any]:
    """Sections of their own for the terms or the objectives, by the names that they have in `section`."""
    parts: dict[str, Any] = {name: info.annotation for name, info in section.model_fields.items()}
    kinds = {part.kind: (name, part) for name, part in parts.items()}
    out = {}
    for thing in things:
        if type(thing) not in kinds:
            raise InputError(
                f"the problem cannot be written to a file, which knows no {type(thing).__name__}"
            )
        name, part = kinds[type(thing)]
        out[name] = _section(part, thing)
    return {name: out[name] for name in section.model_fields if name in out}


def target_data(target: Target) -> dict[str, Any]:
    """A target as a problem file's section, without what is a default."""
    return _of_kind("target", target, TARGETS, "kind")


def law_data(law: ContactLaw) -> dict[str, Any]:
    """A contact law as a problem file's section, without what is a default."""
    return _of_kind("law", law, LAWS, "law")


def _of_kind(what: str, thing: Any, kinds: Mapping[str, type[Section]], key: str) -> dict[str, Any]:
    names = {section.kind: name for name, section in kinds.items()}
    if type(thing) not in names:
        raise InputError(
            f"the problem cannot be written to a file, which is data: its {what} {type(thing).__name__} is "
            "made of functions in Python"
        )
    name = names[type(thing)]
    return {**({} if name == next(iter(kinds)) else {key: name}), **_section(kinds[name], thing)}


def _section(section: type[Section], thing: Any, without: Sequence[str] = ()) -> dict[str, Any]:
    """A thing that a section describes, without what is a default; `without`: keys that it has not."""
    left_out = (section.choice, *section.apart, *without)
    names = [name for name in section.model_fields if name not in left_out]
    return _different(section, {name: getattr(thing, name) for name in names})


def _different(section: type[Section], values: Mapping[str, Any]) -> dict[str, Any]:
    usual, out = section.defaults(), {}
    for name, value in values.items():
        if name not in usual or not _equal(usual[name], value):
            out[section.model_fields[name].alias or name] = _written(name, value)
    return out


def _written(name: str, value: Any) -> Any:
    """A field's value as the file has it."""
    if value is None:  # the one that may be None and is no default
        return "anywhere"
    if name in ("duration", "contact_duration") and value[0] == value[1]:
        return value[0]
    return plain_value(value)


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return a is not None and b is not None and np.array_equal(a, b)
    return bool(a == b)


def _solver(solver: SolverSettings) -> dict[str, Any]:
    limit = {} if solver.time_limit is None else {"time_limit_s": solver.time_limit}
    return {"name": solver.name, **limit, **{name: plain_value(o) for name, o in solver.options.items()}}
