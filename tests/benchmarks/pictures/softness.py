"""Impulse and gear loads of a blow over stiffness; and the stiffness that a plan chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from impactopt.report.pictures.style import BLUE, GREEN, PAGE, PURPLE, VERMILION, Picture, styled

Row = Mapping[str, Any]
COLOURS = (BLUE, VERMILION, GREEN, PURPLE)


@styled
def softness_picture(rows: Sequence[Row]) -> Picture:
    """A line a problem over factors on the stiffness; stars are what plans choose.

    rows : of `benchmarks.softness`. Panels are impulse, depth of nails if there are any, gears.
    """
    quantities = {"impulse [N s]": _impulse, "nail driven [mm]": _depth, "gear load / torque limit": _load}
    solved = [row for row in rows if row.get("impulse_Ns")]
    if not any("depth_m" in row["outcome"] for row in solved):
        del quantities["nail driven [mm]"]
    figure = Picture(PAGE, 2.4)
    panels = figure.subplots(1, len(quantities))
    colours = dict(zip(dict.fromkeys(row["problem"] for row in rows), COLOURS, strict=False))
    given = sorted({row["factor"] for row in solved if not row["chosen"]})
    for axes, (label, of) in zip(panels, quantities.items(), strict=True):
        for name, colour in colours.items():
            for chosen, style in ((False, "o-"), (True, "*")):
                own = [r for r in solved if r["problem"] == name and r["chosen"] is chosen]
                factors, size = [r["factor"] for r in own], 9 if chosen else 3
                axes.plot(factors, [of(r) for r in own], style, markersize=size, color=colour)
        axes.set(xscale="log", xlabel="stiffness / that of the file", ylabel=label)
        axes.set_xticks(given, [f"{factor:g}" for factor in given], minor=False)
        axes.set_xticks([], minor=True)
        most = max((of(row) for row in solved if np.isfinite(of(row))), default=1.0)
        axes.set_ylim(0.0, 1.08 * most)
    key = [Line2D([], [], marker="o", markersize=3, color=c, label=name) for name, c in colours.items()]
    star: Any = {"marker": "*", "markersize": 9, "linestyle": "", "color": "#555555"}
    key.append(Line2D([], [], label="chosen by the plan", **star))
    figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def _impulse(row: Row) -> float:
    return float(row["impulse_Ns"])


def _depth(row: Row) -> float:
    return 1e3 * float(row["outcome"].get("depth_m", np.nan))


def _load(row: Row) -> float:
    return float(row["gear_planned"])
