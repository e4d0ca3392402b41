"""Writing of problem files: differences of a problem and its robot from the defaults, with comments."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.bodies.world import TargetBody
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError, check_kind, named_table
from impactopt.files.problem_file.reading import ProblemFile
from impactopt.files.problem_file.sections import ELEMENTS, File, SolverSettings, comment_at, defaults_of
from impactopt.files.sections.collision import LAWS, TARGETS, Body, ProblemSection
from impactopt.files.sections.diagnostics import section_in
from impactopt.files.sections.robot import (
    ActuatorSection,
    GripSection,
    RobotSection,
    StrikerSection,
    ToolSection,
)
from impactopt.files.sections.values import Section
from impactopt.files.toml import plain_value, write_toml
from impactopt.kinematics.stance import OneSole
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import DEFAULT_TERMS
from impactopt.robots.actuators import Actuator
from impactopt.robots.build import locked_angles
from impactopt.robots.checks import GIVEN
from impactopt.robots.robot import Robot, Sole

ROBOT_KEYS = {name: info.alias or name for name, info in RobotSection.model_fields.items()}
BY_JOINT = ("armature", "torque_limit", "velocity_limit", "kd", "kp")
ROUNDS = 4  # of comparing with the robot: a torque limit changes the default of kd, and kd that of kp


def robot_data(robot: Robot, folder: Path) -> tuple[dict[str, Any], Robot]:
    """The section [robot] of a file in `folder`, {"preset": name} for an unchanged preset; and its robot.

    Raises
    ------
    InputError : the robot was made from a model in Python.
    """
    data = _source(robot, folder)
    for _ in range(ROUNDS):
        built = RobotSection.model_validate(data).make(folder)
        changes = _differences(built, robot)
        if not changes:
            break
        for key, value in changes.items():
            old = data.get(key)
            if isinstance(value, dict) and isinstance(old, (int, float)):
                old = dict.fromkeys(robot.joint_names, old)
            data[key] = {**(old or {}), **value} if isinstance(value, dict) else value
    return data, built


def _source(robot: Robot, folder: Path) -> dict[str, Any]:
    """Keys of [robot] from the robot's source: its preset or file, and the options given there."""
    source = robot.source
    if source is None:
        raise InputError(
            f"robot {robot.name!r} was made from a model in Python, which a file cannot contain: make it "
            "with `load_robot` or `Robot.from_urdf`"
        )
    options = {name: value for name, value in source.options.items() if value is not None}
    data: dict[str, Any] = {} if source.preset is None else {"preset": source.preset}
    if source.urdf is not None:
        data["urdf"] = relative_path(source.urdf, folder)
    if source.mjcf is not None:
        data["mjcf"] = relative_path(source.mjcf, folder)
    if options.get("inertias", GIVEN) != GIVEN:
        data["inertias"] = options["inertias"]
    if "srdf" in options:
        data["srdf"] = relative_path(options["srdf"], folder)
    if "name" in options:
        data["name"] = options["name"]
    if "floating" in options and (source.mjcf is not None or not options["floating"]):
        data["floating"] = options["floating"]
    if "gravity" in options:
        data["gravity_m_s2"] = plain_value(options["gravity"])
    locked = options.get("locked", ())
    angles = locked_angles(locked)
    if angles or (locked != () and source.preset is not None):
        data["locked_rad"] = plain_value(angles)
    for name in BY_JOINT:
        if isinstance(numbers := named_table(options.get(name)), (int, float, Mapping)):
            data[ROBOT_KEYS[name]] = plain_value(numbers)
    if "soles" in options:
        data["soles"] = [sole_data(sole) for sole in options["soles"]]
    if options.get("strikers") and source.preset is None:
        data["strikers"] = [section_data(StrikerSection, striker) for striker in options["strikers"]]
    if source.tools:
        data["tools"] = [section_data(ToolSection, tool) for tool in source.tools]
    grips = {tool.name: tool.grip for tool in robot.tools if tool.grip is not None}
    if grips:
        data["grips"] = {name: section_data(GripSection, grip) for name, grip in grips.items()}
    postures = options.get("postures", {})
    named = {
        name: plain_value(table)
        for name, angles in postures.items()
        if isinstance(table := named_table(angles), Mapping)
    }
    return data | ({"postures_rad": named} if named else {})


