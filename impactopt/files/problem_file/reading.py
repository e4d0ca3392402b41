"""Reads a problem file in two steps: the text is checked, and then the robot is built."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.problem_file.changes import change_and_place
from impactopt.files.problem_file.diagnostics import Mistake, key_lines, mistakes_of, report_mistakes
from impactopt.files.problem_file.names import problem_file
from impactopt.files.problem_file.sections import File, with_kinds
from impactopt.files.problem_file.solver_sections import SolverSettings, with_todays_names
from impactopt.files.problem_file.toml import (
    LONGEST_TEXT,
    Place,
    TOMLError,
    check_plain,
    plain_value,
    read_toml,
    text_with_control,
    write_toml,
)
from impactopt.problem.checks import MANY, check_names
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.checks import check_legs
from impactopt.simulation.controller import ControllerSettings

__all__ = [
    "ProblemFile",
    "SolverSettings",
    "load_problem",
    "parse_problem_file",
    "problem_file_from_data",
    "problem_from_data",
    "read_problem_file",
]

_T = TypeVar("_T")
# each entry is checked by itself, and most are part of the program: of thousands a file could say too much
_LISTS = (
    ("scenarios",),
    ("obstacles",),
    ("robot", "soles"),
    ("robot", "strikers"),
    ("robot", "tools"),
)


@dataclass(frozen=True, kw_only=True)
class ProblemFile:
    """A problem file whose text is sound.

    path, text : where it was read, and what it said, or says with its changes.  data : the same as tables.
    solver : its [solver] section.  controller : its [controller] section, or the defaults.
    """

    path: Path
    text: str
    data: Mapping[str, Any] = field(repr=False)
    solver: SolverSettings
    controller: ControllerSettings
    content: File = field(repr=False)
    lines: Mapping[Place, int] = field(repr=False, default_factory=dict)

    def changed(self, settings: Mapping[str, Any]) -> ProblemFile:
        """The file with other values, by key paths (`change_data`).

        Raises
        ------
        InputError : unknown keys; values that are wrong, as in a file.
        """
        if not settings:
            return self
        try:
            data, places = change_and_place(self.data, settings)
            text = write_toml(data)
        except (InputError, TOMLError) as error:
            raise InputError(f"{self.path}: {error}") from error
        return _checked(data, self.path, text, {**self.lines, **dict.fromkeys(places, 0)})

    def build(self) -> ImpactProblem:
        """The problem, with its robot.

        Raises
        ------
        InputError : what only shows with the robot: a URDF that is missing or not sound, an unknown joint or
            frame; then an unknown striker, posture and sole, all at once; then a point out of reach.
        """
        content, mistakes = self.content, _Collector(self.lines)
        try:
            robot = content.make_robot(self.path.parent)
        except InputError as error:
            legs = content.leg_mistake(self.path.parent)
            if legs is not None:
                mistakes.add(("robot", "soles"), legs, first=True)
            for place, wrong in content.robot_mistakes(self.path.parent, error):
                mistakes.add(place, wrong)
            raise InputError(mistakes.report(self.path)) from error
        mistakes.attempt(("problem", "striker"), lambda: robot.striker(content.problem.striker))
        mistakes.attempt(("problem", "start"), lambda: content.make_start(robot))
        stance = mistakes.attempt(("stance", "soles"), lambda: content.make_stance(robot))
        given = content.arguments()
        if stance is not None:
            try:
                check_legs(robot.model, [(sole.name, sole.frame) for sole in stance.soles(robot)])
            except InputError as error:
                mistakes.add(("robot", "soles"), error, first=True)
        if mistakes or stance is None:
            # the rest of the problem cannot be put together, but what its terms name can be looked at
            for name, term in content.given_terms():
                mistakes.attempt(("terms", name), partial(check_names, robot, term))
            mistakes.raise_if_any(self.path)
        assert stance is not None
        try:
            return ImpactProblem(robot=robot, stance=stance, **given)
        except InputError as error:
            mistakes.add((), error)
            raise InputError(mistakes.report(self.path)) from error


def load_problem(path: str | os.PathLike[str]) -> ImpactProblem:
    """The problem that a TOML file describes: its path, or the name of one that comes with the package.

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    return read_problem_file(path).build()


def problem_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str]) -> ImpactProblem:
    """The problem that a problem file's data describes, as `read_toml` or `change_data` gives them.

    where : what messages call it; files that it names are relative to the folder of that path.

    Raises
    ------
    InputError : the data are wrong; one message with all mistakes.
    """
    return problem_file_from_data(data, where=where).build()


