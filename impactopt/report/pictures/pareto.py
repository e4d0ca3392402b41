"""Run time of a collision against the error of its impulse, with the front of what nothing else beats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from impactopt.report.pictures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PAGE,
    PURPLE,
    SKY,
    VERMILION,
    Picture,
    styled,
)

Row = Mapping[str, Any]

_LEAST = 1e-6  # [%] drawn for what is exact
# how a method's name begins: colour, mark
_MARKS = {
    "virtual": (ORANGE, "s"),
    "paper": (VERMILION, "v"),
    "sdc, freezes": (BLUE, "*"),
    "sdc": (BLUE, "o"),
    "exact": (GREEN, "D"),
    "CVODES": (PURPLE, "P"),
    "Pinocchio": (BLACK, "x"),
    "MuJoCo": (SKY, "^"),
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
    """One panel a robot; rows of `impactopt.studies.bench.collision` that have a time and an error."""
    known = [r for r in rows if r["time_us"] is not None and r["impulse_error_pct"] is not None]
    robots = list(dict.fromkeys(r["robot"] for r in known))
    figure = Picture(PAGE, 4.0)
    panels = figure.subplots(1, max(1, len(robots)), sharex=True, sharey=True, squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=False):
        own = [r for r in known if r["robot"] == robot]
        best = front(own)
        times, errors = [r["time_us"] for r in best], [_size(r) for r in best]
        axes.step(times, errors, where="post", color="#999999", linewidth=1.0, zorder=1)
        for method in dict.fromkeys(map(_kind, own)):
            mine = [r for r in own if _kind(r) == method]
            colour, mark = next(x for key, x in _MARKS.items() if method.startswith(key))
            hollow = "CasADi's C" in method
            axes.loglog(
                [r["time_us"] for r in mine],
                [_size(r) for r in mine],
                mark,
                color=colour,
                markerfacecolor="none" if hollow else colour,
                label=method,
            )
        axes.set_title(robot, loc="left")
        axes.set_xlabel("time of a collision [us]")
    panels[0].set_ylabel("impulse error against full dynamics [%]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=6.5)
    return figure


def _kind(row: Row) -> str:
    """The method; several freezes are one."""
    return "sdc, freezes" if row["method"].endswith(" freezes") else str(row["method"])


def _size(row: Row) -> float:
    return max(abs(float(row["impulse_error_pct"])), _LEAST)
