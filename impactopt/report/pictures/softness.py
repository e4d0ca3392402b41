"""What a blow brings, and what its gears bear, over stiffness; and the stiffness that a plan chooses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from impactopt.report.pictures.style import BLUE, GREEN, PAGE, PURPLE, VERMILION, Picture, styled

Row = Mapping[str, Any]


@styled
def softness_picture(rows: Sequence[Row]) -> Picture:
    """Two panels, a line a problem, over factors on the stiffness; stars are what plans choose.

    rows : of `impactopt.studies.bench.softness`; of a blow the nail's depth is drawn, else its impulse.
    """
    figure = Picture(PAGE, 2.6)
    worth, gear = figure.subplots(1, 2)
    colours = (BLUE, VERMILION, GREEN, PURPLE)
    names = dict.fromkeys(row["problem"] for row in rows)
    for name, colour in zip(names, colours, strict=False):
        own = [row for row in rows if row["problem"] == name and row.get("impulse_Ns")]
        given = [row for row in own if not row["chosen"]]
        chosen = [row for row in own if row["chosen"]]
        for axes, of in ((worth, _brought), (gear, _load)):
            axes.plot(
                [r["factor"] for r in given], [of(r) for r in given], "o-", ms=3, color=colour, label=name
            )
            axes.plot([r["factor"] for r in chosen], [of(r) for r in chosen], "*", ms=9, color=colour)
    depths = any("depth_m" in row.get("outcome", {}) for row in rows)
    worth.set(ylabel="nail driven [mm]" if depths else "impulse [N s]")
    gear.set(ylabel="gear load / torque limit")
    for axes in (worth, gear):
        axes.set(xscale="log", xlabel="stiffness / that of the file")
        axes.set_ylim(bottom=0.0)
    if worth.lines:
        worth.legend(fontsize=6.5)
    return figure


def _brought(row: Row) -> float:
    depth = row["outcome"].get("depth_m")
    return float(row["impulse_Ns"] if depth is None else 1e3 * depth)


def _load(row: Row) -> float:
    return float(row["gear_planned"])
