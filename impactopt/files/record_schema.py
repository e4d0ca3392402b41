"""What the arrays and the summary of a saved result have to be: names, shapes, kinds of numbers.

What is read back from a disk may be damaged, of another version, or made by someone else. What does not keep
to this is refused as a whole, before anything is drawn or computed from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import has_control

__all__ = ["check_arrays", "check_summary"]

# Letters are sizes: n, nq and nv of the robot in all arrays; others are the same among arrays of one prefix.
_MOTION = {"time": "k", "q": "k nq"}
_REFERENCE = {
    **_MOTION,
    **dict.fromkeys(("v", "a"), "k nv"),
    **{"phase": "k", "torque": "k n", "ground": "k 6", "contact_start": "", "contact_end": "", "end": ""},
}
_HISTORIES = {
    **dict.fromkeys(("force", "target_speed", "hand_speed"), "k"),
    **dict.fromkeys(("slip", "lift", "cop_margin"), "k s"),
    **dict.fromkeys(("impulse", "saturated", "posture_error", "contact_start", "contact_end"), ""),
    "sole_ground": "k s 6",
}
_SCHEMA: Mapping[str, Mapping[str, str]] = {
    "": {"joints": "n", "torque_limit": "n", "velocity_limit": "n", "polygon": "c 2"},
    "reference": {**_REFERENCE, "angle": "k n"},
    "missed": _REFERENCE,
    "strike": {"posture": "nq", "velocity": "nv", "torque": "n"},
    "simulated": {**_MOTION, **_HISTORIES, "v": "k nv", "demand": "k n", "torque": "k n", "angle": "k n"},
    "replayed": {**_MOTION, **_HISTORIES, "soles": "s"},
    "collision": {"time": "m", "force": "m", "target_speed": "m", "torque": "p n"},
    "pose": {"time": "r", "links": "r l 2 3", "path": "k 3", "point": "3", "normal": "3", "contact": ""},
    "history": dict.fromkeys(("iteration", "objective", "max_violation", "kkt"), "i"),
}
_TEXTS = ("joints", "replayed_soles")
_ROBOT = ("n", "nq", "nv")
# of the motion; what there is none of may be NaN
_FINITE = ("time", "q", "posture", "velocity", "angle", "torque", "links", "path")
_NUMBER, _NONE = (int, float), (int, float, type(None))
_KEYS: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("status", "message", "solver"), (str,)),
    **dict.fromkeys(("violations", "starts"), (list,)),
    **dict.fromkeys(("iterations",), (int,)),
    **dict.fromkeys(("solve_seconds", "build_seconds", "max_violation"), _NONE),
    "problem": (dict,),
}
_TYPES: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("target", "objectives", "torque_ratio", "versions", "simulated", "replayed"), (dict,)),
    **dict.fromkeys(("contacts_besides", "collision_elements"), (list, type(None))),
    **dict.fromkeys(("note", "caution", "command"), (str,)),
    **dict.fromkeys(("impulse_Ns", "peak_force_N", "contact_ms", "hand_speed_m_s", "duration_s"), _NONE),
    **dict.fromkeys(("clearance_mm", "collision_error_pct", "nodes_added"), _NONE),
}
_DEEPEST = 20


def check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """ValueError that names the array which is missing, or is not what it should be."""
    for name, array in arrays.items():
        text = name in _TEXTS and (array.dtype.kind == "U" or not array.size)
        if not text and (name == "joints" or array.dtype.kind not in "biuf"):
            raise ValueError(f"{name} has elements of the kind {array.dtype}")
        if text and not all(str(word).isprintable() for word in array.ravel()):
            raise ValueError(f"{name} has names with control characters")
    sizes: dict[str, int] = {}
    known = [f"{p}_{name}".lstrip("_") for p, shapes in _SCHEMA.items() for name in shapes]
    for prefix, shapes in _SCHEMA.items():
        of = {name: f"{prefix}_{name}" if prefix else name for name in shapes}
        if not any(name in arrays for name in (of.values() if prefix else known)):
            continue
        sizes = {letter: size for letter, size in sizes.items() if letter in _ROBOT}
        for name, shape in shapes.items():
            _check_shape(of[name], arrays, shape.split(), sizes)
            if name in _FINITE and not np.all(np.isfinite(arrays[of[name]])):
                raise ValueError(f"{of[name]} has numbers that are not finite")
        if "time" in shapes and not _rises(arrays[of["time"]]):
            raise ValueError(f"{of['time']} does not rise")


def _check_shape(
    name: str, arrays: Mapping[str, NDArray[Any]], shape: list[str], sizes: dict[str, int]
) -> None:
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


def _rises(time: NDArray[Any]) -> bool:
    return len(time) > 0 and bool(np.all(np.diff(time) >= 0))


def check_summary(summary: Any, *, whole: bool) -> None:
    """ValueError for a summary that is none: a wrong kind of value, text that a terminal would obey.

    whole : it is of a record with arrays, of which more is read.
    """
    if not isinstance(summary, dict):
        raise ValueError("its summary is no table")
    for name, kinds in _KEYS.items():
        if name in summary:
            _check_kind(name, summary[name], kinds)
        elif whole:
            raise ValueError(f"its summary has no {name}")
    for name in _TYPES.keys() & summary.keys():
        _check_kind(name, summary[name], _TYPES[name])
    for name in ("violations", "starts"):
        for entry in summary.get(name, ()):
            _check_kind(name, entry, (dict,))
    for text in _texts(summary):
        if has_control(text):
            raise ValueError(f"its summary has text with control characters: {text[:40]!r}")


def _check_kind(name: str, value: Any, kinds: tuple[type, ...]) -> None:
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ValueError(f"{name} in its summary is of the kind {type(value).__name__}")


def _texts(data: Any, depth: int = 0) -> Iterator[str]:
    if depth > _DEEPEST:
        raise ValueError(f"its summary is nested deeper than {_DEEPEST}")
    if isinstance(data, str):
        yield data
    elif isinstance(data, dict):
        for key, value in data.items():
            yield key
            yield from _texts(value, depth + 1)
    elif isinstance(data, list):
        for value in data:
            yield from _texts(value, depth + 1)
