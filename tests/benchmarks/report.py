"""What a bench, or a table or figure of the paper, gives; its tables, and how it is kept."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

    from impactopt.report.pictures.style import Picture

Say = Callable[[str], None]  # told in words what is being done
Column = tuple[str, str, int | str]  # heading, key of a row, digits or format


@dataclass(frozen=True, kw_only=True)
class Report:
    """What a bench found.

    name : of the bench, and of its files.  numbers : for JSON.  tables : for the screen.
    figures : makes the pictures, by file name without .png; made only where they are kept.
    """

    name: str
    numbers: Mapping[str, Any]
    tables: Sequence[Table] = ()
    figures: Mapping[str, Callable[[], Picture]] = field(default_factory=dict)


def timed(run: Callable[..., Report], say: Say, **options: Any) -> Report:
    """A bench's report; how long it took, on what and with which versions stand in its numbers."""
    began = time.perf_counter()
    report = run(say, **options)
    extra = {"seconds": round(time.perf_counter() - began, 1), "versions": _versions(), "machine": machine()}
    return replace(report, numbers={**report.numbers, **extra})


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cpus": os.cpu_count(),
    }


def _processor() -> str:
    try:  # platform.processor() says little, or nothing, on Linux
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    from impactopt.planning.solution import versions

    found = versions()
    for name in ("mujoco", "unopy", "pounce-solver"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def make_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Cells as plain text: the first column to the left, the others to the right."""
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    # without lines between columns ten of them fit into a terminal
    style: Any = {"box": SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_justify": "left"}
    table = Table(title=escape(title), show_header=any(columns), **style)
    for k, column in enumerate(columns):
        table.add_column(escape(column), justify="right" if k else "left", no_wrap=k == 0 and any(columns))
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    return table


def columns_table(title: str, columns: Sequence[Column], rows: Sequence[Mapping[str, Any]]) -> Table:
    """Rows by key, in the order of the columns; "-" where a row has no such key."""
    cells = [[cell(row.get(key), digits) for _, key, digits in columns] for row in rows]
    return make_table(title, [heading for heading, _, _ in columns], cells)


def cell(value: Any, digits: int | str) -> str:
    """A number, or yes or no, as a table has it; text stays as it is; "-" for None and nan.

    digits : behind the point, or a format.
    """
    if value is None or value != value:  # nan
        return "-"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    form = digits if isinstance(digits, str) else f".{digits}f"
    return f"{value:{form}}"


def save_report(report: Report, directory: Path) -> list[Path]:
    """Write the numbers and pictures of a report.

    Raises
    ------
    InputError : they cannot be written.
    """
    from impactopt.files.output import write_file
    from impactopt.files.record import plain

    written = [directory / f"{report.name}.json"]
    text = json.dumps(plain(report.numbers), indent=2, allow_nan=False)
    write_file(written[0], lambda file: file.write(f"{text}\n".encode()))
    for name, draw in report.figures.items():
        write_file(directory / f"{name}.png", draw().write)
        written.append(directory / f"{name}.png")
    return written
