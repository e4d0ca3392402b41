"""Plans by the model of their collision: how long they take, and how far full dynamics are from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from impactopt.report.pictures.style import Picture, model_colour, styled

Row = Mapping[str, Any]

# model and freezes: mark, and what it is called
MARKS = {
    ("virtual-mass", 0): ("v", "virtual mass"),
    ("sdc-paper", 0): ("s", "the paper's SDC"),
    ("sdc", 0): ("o", "our SDC, frozen at contact"),
    ("sdc", 4): ("D", "our SDC, 4 freezes on the way"),
    ("full", 0): ("o", "full dynamics"),
    ("auto", 0): ("*", "auto"),
}
LEAST = 1e-3  # [%] an error is not told to be less


@styled
def models_picture(rows: Sequence[Row]) -> Picture:
    """One panel a problem; rows of `benchmarks.models`. Open marks: it does not stand."""
    problems = list(dict.fromkeys(r["problem"] for r in rows))
    figure = Picture(1.9 * len(problems) + 0.9, 3.4)
    panels = figure.subplots(1, len(problems), sharey=True, squeeze=False)[0]
    for axes, problem in zip(panels, problems, strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        for r in (r for r in rows if r["problem"] == problem):
            mark, _ = MARKS.get((r["model"], r["freezes"]), ("", ""))
            if not mark or r["error_pct"] is None:
                continue
            colour = model_colour(r["model"], r["freezes"])
            face = "none" if r["stands"] is False else colour
            error = max(abs(r["error_pct"]), LEAST)
            axes.plot(r["seconds"], error, mark, color=colour, markerfacecolor=face, markersize=6)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        axes.set_title(problem, loc="left")
        axes.set_xlabel("solve [s]")
    panels[0].set_ylabel("impulse: plan against replay [%]")
    handles = [
        Line2D([], [], color=model_colour(*which), marker=mark, linestyle="", label=label)
        for which, (mark, label) in MARKS.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7)
    return figure