def problem_file_from_data(data: Mapping[str, Any], *, where: str | os.PathLike[str]) -> ProblemFile:
    """Data checked like the text of a problem file, with that text; see `problem_from_data`."""
    try:
        check_plain(data)
        data = plain_value(data)
        text = write_toml(data)
    except TOMLError as error:
        raise InputError(f"{where}: {error}") from error
    return _checked(data, Path(where), text, {})


def read_problem_file(path: str | os.PathLike[str], settings: Mapping[str, Any] | None = None) -> ProblemFile:
    """A problem file, by path or name, checked as far as that is possible without its robot.

    settings : values by key path, in place of the file's (`change_data`).

    Raises
    ------
    InputError : the file cannot be read, or is wrong; one message with all mistakes and their lines.
    """
    path = problem_file(path)
    return parse_problem_file(_read(path), path, settings)


def parse_problem_file(text: str, path: Path, settings: Mapping[str, Any] | None = None) -> ProblemFile:
    """A problem file's text, checked like the file; `path` is where it was: the place of the files it names.

    Raises
    ------
    InputError : the text is wrong; one message with all mistakes and their lines.
    """
    try:
        data = read_toml(text)
    except TOMLError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return _checked(data, path, text, key_lines(text)).changed(settings or {})


def _checked(data: Mapping[str, Any], path: Path, text: str, lines: Mapping[Place, int]) -> ProblemFile:
    for place in _LISTS:
        there: Any = data
        for key in place:
            there = there.get(key) if isinstance(there, Mapping) else None
        if isinstance(there, list) and len(there) > MANY:
            raise InputError(f"{path}: there are {len(there)} [[{'.'.join(place)}]]; give at most {MANY}")
    if found := text_with_control(data):
        raise InputError(f"{path}: the text {shortened(repr(found))} has control characters; take them out")
    today, lines = with_todays_names(data, lines)
    mistakes, model = _robot_given_once(today), with_kinds(File, today)
    try:
        content = model.model_validate(today)
    except ValidationError as error:
        mistakes += mistakes_of(error, model)
    if mistakes:
        raise InputError(report_mistakes(str(path), lines, mistakes))
    given = content.solver.model_dump(exclude_unset=True) if content.solver else {}
    options: dict[str, Any] = {}
    for solver in {"ipm", "sqp", "ipopt"} & given.keys():
        options[solver] = given.pop(solver)
    settings = SolverSettings(**given, options=options)
    controller = content.controller.build() if content.controller else ControllerSettings()
    return ProblemFile(
        path=path, text=text, data=data, content=content, solver=settings, controller=controller, lines=lines
    )


class _Collector:
    """Gathers the mistakes of several attempts."""

    def __init__(self, lines: Mapping[Place, int]) -> None:
        self._lines, self._mistakes = lines, list[Mistake]()

    def __bool__(self) -> bool:
        return bool(self._mistakes)

    def add(self, place: tuple[str, ...], error: InputError, *, first: bool = False) -> None:
        sections = max(1, len(place) - 1) if place[:1] != ("terms",) else len(place)
        self._mistakes += [
            Mistake(place=place, sections=sections, text=text, first=first) for text in error.mistakes
        ]

    def attempt(self, place: tuple[str, ...], make: Callable[[], _T]) -> _T | None:
        """Result of `make`; None, and a mistake at `place`, if it raises an InputError."""
        try:
            return make()
        except InputError as error:
            self.add(place, error)
            return None

    def report(self, path: Path) -> str:
        return report_mistakes(str(path), self._lines, self._mistakes)

    def raise_if_any(self, path: Path) -> None:
        if self._mistakes:
            raise InputError(self.report(path))


def _robot_given_once(data: Mapping[str, Any]) -> list[Mistake]:
    section = data.get("problem")
    named, table = isinstance(section, Mapping) and "robot" in section, "robot" in data
    if named != table:
        return []
    text = "given twice: keep this, or the section [robot]" if named else "missing; name a preset"
    return [Mistake(place=("problem", "robot"), sections=1, text=text)]


def _read(path: Path) -> str:
    try:
        return read_plain(path, LONGEST_TEXT).decode()
    except FileNotFoundError as error:
        folder = path.parent
        near = (
            did_you_mean(path.name, [p.name for p in folder.glob("*.toml")]) if os.path.isdir(folder) else ""
        )
        raise InputError(f"there is no file {shortened(str(path), 300)}{near}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8: {error.reason} at byte {error.start}") from error
    except OSError as error:
        raise InputError(f"cannot read {shortened(str(path), 300)}: {error.strerror}") from error
