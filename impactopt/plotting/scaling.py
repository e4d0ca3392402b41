"""Cost of a collision over degrees of freedom, over the step, and over the size of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from impactopt.plotting.style import BLUE, GREEN, ORANGE, VERMILION

Row = Mapping[str, Any]
_MARKS = {"chain": "v", "tree": "o"}


def scaling_picture(rows: Sequence[Row]) -> Figure:
    """Three panels; rows of `impactopt.bench.scaling`."""
    figure = Figure(figsize=(12.0, 4.2))
    dof, step, batch = figure.subplots(1, 3)
    _over_dof(dof, [r for r in rows if r["over"] == "dof"])
    for method, colour in (("events", BLUE), ("rk4", VERMILION)):
        own = [r for r in rows if r["over"] == "step" and r["method"] == method]
        times, errors = [r["time_us"] for r in own], [max(r["integration_error"], 1e-14) for r in own]
        step.loglog(times, errors, "o-", color=colour, markersize=4, label=method)
        for r, x, y in zip(own, times, errors, strict=True):
            step.annotate(f"{r['step_s']:g}", (x, y), fontsize=7, xytext=(3, 3), textcoords="offset points")
    step.set(xlabel="time of a collision [us]", ylabel="impulse against the exact solution")
    step.set_title("over the step [s]", loc="left")
    step.legend(fontsize=8)
    for threads, colour in ((1, BLUE), (2, GREEN)):
        own = [r for r in rows if r["over"] == "batch" and r["threads"] == threads]
        sizes, rates = [r["batch"] for r in own], [r["impacts_per_second"] for r in own]
        batch.loglog(sizes, rates, "o-", color=colour, label=f"{threads} threads")
    batch.set(xlabel="collisions in a batch", ylabel="collisions a second")
    batch.set_title("over the batch", loc="left")
    batch.legend(fontsize=8)
    return figure


def _over_dof(axes: Any, rows: Sequence[Row]) -> None:
    for part, colour, count in (
        ("freeze_us", BLUE, "paper_once"),
        ("step_us", ORANGE, "paper_iteration"),
    ):
        name = part.removesuffix("_us")
        for kind in dict.fromkeys(r["robot"] for r in rows):
            own = [r for r in rows if r["robot"] == kind and r[part] > 0]
            label = f"{name}, {kind}"
            numbers = [r["n"] for r in own], [r[part] for r in own]
            axes.loglog(*numbers, _MARKS.get(kind, "*"), color=colour, markersize=6, label=label)
        trees = sorted((r for r in rows if r["robot"] == "tree" and r[part] > 0), key=lambda r: r["n"])
        if trees:
            # the paper's count through the largest tree
            scale = trees[-1][part] / trees[-1][count]
            line = [scale * r[count] for r in trees]
            axes.loglog([r["n"] for r in trees], line, ":", color=colour, label=f"{name}: paper's formula")
    axes.set(xlabel="joints", ylabel="time [us]")
    axes.set_title("over degrees of freedom", loc="left")
    axes.legend(fontsize=7)
