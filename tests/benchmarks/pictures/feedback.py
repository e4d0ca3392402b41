"""Fraction of draws that stand over a plan's impulse: with the joints' servos, and with a controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from impactopt.report.pictures.style import BLACK, BLUE, COLUMN, VERMILION, Picture, styled

Row = Mapping[str, Any]
COLOURS = {"servo": (VERMILION, "the joints' servos"), "wbc": (BLUE, "whole-body controller")}
MARKERS = {"stated": ("o", "balance as stated"), "loosened": ("^", "loosened")}
ASIDE = 1 / 11  # [in] by which those of one impulse stand beside each other


@styled
def feedback_picture(rows: Sequence[Row]) -> Picture:
    """Share of draws that stand, with its 95 % interval; rows of `benchmarks.feedback`.

    A cross: it falls even if all is as planned.
    """
    figure = Picture(COLUMN, 2.9)
    axes = figure.subplots()
    known = [row for row in rows if row["impulse_planned_Ns"] is not None]
    kinds = [(controller, balance) for balance in MARKERS for controller in COLOURS]
    for k, kind in enumerate(kinds):
        own = [row for row in known if (row["controller"], row["balance"]) == kind]
        (colour, _), (marker, _) = COLOURS[kind[0]], MARKERS[kind[1]]
        aside = ScaledTranslation((k - (len(kinds) - 1) / 2) * ASIDE, 0.0, figure.dpi_scale_trans)
        style: Any = {"color": colour, "elinewidth": 0.9, "capsize": 2, "markersize": 4.5}
        style["transform"] = axes.transData + aside
        for row in own:
            at, rate = row["impulse_planned_Ns"], 100 * row["standing_rate"]
            bars = np.abs(100 * np.array(row["standing_interval_95"]) - rate)[:, None]
            axes.errorbar(at, rate, bars, marker=marker, **style)
            if not row["nominal_standing"]:
                axes.plot(at, rate, "x", color=BLACK, markersize=8, zorder=4, transform=style["transform"])
    for name in dict.fromkeys(row["problem"] for row in known):
        at = np.mean([row["impulse_planned_Ns"] for row in known if row["problem"] == name])
        axes.text(at, 106.0, name, fontsize=6.5, ha="center", va="bottom")
    impulses = [row["impulse_planned_Ns"] for row in known] or [0.0]
    middle, half = (max(impulses) + min(impulses)) / 2, (max(impulses) - min(impulses)) / 2 or 1.0
    axes.set_xlim(middle - 1.25 * half, middle + 1.25 * half)  # not by itself: the marks are moved aside
    axes.set_ylim(-4.0, 104.0)
    axes.set(xlabel="planned impulse [N s]", ylabel="draws that stand [%]")
    axes.legend(
        handles=[
            *(
                Line2D([], [], color=c, marker="s", markersize=4.5, linestyle="", label=t)
                for c, t in COLOURS.values()
            ),
            *(
                Line2D([], [], color="#777777", marker=m, markersize=4.5, linestyle="", label=t)
                for m, t in MARKERS.values()
            ),
            Line2D(
                [], [], color=BLACK, marker="x", markersize=7, linestyle="", label="falls even as planned"
            ),
        ],
        fontsize=6.5,
        loc="center",
    )
    return figure
