"""Accuracy of virtual bases: errors over the mass M_g that is put under the soles, in two forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from impactopt.report.pictures.style import BLACK, BLUE, VERMILION, Picture, styled

Row = Mapping[str, Any]

# what is drawn of a row: key, colour, style
CURVES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("error_literal", VERMILION, {"marker": "s", "markersize": 3.5}),
    ("impulse_error_literal", VERMILION, {"linestyle": "--", "linewidth": 1.1}),
    ("error_model", BLUE, {"marker": "o", "markersize": 3.5}),
    ("impulse_error_model", BLUE, {"linestyle": "--", "linewidth": 1.1}),
)
PAPER = 1e5  # [kg]
LEAST = 1e-16  # below a double's rounding nothing is to be seen


@styled
def virtual_base_picture(rows: Sequence[Row]) -> Picture:
    """One panel a robot; rows of `benchmarks.virtual_base`."""
    robots = list(dict.fromkeys(r["robot"] for r in rows))
    figure = Picture(3.3 * len(robots) + 0.6, 3.8)
    panels = figure.subplots(1, len(robots), sharex=True, sharey=True, squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=True):
        chosen = [r for r in rows if r["robot"] == robot]
        masses = np.array([r["M_g"] for r in chosen])
        axes.axvline(PAPER, color="#bbbbbb", linewidth=5.0, alpha=0.5, zorder=0)
        for key, colour, style in CURVES:
            errors = np.array([np.nan if r[key] is None else max(r[key], LEAST) for r in chosen])
            axes.loglog(masses, errors, color=colour, **style)
        failed = [r["M_g"] for r in chosen if r["error_literal"] is None]
        axes.plot(failed, np.full(len(failed), 1.0), "x", color=BLACK, markersize=6)
        axes.set_title(robot, loc="left")
        axes.set_xlabel("$M_g$ [kg], $I_g$ [kg m²]")
        axes.xaxis.set_major_locator(LogLocator(numticks=9))
        axes.yaxis.set_major_locator(LogLocator(numticks=10))
        axes.minorticks_off()
        axes.set_ylim(LEAST / 2, 5.0)
    panels[0].set_ylabel("relative error against exactly fixed soles")
    solid: dict[str, Any] = {"marker": "o", "markersize": 3.5}
    handles = [
        Line2D([], [], color=BLUE, label="ours, effective mass", **solid),
        Line2D([], [], color=BLUE, label="ours, impulse", linestyle="--", linewidth=1.1),
        Line2D([], [], color="#bbbbbb", label="the paper's example, 1e5 kg", linewidth=5.0, alpha=0.5),
        Line2D([], [], color=VERMILION, label="literal, effective mass", marker="s", markersize=3.5),
        Line2D([], [], color=VERMILION, label="literal, impulse", linestyle="--", linewidth=1.1),
        Line2D([], [], color=BLACK, label="literal: Cholesky fails", marker="x", linestyle=""),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=7)
    return figure
