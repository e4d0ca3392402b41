"""The result of a sweep: one row a case in a Parquet file, which pandas, polars and DuckDB read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_choice, missing_package
from impactopt.files.output import write_file
from impactopt.sweeps.design import Columns

__all__ = ["merge_kinds", "pyarrow", "read_columns", "unit_of", "without_unit", "write_table"]

Part = tuple[int, Columns]  # the first case, and columns of it and those after it

ROWS = 1 << 16  # in a group of rows, at least; small units are put together
# how a column's name ends, and its unit; `_N_m` is a stiffness's where it is one
_UNITS = {
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


def pyarrow() -> Any:
    """The module that writes Parquet.

    Raises
    ------
    InputError : it is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise missing_package("a sweep's table", "pyarrow", "sweep") from error
    return pyarrow


def unit_of(name: str) -> str:
    """The unit that a column's name has, "" for none: impulse_Ns is in N s."""
    if name.endswith("seconds"):
        return "s"
    # the last part that ends with one: others name a joint, or an entry of a list
    for part in reversed(name.split(".")):
        ends = [end for end in _UNITS if part.endswith(end)]
        if ends:
            end = max(ends, key=len)
            return "N/m" if end == "_N_m" and part.startswith(("stiffness", "hardening")) else _UNITS[end]
    return ""


def without_unit(name: str) -> str:
    """A column's name without its unit: target.mass_kg is target.mass."""
    parts = name.split(".")
    for k in reversed(range(len(parts))):
        ends = [end for end in _UNITS if parts[k].endswith(end)]
        if ends:
            parts[k] = parts[k].removesuffix(max(ends, key=len))
            break
    return ".".join(parts)


def read_columns(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Columns of a table: numbers, nan where there is none, or texts.

    Raises
    ------
    InputError : it has no such column; it cannot be read.
    """
    arrow = pyarrow()
    try:
        there = arrow.parquet.read_schema(path).names
        for name in names:
            check_choice(f"{path} has no column", name, there)
        table = arrow.parquet.read_table(path, columns=list(names))
    except (OSError, arrow.ArrowException) as error:
        raise InputError(f"cannot read {path}: {error}") from error
    return {name: table[name].to_numpy() for name in table.column_names}


def write_table(
    path: Path, parts: Iterable[Part], kinds: Mapping[str, str], metadata: Mapping[str, str]
) -> None:
    """Write rows in their order; the file takes the place of the one before in one step.

    parts : first case and columns of each; a column that a part does not have is null there.
    kinds : by column what it holds, "float", "int", "bool", "text" or "json" (`merge_kinds`).
    metadata : text by name, under `impactopt.<name>`; units are each column's own, and all under `units`.

    Raises
    ------
    InputError : it cannot be written.
    """
    arrow = pyarrow()
    types = {
        "float": arrow.float64(),
        "int": arrow.int64(),
        "bool": arrow.bool_(),
        "text": arrow.string(),
        "json": arrow.string(),
    }
    fields = [arrow.field("case", arrow.int64())]
    units = {name: unit_of(name) for name in kinds if unit_of(name)}
    for name, kind in kinds.items():
        own = {"unit": units[name]} if name in units else None
        fields.append(arrow.field(name, types[kind], metadata=own))
    said = {**metadata, "units": json.dumps(units)}
    schema = arrow.schema(fields, metadata={f"impactopt.{name}": text for name, text in said.items()})

    def write(file: Any) -> None:
        with arrow.parquet.ParquetWriter(file, schema) as writer:
            for cases, columns in _groups(parts, tuple(kinds)):
                arrays = [arrow.array(cases, arrow.int64())]
                arrays += [_array(arrow, columns[name], kind, types[kind]) for name, kind in kinds.items()]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

    write_file(path, write)


def merge_kinds(kinds: dict[str, str], columns: Columns) -> None:
    """Add to the kinds of columns what more of their values say."""
    for name, values in columns.items():
        kind = _kind(values)
        before = kinds.get(name, "")
        if before and kind and kind != before:
            kind = "float" if {kind, before} == {"int", "float"} else "json"
        kinds[name] = kind or before


def _kind(values: Sequence[Any] | NDArray[Any]) -> str:
    """Type of values; "" for nothing but None."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
        return {"f": "float", "b": "bool"}.get(values.dtype.kind, "int")
    names = {bool: "bool", int: "int", float: "float", str: "text"}
    found = {names.get(type(value), "json") for value in values if value is not None}
    if found == {"int", "float"}:
        return "float"
    return found.pop() if len(found) == 1 else "json" if found else ""


def _array(arrow: Any, values: Any, kind: str, of: Any) -> Any:
    if kind == "json":
        values = [None if value is None else json.dumps(value) for value in values]
    elif kind == "float":
        # no number is nan in an array, None in a list; both are null in the table
        values = np.array(
            [np.nan if x is None else x for x in values] if isinstance(values, list) else values
        )
        return arrow.array(values.astype(np.float64), of, mask=np.isnan(values.astype(np.float64)))
    return arrow.array(values, of)


def _groups(
    parts: Iterable[Part], names: Sequence[str]
) -> Iterator[tuple[NDArray[np.int64], dict[str, Any]]]:
    """Parts put together, so that a file of many small ones is read as fast as one of a few."""
    held: list[Part] = []
    rows = 0
    for first, columns in parts:
        held.append((first, columns))
        rows += _length(columns)
        if rows >= ROWS:
            yield _joined(held, names)
            held, rows = [], 0
    if held:
        yield _joined(held, names)


def _joined(parts: Sequence[Part], names: Sequence[str]) -> tuple[NDArray[np.int64], dict[str, Any]]:
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
