"""Comparison of results: their values, differences of problems and versions, and a page of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.files.output import is_usable
from impactopt.files.record import Record, plain
from impactopt.files.toml import TOMLError, read_toml
from impactopt.report.charts import chart, series_of
from impactopt.report.histories import contact_force, ground_wrenches, planned_torque, thinned, zmp_margins
from impactopt.report.page import Page, html_table, report_html
from impactopt.report.result_rows import Cell, Row, contact_rows, number_row, phase_rows, standing, word_row

MOST = 5  # results: the page has as many line styles
STYLES = ("planned", "simulated", "free", "one", "two")
NOT_SET = "-"
COMPARED = (  # keys of ``summary.json``
    *("status", "message", "impulse_Ns", "peak_force_N", "contact_ms", "hand_speed_m_s", "target"),
    *("duration_s", "zmp_margin_m", "torque_ratio", "clearance_mm", "max_violation"),
    *("solver", "iterations", "solve_seconds", "collision_model"),
)
REPLAYS = ("simulated", "replayed")


@dataclass(frozen=True)
class Difference:
    """A key in which results differ, and the value of each, as text."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Comparison of results.

    records : by name.  rows : of a table with a column for each result.
    problem, versions : differences of problems and versions.
    """

    records: Mapping[str, Record]
    rows: tuple[Row, ...]
    problem: tuple[Difference, ...]
    versions: tuple[Difference, ...]

    def describe(self) -> dict[str, Any]:
        """JSON form, as `impactopt compare --json` prints it."""
        results = []
        for name, record in self.records.items():
            values: dict[str, Any] = {"name": name}
            values |= {key: record.summary.get(key) for key in COMPARED}
            values |= {key: record.summary[key] for key in REPLAYS if key in record.summary}
            results.append(values)

        def by_key(differences: Sequence[Difference]) -> dict[str, dict[str, str]]:
            return {d.key: dict(zip(self.records, d.values, strict=True)) for d in differences}

        return {"results": plain(results), "problem": by_key(self.problem), "versions": by_key(self.versions)}

    def page(self) -> Page:
        """HTML page of the comparison, with histories over the time since each result's contact."""
        arrays: dict[str, Any] = {}
        charts = list(_charts(self.records, arrays))
        title = " and ".join(self.records)
        html = report_html(
            title=title,
            heading=title,
            about="compared",
            parts=_parts(self),
            header={"charts": charts},
            arrays=arrays,
        )
        return Page(html)


def compare(records: Mapping[str, Record]) -> Comparison:
    """Compares results, given by name.

    Raises
    ------
    InputError : fewer than two, or more than `MOST`.
    """
    if not 2 <= len(records) <= MOST:
        raise InputError(f"give 2 to {MOST} results to compare, not {len(records)}")
    summaries = [record.summary for record in records.values()]
    versions = [{str(k): str(v) for k, v in s.get("versions", {}).items()} for s in summaries]
    return Comparison(
        records=dict(records),
        rows=tuple(row for row in _rows(summaries) if row is not None),
        problem=_differences(_problems(list(records.values()))),
        versions=_differences(versions),
    )