def _differences(built: Robot, robot: Robot) -> dict[str, Any]:
    """Keys of [robot] in which `built` differs from `robot`, or some of them if others depend on these."""
    out: dict[str, Any] = {}
    if built.name != robot.name:
        out["name"] = robot.name
    if built.joint_names != robot.joint_names:
        return out
    joints = robot.joint_names
    for name in BY_JOINT:
        old, new = getattr(built, name), getattr(robot, name)
        changed = {joint: float(b) for joint, a, b in zip(joints, old, new, strict=True) if a != b}
        if changed:
            out[ROBOT_KEYS[name]] = changed
            return out  # defaults of the others may depend on it
    limits = zip(joints, built.lower, built.upper, robot.lower, robot.upper, strict=True)
    moved = {joint: [float(c), float(d)] for joint, a, b, c, d in limits if (a, b) != (c, d)}
    if moved:
        out["position_limit_rad"] = moved
    if built.actuators != robot.actuators:
        out["actuators"] = _actuators(robot)
    if [sole_data(sole) for sole in built.soles] != [sole_data(sole) for sole in robot.soles]:
        out["soles"] = [sole_data(sole) for sole in robot.soles]
    pairs = [list(pair) for pair in robot.disable_collisions if pair not in built.disable_collisions]
    if pairs:
        out["disable_collisions"] = pairs
    of_tools = {tool.name for tool in (robot.source.tools if robot.source else ())}
    known, own = (
        {name: section_data(StrikerSection, striker) for name, striker in each.strikers.items()}
        for each in (built, robot)
    )
    strikers = [own[name] for name in own if own[name] != known.get(name) and name not in of_tools]
    return out | ({"strikers": strikers} if strikers else {})


def _actuators(robot: Robot) -> list[dict[str, Any]]:
    """A section for each group of joints with equal actuators, without passive joints, as of soft grips."""
    groups: dict[Actuator, list[str]] = {}
    for k in np.flatnonzero(~robot.passive):
        groups.setdefault(robot.actuators[k], []).append(robot.joint_names[k])
    return [
        {"joints": joints} | section_data(ActuatorSection, actuator, ("joints",))
        for actuator, joints in groups.items()
    ]


def relative_path(path: Any, folder: Path) -> str:
    """A path relative to the folder if it is in or below it, else the absolute path."""
    absolute, base = Path(path).expanduser().resolve(), folder.resolve()
    return str(absolute.relative_to(base) if absolute.is_relative_to(base) else absolute)


def sole_data(sole: Sole) -> dict[str, Any]:
    data: dict[str, Any] = {"name": sole.name, "frame": sole.frame, "polygon_m": sole.polygon.tolist()}
    if sole.parent is not None:
        data |= {"parent": sole.parent, "position_m": sole.placement.translation.tolist()}
        rotation = sole.placement.rotation
        data |= {} if np.array_equal(rotation, np.eye(3)) else {"rotation": rotation.tolist()}
    if sole.hinge is not None:
        data |= {"hinge": sole.hinge, "hinge_range_rad": float(sole.hinge_range)}
    return data


def write_problem(
    problem: ImpactProblem, *, solver: SolverSettings | None = None, folder: str | os.PathLike[str] = "."
) -> str:
    """Text of a problem's file, from which the same problem (`ImpactProblem.hash`) can be read.

    Defaults are left out; each key has a comment with its unit.

    Parameters
    ----------
    problem : with a robot that is a preset or read from a file, with or without changes.
    solver : the file's [solver] section.
    folder : folder of the file, to which the path of a URDF in or below it is relative.

    Raises
    ------
    InputError : contact laws, targets or terms that are not of this package; a robot built in Python.
    """
    data = problem_data(problem, folder=folder)
    if solver is not None:
        check_kind("solver", solver, SolverSettings)
        data["solver"] = _solver(solver)
    read = ProblemFile.from_data(data, Path(folder) / "problem.toml")
    if read.build().hash != problem.hash:
        raise InputError(
            f"the problem cannot be written to a file: its robot {problem.robot.name!r} has changes that a "
            "file cannot contain, such as links or frames of its model"
        )
    return write_toml(data, lambda place: comment_at(data, place))


