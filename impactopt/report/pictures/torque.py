"""Torque demand over limit, joints by time; and torque through the gears in contact."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import FigureBase

from impactopt.files.record import Record
from impactopt.report.pictures.style import (
    BLUE,
    GREEN,
    OVER,
    PHASES,
    VERMILION,
    Array,
    joint_label,
    picture,
    simulated_parts,
)

JOINT_HEIGHT = 0.13  # [in]
GEARS_HEIGHT = 2.0  # [in] of the panel of gears


def _title(record: Record) -> str:
    return f"torque over limit ({'simulated, before saturation' if record.simulated else 'planned'})"


@picture(
    height=lambda record: torque_height(record) + 0.2 + (GEARS_HEIGHT if _gears(record) else 0.0),
    title=_title,
)
def torque(figure: FigureBase, record: Record) -> None:
    """Torque demand over limit, joints by time; contact has a panel of its own, at a larger scale."""
    gears = _gears(record)
    if not gears:
        draw_torque(figure, record)
        return
    parts: Any = figure.subfigures(2, 1, height_ratios=[torque_height(record) + 0.2, GEARS_HEIGHT])
    above, below = parts
    draw_torque(above, record)
    _draw_gears(below, record, gears)


def _gears(record: Record) -> dict[str, tuple[Array, Array]]:
    """Times since contact [ms] and torque through the gears over limit (k, n): planned, and simulated."""
    a, out = record.arrays, dict[str, tuple[Array, Array]]()
    if a.get("collision_acceleration", np.zeros(0)).size and "armature" in a:
        load = a["collision_torque"] - a["armature"] * a["collision_acceleration"]
        out["planned"] = 1e3 * a["collision_time"], load / a["torque_limit"]
    start, end = (a.get(f"simulated_contact_{name}", np.nan) for name in ("start", "end"))
    if a.get("simulated_gear", np.zeros(0)).size and np.isfinite(start) and np.isfinite(end):
        before = 0.1 * (end - start)
        near = (a["simulated_time"] >= start - before) & (a["simulated_time"] <= end + before)
        out["simulated"] = (
            1e3 * (a["simulated_time"][near] - start),
            a["simulated_gear"][near] / a["torque_limit"],
        )
    return {name: part for name, part in out.items() if len(part[0]) > 1}


def _draw_gears(figure: FigureBase, record: Record, gears: dict[str, tuple[Array, Array]]) -> None:
    """Draws the joints with the largest gear loads, which jump at contact if a damper has a force at once."""
    axes, names = figure.subplots(), record.arrays["joints"]
    most = np.max([np.abs(load).max(axis=0) for _, load in gears.values()], axis=0)
    for k, colour in zip(np.argsort(-most), (BLUE, VERMILION, GREEN), strict=False):
        for source, style in (("planned", "-"), ("simulated", "--")):
            if source in gears:
                time, load = gears[source]
                label = f"{joint_label(names[k])}, {source}"
                axes.plot(time, load[:, k], style, color=colour, label=label)
    axes.axhline(0.0, color="0.6", linewidth=0.6)
    axes.set(xlabel="time since contact [ms]", ylabel="through the gear / limit")
    axes.set_title("torque through the gears, worst joints")
    axes.legend(fontsize=6.5, loc="center left", bbox_to_anchor=(1.0, 0.5))


def torque_height(record: Record) -> float:
    """Height [in] at which the joints' names are legible."""
    return 0.75 + JOINT_HEIGHT * max(len(record.arrays["joints"]), 8)


def draw_torque(figure: FigureBase, record: Record) -> None:
    """Torque demand alone, into a figure, or a part of one."""
    a = record.arrays
    names = [joint_label(name) for name in a["joints"]]
    histories = _demand(record)
    panels = figure.subplots(1, 3, sharey=True, gridspec_kw={"width_ratios": [4, 3, 4]})
    colours = matplotlib.colormaps["cividis"].with_extremes(over=OVER)
    mesh: Any = None
    for k, (axes, (time, ratio)) in enumerate(zip(panels, histories, strict=True)):
        if len(time) < 2 or time[0] == time[-1]:  # after a contact that never ends; in one without duration
            axes.set_visible(False)
            continue
        edges, values = _binned(time, ratio)
        joints = np.arange(len(names) + 1) - 0.5
        mesh = axes.pcolormesh(edges, joints, values.T, cmap=colours, vmin=0.0, vmax=1.0, rasterized=True)
        axes.grid(False)
        axes.set(
            xlabel="time since contact [ms]" if k == 1 else "time [s]",
            title=f"{'contact' if k == 1 else PHASES[k]}: at most {ratio.max():.2f}",
        )
    panels[0].set_yticks(np.arange(len(names)), names, fontsize=6.5)
    panels[0].invert_yaxis()
    for axes in panels[1:]:
        axes.tick_params(left=False)
    bar = figure.colorbar(mesh, ax=list(panels), extend="max", aspect=40, pad=0.01)
    bar.set_label("|demand| / limit")


def _demand(record: Record) -> list[tuple[Array, Array]]:
    """Times and |demand| / limit (k, n) of the three phases."""
    a = record.arrays
    if record.simulated:
        return simulated_parts(record, np.abs(a["simulated_demand"]) / a["torque_limit"])
    torque, time, phase = a["reference_torque"], a["reference_time"], a["reference_phase"]
    histories = [(time[phase == k], torque[phase == k]) for k in range(3)]
    histories[1] = 1e3 * a["collision_time"], a["collision_torque"]
    return [(time, np.abs(values) / a["torque_limit"]) for time, values in histories]


def _binned(time: Array, values: Array, most: int = 500) -> tuple[Array, Array]:
    """Edges of bins, and the largest value in each, so that no peak is lost between pixels."""
    count = min(most, len(time))
    wanted = np.linspace(time[0], time[-1], count, endpoint=False)
    start = np.unique(np.searchsorted(time, wanted, side="right") - 1)
    return np.append(time[start], time[-1]), np.maximum.reduceat(values, start, axis=0)
