"""Errors of collision models against full dynamics: impulse error over the number of freezes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullLocator

from impactopt.report.pictures.style import BLACK, MODELS, Picture, styled

Row = Mapping[str, Any]

# models without freezes on the way: colour of their level, and what they are called
LEVELS = {
    ("virtual-mass", None): (MODELS["virtual-mass"], "virtual mass"),
    ("sdc-paper", None): (MODELS["sdc-paper"], "the paper's SDC"),
    ("sdc", 0): (MODELS["sdc"], "our SDC, frozen at contact"),
}
AGAIN = MODELS["freezes"]
GREY = "#999999"
WORST, MEDIAN = "worst_impulse_error_pct", "median_impulse_error_pct"


@styled
def fidelity_picture(rows: Sequence[Row]) -> Picture:
    """One panel a robot; rows of `benchmarks.fidelity`. Worst errors solid, medians dashed."""
    robots = list(dict.fromkeys(r["robot"] for r in rows))
    figure = Picture(2.1 * len(robots) + 0.9, 3.6)
    panels = figure.subplots(1, len(robots), sharex=True, sharey=True, squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=True):
        own = [r for r in rows if r["robot"] == robot]
        for r in own:
            colour, _ = LEVELS.get((r["model"], r["freezes"]), (None, ""))
            if colour is not None and r[WORST] is not None:
                axes.axhline(r[WORST], color=colour)
                axes.axhline(r[MEDIAN], color=colour, linestyle="--", linewidth=1.0)
        again = [r for r in own if r["freezes"] and r[WORST] is not None]
        counts = np.array([float(r["freezes"]) for r in again])
        if counts.size:
            _slope(axes, counts, again[-1][WORST])
        axes.loglog(counts, [r[WORST] for r in again], "o-", color=AGAIN, markersize=5)
        axes.loglog(counts, [r[MEDIAN] for r in again], "o--", color=AGAIN, markersize=4, linewidth=1.0)
        axes.set_xticks(sorted({float(r["freezes"]) for r in rows if r["freezes"]}))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.set_title(robot, loc="left")
        axes.set_xlabel("freezes on the way")
    panels[0].set_ylabel("impulse error against full dynamics [%]")
    handles = [Line2D([], [], color=colour, label=label) for colour, label in LEVELS.values()]
    handles += [
        Line2D([], [], color=AGAIN, marker="o", label="our SDC, frozen again on the way"),
        Line2D([], [], color=GREY, linestyle=":", label="falls with the square"),
        Line2D([], [], color=BLACK, linestyle="--", linewidth=1.0, label="dashed: median"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7)
    return figure


def _slope(axes: Any, counts: Any, last: float) -> None:
    """A line of second order through the last point."""
    axes.loglog(counts, last * (counts[-1] / counts) ** 2, ":", color=GREY, zorder=1)
