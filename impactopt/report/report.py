"""Page of a result: plan and simulations in tables and charts, animation, and how the result was made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from impactopt.errors import counted
from impactopt.files.output import is_usable, record_of
from impactopt.files.record import Record
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.report.charts import charts_of
from impactopt.report.page import Page, html_table, report_html
from impactopt.report.result_rows import Cell, Row, result_columns, result_rows, worst_constraints
from impactopt.report.stage import stage_of
from impactopt.robots.loads import shortfalls

COLUMN_NOTES = {
    "simulated": "Simulated: replayed in Pinocchio's full dynamics, any soles fixed.",
    "fixed soles": "Fixed soles: replayed in Pinocchio's full dynamics, with the soles fixed.",
    "free soles": "Free soles: replayed in MuJoCo, with nothing fixed.",
}
BAD_NOTE = (
    "! is outside a limit, or has less than half of the margin required of the plan; a robot that uses up "
    "a margin may stand all the same."
)
NARROW = "\u202f"  # narrow no-break space, between a number and its unit


def report_of(record: Record, problem: ImpactProblem | None = None) -> Page:
    """Page of a record; with the animation, if the problem is given and there is a motion."""
    charts, arrays = charts_of(record, problem)
    header: dict[str, Any] = {}
    if problem is not None and record.completed:
        header, solids = stage_of(record, problem)
        arrays |= solids
    title = str(record.summary.get("problem", {}).get("name", "")) or "result"
    known = record.summary.get("problem", {})
    about = [str(known[key]) for key in ("robot", "striker") if known.get(key)]
    about += ["the impact alone, without a motion"] if "strike_posture" in record.arrays else []
    html = report_html(
        title=title,
        heading=title,
        about=" · ".join(about),
        parts=_parts(record, animated=bool(header)),
        header={**header, "charts": charts},
        arrays=arrays,
    )
    return Page(html)


def report_page(solution: Solution, *, simulation: Any | None = None, replay: Any | None = None) -> Page:
    """Page as of `impactopt show`; simulation, replay : as in :func:`impactopt.animate`."""
    record = record_of(solution, simulation=simulation, replay=replay)
    return report_of(record, solution.problem)


def _parts(record: Record, *, animated: bool) -> Iterator[str]:
    s = record.summary
    errors = (s.get(name, {}).get("error") for name in ("simulated", "baseline"))
    notes = (s.get("note"), s.get("caution"), s.get("gear_caution"), *errors)
    for note in filter(None, notes):
        yield f'<p class="note">{escape(str(note))}</p>'
    yield _cards(s)
    heading = "Planned beside simulated" if len(result_columns(s)) > 1 else "Planned"
    table = f'<section class="card" aria-label="numbers"><h3>{heading}</h3>{_table(s)}</section>'
    if animated:
        yield '<div class="top"><section class="card stays" id="animation" aria-label="animation"></section>'
        yield f"{table}</div>"
    else:
        yield table
    yield '<h2>Histories</h2><div id="charts"></div>'
    yield _violations(s)
    yield '<h2>How it was made</h2><div class="made"><div>'
    yield _text(
        "problem", "The problem", record.problem or "It was made in Python: there is no problem file."
    )
    yield "</div><div>"
    yield _text(
        "command", "The command", str(s.get("command") or "It was made in Python, by impactopt.solve.")
    )
    yield f'<section class="card"><h3>The solve</h3>{_pairs(_solve(s))}</section>'
    yield f'<section class="card"><h3>The model</h3>{_pairs(s.get("problem", {}))}</section>'
    yield f'<section class="card"><h3>Versions</h3>{_pairs(s.get("versions", {}))}</section>'
    yield "</div></div>"


def _cards(s: Mapping[str, Any]) -> str:
    """Cards of the main results, with those of the most faithful replay."""
    replay: Mapping[str, Any] = s.get("replayed") or s.get("simulated") or {}
    cards = []

    def card(value: str, what: str, kind: str = "") -> None:
        cards.append(
            f'<div class="card"><b class="{kind}">{escape(value)}</b><span>{escape(what)}</span></div>'
        )

    seconds = f"{s.get('solve_seconds') or 0.0:.1f}{NARROW}s"
    spent = f"{s.get('solver', '')}, {counted(s.get('iterations', 0), 'iteration')}, {seconds}"
    status = s.get("status")
    card(str(status or "?"), spent, "good" if status == "solved" else "" if is_usable(status) else "bad")
    if s.get("impulse_Ns") is not None:
        error = replay.get("impulse_error_pct")
        beside = "" if error is None else f", {round(error, 1) + 0.0:+.1f}{NARROW}% when replayed"
        card(f"{s['impulse_Ns']:.2f} N s", f"planned impulse{beside}")
    if s.get("peak_force_N") is not None:
        card(f"{s['peak_force_N']:.0f} N", f"planned peak force, over {s['contact_ms']:.0f}{NARROW}ms")
    if s.get("hand_speed_m_s") is not None:
        card(f"{s['hand_speed_m_s']:.2f} m/s", "speed of the striking point at contact")
    margins = s.get("sole_cop_margin_mm") or {}
    if margins:
        least, phase = min((kept, phase) for phases in margins.values() for phase, kept in phases.items())
        required = (s.get("sole_cop_margin_asked_mm") or {}).get(phase)  # each phase has its own
        beside = "" if required is None else f", in {phase}; {required:g}{NARROW}mm required at nodes"
        kind = "bad" if shortfalls(s) else ""
        card(f"{least:.0f} mm", f"least planned margin of a sole's centre of pressure{beside}", kind)
    standing = s.get("replayed", {}).get("standing")
    if standing is not None and margins:  # without soles nothing can fall
        card("stands" if standing else "falls", "replayed on free soles", "good" if standing else "bad")
    return f'<div class="cards">{"".join(cards)}</div>'


def _table(s: Mapping[str, Any]) -> str:
    columns = result_columns(s)
    rows = result_rows(columns)
    notes = " ".join(text for name, text in COLUMN_NOTES.items() if name in columns)
    if any(not cell.good for row in rows for cell in row.cells):
        notes = f"{notes} {BAD_NOTE}"
    about = f'<p class="about">{escape(notes.strip())}</p>' if notes.strip() else ""
    return f'<div class="scroll" tabindex="0">{html_table(rows, ["", *columns])}{about}</div>'


def _violations(s: Mapping[str, Any]) -> str:
    if not s.get("violations"):
        return ""
    rows = [Row(constraint, (Cell(amount),)) for constraint, amount in worst_constraints(s["violations"])]
    return f'<h2>Violated constraints, worst first</h2><div class="card scroll">{html_table(rows)}</div>'


def _solve(s: Mapping[str, Any]) -> dict[str, Any]:
    out = {name: s[name] for name in ("solver", "message", "iterations") if name in s}
    for name, what in (("solve_seconds", "solving"), ("build_seconds", "building")):
        if s.get(name) is not None:
            out[what] = f"{s[name]:.2f} s"
    if s.get("max_violation") is not None:
        out["largest violation"] = f"{s['max_violation']:.1e}"
    out |= {f"objective: {name}": f"{value:.4g}" for name, value in s.get("objectives", {}).items()}
    return out


def _text(name: str, title: str, text: str) -> str:
    return (
        f'<section class="card"><div class="head"><h3>{escape(title)}</h3>'
        f'<button data-copy="{name}" aria-label="copy: {escape(title)}">copy</button></div>'
        f'<pre id="{name}" tabindex="0">{escape(text)}</pre></section>'
    )


def _pairs(pairs: Mapping[str, Any]) -> str:
    def shown(value: Any) -> str:
        return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)

    known = {str(name): value for name, value in pairs.items() if value not in (None, [], "")}
    rows = [Row(name, (Cell(shown(value)),)) for name, value in known.items()]
    return f'<div class="scroll">{html_table(rows, kind="pairs")}</div>'
