"""Replays under drawn perturbations: how hard they hit, which stand, and what that depends on."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

from impactopt.report.pictures.style import BLACK, BLUE, VERMILION, Picture, styled
from impactopt.simulation.robustness import LOGARITHMIC, Robustness

LABELS = {
    "mass": "target mass / planned",
    "stiffness": "contact stiffness / planned",
    "distance": "target farther [mm]",
    "payload": "payload in the hand [kg]",
    "friction": "friction of the floor",
    "kp": "servo stiffness / planned",
    "kd": "servo damping / planned",
    "torque_limit": "torque limit / planned",
}
SCALE = {"distance": 1e3}
COLUMNS = 4


@styled
def robustness_picture(result: Robustness) -> Picture:
    """Histogram of the impulse above, one scatter a drawn parameter below; falls are crosses."""
    table = result.table()
    rows = -(-len(table) // COLUMNS)
    figure = Picture(8.8, 2.7 + 2.2 * rows)
    grid = figure.add_gridspec(rows + 1, COLUMNS, height_ratios=[1.25] + [1.0] * rows)
    _histogram(figure.add_subplot(grid[0, :]), result)
    for k, (name, value) in enumerate(table.items()):
        axes = figure.add_subplot(grid[1 + k // COLUMNS, k % COLUMNS])
        _scatter(axes, name, value, result)
        if k % COLUMNS == 0:
            axes.set_ylabel("impulse [N s]")
        else:
            axes.tick_params(labelleft=False)
    return figure


def _histogram(axes: Any, result: Robustness) -> None:
    known = np.isfinite(result.impulse)
    stands, falls = (result.impulse[known & mask] for mask in (result.standing, ~result.standing))
    every = result.impulse[known]
    if every.size:
        low, high = float(every.min()), float(every.max())
        edges = np.linspace(low, high if high > low else low + 1.0, 31)
        axes.hist(
            [stands, falls],
            edges,
            stacked=True,
            color=[BLUE, VERMILION],
            label=[f"stands: {stands.size}", f"does not stand: {falls.size}"],
            edgecolor="white",
            linewidth=0.5,
        )
    axes.axvline(result.planned_impulse, color=BLACK, linestyle="--", label="planned")
    low, high = result.interval
    axes.set_title(
        f"{result.draws} draws: {100 * result.rate:.0f} % stand (95 %: {100 * low:.0f} to {100 * high:.0f}), "
        f"impulse {result.impulse_mean:.2f} ± {result.impulse_std:.2f} N s"
    )
    axes.set(xlabel="impulse [N s]", ylabel="draws")
    axes.legend()


def _scatter(axes: Any, name: str, value: Any, result: Robustness) -> None:
    x = SCALE.get(name, 1.0) * value
    for mask, marker, color, size in (
        (result.standing, "o", BLUE, 14),
        (~result.standing, "x", VERMILION, 22),
    ):
        edge = {"edgecolors": "none"} if marker == "o" else {"linewidths": 1.2}
        axes.scatter(x[mask], result.impulse[mask], s=size, marker=marker, color=color, alpha=0.8, **edge)
    if name in LOGARITHMIC:
        axes.set_xscale("log")
        low, high = result.drawn_from.bounds()[name]
        ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0, 10.0) if low <= t <= high]
        axes.xaxis.set_major_locator(FixedLocator(ticks))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.set_xlabel(LABELS.get(name, name))
