"""Run time of a collision against the error of its impulse, with the front of what nothing else beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.ticker import FuncFormatter

from impactopt.report.pictures.style import MODELS, PAGE, Picture, styled

Row = Mapping[str, Any]

# [%] what is below is exact as far as the reference is, and is drawn there
_LEAST = 1e-3
# how a method's name begins: its model, mark
_MARKS = {
    "virtual": ("virtual-mass", "s"),
    "paper": ("sdc-paper", "v"),
    "sdc, freezes": ("freezes", "*"),
    "sdc": ("sdc", "o"),
    "exact": ("sdc", "D"),
    "CVODES": ("sdc", "P"),
    "Pinocchio": ("full", "x"),
    "MuJoCo": ("mujoco", "^"),
}


def front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other one beats in both time and error, the fastest first."""
    out: list[Row] = []
    for r in sorted(rows, key=lambda r: (r["time_us"], abs(r["impulse_error_pct"]))):
        if not out or abs(r["impulse_error_pct"]) < abs(out[-1]["impulse_error_pct"]):
            out.append(r)
    return out


@styled
def pareto_picture(rows: Sequence[Row]) -> Picture:
    """One panel a robot; rows of `benchmarks.collision` that have a time and an error."""
    known = [r for r in rows if r["time_us"] is not None and r["impulse_error_pct"] is not None]
    robots = list(dict.fromkeys(r["robot"] for r in known))
    figure = Picture(PAGE, 4.0)
    panels = figure.subplots(1, max(1, len(robots)), sharex=True, sharey=True, squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=False):
        own = [r for r in known if r["robot"] == robot]
        best = [r for r in front(own) if _size(r) > _LEAST]  # a step down to what is exact has no height
        times, errors = [r["time_us"] for r in best], [_size(r) for r in best]
        axes.step(times, errors, where="post", color="#999999", linewidth=1.0, zorder=1)
        for method in dict.fromkeys(map(_kind, own)):
            mine = [r for r in own if _kind(r) == method]
            model, mark = next(x for key, x in _MARKS.items() if method.startswith(key))
            colour = MODELS[model]
            hollow = "CasADi's C" in method
            axes.loglog(
                [r["time_us"] for r in mine],
                [_size(r) for r in mine],
                mark,
                color=colour,
                markerfacecolor="none" if hollow else colour,
                clip_on=False,  # what is exact stands on the edge
                label=method,
            )
        axes.set_title(robot, loc="left")
        axes.set_xlabel("time of a collision [us]")
        axes.set_ylim(bottom=_LEAST)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{'< ' if y <= _LEAST else ''}{y:g}"))
    panels[0].set_ylabel("impulse error against full dynamics [%]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=6.5)
    return figure


def _kind(row: Row) -> str:
    """The method; several freezes are one."""
    return "sdc, freezes" if row["method"].endswith(" freezes") else str(row["method"])


def _size(row: Row) -> float:
    return max(abs(float(row["impulse_error_pct"])), _LEAST)