def _rows(summaries: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows of the table of values; None for one without values."""
    yield Row(
        "status",
        tuple(Cell(str(s.get("status", NOT_SET)), is_usable(s.get("status"))) for s in summaries),
    )
    replays = [s.get("replayed") or s.get("simulated") or {} for s in summaries]
    yield from contact_rows(summaries)
    yield number_row("duration [s]", [s.get("duration_s") for s in summaries], 2)
    by_phase = [s.get(key, {}) for s in summaries for key in ("zmp_margin_m", "torque_ratio")]
    yield from phase_rows(summaries, tuple(dict.fromkeys(phase for values in by_phase for phase in values)))
    yield number_row("least distance of bodies [mm]", [s.get("clearance_mm") for s in summaries], 1)
    yield number_row("replayed impulse [N s]", [r.get("impulse_Ns") for r in replays], 2)
    yield number_row("replayed, largest slip of a sole [mm]", [r.get("sole_slip_mm") for r in replays], 2)
    yield word_row("replayed, stands at the end", [standing(r) for r in replays], no_is_bad=True)
    yield number_row("iterations", [s.get("iterations") for s in summaries], 0)
    yield number_row("solved in [s]", [s.get("solve_seconds") for s in summaries], 1)


def _problems(records: Sequence[Record]) -> list[dict[str, str]]:
    """Flat keys of each problem's file; if a result has no file, those of all summaries."""
    tables = []
    for record in records:
        try:
            tables.append(read_toml(record.problem) if record.problem else None)
        except TOMLError:
            tables.append(None)
    if any(table is None for table in tables):
        tables = [record.summary.get("problem", {}) for record in records]
    return [dict(_flat("", table)) for table in tables]


def _flat(above: str, value: Any) -> Iterator[tuple[str, str]]:
    """Dotted keys, with numbers for a list of tables, and values as text."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(f"{above}.{key}" if above else str(key), item)
    elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        for k, item in enumerate(value):
            yield from _flat(f"{above}.{k}", item)
    else:
        yield above, _text(value)


def _text(value: Any) -> str:
    """Value as text; 5 and 5.0 are the same."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.12g}" if isinstance(value, (int, float)) else str(value)


def _differences(flat: Sequence[Mapping[str, str]]) -> tuple[Difference, ...]:
    """Keys whose values are not the same in all tables of flat keys."""
    keys = dict.fromkeys(key for table in flat for key in table)
    compared = [Difference(key, tuple(table.get(key, NOT_SET) for table in flat)) for key in keys]
    return tuple(one for one in compared if len(set(one.values)) > 1)


def histories_of(record: Record) -> dict[str, tuple[Array, Array]]:
    """Time since contact [s] and values of the histories that a record has, by name.

    force : [N] on the target.  margin : [mm] of the ZMP.  ratio : of the largest torque to its limit.
    """
    a, histories = record.arrays, dict[str, tuple[Array, Array]]()
    if not record.completed:
        return histories
    start = float(a["reference_contact_start"])
    if len(a["collision_time"]) > 1:
        time, force = contact_force(record, "reference")
        histories["force"] = time - start, force
    if len(a["polygon"]):
        time, wrench = ground_wrenches(record, "reference")
        histories["margin"] = time - start, 1e3 * zmp_margins(record, time, wrench)
    time, torque = planned_torque(record)
    histories["ratio"] = time - start, np.abs(torque / a["torque_limit"]).max(axis=1)
    return histories


def _charts(records: Mapping[str, Record], arrays: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Descriptions of the page's charts; their data are added to `arrays`."""
    known = [histories_of(record) for record in records.values()]
    longest = max((float(r.summary.get("contact_ms") or 0.0) for r in records.values()), default=0.0)
    limit = {"limits": [{"y": 1.0, "text": "limit"}], "include": [0.0, 1.0]}
    for which, title, unit, more in (
        ("force", "Force on the target", "force [N]", {"view": [-0.2e-3 * longest, 1.2e-3 * longest]}),
        ("margin", "ZMP margin", "margin [mm]", {"limits": [{"y": 0.0, "text": "edge"}]}),
        ("ratio", "Torque demand over limit", "torque / limit", limit),
    ):
        series = []
        for k, (name, histories) in enumerate(zip(records, known, strict=True)):
            if which in histories:
                x, y = thinned(*histories[which], whole=[-0.01, 2e-3 * longest])
                series.append(series_of(arrays, f"{which}{k}", name, STYLES[k], x, y))
        if series:
            yield chart(title, unit, series, **{"x": "time since contact [s]", "include": [0.0], **more})


def _parts(comparison: Comparison) -> Iterator[str]:
    yield _table(comparison, comparison.rows)
    yield '<h2>Planned histories</h2><div id="charts"></div>'
    for heading, differences in (
        ("Differences of the problems", comparison.problem),
        ("Differences of the versions", comparison.versions),
    ):
        rows = [Row(d.key, tuple(map(Cell, d.values))) for d in differences]
        yield f"<h2>{heading}</h2>"
        yield _table(comparison, rows, kind="pairs") if rows else "<p>None.</p>"


def _table(comparison: Comparison, rows: Sequence[Row], *, kind: str = "") -> str:
    """HTML table with a column for each result; kind : CSS class, "pairs" breaks long values."""
    table = html_table(rows, ["", *comparison.records], kind=kind)
    return f'<section class="card"><div class="scroll" tabindex="0">{table}</div></section>'
