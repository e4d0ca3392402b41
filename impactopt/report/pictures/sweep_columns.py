"""A sweep's table as its picture takes it: numbers and texts by name, groups of rows, errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.report.pictures.style import joint_label
from impactopt.sweeps.sections import Figure as Section
from impactopt.sweeps.table import unit_of, without_unit

__all__ = ["Columns", "SweepColumns", "combined", "errors_against", "name_of_error"]

Array = NDArray[np.float64]
Columns = Mapping[str, Sequence[Any] | NDArray[Any]]


class SweepColumns:
    """Columns as numbers, or as text."""

    def __init__(self, section: Section, columns: Columns) -> None:
        self.section, self._columns = section, columns
        reasons = columns.get("reason", ())
        self.reasons = Counter(str(r) for r in reasons if r)
        self.good = np.array([not r for r in reasons], dtype=bool) if len(reasons) else None

    def values(self, name: str) -> NDArray[Any]:
        """Numbers, nan in rows without any, or objects."""
        raw = self._columns[name]
        if not isinstance(raw, np.ndarray) or raw.dtype == object:
            there = [x for x in raw if x is not None]
            if any(not isinstance(x, (int, float, bool)) for x in there):
                return np.array(["" if x is None else str(x) for x in raw], dtype=object)
        array = np.array(raw, dtype=np.float64)
        return array

    def numbers(self, name: str) -> Array:
        array = self.values(name)
        if array.dtype == object:
            raise InputError(f"[figure]: {name} is no column of numbers; take another one")
        return array

    def results(self, name: str) -> Array:
        """Numbers, nan in rows that are impossible."""
        array = self.numbers(name)
        return array if self.good is None else np.where(self.good, array, np.nan)

    def label(self, name: str) -> str:
        return self.section.labels.get(name, _label(name))

    def note(self) -> str:
        """Reasons why rows are impossible, most frequent first."""
        return "; ".join(reason.partition(";")[0] for reason, _ in self.reasons.most_common(2))


def _label(name: str) -> str:
    """`target.mass_kg` as "target mass [kg]"."""
    unit, parts = unit_of(name), without_unit(name).split(".")
    if parts[0] == "at_contact":
        parts = parts[1:]
        if parts[0] == "joints":
            return f"{joint_label(parts[1])} moved by [rad]"
        parts = ["speed at contact"] if parts == ["speed"] else parts
    elif parts[0] in ("problem", "robot"):
        parts = parts[1:]
    text = " ".join(parts).replace("_", " ")
    return f"{text.replace('zmp', 'ZMP')} [{unit}]" if unit else text


def name_of_error(section: Section, data: SweepColumns, name: str) -> str:
    what = data.label(name).partition(" [")[0]
    given = section.labels.get(name)
    return given or f"{what}: {'size of the ' if 'y' in section.log else ''}error [%]"


def errors_against(section: Section, data: SweepColumns, values: Array) -> Array:
    """Deviations [%] from the rows with the same x, panel and all other keys but these."""
    keys = {name: data.values(name) for name in section.against}
    base = np.ones(len(values), dtype=bool)
    for name, wanted in section.against.items():
        base &= keys[name] == (str(wanted) if keys[name].dtype == object else wanted)
    if not base.any():
        raise InputError(f"[figure] against: no row has {section.against}")
    rest = [section.x, *([section.panel] if section.panel else [])]
    place = list(zip(*[data.values(name).tolist() for name in rest], strict=True))
    true = {place[i]: values[i] for i in np.flatnonzero(base)}
    of = np.array([true.get(p, np.nan) for p in place])
    off = np.where(base, np.nan, 100 * (values / of - 1))
    return np.abs(off) if "y" in section.log else off


def combined(names: Sequence[str], data: SweepColumns) -> tuple[NDArray[np.intp], list[str]]:
    """Combination of the columns' values in each row, by number, and the combinations' names."""
    if not names:
        return np.zeros(len(data.values(data.section.x)), dtype=np.intp), [""]
    columns = [data.values(name) for name in names]
    rows = list(zip(*[column.tolist() for column in columns], strict=True))
    found = list(dict.fromkeys(rows))
    if all(isinstance(v, float) for row in found for v in row):
        found.sort()
    index = {row: k for k, row in enumerate(found)}
    called = [", ".join(_shown(v, name, data) for v, name in zip(row, names, strict=True)) for row in found]
    return np.array([index[row] for row in rows], dtype=np.intp), called


def _shown(value: Any, name: str, data: SweepColumns) -> str:
    if not isinstance(value, float):
        return str(value)
    if data.section.colour == [name]:  # whose name stands above
        return f"{value:g}"
    label = data.label(name)
    what, _, unit = label.partition(" [")
    return f"{what} {value:g}{' ' + unit.rstrip(']') if unit else ''}"
