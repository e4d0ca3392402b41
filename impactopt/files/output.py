"""Files of a result: `solution.npz` with all arrays, `summary.json` with the main figures, and their folder.

`solution.npz` is complete: it has the summary and the problem file too. Every file is written under another
name and then renamed, so that a reader never sees half of one. Before a new `solution.npz` replaces an old
one, the files that were derived from the old one are removed: whenever a process ends, all files are of one
result.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from impactopt.codegen.files import write_atomically
from impactopt.errors import InputError, check_kind
from impactopt.files.problem_file.reading import change_data
from impactopt.files.problem_file.sections import comment_at
from impactopt.files.record import FORMAT, NUMBERS, SUMMARY, Record, load_record, plain, read_json
from impactopt.files.toml import read_toml, write_toml
from impactopt.kinematics.stance import corners_at, support_polygon
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.reference.poses import poses_of
from impactopt.simulation.result import Simulation, check_simulations
from impactopt.solvers.program import SolverResult, Status

if TYPE_CHECKING:  # reading a record does not import the planner
    from impactopt.planning.solution import Solution
    from impactopt.planning.strike import StrikeSolution

# Bits of saved histories, by prefix, relative to each channel's largest value. References have 32 (5e-10 rad
# of 2 rad): with 24, accelerations are beyond what `verify` allows. Replays have 15 (3e-5 rad, 15 mN of
# 1 kN), which is finer than pictures and measurements.
BITS = {"reference": 32, "missed": 32, "pose": 32, "simulated": 15, "replayed": 15}
SMALLEST = 1e-30  # instead of the largest value of a channel that is zero
# files derived from a result: of `impactopt show`, of `impactopt validate`, and pictures
DERIVED = (
    "report.html",
    "replay.json",
    *(
        f"{picture}.png"
        for picture in ("force", "zmp", "torque", "strobe", "motion", "ellipsoid", "iterations", "replay")
    ),
)


def record_of(
    solution: Solution,
    *,
    simulation: Simulation | None = None,
    replay: Simulation | None = None,
    problem: str = "",
    problem_path: Path | None = None,
) -> Record:
    """Record of a solution, of its re-simulations if there are any, and of the problem file's text.

    A solver that is stopped early may leave legs and base that do not fit together. Then the record has no
    `reference_*`, and its summary no numbers of the motion, but a `note` with the reason.

    Raises
    ------
    InputError : no `Solution`; a simulation or a replay that is no `Simulation`, or is of another plan.
    """
    from impactopt.planning.solution import Solution

    check_kind("solution", solution, Solution)
    plan, robot, result = solution.plan, solution.problem.robot, solution.result
    if simulation is not None or replay is not None:  # a trajectory may not be completed
        check_simulations(solution.trajectory, simulation=simulation, replay=replay)
    arrays = _scene_arrays(solution.problem)
    parts: dict[str, Any] = {"plan": plan, "swing": plan.swing, "follow": plan.follow}
    parts |= {"collision": solution.collision, "solver": result}
    summary, problem = _summary(solution, simulation, replay), _with_chosen_gains(problem, solution)
    if "note" not in summary:
        parts |= {"reference": solution.trajectory, "pose": poses_of(solution.problem, solution.trajectory)}
        if plan.abort is not None:
            parts["missed"] = solution.missed_trajectory
        with contextlib.suppress(InputError):  # legs out of reach in between
            arrays["collision_q"] = plan.in_contact(solution.trajectory)
    if simulation is not None:
        parts["simulated"] = simulation
    if replay is not None:
        arrays |= replay_arrays(replay)
    for prefix in {"reference", "simulated"} & parts.keys():
        arrays[f"{prefix}_angle"] = robot.joint_positions(parts[prefix].q)
    arrays |= _parts_arrays(parts, result)
    if solution.statement:
        arrays["program_statement"] = solution.statement
    arrays = rounded(arrays)
    return Record(summary=plain(summary), problem=problem, arrays=arrays, problem_path=problem_path)


def record_of_strike(
    solution: StrikeSolution, *, problem: str = "", problem_path: Path | None = None
) -> Record:
    """Record of a strike: as of a solution, with `strike_*` (`PlannedStrike`) and no motion."""
    strike = solution.strike
    parts = {"strike": strike, "collision": strike.collision, "solver": solution.result}
    arrays = _scene_arrays(solution.problem) | _parts_arrays(parts, solution.result)
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    summary, problem = plain(solution.summary()), _with_chosen_gains(problem, solution)
    return Record(summary=summary, problem=problem, arrays=arrays, problem_path=problem_path)


def _with_chosen_gains(problem: str, solution: Solution | StrikeSolution) -> str:
    """The text of a problem file, with the optimized gain factors of a solution instead of their ranges."""
    if not problem or not solution.gains:
        return problem
    data = read_toml(problem)
    given = data.get("robot", {}).get("gains", ())
    ranges = [k for k, each in enumerate(given) if isinstance(each["factor"], list)]
    if not ranges:  # a text of the solution's own problem, whose robot has the chosen gains
        return problem
    chosen = {f"robot.gains.{k}.factor": c.factor for k, c in zip(ranges, solution.gains, strict=True)}
    data = change_data(data, chosen)
    return write_toml(data, lambda place: comment_at(data, place))


def summary_of(solution: Solution | StrikeSolution) -> dict[str, Any]:
    """Summary of a solution's record, without computing the record's arrays."""
    from impactopt.planning.strike import StrikeSolution

    return plain(
        solution.summary() if isinstance(solution, StrikeSolution) else _summary(solution, None, None)
    )


def _scene_arrays(problem: ImpactProblem) -> dict[str, Any]:
    """Arrays of a record that describe the robot and its stance."""
    robot, c = problem.robot, problem.coordinates
    out: dict[str, Any] = {
        "joints": np.array(robot.joint_names),
        "prismatic": robot.prismatic,
        "torque_limit": robot.torque_limit,
        "velocity_limit": robot.velocity_limit,
        "armature": robot.armature,
        "polygon": support_polygon(robot, c),
    }
    # reversed, so that the first foothold of a sole that steps is the one that remains
    legs = {leg.frame: leg for c in reversed(problem.stance_coordinates) for leg in c.legs}
    for leg in legs.values():
        if leg.sole is None:
            continue
        out[f"sole_{leg.sole.name}"] = corners_at(leg.sole.polygon, leg.placement)[:, :2]
    return out


def rounded(arrays: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Arrays with rounded histories (`BITS`): those of several channels, (k, ...).

    That makes the file five times smaller. Times and single curves are not rounded.
    """
    out = {name: np.asarray(value) for name, value in arrays.items()}
    for name, array in out.items():
        bits = BITS.get(name.partition("_")[0])
        if bits is not None and array.ndim > 1 and array.dtype == float and array.size:
            largest = np.abs(np.where(np.isfinite(array), array, 0.0)).max(axis=0)
            # rounded to multiples of a power of two, 2^-bits of the next one above the largest value
            unit = np.exp2(np.ceil(np.log2(np.maximum(largest, SMALLEST))) - bits)
            out[name] = np.round(array / unit) * unit
    return out


