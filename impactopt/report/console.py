"""Terminal output: progress of a solve, and tables of results."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.status import Status
from rich.table import Table

from impactopt.errors import counted, printable
from impactopt.report.result_rows import (
    Row,
    collision_rows,
    replay_columns,
    result_columns,
    result_rows,
    worst_constraints,
)
from impactopt.solvers.program import IterationRecord, without_violations

if TYPE_CHECKING:
    from impactopt.report.comparison import Comparison

PIPE_WIDTH = 500  # columns of output that does not go to a terminal
MIN_INTERVAL = 1.0  # [s] between lines about iterations where a line cannot be rewritten


def _plain(text: str) -> str:
    """Text from files, with markup and control characters escaped."""
    return escape(printable(text))


def output() -> Console:
    """Console on stdout; without a terminal and a given width, lines are not wrapped."""
    console = Console()
    return console if console.is_terminal or "COLUMNS" in os.environ else Console(width=PIPE_WIDTH)


class SolveConsole:
    """Progress lines, and a live line about the iterations.

    Without a terminal, iterations are plain lines, at most one a second; `verbose`: all of them.
    """

    def __init__(self, console: Console, *, quiet: bool = False, verbose: bool = False) -> None:
        self._console, self._quiet, self._verbose = console, quiet, verbose
        self._live: Status | None = None
        self._last = -MIN_INTERVAL
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
        """Prints a line about a step that has begun or ended."""
        if self._quiet:
            return
        elapsed = time.perf_counter() - self._start
        self._console.print(f"{elapsed:6.1f} s  {_plain(text)}", highlight=False, soft_wrap=True)
        if self._live is not None:
            self._live.update(_plain(text))

    def iteration(self, record: IterationRecord) -> None:
        """Prints an iteration; the callback of a solver."""
        text = (
            f"iteration {record.iteration:4d}   objective {record.objective:10.4f}   "
            f"violation {record.max_violation:8.1e}   {record.seconds:6.1f} s"
        )
        if self._quiet:
            return
        if self._live is not None:
            self._live.update(text)
        if self._verbose or (self._live is None and record.seconds - self._last >= MIN_INTERVAL):
            self._last = record.seconds
            self._console.print(f"          {text}", highlight=False, soft_wrap=True)


def say(console: Console, *texts: Any) -> None:
    """Prints texts and paths as they are, each on a line; empty ones are left out."""
    for text in filter(None, texts):
        # a path is not broken
        whole = isinstance(text, Path)
        console.print(printable(str(text)), markup=False, highlight=False, soft_wrap=whole)


def say_outcome(console: Console, summary: Mapping[str, Any]) -> None:
    """Prints why a plan or a strike is not solved, its cautions, starts, violations, and its status."""
    errors = (summary.get(name, {}).get("error") for name in ("simulated", "baseline"))
    cautions = (summary.get("caution"), touches_message(summary), summary.get("gear_caution"))
    say(
        console,
        reason_message(summary),
        summary.get("note"),
        *errors,
        *cautions,
        switched_off_message(summary),
    )
    if len(summary["starts"]) > 1:
        console.print(multistart_table(summary["starts"]))
    if summary["violations"]:
        console.print(violation_table(summary["violations"]))
    say(
        console,
        f"{summary['solver']}: {summary['status']} after {counted(summary['iterations'], 'iteration')}, "
        f"{summary['solve_seconds']:.1f} s; building took {summary['build_seconds']:.1f} s",
    )


def result_table(summary: Mapping[str, Any]) -> Table:
    """Table of plan, simulation and replay on free soles; values outside their limits are marked."""
    return _table(summary, result_columns(summary))


def replay_table(report: Mapping[str, Any], summary: Mapping[str, Any]) -> Table:
    """Table of the plan and a replay; `report` as in `impactopt validate --json`."""
    return _table(summary, replay_columns(report, summary))


def touch_message(report: Mapping[str, Any]) -> str:
    """Sentence that compares impulse and first touch of the striking link's hull and point; "" if none."""
    if "point" not in report:
        return ""
    hull, point = (
        f"{contact['impulse_Ns']:.2f} N s, {_early(contact['first_touch_ms'])}"
        for contact in (report, report["point"])
    )
    return f"contact of the link's hull: {hull}; of the striking point: {point}"


