"""Folder of solved problems, whose nearest one to a problem is its initial guess."""

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
from impactopt.files.output import make_directory, record_of, save_record
from impactopt.files.problem_file import ProblemFile
from impactopt.files.record import NUMBERS, load_record
from impactopt.files.replay import problem_of, resumed
from impactopt.files.toml import read_toml
from impactopt.planning.budget import one_after_the_other
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Status

MAX_DISTANCE = 2.0  # of neighbours
# Change of a number in a list, such as [m] of a point, of distance 1; of other numbers it is a factor of 2.
_UNIT_CHANGE = 0.1
_IRRELEVANT = {"name", "solver", "validate", "controller"}  # keys that do not change the plan


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

    A sweep's ``cases`` is one, and so is ``results``. It is made by the first `keep`.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.path = Path(folder)
        self._known: dict[Path, dict[str, Any]] = {}

    def keep(self, solution: Solution, file: ProblemFile, name: str = "") -> Path | None:
        """Save a usable solution in the folder; its directory, or None if it is not usable.

        file : its problem's.  name : of its directory; "": a hash of its problem's text.
        """
        if not solution.status.usable:
            return None
        name = name or hashlib.sha256(file.text.encode()).hexdigest()[:16]
        record = record_of(solution, problem=file.text, problem_path=file.path)
        save_record(record, make_directory(self.path / name))
        return self.path / name

    def nearest(self, file: ProblemFile) -> Neighbour | None:
        """The nearest solved problem within `MAX_DISTANCE`; None if there is none."""
        own = _leaves(read_toml(file.text))
        found = []
        for numbers in sorted(self.path.glob(f"*/{NUMBERS}")):
            distance = _distance(own, self._leaves_of(numbers))
            if distance <= MAX_DISTANCE:
                found.append(Neighbour(path=numbers.parent, distance=distance))
        return min(found, key=lambda near: near.distance, default=None)

    def solve(
        self, problem: ImpactProblem, file: ProblemFile, **options: Any
    ) -> tuple[Solution, Neighbour | None]:
        """`impactopt.solve` with the nearest solution as the initial guess; a cold start if there is none, or
        the solve fails.

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
        first: Solution | None = None
        # the record may be damaged, of another robot, or have other variables
        with contextlib.suppress(InputError):
            record = load_record(near.path)
            neighbour = resumed(record, problem_of(record, near.path))
            rest = {key: value for key, value in options.items() if key not in ("start", "starts")}
            first = solve(problem, start=neighbour, **rest)
            if first.status.usable or first.status is Status.INTERRUPTED:
                return first, near
        solution = solve(problem, **options)
        if first is not None:
            solution = replace(solution, result=one_after_the_other(first.result, solution.result))
        return solution, None

    def _leaves_of(self, numbers: Path) -> dict[str, Any]:
        """Values of a result's problem by key path, cached; {} if it cannot be read."""
        if numbers not in self._known:
            self._known[numbers] = {}
            with contextlib.suppress(InputError):
                self._known[numbers] = _leaves(read_toml(load_record(numbers).problem))
        return self._known[numbers]


def _leaves(data: Any, above: tuple[str, ...] = ()) -> dict[str, Any]:
    """Values that determine the plan, by key path; those of a list by their indices."""
    items: Any = enumerate(data) if isinstance(data, list) else data.items()
    out: dict[str, Any] = {}
    for key, value in items:
        at = (*above, f"[{key}]" if isinstance(data, list) else str(key))
        if at[0] in _IRRELEVANT or at == ("problem", "name"):
            continue
        out |= _leaves(value, at) if isinstance(value, (Mapping, list)) else {".".join(at): value}
    return out


def _distance(own: dict[str, Any], other: dict[str, Any]) -> float:
    """Distance of two problems, the norm of all changes; inf if other values than numbers differ."""
    if own.keys() != other.keys():
        return np.inf
    squares = 0.0
    for key, value in own.items():
        others = other[key]
        if value == others:
            continue
        if any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in (value, others)):
            return np.inf
        if key.endswith("]") or value * others <= 0:
            squares += ((value - others) / _UNIT_CHANGE) ** 2
        else:
            squares += float(np.log2(value / others)) ** 2
    return float(np.sqrt(squares))