def _parts_arrays(parts: Mapping[str, Any], result: SolverResult) -> dict[str, Any]:
    """Numbers of dataclasses under their prefixes, and the solver's history."""
    out: dict[str, Any] = {}
    for prefix, thing in parts.items():
        out |= {f"{prefix}_{name}": value for name, value in _numbers(thing).items()}
    out.pop("collision_motion", None)  # `collision_q` has it, which can be drawn without a stance
    if result.history:
        history = [_numbers(iteration) for iteration in result.history]
        out |= {f"history_{name}": [iteration[name] for iteration in history] for name in history[0]}
    return out


def replay_arrays(replay: Any) -> dict[str, NDArray[Any]]:
    """Arrays `replayed_*` of a record, the motion and forces of a `Simulation` on free soles."""
    left_out = {"v", "demand", "torque", "gear"}
    kept = {name: value for name, value in _numbers(replay).items() if name not in left_out}
    return rounded(
        {f"replayed_{name}": value for name, value in {**kept, "soles": list(replay.soles)}.items()}
    )


def _summary(solution: Solution, simulation: Any | None, replay: Any | None) -> dict[str, Any]:
    try:
        return solution.summary(simulation, replay)
    except InputError as error:
        if simulation is not None:  # such as one that missed the target
            return {**_summary(solution, None, replay), "simulated": {"error": str(error)}}
        return {**solution.outcome(), "note": f"the plan's motion cannot be completed: {error}"}


def _numbers(thing: Any) -> dict[str, Any]:
    """The fields of a dataclass that are numbers or arrays."""
    values = {f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}
    kinds = (int, float, np.ndarray, np.generic)
    return {name: value for name, value in values.items() if isinstance(value, kinds)}


def check_directory(directory: Path) -> Path:
    """The directory, which need not exist: made before a solve, it would stay if there is no result.

    Raises
    ------
    InputError : it could not be made, or is not writable.
    """
    existing = next(path for path in (directory.absolute(), *directory.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"cannot make the directory {directory}: {existing} is a file; give another one")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"cannot write into {existing}; give another directory")
    return directory


def make_directory(directory: str | os.PathLike[str]) -> Path:
    """The directory, made if it does not exist.

    Raises
    ------
    InputError : it cannot be made, or is not writable.
    """
    path = Path(directory)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the directory {path}: {error.strerror}; give another one") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"cannot write into {path}; give another directory")
    return path


