"""The same blow with stiffer and stiffer servos, from free joints to one rigid body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from impactopt.report.pictures.style import BLUE, COLUMN, GREEN, ORANGE, VERMILION, Picture, styled

Row = Mapping[str, Any]


@styled
def gains_picture(rows: Sequence[Row]) -> Picture:
    """Impulse between its two ends, a line a robot; rows of `benchmarks.gains`."""
    figure = Picture(COLUMN, 2.6)
    axes = figure.subplots()
    for name, colour in zip(
        dict.fromkeys(r["robot"] for r in rows), (BLUE, VERMILION, GREEN, ORANGE), strict=False
    ):
        own = [r for r in rows if r["robot"] == name]
        label = f"{name}, {own[0]['effective_mass_kg']:.1f} kg"
        axes.plot([r["factor"] for r in own], [r["share"] for r in own], color=colour, label=label)
    axes.axvline(1.0, color="0.6", linewidth=0.8, linestyle="--")
    axes.set_xscale("log")
    axes.set_yticks([0.0, 0.5, 1.0], ["0\nfree joints", "0.5", "1\nlocked"])
    axes.set(xlabel="servo gains / own", ylabel="impulse")
    axes.legend(fontsize=6.5)
    return figure
