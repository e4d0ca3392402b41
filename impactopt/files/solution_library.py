"""A folder of solved problems, in which the nearest one to another problem is found, to start from."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.files.output import NUMBERS, load_record, make_directory, record_of, save_record
from impactopt.files.problem_file import ProblemFile
from impactopt.files.problem_file.toml import read_toml
from impactopt.files.replay import problem_of, resumed
from impactopt.planning.budget import one_after_the_other
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Status

__all__ = ["Neighbour", "SolvedFolder"]

FAR = 2.0  # distance from which on two problems are no neighbours
_STEP = 0.1  # of a number in a list, as [m] of a point: what counts as much as a factor of 2
_NOT_THE_PLAN = {"name", "solver", "validate", "controller"}  # keys that do not change what is planned


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """A solved problem near another one.

    path : its directory.  distance : a factor of 2 in a number is 1, as is 0.1 in a number of a list.
    """

    path: Path
    distance: float

    def __str__(self) -> str:
        return f"{self.path.name}, {self.distance:.2g} away"


class SolvedFolder:
    """Results of `impactopt solve` in the directories of a folder, each with its problem.

    A sweep's ``cases`` is one, and so is ``results``. It is made when the first result is kept.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.path = Path(folder)
        self._known: dict[Path, dict[str, Any]] = {}

    def keep(self, solution: Solution, file: ProblemFile, name: str = "") -> Path | None:
        """Put a solution into the folder; None if it is none.

        file : its problem's.  name : of its directory; "": one that its problem's text has to itself.
        """
        if not solution.status.usable:
            return None
        name = name or hashlib.sha256(file.text.encode()).hexdigest()[:16]
        record = record_of(solution, problem=file.text, problem_path=file.path)
        save_record(record, make_directory(self.path / name))
        return self.path / name

    def nearest(self, file: ProblemFile) -> Neighbour | None:
        """The nearest solved problem; None where none differs in a few numbers only."""
        own = _leaves(read_toml(file.text))
        found = []
        for numbers in sorted(self.path.glob(f"*/{NUMBERS}")):
            distance = _distance(own, self._leaves_of(numbers))
            if distance <= FAR:
                found.append(Neighbour(path=numbers.parent, distance=distance))
        return min(found, key=lambda near: near.distance, default=None)

    def solve(
        self, problem: ImpactProblem, file: ProblemFile, **options: Any
    ) -> tuple[Solution, Neighbour | None]:
        """`impactopt.solve` from the nearest solution; without, where there is none or it fails.

        options : of `impactopt.solve`, for both.

        Raises
        ------
        InputError : as `impactopt.solve`; several starts.
        """
        if options.get("starts", 1) > 1:
            raise InputError("several starts, and a start from the nearest plan: leave one of the two out")
        near = self.nearest(file)
        if near is None:
            return solve(problem, **options), None
        start = {"start", "starts"}
        first: Solution | None = None
        with contextlib.suppress(InputError):  # of another robot, damaged, or of other variables
            record = load_record(near.path)
            before = resumed(record, problem_of(record, near.path, None, None))
            rest = {key: value for key, value in options.items() if key not in start}
            first = solve(problem, start=before, **rest)
            if first.status.usable or first.status is Status.INTERRUPTED:
                return first, near
        solution = solve(problem, **options)
        if first is not None:
            solution = replace(solution, result=one_after_the_other(first.result, solution.result))
        return solution, None

    def _leaves_of(self, numbers: Path) -> dict[str, Any]:
        """Values in the problem of a result; none if it cannot be read."""
        if numbers not in self._known:
            self._known[numbers] = {}
            with contextlib.suppress(InputError):
                self._known[numbers] = _leaves(read_toml(load_record(numbers).problem))
        return self._known[numbers]


def _leaves(data: Any, above: tuple[str, ...] = ()) -> dict[str, Any]:
    """Values by key path, without what does not change the plan; a list's by their places."""
    items: Any = enumerate(data) if isinstance(data, list) else data.items()
    out: dict[str, Any] = {}
    for key, value in items:
        at = (*above, f"[{key}]" if isinstance(data, list) else str(key))
        if at[0] in _NOT_THE_PLAN or at == ("problem", "name"):
            continue
        out |= _leaves(value, at) if isinstance(value, (Mapping, list)) else {".".join(at): value}
    return out


def _distance(own: dict[str, Any], other: dict[str, Any]) -> float:
    """Distance of two problems; inf if more than numbers differ."""
    if own.keys() != other.keys():
        return np.inf
    squares = 0.0
    for key, value in own.items():
        its = other[key]
        if value == its:
            continue
        if any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in (value, its)):
            return np.inf
        if key.endswith("]") or value * its <= 0:
            squares += ((value - its) / _STEP) ** 2
        else:
            squares += float(np.log2(value / its)) ** 2
    return float(np.sqrt(squares))
