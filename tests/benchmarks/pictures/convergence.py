"""The replay's own error over its step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impactopt.report.pictures.style import BLACK, BLUE, GREEN, ORANGE, PAGE, Picture, styled

LINES = (
    ("impulse_change_pct", "impulse [%]", "o", BLUE),
    ("peak_force_change_pct", "peak force [%]", "s", ORANGE),
    ("base_change_mm", "base at the end [mm]", "^", GREEN),
)


@styled
def convergence_picture(steps: Sequence[Mapping[str, Any]], settings: Sequence[Mapping[str, Any]]) -> Picture:
    """Change from the smallest step's replay over the step, log-log, with a line of first order; beside it
    what other settings change.

    steps, settings : rows of `benchmarks.replay`.
    """
    figure = Picture(PAGE, 3.4)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.1])
    for key, label, marker, color in LINES:
        points = np.array([(1e3 * r["step"], abs(r[key])) for r in steps if r.get(key)]).reshape(-1, 2)
        left.plot(*points.T, marker=marker, color=color, label=label)
    coarse = [(1e3 * r["step"], abs(r["impulse_change_pct"])) for r in steps if r.get("impulse_change_pct")]
    if coarse:
        (x0, y0), x1 = max(coarse), min(coarse)[0]
        left.plot([x0, x1], [y0, y0 * x1 / x0], "--", color=BLACK, linewidth=1.0, label="first order")
    left.set(xscale="log", yscale="log", xlabel="step [ms]", title="change from the smallest step")
    left.legend()
    shown = [r for r in settings if r.get("impulse_Ns") is not None][::-1]
    for k, (key, label, _, color) in enumerate(LINES):
        height = np.arange(len(shown)) + 0.25 * (1 - k)
        right.barh(height, [abs(r[key]) for r in shown], 0.25, color=color, label=label)
    right.set_yticks(np.arange(len(shown)), [r["setting"] for r in shown])
    right.set(xlabel="[%] or [mm]", xlim=(0.0, None), title="change by other settings, same step")
    right.grid(axis="y", visible=False)
    right.legend(loc="upper right")
    return figure