def save_record(record: Record, directory: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Write `solution.npz` and `summary.json` into the directory, which is made if it does not exist.

    Files derived from an earlier result (`DERIVED`) are removed.

    Raises
    ------
    InputError : they cannot be written.
    """
    path = make_directory(directory)
    summary = json.dumps(plain(record.summary), indent=2, allow_nan=False)
    extra = {"summary_json": summary, "problem_toml": record.problem, "format": FORMAT}
    if record.problem_path is not None:  # relative, so that results and problems can move together
        extra["problem_path"] = os.path.relpath(record.problem_path.resolve(), path.resolve())
    numbers: dict[str, Any] = {**{name: _packed(array) for name, array in record.arrays.items()}, **extra}

    def clear() -> None:
        for name in (SUMMARY, *DERIVED):
            remove_file(path / name)

    write_file(path / NUMBERS, lambda file: np.savez_compressed(file, **numbers), before=clear)
    write_file(path / SUMMARY, lambda file: file.write(f"{summary}\n".encode()))
    return path / NUMBERS, path / SUMMARY


def _packed(array: NDArray[Any]) -> NDArray[Any]:
    """A history in single precision, in Fortran order, if that represents it exactly; else the same array."""
    if array.ndim < 2 or array.dtype != float:
        return array
    with np.errstate(over="ignore"):
        short = array.astype(np.float32)
    return np.asfortranarray(short) if np.array_equal(short, array, equal_nan=True) else array


def remove_file(path: Path) -> None:
    """Remove a file if it is there.

    Raises
    ------
    InputError : it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot write over {path}: {error.strerror}") from error


def check_ending(what: str, path: Path, *endings: str) -> None:
    """InputError unless the name of a file ends with one of the endings, and no folder has it.

    what : start of the message, such as "a page is HTML".
    """
    if path.suffix.lower() not in endings:
        raise InputError(f"{what}: give {path.name or str(path)!r} the ending {endings[0]}")
    if path.is_dir():
        raise InputError(f"{what}: {str(path)!r} is a folder; give a file in it, or another name")


def write_file(
    path: Path, write: Callable[[IO[bytes]], Any], *, before: Callable[[], object] | None = None
) -> None:
    """Have `write` fill a new file, which then replaces `path` in one step.

    before : called just before that, when the new file is complete.

    Raises
    ------
    InputError : it cannot be written; an earlier file at `path` is unchanged.
    """
    try:
        write_atomically(path, write, before=before)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error


FAILED = "failed"  # folder in a result's directory, for a failed result that does not replace a good one
SERIES = "blows.json"


def keep_record(record: Record, directory: Path) -> tuple[Path, Path]:
    """Save a record (`save_record`); a failed one does not replace a good one in the directory.

    It is then written to the subdirectory `failed`, which its summary has in `set_aside`. A good one replaces
    the earlier result, and removes such a failed one.

    Raises
    ------
    InputError : they cannot be written.
    """
    good = is_usable(record.summary.get("status"))
    place = _place(directory, good, is_usable(_status_in(directory)), record.summary)
    written = save_record(record, place)
    if good:
        _remove(directory / FAILED, NUMBERS, SUMMARY, *DERIVED)
    return written


def keep_series(done: dict[str, Any], directory: Path) -> Path:
    """Save a series of blows in `blows.json`, as `keep_record`; it is good if the nail is driven in.

    done : `Series.describe`.

    Raises
    ------
    InputError : it cannot be written.
    """
    place = _place(directory, done["done"], bool(read_json(directory / SERIES).get("done")), done)
    text = f"{json.dumps(plain(done), indent=2)}\n".encode()
    make_directory(place)
    write_file(place / SERIES, lambda file: file.write(text))
    if done["done"]:
        _remove(directory / FAILED, SERIES)
    return place / SERIES


def set_aside(summary: Mapping[str, Any]) -> str:
    """Message about a result that has not replaced a good one; "" for others."""
    found = summary.get("set_aside")
    if found is None:
        return ""
    return (
        f"{found['kept']} holds a good result, which is kept; this one failed, and is in {found['directory']}"
    )


def _place(directory: Path, good: bool, has_good: bool, summary: dict[str, Any]) -> Path:
    """Directory for a result. If it is `failed`, as there is a good one, that is noted in its summary."""
    if good or not has_good:
        return directory
    place = directory / FAILED
    summary["set_aside"] = {"directory": str(place), "kept": str(directory)}
    return place


def is_usable(status: Any) -> bool:
    """True if a record's status is that of a usable result; an unknown one, of a newer version, counts so."""
    known = [s.value for s in Status if not s.usable]
    return isinstance(status, str) and status not in known


def _status_in(directory: Path) -> Any:
    with contextlib.suppress(InputError):
        return load_record(directory).summary.get("status")
    return read_json(directory / SUMMARY).get("status")  # for a record of a newer version


def _remove(directory: Path, *names: str) -> None:
    """Remove files of a directory, and the directory if nothing else is in it."""
    with contextlib.suppress(OSError):
        for name in names:
            (directory / name).unlink(missing_ok=True)
        directory.rmdir()
