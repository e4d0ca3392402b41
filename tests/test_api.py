"""What is solved by name or path is what is solved by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import impactopt
from impactopt import (
    FullDynamics,
    ImpactProblem,
    InputError,
    Robot,
    animate,
    coasting_reference,
    collide_many,
    export,
    load_problem,
    moved_solution,
    plot,
    report_page,
    scaled_gains,
    sensitivity_of,
    write_problem,
)
from impactopt import api as by_file
from impactopt.files.named_problems import problem_file

FILE = """
[solver]
time_limit_s = 7
[solver.ipm]
max_iterations = 5
"""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, dict[str, Any]]]:
    seen: list[tuple[Any, dict[str, Any]]] = []

    def planner(problem: ImpactProblem, **options: Any) -> SimpleNamespace:
        seen.append((problem, options))
        return SimpleNamespace()

    monkeypatch.setattr(by_file, "solve", by_file._or_file(planner))
    return seen


def test_a_name_is_the_problem_of_that_name(asked: list[tuple[Any, dict[str, Any]]]) -> None:
    by_file.solve("arm_planar", starts=2)
    problem, options = asked[0]
    assert problem.hash == load_problem("arm_planar").hash and options["starts"] == 2


def test_a_file_brings_its_solver_and_arguments_go_before_it(
    asked: list[tuple[Any, dict[str, Any]]], tmp_path: Path
) -> None:
    file = tmp_path / "mine.toml"
    text = problem_file("arm_planar").read_text(encoding="utf-8")
    file.write_text(text.split("[solver")[0] + FILE, encoding="utf-8")
    by_file.solve(file)
    by_file.solve(file, time_limit=3.0, options={"max_iterations": 9})
    (_, first), (_, second) = asked
    assert first["time_limit"] == 7 and first["options"] == {"max_iterations": 5}
    assert second["time_limit"] == 3.0 and second["options"] == {"max_iterations": 9}


def test_what_is_said_goes_to_the_log_or_to_who_asks(
    asked: list[tuple[Any, dict[str, Any]]], caplog: pytest.LogCaptureFixture
) -> None:
    said = list[str]()
    by_file.solve("arm_planar")
    by_file.solve(load_problem("arm_planar"), report=said.append)
    with caplog.at_level("INFO", logger="impactopt"):
        for _, options in asked:
            options["report"]("building: 100 % done")
    assert caplog.messages == said == ["building: 100 % done"]


@pytest.mark.parametrize("given", [3, None, {}])
def test_what_is_no_problem_is_refused(given: Any) -> None:
    with pytest.raises(InputError, match="give an ImpactProblem"):
        impactopt.solve(given)


def test_an_unknown_name_is_refused_with_the_nearest() -> None:
    with pytest.raises(InputError, match="arm_planar"):
        impactopt.solve("arm_plana")


WRONG: dict[str, tuple[str, Callable[[ImpactProblem, Any], Any]]] = {
    "a problem is drawn": ("solution must be a Solution", lambda p, tmp: plot(p)),
    "a result's path is animated": ("solution must be a Solution", lambda p, tmp: animate("results/punch")),
    "a problem has a page": ("solution must be a Solution", lambda p, tmp: report_page(p)),
    "a problem is exported": ("solution must be a Solution", lambda p, tmp: export(p, "csv", tmp)),
    "a problem is moved": ("solution must be a Solution", lambda p, tmp: moved_solution(p, mass=0.1)),
    "a problem has a sensitivity": ("solution must be a Solution", lambda p, tmp: sensitivity_of(p, "mass")),
    "coordinates": (
        "coordinates must be a StanceCoordinates",
        lambda p, tmp: coasting_reference(p, p.start_posture, np.zeros(3)),
    ),
    "one gain": ("factors must be a Mapping, not 2", lambda p, tmp: scaled_gains(p.robot, 2)),
    "a solver's name": ("solver must be a SolverSettings", lambda p, tmp: write_problem(p, solver="ipm")),
    "a model's path": ("model must be a Model, not 'a.urdf'", lambda p, tmp: Robot.from_model("a.urdf")),
    "a list of strikers": (
        "strikers must be a Mapping",
        lambda p, tmp: replace(p.robot, strikers=[*p.robot.strikers.values()]),
    ),
    "names of columns": (
        "columns must be a Mapping",
        lambda p, tmp: collide_many("arm_planar", ["target.mass_kg"]),
    ),
    "a friction's number": (
        "friction must be a JointFriction, not 0.3",
        lambda p, tmp: FullDynamics(
            robot=p.robot, striker=p.striker, normal=p.normal, law=p.law, target=p.target, friction=0.3
        ),
    ),
}


@pytest.mark.parametrize("slip", WRONG)
def test_an_argument_of_another_type_is_named(slip: str, tmp_path: Path) -> None:
    """An AttributeError from the depth of the package names nothing that the user has written."""
    told, call = WRONG[slip]
    with pytest.raises(InputError, match=told):
        call(load_problem("arm_planar"), tmp_path / "out")
