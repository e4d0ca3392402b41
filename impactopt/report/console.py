"""Terminal output: progress while a problem is solved, and the results as a table."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.status import Status
from rich.table import Table

from impactopt.errors import printable
from impactopt.report.result_rows import (
    PHASES,
    Row,
    collision_rows,
    number_row,
    replay_columns,
    result_columns,
    result_rows,
    worst_rows,
)
from impactopt.solvers.program import IterationRecord, without_violations

if TYPE_CHECKING:
    from impactopt.report.comparison import Comparison

__all__ = [
    "SolveConsole",
    "collision_table",
    "comparison_tables",
    "identified_table",
    "multistart_table",
    "nail_driving_table",
    "output",
    "reason_message",
    "replay_table",
    "result_table",
    "strike_table",
    "switched_off_message",
    "torques_table",
    "touches_message",
    "violation_table",
]

PHASES_OF_STRIKE = ("contact", "collision")
PIPED = 500  # columns of what is no terminal
QUIET_BETWEEN = 1.0  # seconds between lines about iterations where lines cannot be rewritten


def _plain(text: str) -> str:
    """Text that comes from files, for a console: neither markup nor control characters are obeyed."""
    return escape(printable(text))


def output() -> Console:
    """Console on stdout; where that is no terminal and nobody says how wide it is, lines are as long as they
    need to be.
    """
    console = Console()
    return console if console.is_terminal or "COLUMNS" in os.environ else Console(width=PIPED)


class SolveConsole:
    """Lines about what is being done, and a live line about the iterations.

    Where there is no terminal, iterations are plain lines, one a second at most; `verbose`: all of them.
    """

    def __init__(self, console: Console, *, quiet: bool = False, verbose: bool = False) -> None:
        self._console, self._quiet, self._verbose = console, quiet, verbose
        self._live: Status | None = None
        self._last = -QUIET_BETWEEN
        self._start = time.perf_counter()

    def __enter__(self) -> SolveConsole:
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
        self._console.print(f"{elapsed:6.1f} s  {_plain(text)}", highlight=False, soft_wrap=True)
        if self._live is not None:
            self._live.update(_plain(text))

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
        if self._verbose or (self._live is None and record.seconds - self._last >= QUIET_BETWEEN):
            self._last = record.seconds
            self._console.print(f"          {text}", highlight=False, soft_wrap=True)


def result_table(summary: Mapping[str, Any]) -> Table:
    """Planned beside simulated, and beside the replay on free soles; what is outside its limit is marked."""
    return _table(summary, result_columns(summary))


def replay_table(report: Mapping[str, Any], summary: Mapping[str, Any]) -> Table:
    """A replay beside the plan; `report` as in `impactopt validate --json`."""
    return _table(summary, replay_columns(report, summary))


def touch_message(report: Mapping[str, Any]) -> str:
    """Impulse and first touch of the striking link's hull beside those of its striking point; "" without."""
    if "point" not in report:
        return ""
    one, other = (
        f"{found['impulse_Ns']:.2f} N s, {found['first_touch_ms']:+.2f} ms early"
        for found in (report, report["point"])
    )
    return f"contact of the link's hull: {one}; of the striking point: {other}"


def verdict_table(verdict: Mapping[str, Any]) -> Table:
    """Table of a verification, the worst first; `verdict` as in `impactopt verify --json`."""
    kkt = "not computed" if verdict["kkt"] is None else f"KKT residual {verdict['kkt']:.2g}"
    words = "ok" if verdict["ok"] else "not ok"
    table = Table(title=_plain(f"{words}; {kkt}"), title_justify="left")
    for name in ("constraint", "violation", "where"):
        table.add_column(name, justify="right" if name == "violation" else "left")
    for name, row in sorted(verdict["rows"].items(), key=lambda item: -item[1]["violation"]):
        table.add_row(_plain(name), f"{row['violation']:.2g}", _plain(row["where"]))
    return table


def strike_table(summary: Mapping[str, Any]) -> Table:
    """The planned blow; `summary` as of a :class:`impactopt.StrikeSolution`."""
    table = _table(summary, {"planned": summary}, PHASES_OF_STRIKE)
    margin = [summary.get("capture_margin_m")]
    row = number_row("capture point's margin after contact [mm]", margin, 1, scale=1e3, least=-1e-6)
    if row is not None:
        _add(table, row)
    return table


def collision_table(found: Mapping[str, Any]) -> Table:
    """One collision, beside what a saved result says of it; `found` as in `impactopt collide --json`."""
    model = f"{found['model']}, freezes = {found['freezes']}" if found.get("freezes") else found["model"]
    table = Table(title=_plain(f"{found['problem']}: {model}"), title_justify="left")
    words = [f"caution: {found['caution']}"] if found.get("caution") else []
    words += [f"{found['model']}: {found['believe']}"] if "believe" in found else []
    words += ["no peak force: the impact takes no time"] if found["model"] == "rigid" else []
    if words:
        table.caption, table.caption_justify = _plain("\n".join(words)), "left"
    table.add_column("")
    for name in ("collision", *(found.get("saved") or {})):
        table.add_column(name, justify="right")
    for row in collision_rows(found):
        _add(table, row)
    return table


