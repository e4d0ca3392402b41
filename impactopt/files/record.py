"""Records: the content of a result's files, and reading of it; `impactopt.files.output` writes them."""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.codegen.files import read_archive, read_plain
from impactopt.errors import InputError
from impactopt.files.record_schema import check_arrays, check_soles, check_summary

FORMAT = 2  # of solution.npz; increased by a change that an older reader would misread
# Names of the program's statement since format 2, by those of format 1.
_RENAMED = {"rows": "constraints", "more": "added_nodes", "apart": "clearance"}
_RENAMED |= {"way": "vector", "reach": "least_distance"}
LARGEST, MOST_ARRAYS = 1 << 29, 1000  # bytes and arrays of solution.npz; ours have some MB, and a hundred
NUMBERS, SUMMARY = "solution.npz", "summary.json"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Record:
    """A solution as numbers and text: the content of its files, from which reports are made.

    summary : the content of `summary.json`.
    problem : text of the problem file, "" if there was none.
    arrays : by name. `joints`, `prismatic`, `torque_limit`, `velocity_limit`, `armature` (n,); `polygon` and
        `sole_<name>` (k, 2) [m], corners on the ground, for a sole that steps in its first foothold;
        `reference_angle`, `simulated_angle` (k, n), joint angles over time; and, field by field,
        `reference_*` (`impactopt.transcription.plan.Trajectory`) and, of a plan with an abort motion,
        `missed_*`, `plan_*` (`Plan`), `swing_*`, `follow_*` (its splines), `collision_*`
        (`PlannedCollision`), `pose_*` (`Poses`), `simulated_*` (`Simulation`), `replayed_*` (`Simulation` on
        free soles, without velocities and torques), `solver_*` (`SolverResult`), `history_*` (its
        iterations); `program_statement`, names of the program's variables and constraints, as JSON.
        Histories of many channels are rounded (`rounded`).
    problem_path : path of the problem file, to which paths in it are relative; None if there was none.
    """

    summary: dict[str, Any]
    problem: str = ""
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    problem_path: Path | None = None

    def __repr__(self) -> str:
        """One line, without the arrays."""
        name, impulse = self.summary.get("problem", {}).get("name", ""), self.summary.get("impulse_Ns")
        figure = "" if impulse is None else f", {impulse:.2f} N s"
        return f"<Record of {name!r}: {self.summary.get('status')}{figure}>"

    @property
    def slides(self) -> bool:
        """True if the robot has prismatic joints."""
        return bool(self.arrays.get("prismatic", np.zeros(1)).any())

    @property
    def completed(self) -> bool:
        """True if the planned motion is part of the record."""
        return "reference_time" in self.arrays

    @property
    def simulated(self) -> bool:
        """True if a re-simulation is part of the record."""
        return "simulated_time" in self.arrays

    @property
    def replayed(self) -> bool:
        """True if a replay on free soles is part of the record."""
        return "replayed_time" in self.arrays


def replay_name(summary: Mapping[str, Any]) -> str:
    """Heading of MuJoCo's replay, in which soles are not fixed."""
    return "free soles" if summary.get("sole_cop_margin_mm") else "MuJoCo"


def plain(value: Any) -> Any:
    """`value` in the types of JSON; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _unpacked(array: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(array, dtype=float) if array.dtype == np.float32 else array


def _renamed(statement: str) -> str:
    """Statement of a program in format 1, with the names of format 2."""

    def table(entries: dict[str, Any]) -> dict[str, Any]:
        return {_RENAMED.get(name, name): value for name, value in entries.items()}

    return json.dumps(json.loads(statement, object_hook=table))


def load_record(directory: str | os.PathLike[str]) -> Record:
    """The record that `save_record` wrote into a directory, or of a path to `solution.npz`.

    Raises
    ------
    InputError : there is none, it is damaged, or of a newer impactopt.
    """
    path = Path(directory)
    path = path if path.name == NUMBERS and not os.path.isdir(path) else path / NUMBERS
    fix = "solve again with `impactopt solve`"
    try:
        with np.load(read_archive(path, LARGEST, MOST_ARRAYS), allow_pickle=False) as file:
            version = int(file["format"])
            if version > FORMAT:
                raise InputError(f"{path} is of a newer impactopt (format {version}); update impactopt")
            arrays = {name: _unpacked(file[name]) for name in file.files}
        summary = json.loads(str(arrays.pop("summary_json")))
        problem = str(arrays.pop("problem_toml"))
        problem.encode().decode()  # a damaged array may have invalid characters
        relative = str(arrays.pop("problem_path", ""))
        del arrays["format"]
        if version < 2 and "program_statement" in arrays:
            arrays["program_statement"] = np.array(_renamed(str(arrays["program_statement"])))
        check_summary(summary, whole="joints" in arrays)
        check_arrays(arrays)
        check_soles(arrays, summary)
    except InputError:
        raise
    except (FileNotFoundError, NotADirectoryError) as error:
        near = near_result(path.parent)
        raise InputError(f"there is no {path}{near}; `impactopt solve NAME` writes results/NAME") from error
    except PermissionError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    # errors of NumPy and zipfile for files that are truncated, overwritten or of another kind
    except (
        *(OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, MemoryError, OverflowError),
        *(RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
    ) as error:
        raise InputError(f"{path} is damaged ({error}); {fix}") from error
    problem_path = Path(os.path.normpath(path.parent.resolve() / relative)) if relative else None
    return Record(summary=summary, problem=problem, arrays=arrays, problem_path=problem_path)


def near_result(directory: Path) -> str:
    """Suggestion for a misspelt result, for the end of a message: " (did you mean 'results/x'?)", or ""."""
    saved = {file.parent.name: file.parent for file in Path("results").glob(f"*/{NUMBERS}")}
    near = difflib.get_close_matches(directory.name, saved, n=1)
    return f" (did you mean {str(saved[near[0]])!r}?)" if near else ""


def read_json(path: Path, most: int = LARGEST) -> dict[str, Any]:
    """Table in a JSON file of at most so many bytes; {} if it cannot be read."""
    with contextlib.suppress(OSError, ValueError, RecursionError):
        found = json.loads(read_plain(path, most))
        return found if isinstance(found, dict) else {}
    return {}
