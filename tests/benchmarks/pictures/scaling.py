"""Cost of a collision over degrees of freedom, over the step, and over the size of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from impactopt.report.pictures.style import BLACK, BLUE, GREEN, ORANGE, PAGE, VERMILION, Picture, styled

Row = Mapping[str, Any]
_FORMULA = {"linestyle": ":", "linewidth": 1.2}
_KINDS = {"chain": ("v", BLUE, "chain"), "tree": ("o", ORANGE, "tree of four limbs")}
_HUMANOIDS = ("s", "D", "^", "P", "X")  # hollow, as they lie close together
# time, the paper's count of it, and how the table of exponents calls it
_PARTS = (
    ("freeze_us", "paper_once", "freeze"),
    ("loop_us", "paper_stage", "time loop"),
    ("stage_us", "paper_stage", "a stage"),
)
_TITLES = ("freeze", "time loop, which finds its own steps", "a stage of the paper's scheme")
_METHODS = (
    ("implicit", GREEN, "own steps, by tolerance"),
    ("rk4", VERMILION, "the paper's Runge-Kutta, by step [s]"),
)


@styled
def scaling_picture(rows: Sequence[Row], exponents: Sequence[Row]) -> Picture:
    """Three panels over joints, three over step and batch; rows of `benchmarks.scaling`."""
    figure = Picture(PAGE, 8.4)
    of = {over: [r for r in rows if r["over"] == over] for over in ("dof", "step", "batch")}
    grid = figure.subplots(3, 2).ravel()
    for axes, part, title in zip(grid[:3], _PARTS, _TITLES, strict=True):
        _over_dof(axes, of["dof"], exponents, *part)
        axes.set_title(title, loc="left")
    _over_step(grid[3], of["step"])
    _errors(grid[4], of["step"])
    _over_batch(grid[5], of["batch"])
    return figure


def _over_dof(
    axes: Any, rows: Sequence[Row], exponents: Sequence[Row], part: str, count: str, name: str
) -> None:
    powers = {r["robot"]: r for r in exponents if r["part"] == name}
    for kind, (mark, colour, label) in _KINDS.items():
        own = sorted((r for r in rows if r["robot"] == kind and (r[part] or 0) > 0), key=lambda r: r["n"])
        if not own:
            continue
        n, times = [r["n"] for r in own], [r[part] for r in own]
        ours, paper = (_power(powers.get(kind), key) for key in ("exponent", "paper"))
        axes.loglog(n, times, f"{mark}-", color=colour, markersize=5, label=f"{label}{ours}")
        # through the largest
        line = [times[-1] * r[count] / own[-1][count] for r in own]
        axes.loglog(n, line, color=colour, label=f"paper's count, {kind}{paper}", **_FORMULA)
    humanoids = [r for r in rows if r["robot"] not in _KINDS and r[part] is not None]
    hollow = {"color": BLACK, "markersize": 7, "markerfacecolor": "none", "linestyle": "none"}
    for r, mark in zip(humanoids, _HUMANOIDS * len(humanoids), strict=False):
        axes.loglog(r["n"], r[part], marker=mark, label=f"{r['robot']}, {r['n']} joints", **hollow)
    axes.set(xlabel="joints n", ylabel="time [us]")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
    _head_room(axes, 60.0)
    axes.legend(fontsize=6.5, loc="upper left")


def _power(row: Row | None, key: str) -> str:
    return f": n$^{{{row[key]:.1f}}}$" if row else ""


def _over_step(axes: Any, rows: Sequence[Row]) -> None:
    for method, colour, label in _METHODS[1:]:
        own = sorted((r for r in rows if r["method"] == method), key=lambda r: r["step_s"])
        if not own:
            continue
        steps, times = [r["step_s"] for r in own], [r["time_us"] for r in own]
        axes.loglog(steps, times, "o-", color=colour, markersize=4, label=label.partition(",")[0])
        if method == "rk4":
            line = [times[0] * r["paper_operations"] / own[0]["paper_operations"] for r in own]
            axes.loglog(steps, line, color=colour, label="paper's count", **_FORMULA)
    for r in rows:
        if r["default"]:
            axes.axhline(
                r["time_us"], color=GREEN, linestyle="--", linewidth=1.2, label="own steps (default)"
            )
    axes.set(xlabel="step [s]", ylabel="time of a collision [us]")
    axes.set_title(f"over the step{_of(rows)}", loc="left")
    axes.legend(fontsize=6.5, loc="upper right")


def _errors(axes: Any, rows: Sequence[Row]) -> None:
    for method, colour, label in _METHODS:
        own = [r for r in rows if r["method"] == method]
        times, errors = [r["time_us"] for r in own], [max(r["integration_error"], 1e-15) for r in own]
        axes.loglog(times, errors, "o-", color=colour, markersize=4, label=label)
        for r, x, y in zip(own, times, errors, strict=True):
            text, left = f"{r['step_s'] or r['tolerance']:g}", method == "implicit"
            at: Any = {"xytext": (-5 if left else 4, 4), "ha": "right" if left else "left"}
            axes.annotate(text, (x, y), fontsize=6, textcoords="offset points", **at)
    axes.set(xlabel="time of a collision [us]", ylabel="impulse against the exact solution")
    axes.set_title(f"error over time{_of(rows)}", loc="left")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.8, high * 1.4)  # room for the numbers
    _head_room(axes, 1e3)
    axes.legend(fontsize=6.5, loc="upper right")


def _of(rows: Sequence[Row]) -> str:
    return f" ({rows[0]['robot']})" if rows else ""


def _over_batch(axes: Any, rows: Sequence[Row]) -> None:
    for threads, colour, name in ((1, BLUE, "one thread"), (2, GREEN, "two threads")):
        own = [r for r in rows if r["threads"] == threads]
        sizes, rates = [r["batch"] for r in own], [r["impacts_per_second"] for r in own]
        axes.loglog(sizes, rates, "o-", color=colour, label=name)
    axes.set(xlabel="collisions in a batch", ylabel="collisions a second")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_title("over the batch", loc="left")
    axes.legend(fontsize=6.5, loc="lower right")


def _head_room(axes: Any, factor: float) -> None:
    """Room for a legend above the data."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * factor)
