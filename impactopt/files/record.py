"""Records: the content of a result's files, reading of it, and the schema that it has to satisfy.

`impactopt.files.output` writes them. A file may be damaged, of another version, or made by someone else. One
that violates the schema is refused before anything is drawn or computed from it.
"""

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
from impactopt.errors import InputError, shortened
from impactopt.files.toml import check_plain, text_with_control

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
    if not isinstance(directory, (str, os.PathLike)):
        raise InputError(f"a result is given by the path of its directory, not {shortened(repr(directory))}")
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
    except NotADirectoryError as error:
        raise InputError(
            f"{path.parent} is a file; give the directory of a result, or its {NUMBERS}"
        ) from error
    except FileNotFoundError as error:
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


# Shapes of arrays. Letters are sizes: n, nq and nv are the robot's, the same in all arrays; others are the
# same in all arrays of one prefix. "?" at the beginning: the array may be missing, as in records of older
# versions, or empty, together with the others of this shape and prefix.
_MOTION = {"time": "k", "q": "k nq"}
_REFERENCE = {
    **_MOTION,
    **dict.fromkeys(("v", "a"), "k nv"),
    **{"phase": "k", "torque": "k n", "ground": "k 6", "contact_start": "", "contact_end": "", "end": ""},
    **{"sole_wrench": "? k w", "stance": "? k"},
}
_HISTORIES = {
    **dict.fromkeys(("force", "target_speed", "hand_speed"), "k"),
    **dict.fromkeys(("slip", "lift", "cop_margin"), "k s"),
    **dict.fromkeys(("impulse", "saturated", "posture_error", "contact_start", "contact_end"), ""),
    "sole_ground": "k s 6",
    **dict.fromkeys(("contact_time", "contact_force"), "? m"),
    "target_travel": "? k",
    "target_aside": "? k 3",
}
_SCHEMA: Mapping[str, Mapping[str, str]] = {
    "": {
        **{"joints": "n", "torque_limit": "n", "velocity_limit": "n", "polygon": "c 2"},
        **dict.fromkeys(("armature", "prismatic"), "? n"),
    },
    "reference": {**_REFERENCE, "angle": "k n"},
    "missed": _REFERENCE,
    "strike": {"posture": "nq", "velocity": "nv", "torque": "n"},
    "simulated": {**_MOTION, **_HISTORIES, "v": "k nv", "demand": "k n", "torque": "k n", "angle": "k n"}
    | {"gear": "? k n"},
    "replayed": {**_MOTION, **_HISTORIES, "soles": "s"},
    "collision": {"time": "m", "force": "m", "target_speed": "m", "torque": "p n"}
    | {"ground": "g 6", "sole_wrench": "g w"}
    | {"q": "? c nq"}
    | dict.fromkeys(("velocity", "acceleration"), "? p n")
    | {"tangential_velocity": "? m 3"},
    "pose": {"time": "r", "links": "r l 2 3", "path": "k 3", "normal": "3", "contact": ""}
    | {"target": "? b c 3", "obstacles": "? o u 3", "ground": "? g"},
    "history": dict.fromkeys(("iteration", "objective", "max_violation", "kkt"), "i"),
}
_TEXTS = ("joints", "replayed_soles", "program_statement")
_ROBOT = ("n", "nq", "nv")
# arrays without NaN and infinity; in others NaN stands for a quantity that does not exist
_FINITE = ("time", "q", "posture", "velocity", "angle", "torque", "links", "path")
# Kinds of a value of the summary, of which one has to match: a type; a dict of keys and kinds for a table, in
# which a key with "?" is optional and "*" is any key; a list with one kind for a list. A key that is not
# named in its table is a number if it has one of these endings.
_UNITS = ("_s", "_ms", "_m", "_mm", "_rad", "_rad_s3", "_N", "_Ns", "_J", "_W", "_pct", "_ratio", "_seconds")
_Kinds = tuple[Any, ...]
_TEXT: _Kinds = (str,)
_NUMBER: _Kinds = (int, float, type(None))  # null for numbers that are not finite
_YES: _Kinds = (bool, type(None))
_NUMBERS: _Kinds = ({"*": _NUMBER},)
_TOUCHES: _Kinds = (
    [{**dict.fromkeys(("one", "other"), _TEXT), "depth_mm": (int, float), "missed?": _YES}],
    type(None),
)
_CUT: dict[str, _Kinds] = {"joint": _TEXT, **dict.fromkeys(("ms", "most_Nm", "since_s"), _NUMBER)}
_BLOW: dict[str, _Kinds] = {
    "target?": ({"*": (int, float, bool, type(None))}, type(None)),
    "impulses_Ns?": ([_NUMBER], type(None)),  # of two strikers
}
_BODIES: dict[str, _Kinds] = {"nearest?": (str, type(None)), "contacts_besides?": _TOUCHES}
_LOADS: dict[str, _Kinds] = {
    **dict.fromkeys(
        ("gear_joint?", "motor_joint?", "power_joint?", "velocity_jump_joint?", "motor_cut_joint?"),
        (str, type(None)),
    ),
    "motor_cuts?": ([_CUT],),
}
_SOLES: dict[str, _Kinds] = {
    **dict.fromkeys(("sole_cop_margin_mm?", "sole_force_N?"), ({"*": _NUMBERS}, type(None))),
    "sole_cop_margin_asked_mm?": _NUMBERS,
    "landing_speed_m_s?": (*_NUMBERS, type(None)),
}
_ANY_REPLAY: dict[str, _Kinds] = {
    **_BLOW,
    **_BODIES,
    **_LOADS,
    **dict.fromkeys(("engine?", "reason?", "error?"), _TEXT),
    "beyond_range?": (str, type(None)),
    "standing?": _YES,
    **_SOLES,
}
_SIMULATED = {**_ANY_REPLAY, "torque_ratio?": _NUMBERS, "zmp_margin_m?": _NUMBERS}
_REPLAYED = {
    **_ANY_REPLAY,
    **dict.fromkeys(("torque_ratio_by_phase?", "zmp_margin_by_phase_m?"), (*_NUMBERS, type(None))),
}
_START = {
    **dict.fromkeys(("start", "status"), _TEXT),
    **dict.fromkeys(("impulse_Ns", "seconds"), (int, float)),
    "iterations": (int,),
    "kept": (bool,),
    **dict.fromkeys(("objective?", "max_violation?"), _NUMBER),
}
_PROBLEM = {
    **dict.fromkeys(
        ("name?", "robot?", "striker?", "target?", "target_body?", "law?", "hash?", "hulls?", "collision?"),
        _TEXT,
    ),
    **dict.fromkeys(("point_m?", "normal?"), ([(int, float)],)),
    **dict.fromkeys(("scenarios?", "objectives?", "off?", "gains?"), ([_TEXT],)),
}
_GAINS = {
    "joints": ([_TEXT],),
    "factor": (int, float),
    "between": ([(int, float)],),
    "at_bound": (bool,),
    **dict.fromkeys(("stiffness_N_m_rad", "damping_N_m_s_rad"), _NUMBERS),
}
_SCENARIO = {**_BLOW, "name": _TEXT}
# required keys of a record with arrays
_KEYS: Mapping[str, _Kinds] = {
    **dict.fromkeys(("status", "message", "solver"), _TEXT),
    "violations": ([({"row": _TEXT, "by": _TEXT, "amount?": _NUMBER},)],),
    "starts": ([(_START,)],),
    "iterations": (int,),
    **dict.fromkeys(("solve_seconds", "build_seconds", "max_violation"), _NUMBER),
    "problem": (_PROBLEM,),
}
_OTHERS: Mapping[str, _Kinds] = {
    **_BLOW,
    **_BODIES,
    **_SOLES,
    **_LOADS,
    **dict.fromkeys(("objectives?", "posture_rad?", "velocity_rad_s?"), _NUMBERS),
    **dict.fromkeys(("torque_ratio?", "zmp_margin_m?"), _NUMBERS),
    **dict.fromkeys(("nodes_added?", "reversals?", "freezes?", "price_scale?"), _NUMBER),
    "touches?": (int, [_TEXT]),  # a number in records of older versions
    "stances?": (
        [
            (
                {
                    "soles": ([_TEXT],),
                    "from_s": (int, float),
                    "to_s": (int, float),
                    "moved_m?": ({"*": ([(int, float)],)},),
                },
            )
        ],
    ),
    "ground_force_share?": ([(int, float)], type(None)),
    "collision_elements?": ([(int,)], type(None)),
    "scenarios?": ([(_SCENARIO,)],),
    "simulated?": (_SIMULATED,),
    "replayed?": (_REPLAYED,),
    "versions?": ({"*": _TEXT},),
    "baseline?": ({"*": (str, *_NUMBER, bool, dict, list)},),
    "rows_on_demand?": ([_TEXT],),
    "gains?": ([(_GAINS,)],),
    "set_aside?": ({"directory": _TEXT, "kept": _TEXT},),
    **dict.fromkeys(("note?", "caution?", "gear_caution?", "command?", "style?", "collision_model?"), _TEXT),
}


