"""Convergence of a solver: objective, violation and stationarity over its iterations."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase

from impactopt.files.record import Record
from impactopt.report.pictures.style import BLUE, COLUMN, GREEN, VERMILION, Array, picture

MIN_VALUE = 1e-12  # smaller values are drawn there


@picture(
    width=COLUMN,
    height=3.6,
    title="the solver's iterations",
    exists=lambda record: "history_iteration" in record.arrays,
    lacking="the solver kept no history",
)
def iterations(figure: FigureBase, record: Record) -> None:
    """Objective (the impulse, minus small penalties) above, violation and stationarity below."""
    a = record.arrays
    count = a["history_iteration"]
    top, bottom = figure.subplots(2, 1, sharex=True)
    gain = -a["history_objective"]
    top.plot(count, gain, color=BLUE)
    # the objective of the first, very infeasible iterates is meaningless
    top.set_ylim(*_middle_of(gain))
    # objectives other than the impulse have units of their own
    several = "objectives" in record.summary.get("problem", {})
    top.set(ylabel="maximized [-]" if several else "maximized [N s]")
    for key, label, style, colour in (
        ("max_violation", "largest violation", "-", VERMILION),
        ("kkt", "stationarity", "--", GREEN),
    ):
        values = np.maximum(a[f"history_{key}"], MIN_VALUE)
        bottom.semilogy(count, values, style, color=colour, label=label)
    bottom.set(xlabel="iterations [-]", ylabel="residuals [-]")
    figure.legend(loc="outside lower center", ncols=2)


def _middle_of(values: Array) -> tuple[float, float]:
    """Limits of an axis that contain the last half of the values, and others within five times their span."""
    last = values[len(values) // 2 :]
    low, high = float(last.min()), float(last.max())
    pad = max(5 * (high - low), 0.05 * abs(values[-1]), 1e-9)
    return max(float(values.min()), low - pad) - 0.05 * pad, min(float(values.max()), high + pad) + 0.05 * pad