def replayed_touches_message(report: Mapping[str, Any]) -> str:
    """Sentence about bodies that hit each other in a replay, which loads the gears too; "" without any."""
    pairs: dict[tuple[str, str], float] = {}  # first contact [s]
    for touch in report.get("contacts_besides") or ():
        pair = touch["one"], touch["other"]
        pairs[pair] = min(float(touch["start_s"]), pairs.get(pair, math.inf))
    if not pairs:
        return ""
    (one, other), start = min(pairs.items(), key=lambda item: item[1])
    more = f" (and {len(pairs) - 1} more)" if len(pairs) > 1 else ""
    return (
        f"in the replay {one} and {other}{more} hit each other from {start:.3f} s on: gear loads and jumps "
        "of joints' speeds include that"
    )


def _early(ms: float | None) -> str:
    return "no touch" if ms is None else f"{abs(ms):.2f} ms {'late' if ms < 0 else 'early'}"


def verdict_table(verdict: Mapping[str, Any]) -> Table:
    """Table of a verification, worst constraint first; `verdict` as in `impactopt verify --json`."""
    kkt = "not computed" if verdict["kkt"] is None else f"KKT residual {verdict['kkt']:.2g}"
    title, left = f"{'ok' if verdict['ok'] else 'not ok'}; {kkt}", ("constraint", "where")
    table = _empty(title, "constraint", "violation", "where", left=left)
    for name, worst in sorted(verdict["rows"].items(), key=lambda item: -item[1]["violation"]):
        table.add_row(_plain(name), f"{worst['violation']:.2g}", _plain(worst["where"]))
    return table


def strike_table(summary: Mapping[str, Any]) -> Table:
    """Table of a planned strike; `summary` as in a :class:`impactopt.StrikeSolution`."""
    return _table(summary, {"planned": summary})


def collision_table(found: Mapping[str, Any]) -> Table:
    """Table of one collision and those of a saved result; `found` as in `impactopt collide --json`."""
    model = f"{found['model']}, freezes = {found['freezes']}" if found.get("freezes") else found["model"]
    if "coefficient_of_restitution" in found:
        model += f", restitution = {found['coefficient_of_restitution']:g}"
    table = _empty(f"{found['problem']}: {model}", "", "collision", *(found.get("saved") or {}))
    notes = [f"caution: {found[key]}" for key in ("caution", "again", "drifts") if found.get(key)]
    notes += [f"{found['model']}: {found['believe']}"] if "believe" in found else []
    if found["model"] == "sdc-paper" and "believe" not in found:
        notes.append("torque demands without those that carry the weight: this model has no feed-forward")
    notes += ["no peak force: the impact takes no time"] if found["model"] == "rigid" else []
    if notes:
        table.caption, table.caption_justify = _plain("\n".join(notes)), "left"
    for row in collision_rows(found):
        _add(table, row)
    return table


def comparison_tables(found: Comparison) -> list[Table]:
    """Tables of results side by side: their values, and the keys in which problems and versions differ."""
    values = _empty("values", "", *found.records, fold=True)
    for row in found.rows:
        _add(values, row)
    tables = [values]
    for what, differences in (("problems", found.problem), ("versions", found.versions)):
        if differences:
            table = _empty(f"{what}: differences", "", *found.records, fold=True)
            for difference in differences:
                table.add_row(_plain(difference.key), *map(_plain, difference.values))
            tables.append(table)
    return tables


def _empty(title: str, *columns: str, left: Collection[str] = ("",), fold: bool = False) -> Table:
    """Table without rows; `left` : columns of text, the others are aligned to the right.

    fold : break long words, and not shorten them.
    """
    table = Table(title=_plain(title), title_justify="left")
    for name in columns:
        table.add_column(
            _plain(name), justify="left" if name in left else "right", overflow="fold" if fold else "ellipsis"
        )
    return table


def torques_table(joints: Sequence[Mapping[str, Any]], most: int = 5) -> Table:
    """Table of the largest torque demands; `joints` as in `impactopt collide --json`."""
    shown = joints[:most]
    unit = " or ".join(sorted({str(joint["unit"]) for joint in shown}, reverse=True))
    columns = ("joint", f"torque [{unit}]", f"limit [{unit}]", "ratio")
    table = _empty("largest torque demands", *columns, left=("joint",))
    for joint in shown:
        numbers = (f"{joint['torque_Nm']:.1f}", f"{joint['limit_Nm']:.1f}", f"{joint['ratio']:.2f}")
        table.add_row(_plain(str(joint["joint"])), *numbers)
    return table


