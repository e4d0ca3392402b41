"""Cost and benefit of margins: impulse and fraction standing over each option's values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from impactopt.report.pictures.style import BLACK, BLUE, PAGE, VERMILION, Picture, styled

COLUMNS = 3
Row = Mapping[str, Any]


@styled
def margins_picture(rows: Sequence[Row]) -> Picture:
    """One panel an option, values from daring to cautious: planned impulse above, standing draws below.

    rows : of `benchmarks.margins`. All panels share their scales, so that what one option
    costs can be held against what another one does.
    """
    options = list(dict.fromkeys(r["option"] for r in rows))
    lines = -(-(len(options) + 1) // COLUMNS)  # one place is the legend's
    height = 2.5 * lines + 0.5
    # by hand: an automatic layout would make panels with long labels smaller than the others
    figure = Picture(PAGE, height)
    figure.set_layout_engine("none")
    edges = {"left": 0.1, "right": 0.985, "bottom": 0.8 / height, "top": 1 - 0.28 / height}
    outer = figure.add_gridspec(lines, COLUMNS, wspace=0.1, hspace=0.27, **edges)
    impulses = [r["impulse_planned_Ns"] for r in rows if r["impulse_planned_Ns"] is not None]
    span = (min(impulses), max(impulses)) if impulses else (0.0, 1.0)
    pad = 0.08 * (span[1] - span[0] or 1.0)
    for k, option in enumerate(options):
        chosen = [r for r in rows if r["option"] == option]
        inner = outer[k // COLUMNS, k % COLUMNS].subgridspec(2, 1, height_ratios=[1.25, 1.0], hspace=0.1)
        upper, lower = figure.add_subplot(inner[0]), figure.add_subplot(inner[1])
        upper.set_ylim(span[0] - 2 * pad, span[1] + pad)
        _impulse(upper, chosen)
        _standing(lower, chosen)
        unit = f" [{chosen[0]['unit']}]" if chosen[0]["unit"] else ""
        upper.set_title(f"{option}{unit}", fontsize=7, loc="left")
        for axes in (upper, lower):
            axes.set_xlim(-0.5, len(chosen) - 0.5)
            axes.set_xticks(range(len(chosen)))
            axes.grid(axis="x", visible=False)
        upper.tick_params(labelbottom=False)
        _name_values(lower, [str(r["value"]) for r in chosen])
        if k % COLUMNS == 0:
            upper.set_ylabel("planned [N s]", color=BLUE)
            lower.set_ylabel("draws that\nstand [%]", color=VERMILION)
        else:
            upper.tick_params(labelleft=False)
            lower.tick_params(labelleft=False)
    _legend(figure.add_subplot(outer[lines - 1, len(options) % COLUMNS]))
    return figure


def _impulse(axes: Any, rows: Sequence[Row]) -> None:
    """Line of planned impulses; filled where the robot survives a missing target; a cross without plan."""
    _base_line(axes, rows)
    axes.plot(range(len(rows)), _numbers(rows, "impulse_planned_Ns"), color=BLUE)
    for k, r in enumerate(rows):
        if r["impulse_planned_Ns"] is None:
            continue
        fill = BLUE if r["standing_missing"] else "white"
        axes.plot(k, r["impulse_planned_Ns"], "o", color=BLUE, markerfacecolor=fill, markersize=5.5)
        if r["standing"] is False:
            axes.plot(k, r["impulse_planned_Ns"], "x", color=BLACK, markersize=9, zorder=4)
    bottom = axes.get_ylim()[0]
    for k, r in enumerate(rows):
        if r["impulse_planned_Ns"] is None:
            axes.text(k, bottom, f" {r['status']}", rotation=90, ha="center", va="bottom", fontsize=6.5)


def _standing(axes: Any, rows: Sequence[Row]) -> None:
    """Share of draws that stand with its 95 % interval."""
    _base_line(axes, rows)
    rate = 100 * _numbers(rows, "standing_rate")
    ends = [100 * np.array(r.get("standing_interval_95") or (np.nan, np.nan)) for r in rows]
    bars = np.clip([rate - [e[0] for e in ends], [e[1] for e in ends] - rate], 0.0, None)
    style: Any = {"color": VERMILION, "marker": "s", "markersize": 4.5, "elinewidth": 0.9, "capsize": 2}
    axes.errorbar(range(len(rows)), rate, bars, **style)
    axes.set_ylim(0.0, 105.0)
    axes.set_yticks([0, 50, 100])


def _numbers(rows: Sequence[Row], key: str) -> NDArray[np.float64]:
    """nan, which is a gap in a line, where there is none."""
    return np.array([np.nan if r[key] is None else r[key] for r in rows], dtype=float)


def _base_line(axes: Any, rows: Sequence[Row]) -> None:
    for k, r in enumerate(rows):
        if r["base"]:
            axes.axvline(k, color="#bbbbbb", linewidth=5.0, alpha=0.5, zorder=0)


def _name_values(axes: Any, labels: Sequence[str]) -> None:
    if max(map(len, labels)) > 6:
        axes.set_xticklabels(labels, rotation=35, ha="right", rotation_mode="anchor", fontsize=6.5)
    else:
        axes.set_xticklabels(labels, fontsize=7)


def _legend(axes: Any) -> None:
    """Legend of the marks, in axes of its own."""
    axes.axis("off")

    def mark(label: str, **style: Any) -> Line2D:
        return Line2D([], [], label=label, **style)

    axes.legend(
        handles=[
            mark("planned impulse", color=BLUE),
            mark("stands if the target is missing", color=BLUE, marker="o", linestyle=""),
            mark("falls then", color=BLUE, marker="o", linestyle="", markerfacecolor="white"),
            mark("falls even as planned", color=BLACK, marker="x", linestyle="", markersize=9),
            mark("share of draws that stand,\n95 % interval", color=VERMILION, marker="s"),
            mark("the base, the same everywhere", color="#bbbbbb", linewidth=5.0, alpha=0.5),
        ],
        loc="center left",
        bbox_to_anchor=(-0.08, 0.5),
        fontsize=7,
        title="to the right: more cautious",
        alignment="left",
    )
