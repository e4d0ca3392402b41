"""What is solved by name or path is what is solved by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import impactopt
from impactopt import ImpactProblem, InputError, load_problem
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
