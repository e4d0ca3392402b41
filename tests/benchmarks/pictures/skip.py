"""Savings by leaving terms out of a collision function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impactopt.report.pictures.style import BLUE, ORANGE, PAGE, Picture, styled

Row = Mapping[str, Any]


@styled
def skip_picture(rows: Sequence[Row]) -> Picture:
    """Bars of time and instructions; rows of `benchmarks.skip` that have a time."""
    timed = [r for r in rows if r["time_us"] is not None][::-1]
    figure = Picture(PAGE, 0.28 * len(timed) + 1.1)
    panels = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(timed))
    panels[0].barh(places, [r["time_us"] for r in timed], color=BLUE)
    panels[0].set_xlabel("time of a collision [us]")
    for place, r in zip(places, timed, strict=True):
        panels[0].text(r["time_us"], place, f" {r['speedup']:.2f}x", va="center", fontsize=6.5)
    panels[0].set_xlim(right=1.2 * max(r["time_us"] for r in timed))
    freeze, step = ([r[f"{part}_instructions"] for r in timed] for part in ("freeze", "step"))
    panels[1].barh(places, freeze, color=BLUE, label="freeze, once")
    panels[1].barh(places, step, left=freeze, color=ORANGE, label="one step")
    panels[1].set_xlabel("instructions")
    panels[1].legend()
    panels[0].set_yticks(places, [r["skipped"].replace("everything", "nothing") for r in timed])
    panels[0].set_ylabel("left out")
    for axes in panels:
        axes.grid(axis="y", visible=False)
    return figure
