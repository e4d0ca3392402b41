"""What a person sees in the terminal: progress while a problem is solved, and the results as a table."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.status import Status
from rich.table import Table

from impactopt.program import IterationRecord

__all__ = ["Progress", "result_table", "violation_table"]

PHASES = ("swing", "collision", "follow")
QUIET_BETWEEN = 1.0  # seconds between lines about iterations where lines cannot be rewritten


class Progress:
    """Lines about what is being done, and a live line about the iterations.

    Where there is no terminal, iterations are plain lines, one a second at most.
    """

    def __init__(self, console: Console, *, quiet: bool = False) -> None:
        self._console, self._quiet = console, quiet
        self._live: Status | None = None
        self._last = -QUIET_BETWEEN
        self._start = time.perf_counter()

    def __enter__(self) -> Progress:
        if self._console.is_terminal and not self._quiet:
            self._live = self._console.status("starting")
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """One more thing is done or begun."""
        if self._quiet:
            return
        elapsed = time.perf_counter() - self._start
        self._console.print(f"{elapsed:6.1f} s  {escape(text)}", highlight=False, soft_wrap=True)
        if self._live is not None:
            self._live.update(escape(text))

    def iteration(self, record: IterationRecord) -> None:
        """A solver's callback."""
        text = (
            f"iteration {record.iteration:4d}   objective {record.objective:10.4f}   "
            f"violation {record.max_violation:8.1e}   {record.seconds:6.1f} s"
        )
        if self._quiet:
            return
        if self._live is not None:
            self._live.update(text)
        elif record.seconds - self._last >= QUIET_BETWEEN:
            self._last = record.seconds
            self._console.print(f"          {text}", highlight=False, soft_wrap=True)


def result_table(summary: Mapping[str, Any]) -> Table:
    """Planned beside simulated; what is outside its limit is marked."""
    simulated = summary.get("simulated", {})
    if "error" in simulated:
        simulated = {}
    table = Table(title=escape(str(summary.get("problem", {}).get("name", "result"))), title_justify="left")
    table.add_column("")
    table.add_column("planned", justify="right")
    if simulated:
        table.add_column("simulated", justify="right")
    for label, key, digits in (
        ("impulse [N s]", "impulse_Ns", 2),
        ("peak force [N]", "peak_force_N", 0),
        ("contact time [ms]", "contact_ms", 1),
        ("hand speed at contact [m/s]", "hand_speed_m_s", 3),
    ):
        _row(table, label, summary.get(key), simulated, key, digits)
    for label, key, digits, scale, least, most in (
        ("ZMP margin [mm]", "zmp_margin_m", 1, 1e3, 0.0, np.inf),
        ("torque demand / limit", "torque_ratio", 2, 1.0, 0.0, 1.0),
    ):
        for phase in PHASES:
            values = [source.get(key, {}).get(phase) for source in (summary, simulated)]
            if values[0] is not None or values[1] is not None:
                cells = [_cell(v, digits, scale=scale, good=v is None or least <= v <= most) for v in values]
                table.add_row(escape(f"{label}, {phase}"), *cells[: 2 if simulated else 1])
    if simulated:
        for label, key, digits in (
            ("least normal force [N]", "min_normal_force_N", 0),
            ("largest slip of a sole [mm]", "sole_slip_mm", 3),
            ("largest lift of a sole [mm]", "sole_lift_mm", 3),
            ("impulse error [%]", "impulse_error_pct", 2),
        ):
            if key in simulated:
                lifted = key == "min_normal_force_N" and (simulated[key] or 0) <= 0
                table.add_row(escape(label), "", _cell(simulated[key], digits, good=not lifted))
    return table


def _row(
    table: Table, label: str, planned: float | None, simulated: Mapping[str, Any], key: str, digits: int
) -> None:
    cells = [_cell(planned, digits)]
    if simulated:
        cells.append(_cell(simulated.get(key), digits))
    table.add_row(escape(label), *cells)


def _cell(value: float | None, digits: int, *, scale: float = 1.0, good: bool = True) -> str:
    if value is None:
        return "-"
    text = f"{scale * value:.{digits}f}"
    return text if good else f"[bold red]! {text}[/]"


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """The named rows that are not met, worst first."""
    table = Table(title="rows that are not met, worst first", title_justify="left")
    table.add_column("row", overflow="fold")
    table.add_column("off by", justify="right")
    for violation in violations:
        table.add_row(escape(str(violation["row"])), f"{violation['amount']:.2g}")
    return table