def comparison_tables(found: Comparison) -> list[Table]:
    """Numbers of results beside each other, and the keys in which their problems and versions differ."""
    numbers = _beside("numbers", found.records)
    for row in found.rows:
        _add(numbers, row)
    tables = [numbers]
    for what, differences in (("problems", found.problem), ("versions", found.versions)):
        if differences:
            table = _beside(f"where the {what} differ", found.records)
            for difference in differences:
                table.add_row(_plain(difference.key), *map(_plain, difference.values))
            tables.append(table)
    return tables


def _beside(title: str, names: Iterable[str]) -> Table:
    """A table with a column for each result."""
    table = Table(title=title, title_justify="left")
    table.add_column("", overflow="fold")
    for name in names:
        table.add_column(_plain(name), justify="right", overflow="fold")
    return table


def torques_table(joints: Sequence[Mapping[str, Any]], most: int = 5) -> Table:
    """The joints whose servos are asked for most; `joints` as in `impactopt collide --json`."""
    table = Table(title="largest torque demands", title_justify="left")
    for name in ("joint", "torque [N m]", "limit [N m]", "ratio"):
        table.add_column(name, justify="left" if name == "joint" else "right")
    for joint in joints[:most]:
        numbers = (f"{joint['torque_Nm']:.1f}", f"{joint['limit_Nm']:.1f}", f"{joint['ratio']:.2f}")
        table.add_row(_plain(str(joint["joint"])), *numbers)
    return table


def identified_table(found: Mapping[str, Any]) -> Table:
    """Contact laws and their numbers, the best law first; `found` as in `impactopt identify --json`."""
    blows = "one blow" if found["blows"] == 1 else f"{found['blows']} blows"
    table = Table(title=_plain(f"{found['log']}: {blows}"), title_justify="left")
    for name in ("", "value", f"{100 * found['level']:g} % interval"):
        table.add_column(name, justify="right" if name else "left")
    for law in found["laws"]:
        more = law["aic"] - found["laws"][0]["aic"]
        left = f"leaves {law['force_left_pct']:.2g} % of the peak force, AIC {more:+.0f}"
        table.add_row(_plain(f"{law['law']}: {left}"), end_section=False)
        for name, each in law["estimates"].items():
            ends = [f"{x:.4g}" if x is not None else "?" for x in (each["low"], each["high"])]
            label = f"  {name} [{each['unit']}]" if each["unit"] else f"  {name}"
            cells = [*map(_plain, (label, f"{each['value']:.4g}", " to ".join(ends)))]
            cells[-1] = cells[-1] if each["determined"] else f"[bold red]! {cells[-1]}[/]"
            table.add_row(*cells, end_section=name == [*law["estimates"]][-1])
    return table


def multistart_table(starts: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the starts' results; `starts` as in a summary."""
    table = Table(title="starts", title_justify="left")
    for name in ("start", "status", "impulse [N s]", "iterations", "time [s]"):
        table.add_column(name, justify="left" if name in ("start", "status") else "right")
    for start in starts:
        name, numbers = str(start["start"]), (start["impulse_Ns"], start["iterations"], start["seconds"])
        cells = (f"{number:.{digits}f}" for number, digits in zip(numbers, (2, 0, 1), strict=True))
        table.add_row(
            _plain(f"{name}, kept" if start["kept"] else name), _plain(str(start["status"])), *cells
        )
    return table


def _table(
    summary: Mapping[str, Any], columns: Mapping[str, Mapping[str, Any]], phases: Sequence[str] = PHASES
) -> Table:
    table = Table(title=_plain(str(summary.get("problem", {}).get("name", "result"))), title_justify="left")
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for row in result_rows(columns, phases):
        _add(table, row)
    return table


def _add(table: Table, row: Row) -> None:
    texts = ((_plain(cell.text), cell.good) for cell in row.cells)
    cells = (text if good else f"[bold red]! {text}[/]" for text, good in texts)
    table.add_row(_plain(row.label), *cells)


def touches_message(summary: Mapping[str, Any]) -> str:
    """Sentence about contacts between a plan's bodies; "" if there are none."""
    touches = summary.get("contacts_besides") or ()
    if not touches:
        return ""
    pairs = {(touch["one"], touch["other"]) for touch in touches}
    worst = max(touches, key=lambda touch: float(touch["depth_mm"]))
    count = f"{len(pairs)} pairs of bodies penetrate" if len(pairs) > 1 else "two bodies penetrate"
    return (
        f"{count} each other, {worst['one']} and {worst['other']} by {worst['depth_mm']:.0f} mm; "
        "[terms.self_collision] and [terms.keep_out] keep them apart"
    )


def reason_message(summary: Mapping[str, Any]) -> str:
    """Sentences about why a plan is not called solved, without its violations; "" of one that is."""
    if summary["status"] == "solved":
        return ""
    return without_violations(str(summary["message"]))


def switched_off_message(summary: Mapping[str, Any]) -> str:
    """Sentence about the standard bounds that a plan was made without; "" if all are on."""
    off = summary.get("problem", {}).get("off") or ()
    return f"switched off: {', '.join(off)}" if off else ""


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """Table of violations, worst first, one a term."""
    table = Table(title="violations, worst first", title_justify="left")
    table.add_column("constraint", overflow="fold")
    table.add_column("violation", overflow="fold")
    for row, by in worst_rows(violations):
        table.add_row(_plain(row), _plain(by))
    return table


def nail_driving_table(series: Mapping[str, Any]) -> Table:
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