def check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """ValueError with the name of an array that is missing, or has a wrong type, shape or value."""
    for name, array in arrays.items():
        text = name in _TEXTS and (array.dtype.kind == "U" or not array.size)
        if not text and (name == "joints" or array.dtype.kind not in "biuf"):
            raise ValueError(f"{name} has elements of the kind {array.dtype}")
        if text and not all(str(word).isprintable() for word in array.ravel()):
            raise ValueError(f"{name} has names with control characters")
    sizes: dict[str, int] = {}
    known = [f"{p}_{name}".lstrip("_") for p, shapes in _SCHEMA.items() for name in shapes]
    for prefix, shapes in _SCHEMA.items():
        full_names = {name: f"{prefix}_{name}" if prefix else name for name in shapes}
        # a part, such as "missed", may be left out whole
        if not any(name in arrays for name in (full_names.values() if prefix else known)):
            continue
        sizes = {letter: size for letter, size in sizes.items() if letter in _ROBOT}
        given = {shape for name, shape in shapes.items() if np.size(arrays.get(full_names[name], ()))}
        for name, shape in shapes.items():
            full = full_names[name]
            # optional arrays of a motion come together, those of the robot are of different versions
            wanted = shape in given if prefix else np.size(arrays.get(full, ()))
            if shape.startswith("?") and not wanted:
                continue
            _check_shape(full, arrays, shape.strip("? ").split(), sizes)
            if name in _FINITE and not np.all(np.isfinite(arrays[full])):
                raise ValueError(f"{full} has numbers that are not finite")
        if "time" in shapes:
            time = arrays[full_names["time"]]
            if not len(time) or np.any(np.diff(time) < 0):
                raise ValueError(f"{full_names['time']} does not rise")