def identified_table(found: Mapping[str, Any]) -> Table:
    """Table of contact laws and their parameters, best law first; `found` as in `identify --json`."""
    impacts = "one impact" if found["blows"] == 1 else f"{found['blows']} impacts"
    table = _empty(f"{found['log']}: {impacts}", "", "value", f"{100 * found['level']:g} % interval")
    for law in found["laws"]:
        more = law["aic"] - found["laws"][0]["aic"]
        fit = f"residual {law['force_left_pct']:.2g} % of the peak force, AIC {more:+.0f}"
        table.add_row(_plain(f"{law['law']}: {fit}"))
        for name, each in law["estimates"].items():
            ends = [f"{x:.4g}" if x is not None else "?" for x in (each["low"], each["high"])]
            label = f"  {name} [{each['unit']}]" if each["unit"] else f"  {name}"
            cells = [*map(_plain, (label, f"{each['value']:.4g}", " to ".join(ends)))]
            cells[-1] = cells[-1] if each["determined"] else f"[bold red]! {cells[-1]}[/]"
            table.add_row(*cells, end_section=name == [*law["estimates"]][-1])
    return table


def multistart_table(starts: Sequence[Mapping[str, Any]]) -> Table:
    """Table of the results from several initial guesses; `starts` as in a summary."""
    columns = ("start", "status", "impulse [N s]", "iterations", "time [s]")
    table = _empty("starts", *columns, left=("start", "status"))
    for start in starts:
        name, numbers = str(start["start"]), (start["impulse_Ns"], start["iterations"], start["seconds"])
        cells = (f"{number:.{digits}f}" for number, digits in zip(numbers, (2, 0, 1), strict=True))
        table.add_row(
            _plain(f"{name}, kept" if start["kept"] else name), _plain(str(start["status"])), *cells
        )
    return table


def _table(summary: Mapping[str, Any], columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Table titled with the problem's name, with the rows of `result_rows`."""
    table = _empty(str(summary.get("problem", {}).get("name", "result")), "", *columns)
    for row in result_rows(columns):
        _add(table, row)
    return table


def _add(table: Table, row: Row) -> None:
    """Adds a row; values outside their limits are marked."""
    texts = ((_plain(cell.text), cell.good) for cell in row.cells)
    cells = (text if good else f"[bold red]! {text}[/]" for text, good in texts)
    table.add_row(_plain(row.label), *cells)


def touches_message(summary: Mapping[str, Any]) -> str:
    """Sentence about unintended contacts of bodies; "" without any."""
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
    """Sentences about why a problem is not solved, without its violations; "" if it is solved."""
    if summary["status"] == "solved":
        return ""
    return without_violations(str(summary["message"]))


def switched_off_message(summary: Mapping[str, Any]) -> str:
    """Sentence about default terms that are switched off; "" without any."""
    off = summary.get("problem", {}).get("off") or ()
    return f"switched off: {', '.join(off)}" if off else ""


def violation_table(violations: Sequence[Mapping[str, Any]]) -> Table:
    """Table of violated constraints, worst first, one of each term."""
    columns = ("constraint", "violation")
    table = _empty("violations, worst first", *columns, left=columns, fold=True)
    for constraint, amount in worst_constraints(violations):
        table.add_row(_plain(constraint), _plain(amount))
    return table


def nail_driving_table(series: Mapping[str, Any]) -> Table:
    """Table of the blows on a nail; `series` as in `impactopt drive --json`."""
    columns = (
        ("driven [mm]", "driven_m", 1e3, 1),
        ("depth [mm]", "depth_m", 1e3, 1),
        ("impulse [N s]", "impulse_Ns", 1.0, 2),
        ("peak force [N]", "peak_force_N", 1.0, 0),
        ("speed [m/s]", "hand_speed_m_s", 1.0, 2),
        ("solved in [s]", "solve_seconds", 1.0, 1),
    )
    table = _empty("blows on the nail", "blow", *(label for label, *_ in columns))
    for k, blow in enumerate(series["blows"], start=1):
        table.add_row(str(k), *(f"{scale * blow[key]:.{n}f}" for _, key, scale, n in columns))
    return table