def problem_data(problem: ImpactProblem, *, folder: str | os.PathLike[str] = ".") -> dict[str, Any]:
    """Data of a problem's file, without defaults; see `write_problem`."""
    check_kind("problem", problem, ImpactProblem)
    factories: dict[str, Any] = {f.name: f.default_factory for f in fields(ImpactProblem)}
    robot, built = robot_data(problem.robot, Path(folder))
    if problem.gains:
        robot["gains"] = [{"joints": list(g.joints), "factor": list(g.factor)} for g in problem.gains]
    preset_only = robot.keys() == {"preset"}
    postures = {"start": problem.start} | (
        {} if problem.near_contact is None else {"near_contact": problem.near_contact}
    )
    for key, given in postures.items():
        q = problem.robot.given_posture(given, name=key)
        if not isinstance(given, str) or not _equal(built.postures.get(given), q):
            postures[key] = q.tolist()
    data: dict[str, Any] = {
        "problem": {
            **_different(ProblemSection, {"name": problem.name}),
            **({"robot": robot["preset"]} if preset_only else {}),
            "striker": problem.striker,
            "point_m": problem.point.tolist(),
            "normal": problem.normal.tolist(),
            **_different(ProblemSection, postures),
        },
        **({} if preset_only else {"robot": robot}),
        "target": target_data(problem.target),
        "contact": law_data(problem.law),
    }
    stance = problem.stance
    fixed_hands = stance.held_hands(problem.robot)
    hands = {"hands": [hand.name for hand in fixed_hands]} if fixed_hands else {}
    data["stances"] = [
        {"soles": list(each.soles)}
        | ({} if each.phase is None else _section("stances", each.phase, ("soles", "steps")))
        | ({"steps_m": {name: list(step) for name, step in each.steps.items()}} if each.steps else {})
        for each in problem.stances
    ]
    if problem.floats:
        data["stance"] = {"soles": "none"}
    if (isinstance(stance, OneSole) and not problem.stances) or hands:
        data["stance"] = ({"soles": stance.name} if isinstance(stance, OneSole) else {}) | hands
    if problem.second is not None:
        data["second"] = _section("second", problem.second)
    for name, phase in (("swing", problem.swing), ("follow", problem.follow)):
        if phase != factories[name]():
            data[name] = _section(name, phase)
    elements = dict(zip(ELEMENTS, problem.collision_elements, strict=True))
    for name in ("collision", "objective"):
        part = _kind(name)
        values = {key: elements.get(key, getattr(problem, key, None)) for key in part.model_fields}
        data[name] = _different(part, values)
    data["scenarios"] = [_section("scenarios", scenario) for scenario in problem.scenarios]
    if problem.objectives != ImpactProblem.objectives:
        data["objectives"] = _parts(_kind("objectives"), problem.objectives)
    data["terms"] = _parts(_kind("terms"), [term for term in problem.terms if term not in DEFAULT_TERMS])
    if problem.body != TargetBody():
        data["target"]["body"] = section_data(Body, problem.body)
    data["obstacles"] = [_section("obstacles", obstacle) for obstacle in problem.obstacles]
    if problem.friction is not None:
        friction = _section("friction", problem.friction)
        data["friction"] = {"coefficient": problem.friction.coefficient} | friction
    if problem.ground is not None:
        data["ground"] = {"height_m": 0.0} | _section("ground", problem.ground)
    order = ["problem", *(name for name in File.model_fields if name != "problem")]
    return {name: data[name] for name in order if data.get(name)}


def _kind(name: str) -> Any:
    """The class of a file's section, by its name."""
    return section_in(File.model_fields[name].annotation)


def _section(name: str, thing: Any, without: Sequence[str] = ()) -> dict[str, Any]:
    """`section_data` of a file's section, by its name."""
    return section_data(_kind(name), thing, without)


def _parts(section: type[Section], things: Any) -> dict[str, Any]:
    """Sections of terms or objectives, by their names in the section above."""
    parts: dict[str, Any] = {name: info.annotation for name, info in section.model_fields.items()}
    kinds = {part.kind: (name, part) for name, part in parts.items()}
    out = {}
    for thing in things:
        if type(thing) not in kinds:
            raise InputError(
                f"the problem cannot be written to a file, which has no section for {type(thing).__name__}"
            )
        name, part = kinds[type(thing)]
        out[name] = section_data(part, thing)
    return {name: out[name] for name in section.model_fields if name in out}


def target_data(target: Target) -> dict[str, Any]:
    """Section of a target, without defaults."""
    return _of_kind("target", target, TARGETS, "kind")


def law_data(law: ContactLaw) -> dict[str, Any]:
    """Section of a contact law, without defaults."""
    return _of_kind("law", law, LAWS, "law")


def _of_kind(what: str, thing: Any, kinds: Mapping[str, type[Section]], key: str) -> dict[str, Any]:
    names = {section.kind: name for name, section in kinds.items()}
    if type(thing) not in names:
        raise InputError(
            f"the problem cannot be written to a file, which contains only data: its {what} "
            f"{type(thing).__name__} is a class in Python"
        )
    name = names[type(thing)]
    return {**({} if name == next(iter(kinds)) else {key: name}), **section_data(kinds[name], thing)}


def section_data(section: type[Section], thing: Any, without: Sequence[str] = ()) -> dict[str, Any]:
    """Data of the section of a thing, without defaults; without : keys that the thing does not have."""
    left_out = (section.choice, *section.apart, *without)
    names = [name for name in section.model_fields if name not in left_out]
    return _different(section, {name: getattr(thing, name) for name in names})


def _different(section: type[Section], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by key that are not the section's defaults."""
    defaults, out = defaults_of(section), {}
    for name, value in values.items():
        if name not in defaults or not _equal(defaults[name], value):
            out[section.model_fields[name].alias or name] = _written(name, value)
    return out


def _written(name: str, value: Any) -> Any:
    """A field's value in the file."""
    if value is None:  # only the margin of `any_margin` may be None without None being its default
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
