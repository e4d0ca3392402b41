"""Columns of a sweep's table for its picture: numbers and texts by name, groups of cases, errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.arrays import Array, Index
from impactopt.errors import InputError
from impactopt.report.pictures.style import joint_label
from impactopt.sweeps.sections import Figure as Section
from impactopt.sweeps.table import unit_of, without_unit

Columns = Mapping[str, Sequence[Any] | NDArray[Any]]


class SweepColumns:
    """Columns of a sweep's table, as numbers or as text.

    good : mask of the cases with a result.  reasons : counts of the reasons why others have none.  units :
    of the columns; None: those in their names.
    """

    def __init__(self, section: Section, columns: Columns, units: Mapping[str, str] | None = None) -> None:
        self.section, self._columns = section, columns
        self._units = {name: unit_of(name) for name in columns} if units is None else units
        reasons = columns.get("reason", ())
        # without what follows, which is each case's own
        self.reasons = Counter(str(r).partition(";")[0] for r in reasons if r)
        self.good = np.array([not r for r in reasons], dtype=bool) if len(reasons) else None

    def values(self, name: str) -> NDArray[Any]:
        """Numbers, nan without a value; or texts, of dtype object."""
        raw = self._columns[name]
        if not isinstance(raw, np.ndarray) or raw.dtype == object:
            given = [x for x in raw if x is not None]
            if any(not isinstance(x, (int, float, bool)) for x in given):
                return np.array(["" if x is None else str(x) for x in raw], dtype=object)
        return np.array(raw, dtype=np.float64)

    def is_numeric(self, name: str) -> bool:
        """True for a column of numbers, False for one of texts."""
        return self.values(name).dtype != object

    def numbers(self, name: str) -> Array:
        """Numbers of a column.

        Raises
        ------
        InputError : it is a column of texts.
        """
        array = self.values(name)
        if array.dtype == object:
            raise InputError(f"[figure]: {name} is no column of numbers; take another one")
        return array

    def results(self, name: str) -> Array:
        """Numbers of a column, nan in cases without a result."""
        array = self.numbers(name)
        return array if self.good is None else np.where(self.good, array, np.nan)

    def label(self, name: str) -> str:
        """Label of a column, with its unit."""
        return self.section.labels.get(name, _label(name, self._units.get(name, "")))

    def note(self) -> str:
        """The two most frequent reasons why cases have no result."""
        return "; ".join(reason for reason, _ in self.reasons.most_common(2))


def _label(name: str, unit: str) -> str:
    """Label of a column, such as "target mass [kg]" of `target.mass_kg`."""
    parts = without_unit(name).split(".")
    if parts[0] == "at_contact":
        parts = parts[1:]
        if parts[0] == "joints":
            return f"{joint_label(parts[1])} moved by [{unit}]"
        parts = ["speed at contact"] if parts == ["speed"] else parts
    elif parts[0] in ("problem", "robot"):
        parts = parts[1:]
    text = " ".join(parts).replace("_", " ")
    return f"{text.replace('zmp', 'ZMP')} [{unit}]" if unit else text


def name_of_error(section: Section, data: SweepColumns, name: str) -> str:
    """Label of the error of a column."""
    what = data.label(name).partition(" [")[0]
    given = section.labels.get(name)
    return given or f"{what}: {'size of the ' if 'y' in section.log else ''}error [%]"


def errors_against(section: Section, data: SweepColumns, values: Array) -> Array:
    """Errors [%] against the reference cases, given by `section.against`, with the same x and panel."""
    keys = {name: data.values(name) for name in section.against}
    base = np.ones(len(values), dtype=bool)
    for name, wanted in section.against.items():
        base &= keys[name] == (str(wanted) if keys[name].dtype == object else wanted)
    if not base.any():
        raise InputError(f"[figure] against: no row has {section.against}")
    shared = [section.x, *([section.panel] if section.panel else [])]
    points = list(zip(*[data.values(name).tolist() for name in shared], strict=True))
    reference: dict[tuple[Any, ...], float] = {}
    for i in np.flatnonzero(base & np.isfinite(values)):
        if reference.setdefault(points[i], values[i]) != values[i]:
            raise InputError(
                f"[figure] against: several rows with {section.against} have the same "
                f"{' and '.join(shared)}, and other results; take the key in which they differ as the panel, "
                "or give it one value"
            )
    true = np.array([reference.get(point, np.nan) for point in points])
    error = np.where(base, np.nan, 100 * (values / true - 1))
    return np.abs(error) if "y" in section.log else error


def combined(names: Sequence[str], data: SweepColumns) -> tuple[Index, list[str]]:
    """Number of each case's combination of the columns' values, and names of the combinations."""
    if not names:
        return np.zeros(len(data.values(data.section.x)), dtype=np.intp), [""]
    columns = [data.values(name) for name in names]
    of_cases = list(zip(*[column.tolist() for column in columns], strict=True))
    different = list(dict.fromkeys(of_cases))
    if all(isinstance(v, float) for values in different for v in values):
        different.sort()
    number = {values: k for k, values in enumerate(different)}
    labels = [
        ", ".join(_shown(v, name, data) for v, name in zip(values, names, strict=True))
        for values in different
    ]
    return np.array([number[values] for values in of_cases], dtype=np.intp), labels


def _shown(value: Any, name: str, data: SweepColumns) -> str:
    """Value as text, with the name of its column unless the legend's title has it."""
    if not isinstance(value, float):
        return str(value)
    if data.section.colour == [name]:  # the legend's title names it
        return f"{value:g}"
    label = data.label(name)
    what, _, unit = label.partition(" [")
    return f"{what} {value:g}{' ' + unit.rstrip(']') if unit else ''}"