def check_soles(arrays: Mapping[str, NDArray[Any]], summary: Mapping[str, Any]) -> None:
    """ValueError for a sole, also one of the summary's stance phases, without corners (c, 2) [m]."""
    names = {name for phase in summary.get("stances") or [] for name in phase["soles"]}
    for name in sorted({f"sole_{name}" for name in names} | {x for x in arrays if x.startswith("sole_")}):
        _check_shape(name, arrays, ["c", "2"], {})
        if not arrays[name].size or not np.all(np.isfinite(arrays[name])):
            raise ValueError(f"{name} has no corners, or some that are not finite")


def _check_shape(
    name: str, arrays: Mapping[str, NDArray[Any]], shape: list[str], sizes: dict[str, int]
) -> None:
    """ValueError for another shape; sizes of new letters are added to `sizes`."""
    if name not in arrays:
        raise ValueError(f"{name} is missing")
    found = arrays[name].shape
    if len(found) == len(shape):
        wanted = [
            int(letter) if letter.isdecimal() else sizes.setdefault(letter, size)
            for letter, size in zip(shape, found, strict=True)
        ]
        if list(found) == wanted:
            return
        shape = list(map(str, wanted))
    raise ValueError(f"{name} has the shape {found}, not ({', '.join(shape)})")


def check_summary(summary: Any, *, whole: bool) -> None:
    """ValueError for a summary with a wrong kind of value, or with control characters in text.

    whole : it is of a record with arrays, for which more keys are required.
    """
    if not isinstance(summary, dict):
        raise ValueError("its summary is no table")
    needed = _KEYS if whole else {f"{name}?": kinds for name, kinds in _KEYS.items()}
    _check_table("", summary, {**needed, **_OTHERS})
    check_plain(summary)
    if text := text_with_control(summary):
        raise ValueError(f"its summary has text with control characters: {text[:40]!r}")


def _check_kind(name: str, value: Any, kinds: _Kinds) -> None:
    """ValueError unless a value is of one of these kinds; name : its path in the summary."""
    for kind in kinds:
        if isinstance(kind, dict) and isinstance(value, dict):
            return _check_table(f"{name}.", value, kind)
        if isinstance(kind, list) and isinstance(value, list):
            (inner,) = kind
            for i, entry in enumerate(value):
                _check_kind(f"{name}[{i}]", entry, inner if isinstance(inner, tuple) else (inner,))
            return None
        # Python's bool is an int
        if (
            isinstance(kind, type)
            and isinstance(value, kind)
            and (kind is bool or not isinstance(value, bool))
        ):
            return None
    raise ValueError(f"{name} in its summary is of the kind {type(value).__name__}")


def _check_table(above: str, table: Mapping[str, Any], kinds: Mapping[str, _Kinds]) -> None:
    """ValueError for a table with a missing key or a wrong value. Other keys, of newer versions, may be."""
    for key, inner in kinds.items():
        name = key.removesuffix("?")
        if name != "*" and name in table:
            _check_kind(f"{above}{name}", table[name], inner)
        elif name == key != "*":
            raise ValueError(f"its summary has no {above}{name}")
    for name, value in table.items():
        if "*" in kinds:
            _check_kind(f"{above}{name}", value, kinds["*"])
        elif name not in kinds and f"{name}?" not in kinds and name.endswith(_UNITS):
            _check_kind(f"{above}{name}", value, _NUMBER)
