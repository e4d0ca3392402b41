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

__all__ = [
    "Progress",
    "blows_table",
    "replay_table",
    "result_table",
    "starts_table",
    "strike_table",
    "violation_table",
]

PHASES = ("swing", "collision", "follow")
PHASES_OF_STRIKE = ("contact", "collision")
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
    """Planned beside simulated, and beside the replay on free soles; what is outside its limit is marked."""
    columns = {"planned": summary, "simulated": summary.get("simulated", {})}
    return _table(summary, {**columns, "free soles": _by_phase(summary.get("replayed", {}))})


def replay_table(report: Mapping[str, Any], summary: Mapping[str, Any]) -> Table:
    """A replay beside the plan; `report` as in `impactopt validate --json`."""
    name = "free soles" if report["engine"] == "mujoco" else "held soles"
    return _table(summary, {"planned": summary, name: _by_phase(report)})


def strike_table(summary: Mapping[str, Any]) -> Table:
    """The planned blow; `summary` as of a :class:`impactopt.StrikeSolution`."""
    table = _table(summary, {"planned": summary}, PHASES_OF_STRIKE)
    if "capture_margin_m" in summary:
        margin = summary["capture_margin_m"]
        _row(table, "capture point's margin after contact [mm]", [margin], 1, scale=1e3, least=-1e-6)
    return table


def starts_table(starts: Sequence[Mapping[str, Any]]) -> Table:
    """What came of each start; `starts` as in a summary."""
    table = Table(title="starts", title_justify="left")
    for name in ("start", "status", "impulse [N s]", "iterations", "time [s]"):
        table.add_column(name, justify="left" if name in ("start", "status") else "right")
    for start in starts:
        name, numbers = str(start["start"]), (start["impulse_Ns"], start["iterations"], start["seconds"])
        cells = (f"{number:.{digits}f}" for number, digits in zip(numbers, (2, 0, 1), strict=True))
        table.add_row(f"{name}, kept" if start["kept"] else name, str(start["status"]), *cells)
    return table


def _by_phase(report: Mapping[str, Any]) -> dict[str, Any]:
    """A report with its numbers by phase, named as in a summary."""
    names = {"zmp_margin_m": "zmp_margin_by_phase_m", "torque_ratio": "torque_ratio_by_phase"}
    return {**report, **{name: report.get(other) or {} for name, other in names.items()}} if report else {}


def _table(
    summary: Mapping[str, Any], sources: Mapping[str, Mapping[str, Any]], phases: Sequence[str] = PHASES
) -> Table:
    """A column for each source that says something; the first is the plan's."""
    columns = {name: source for name, source in sources.items() if source and "error" not in source}
    table = Table(title=escape(str(summary.get("problem", {}).get("name", "result"))), title_justify="left")
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for label, key, digits in (
        ("impulse [N s]", "impulse_Ns", 2),
        ("peak force [N]", "peak_force_N", 0),
        ("contact time [ms]", "contact_ms", 1),
        ("hand speed at contact [m/s]", "hand_speed_m_s", 3),
    ):
        _row(table, label, [source.get(key) for source in columns.values()], digits)
    _outcome(table, [source.get("target") or {} for source in columns.values()])
    for label, key, digits, scale, least, most in (
        ("ZMP margin [mm]", "zmp_margin_m", 1, 1e3, 0.0, np.inf),
        ("torque demand / limit", "torque_ratio", 2, 1.0, 0.0, 1.0),
    ):
        for phase in phases:
            values = [source.get(key, {}).get(phase) for source in columns.values()]
            _row(table, f"{label}, {phase}", values, digits, scale=scale, least=least, most=most)
    replays = list(columns.values())[1:]
    for label, key, digits in (
        ("least normal force [N]", "min_normal_force_N", 0),
        ("largest slip of a sole [mm]", "sole_slip_mm", 2),
        ("largest lift of a sole [mm]", "sole_lift_mm", 2),
        ("impulse error [%]", "impulse_error_pct", 2),
    ):
        _row(table, label, [None, *(source.get(key) for source in replays)], digits, first="")
    if any(source.get("standing") is not None for source in replays):
        _stands(table, replays)
    return table


def _outcome(table: Table, targets: Sequence[Mapping[str, Any]]) -> None:
    """What the blow has brought the target, where that is known."""
    _row(table, "speed of the target [m/s]", [target.get("speed_m_s") for target in targets], 3)
    _row(table, "driven into the wood [mm]", [target.get("depth_m") for target in targets], 2, scale=1e3)
    broken = [target.get("broken") for target in targets]
    if any(value is not None for value in broken):
        table.add_row("the board breaks", *("-" if b is None else "yes" if b else "no" for b in broken))


def _stands(table: Table, replays: Sequence[Mapping[str, Any]]) -> None:
    words = {True: "yes", False: "[bold red]! no[/]", None: "-"}
    table.add_row("stands at the end", "", *(words[source.get("standing")] for source in replays))


def _row(
    table: Table,
    label: str,
    values: Sequence[float | None],
    digits: int,
    *,
    scale: float = 1.0,
    least: float = -np.inf,
    most: float = np.inf,
    first: str | None = None,
) -> None:
    """A row where some column has a number; `first` instead of the first one."""
    if all(value is None for value in values):
        return
    cells = [_cell(v, digits, scale=scale, good=v is None or least <= v <= most) for v in values]
    table.add_row(escape(label), *([first, *cells[1:]] if first is not None else cells))


def _cell(value: float | None, digits: int, *, scale: float = 1.0, good: bool = True) -> str:
    if value is None:
        return "-"
    text = f"{scale * value:.{digits}f}"
    return text if good else f"[bold red]! {text}[/]"


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """What is not met, worst first."""
    table = Table(title="what is not met, worst first", title_justify="left")
    table.add_column("row", overflow="fold")
    table.add_column("by how much", overflow="fold")
    for violation in violations:
        table.add_row(escape(str(violation["row"])), escape(str(violation["by"])))
    return table


def blows_table(series: Mapping[str, Any]) -> Table:
    """A row for each blow on a nail; `series` as in `impactopt drive --json`."""
    table = Table(title="blows on the nail", title_justify="left")
    columns = (
        ("driven [mm]", "driven_m", 1e3, 1),
        ("depth [mm]", "depth_m", 1e3, 1),
        ("impulse [N s]", "impulse_Ns", 1.0, 2),
        ("peak force [N]", "peak_force_N", 1.0, 0),
        ("speed [m/s]", "hand_speed_m_s", 1.0, 2),
        ("solved in [s]", "solve_seconds", 1.0, 1),
    )
    for name in ("blow", *(label for label, *_ in columns)):
        table.add_column(name, justify="right")
    for k, blow in enumerate(series["blows"], start=1):
        table.add_row(str(k), *(f"{scale * blow[key]:.{n}f}" for _, key, scale, n in columns))
    return table
