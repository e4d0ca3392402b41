"""Table of a sweep's results: a Parquet file with one row for each case, for pandas, polars or DuckDB."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_choice, missing_package
from impactopt.files.output import write_file
from impactopt.sweeps.design import Columns

Part = tuple[int, Columns]  # number of the first case, and columns of consecutive cases from it on

MIN_GROUP = 1 << 16  # rows in one of the file's row groups, but for the last; small units are joined
# Units by the endings of columns' names. `_N_m` is N/m for stiffness and hardening (`unit_of`).
UNITS = {
    "_N_m_rad": "N m/rad",
    "_N_m_s_rad": "N m s/rad",
    "_N_s_m": "N s/m",
    "_N_m_s": "N m s",
    "_N_mp": "N/m^p",
    "_N_m1_5": "N/m^1.5",
    "_N_s_m1_25": "N s/m^1.25",
    "_N2m2s2": "(N m s)^2",
    "_kg_m2": "kg m^2",
    "_rad_s": "rad/s",
    "_m_s": "m/s",
    "_s_m": "s/m",
    "_N_m": "N m",
    "_Ns": "N s",
    "_ms": "ms",
    "_kg": "kg",
    "_rad": "rad",
    "_N": "N",
    "_J": "J",
    "_m": "m",
    "_s": "s",
}

# of prismatic joints' values
LINEAR_UNITS = {
    "rad": "m",
    "rad/s": "m/s",
    "N m": "N",
    "N m/rad": "N/m",
    "N m s/rad": "N s/m",
    "kg m^2": "kg",
}

START = "started_from"  # column with the solved case that a solve started from; "": none
# entries of a plan's summary that are columns of the same name
SUMMARY_COLUMNS = (
    START,
    "impulse_Ns",
    "peak_force_N",
    "contact_ms",
    "hand_speed_m_s",
    "duration_s",
    "capture_margin_m",
    "max_violation",
    "iterations",
    "solve_seconds",
    "build_seconds",
)
PLAN_COLUMNS = ("case", "status", "reason", "seconds", *SUMMARY_COLUMNS)
# prefixes of a plan's other columns, which its target and objectives determine
PLAN_PREFIXES = ("target_", "torque_ratio_", "zmp_margin_", "objective_")


def pyarrow() -> Any:
    """Module pyarrow, with its parquet.

    Raises
    ------
    InputError : pyarrow is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise missing_package("a sweep's table", "pyarrow", "sweep") from error
    return pyarrow


def unit_of(name: str, prismatic: Collection[str] = ()) -> str:
    """Unit in a column's name, "" for none: impulse_Ns is in N s.

    prismatic : joints whose values are in `LINEAR_UNITS`, as at_contact.joints_rad.slide in m.
    """
    if name.endswith("seconds"):
        return "s"
    k, end = _ending(name)
    parts = name.split(".")
    stiff = end == "_N_m" and parts[k].startswith(("stiffness", "hardening"))
    unit = "N/m" if stiff else UNITS.get(end, "")
    return LINEAR_UNITS.get(unit, unit) if ".".join(parts[k + 1 :]) in prismatic else unit


def without_unit(name: str) -> str:
    """Name of a column without its unit: target.mass for target.mass_kg."""
    parts, (k, end) = name.split("."), _ending(name)
    parts[k] = parts[k].removesuffix(end)
    return ".".join(parts)


def _ending(name: str) -> tuple[int, str]:
    """Index of the last part of a key path with a unit, as later ones name a joint, or an index of a list;
    and the part's ending, one of `UNITS`, or "".
    """
    parts = name.split(".")
    for k in reversed(range(len(parts))):
        if ends := [end for end in UNITS if parts[k].endswith(end)]:
            return k, max(ends, key=len)
    return 0, ""


