"""Impulse of a blow over the limit of gear loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from impactopt.report.pictures.style import COLUMN, Picture, styled

Row = Mapping[str, Any]
STEP = 0.75  # beyond the largest limit, where the impulse without one is drawn


@styled
def machine_picture(rows: Sequence[Row]) -> Picture:
    """Impulse over that without a limit, a line a problem; rows of `benchmarks.machine`."""
    figure = Picture(COLUMN, 2.6)
    axes = figure.subplots()
    limits = sorted({row["gear_limit"] for row in rows} - {None})
    free = max(limits, default=0.0) + STEP
    for case in dict.fromkeys((row["problem"], row["armature"]) for row in rows):
        own = [row for row in rows if (row["problem"], row["armature"]) == case and row.get("impulse_Ns")]
        name = case[0] if case[1] == 1.0 else f"{case[0]}, armature x {case[1]:g}"
        whole = next((row["impulse_Ns"] for row in own if row["gear_limit"] is None), None)
        if not whole:
            continue
        places = sorted((row["gear_limit"] or free, row["impulse_Ns"] / whole) for row in own)
        axes.plot(*zip(*places, strict=True), marker="o", markersize=3, label=name)
    axes.set_xticks([*limits, free], [*(f"{limit:g}" for limit in limits), "none"])
    axes.set_ylim(bottom=0.0)
    axes.set(xlabel="gear load / torque limit, at most", ylabel="impulse / that without a limit")
    if axes.lines:
        axes.legend(fontsize=6.5)
    return figure
