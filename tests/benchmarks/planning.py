"""From a problem file to a plan that is worth measuring."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.report import Say
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.files.problem_file import read_problem_file
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation import ControllerSettings
from impactopt.simulation.controller import controller_of

DEMO = Path("problems/punch.toml")


def plan_of(file: Path, say: Say) -> Solution:
    """The solution of a problem file, by the solver that it names.

    Raises
    ------
    InputError : the file is wrong, or its problem is not solved.
    """
    solution = solved(file, say)
    if not solution.status.usable:
        raise InputError(
            f"the plan of {file} is not usable ({solution.result.message}); see what "
            f"`impactopt solve {file}` says of it"
        )
    return solution


def controller_in(file: Path, chosen: str) -> ControllerSettings | None:
    """Settings of the controller "wbc" in a problem file; None for "servo"."""
    return controller_of(chosen, read_problem_file(file).controller)


def solved(file: Path, say: Say, change: Callable[[ImpactProblem], ImpactProblem] | None = None) -> Solution:
    """The same, whatever the solver made of it.

    change : what is done to the file's problem before.
    """
    read = read_problem_file(file)
    say(f"planning {file}")
    solver = read.solver.name
    options: Mapping[str, Any] | None = read.solver.options.get(solver)
    problem = read.build() if change is None else change(read.build())
    solution = solve(problem, solver=solver, options=options, time_limit=read.solver.time_limit)
    say(f"{file}: {solution.status.value}, {solution.impulse:.2f} N s, {solution.solve_seconds:.1f} s")
    return solution