def read_columns(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Columns of a table: numbers, nan for a null, or texts.

    Raises
    ------
    InputError : there is no such column; the table cannot be read.
    """
    arrow = pyarrow()
    try:
        known = arrow.parquet.read_schema(path).names
        for name in names:
            check_choice(f"{path} has no column", name, known)
        table = arrow.parquet.read_table(path, columns=list(names))
    except (OSError, arrow.ArrowException) as error:
        raise InputError(f"cannot read {path}: {error}") from error
    return {name: table[name].to_numpy() for name in table.column_names}


def read_units(path: Path) -> dict[str, str]:
    """Units of a table's columns by name, as `write_table` has written them."""
    metadata = pyarrow().parquet.read_schema(path).metadata or {}
    units: dict[str, str] = json.loads(metadata.get(b"impactopt.units", b"{}"))
    return units


def write_table(
    path: Path,
    parts: Iterable[Part],
    kinds: Mapping[str, str],
    metadata: Mapping[str, str],
    prismatic: Collection[str] = (),
) -> None:
    """Write a table, with rows in the order of the parts; it replaces an old file atomically.

    parts : a column that a part does not have is null there.
    kinds : type of each column, "float", "int", "bool", "text" or "json", or "" for nulls only
        (`merge_kinds`).
    metadata : text by name, under `impactopt.<name>`. Each column has its unit, and `impactopt.units` has
    all.
    prismatic : joints, as of `unit_of`.

    Raises
    ------
    InputError : the file cannot be written.
    """
    arrow = pyarrow()
    types = {
        "float": arrow.float64(),
        "int": arrow.int64(),
        "bool": arrow.bool_(),
        "text": arrow.string(),
        "json": arrow.string(),
        "": arrow.float64(),  # a number that no case has, such as the peak force of rigid impacts
    }
    fields = [arrow.field("case", arrow.int64())]
    units = {name: unit for name in kinds if (unit := unit_of(name, prismatic))}
    for name, kind in kinds.items():
        own = {"unit": units[name]} if name in units else None
        fields.append(arrow.field(name, types[kind], metadata=own))
    texts = {**metadata, "units": json.dumps(units)}
    schema = arrow.schema(fields, metadata={f"impactopt.{name}": text for name, text in texts.items()})

    def write(file: Any) -> None:
        with arrow.parquet.ParquetWriter(file, schema) as writer:
            for cases, columns in _groups(parts, tuple(kinds)):
                arrays = [arrow.array(cases, arrow.int64())]
                arrays += [_array(arrow, columns[name], kind, types[kind]) for name, kind in kinds.items()]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

    write_file(path, write)


def merge_kinds(kinds: dict[str, str], columns: Columns) -> None:
    """Update the kinds of columns by more of their values; "json" if values are of different kinds, "" while
    all are None.
    """
    for name, values in columns.items():
        kind = _kind(values)
        before = kinds.get(name, "")
        if before and kind and kind != before:
            kind = "float" if {kind, before} == {"int", "float"} else "json"
        kinds[name] = kind or before


def _kind(values: Sequence[Any] | NDArray[Any]) -> str:
    """Kind of values; "" if all are None."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
        return {"f": "float", "b": "bool"}.get(values.dtype.kind, "int")
    names = {bool: "bool", int: "int", float: "float", str: "text"}
    found = {names.get(type(value), "json") for value in values if value is not None}
    if found == {"int", "float"}:
        return "float"
    return found.pop() if len(found) == 1 else "json" if found else ""


def _array(arrow: Any, values: Any, kind: str, arrow_type: Any) -> Any:
    """Values of a column as a pyarrow array."""
    if kind == "json":
        values = [None if value is None else json.dumps(value) for value in values]
    elif kind == "float":
        # a missing number is nan in an array, None in a list, and null in the table
        numbers = [np.nan if x is None else x for x in values] if isinstance(values, list) else values
        floats = np.array(numbers).astype(np.float64)
        return arrow.array(floats, arrow_type, mask=np.isnan(floats))
    return arrow.array(values, arrow_type)


def _groups(
    parts: Iterable[Part], names: Sequence[str]
) -> Iterator[tuple[NDArray[np.int64], dict[str, Any]]]:
    """Case numbers and columns of row groups: parts are joined, as many small groups are slow to read."""
    group: list[Part] = []
    rows = 0
    for first, columns in parts:
        group.append((first, columns))
        rows += _length(columns)
        if rows >= MIN_GROUP:
            yield _joined(group, names)
            group, rows = [], 0
    if group:
        yield _joined(group, names)


def _joined(parts: Sequence[Part], names: Sequence[str]) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Case numbers (k,) and columns of several parts; a column that a part does not have is None there."""
    cases = np.concatenate([first + np.arange(_length(columns)) for first, columns in parts])
    out: dict[str, Any] = {}
    for name in names:
        pieces = [columns.get(name, [None] * _length(columns)) for _, columns in parts]
        if all(isinstance(piece, np.ndarray) for piece in pieces):
            out[name] = np.concatenate(pieces)
        else:
            out[name] = [
                x for piece in pieces for x in (piece.tolist() if isinstance(piece, np.ndarray) else piece)
            ]
    return cases, out


def _length(columns: Columns) -> int:
    return len(next(iter(columns.values())))
