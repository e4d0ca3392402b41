"""Problem files: text to problem, and keys of all their sections.

Values can be changed by key paths; see `impactopt.files.sections.reading`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

from impactopt.errors import InputError
from impactopt.files.problem_file.sections import File, SolverSettings
from impactopt.files.sections.collision import with_kinds
from impactopt.files.sections.diagnostics import Mistake
from impactopt.files.sections.reading import Collector, CollisionFile, change_and_place, find_key, paths_in
from impactopt.files.toml import Place
from impactopt.kinematics.stance import Stance
from impactopt.problem.checks import check_names
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.checks import check_legs
from impactopt.robots.robot import Robot
from impactopt.simulation.controller import ControllerSettings


def change_data(data: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a problem file's data with changed values, as of `change_and_place`."""
    return change_and_place(File, data, settings)[0]


def key_place(data: Mapping[str, Any], key: str) -> Place:
    """Place of a key path in a problem file's data: full names of keys and indices of entries.

    Raises
    ------
    InputError : there is no such key.
    """
    try:
        return find_key(with_kinds(File, data), data, key)
    except KeyError as error:
        raise InputError(str(error.args[0])) from None


def key_paths(data: Mapping[str, Any]) -> Iterator[str]:
    """All key paths of a file with these data, given or not; entries of lists are those given."""
    yield from paths_in(with_kinds(File, data), data, "")


@dataclass(frozen=True, kw_only=True)
class ProblemFile(CollisionFile):
    """A problem file whose sections have been checked, all of them. Attributes as of `CollisionFile`."""

    sections: ClassVar[type[File]] = File
    content: File = field(repr=False)

    @cached_property
    def solver(self) -> SolverSettings:
        """Its [solver] section, or the defaults."""
        given = self.content.solver.model_dump(exclude_unset=True) if self.content.solver else {}
        options: dict[str, Any] = {}
        for solver in {"ipm", "sqp", "ipopt"} & given.keys():
            options[solver] = given.pop(solver)
        return SolverSettings(**given, options=options)

    @cached_property
    def controller(self) -> ControllerSettings:
        """Its [controller] section, or the defaults."""
        section = self.content.controller
        made: ControllerSettings = section.build() if section else ControllerSettings()
        return made

    def build(self) -> ImpactProblem:
        """The problem, with its robot.

        Raises
        ------
        InputError : mistakes that need the robot to be found: a URDF that is missing or not sound, an unknown
            joint or frame; else unknown strikers, postures and soles; else a point out of reach.
        """
        content, found = self.content, Collector()
        robot, stance = _built_robot(content, self.path.parent, found)
        if found:
            raise InputError(self.report(found.mistakes))
        assert robot is not None and stance is not None
        given = content.arguments()
        try:
            return ImpactProblem(robot=robot, stance=stance, **given)
        except InputError as error:
            found.add((), error)
            raise InputError(self.report(found.mistakes)) from error


def load_problem(path: str | os.PathLike[str]) -> ImpactProblem:
    """The problem of a TOML file, by its path, or by the name of one of the package's problems.

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    return read_problem_file(path).build()


def read_problem_file(
    path: str | os.PathLike[str], settings: Mapping[str, Any] | None = None, *, names: bool = False
) -> ProblemFile:
    """A problem file, by path or name, checked as far as possible without its robot.

    settings : values by key path that replace the file's (`change_data`).
    names : if there are mistakes, build the robot, too, to find wrong names of its parts in the same message.

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    return (_WithNames if names else ProblemFile).read(path, settings)


class _WithNames(ProblemFile):
    """A problem file whose mistakes include wrong names of the robot's parts."""

    @classmethod
    def wrong_names(cls, content: File, folder: Path) -> list[Mistake]:
        found = Collector()
        _built_robot(content, folder, found)
        return found.mistakes


def _built_robot(content: File, folder: Path, mistakes: Collector) -> tuple[Robot | None, Stance | None]:
    """The robot and its stance, None if wrong; adds mistakes of the robot and in names of its parts."""
    try:
        robot = content.make_robot(folder)
    except InputError as error:
        legs = content.leg_mistake(folder)
        if legs is not None:
            mistakes.add(("robot", "soles"), legs, first=True)
        for place, wrong in content.robot_mistakes(folder, error):
            mistakes.add(place, wrong)
        return None, None
    mistakes.attempt(("problem", "striker"), lambda: robot.striker(content.problem.striker))
    mistakes.attempt(("problem", "start"), lambda: content.make_start(robot))
    if (near := content.problem.given().get("near_contact")) is not None:
        mistakes.attempt(("problem", "near_contact"), partial(robot.given_posture, near, name="near_contact"))
    for k, phase in enumerate(content.stances or ()):
        for sole in phase.soles:
            mistakes.attempt(("stances", k, "soles"), partial(robot.sole, sole))
    stance = mistakes.attempt(("stance", "soles"), lambda: content.make_stance(robot))
    if stance is not None:
        try:
            check_legs(robot.model, [(sole.name, sole.frame) for sole in stance.soles(robot)])
        except InputError as error:
            mistakes.add(("robot", "soles"), error, first=True)
    if mistakes or stance is None:
        # the problem cannot be built, but names in its terms can be checked
        for name, term in content.given_terms():
            mistakes.attempt(("terms", name), partial(check_names, robot, term))
    return robot, stance
