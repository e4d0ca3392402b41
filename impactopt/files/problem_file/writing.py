"""Writes a problem to a file: the differences from the defaults, with a comment to each key."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.bodies.shapes import TargetBody
from impactopt.errors import InputError
from impactopt.files.problem_file.contacts import LAWS, TARGETS, Body
from impactopt.files.problem_file.key_docs import comment_at
from impactopt.files.problem_file.reading import problem_file_from_data
from impactopt.files.problem_file.robot_writing import robot_data
from impactopt.files.problem_file.section import Section
from impactopt.files.problem_file.sections import (
    ELEMENTS,
    CollisionSection,
    File,
    FollowSection,
    GroundSection,
    ObjectiveSection,
    ObstacleSection,
    ProblemSection,
    ScenarioSection,
    SecondSection,
    SwingSection,
)
from impactopt.files.problem_file.solver_sections import SolverSettings
from impactopt.files.problem_file.term_sections import ObjectiveSections, TermSections
from impactopt.files.problem_file.toml import plain_value, write_toml
from impactopt.kinematics.stance import OneSole
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import DEFAULT_TERMS

__all__ = ["problem_data", "write_problem"]


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
        "target": _of_kind("target", problem.target, TARGETS, "kind"),
        "contact": _of_kind("law", problem.law, LAWS, "law"),
    }
    stance = problem.stance
    hands = {"hands": [hand.name for hand in held]} if (held := stance.held_hands(problem.robot)) else {}
    if isinstance(stance, OneSole) or hands:
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


def _of_kind(what: str, thing: Any, kinds: Mapping[str, type[Section]], key: str) -> dict[str, Any]:
    names = {section.kind: name for name, section in kinds.items()}
    if type(thing) not in names:
        raise InputError(
            f"the problem cannot be written to a file, which is data: its {what} {type(thing).__name__} is "
            "made of functions in Python"
        )
    name = names[type(thing)]
    return {**({} if name == next(iter(kinds)) else {key: name}), **_section(kinds[name], thing)}


def _section(section: type[Section], thing: Any) -> dict[str, Any]:
    """A thing that a section describes, without what is a default."""
    names = [name for name in section.model_fields if name not in (section.choice, *section.apart)]
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
