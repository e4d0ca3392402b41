"""Histories of a record: contact force, torques, joint motion over time; the solver's over its iterations."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D

from impactopt.arrays import Array
from impactopt.files.record import Record
from impactopt.report.histories import contact_force
from impactopt.report.pictures.style import (
    BLACK,
    BLUE,
    COLOURS,
    COLUMN,
    GREEN,
    OVER,
    PHASES,
    PLANNED,
    SIMULATED,
    VERMILION,
    impulse_text,
    joint_label,
    picture,
    simulated_parts,
    title,
)


@picture(width=COLUMN, height=2.6)
def force(figure: FigureBase, record: Record) -> None:
    """Contact force over the time since contact."""
    draw_force(figure, record)
    whole: Any = figure  # of which matplotlib has wrong types
    whole.axes[0].set_title(title(record, "contact force"))


def draw_force(place: FigureBase | Axes, record: Record) -> None:
    """Draws the picture into a figure, a part of one, or axes."""
    a, summary = record.arrays, record.summary
    axes: Any = place if isinstance(place, Axes) else place.subplots()
    label = f"planned: {impulse_text(summary)}"
    style: Any = {"color": PLANNED, "markersize": 4, "label": label, "zorder": 3}
    axes.plot(1e3 * a["collision_time"], a["collision_force"], "o", **style)
    end = 1e3 * float(a["collision_time"][-1])
    if not end:  # an impact without duration: take the simulated contact
        end = 1e3 * float(a.get("simulated_contact_end", 0.0) - a.get("simulated_contact_start", 0.0))
        end = end if np.isfinite(end) else 0.0
    if record.simulated and np.isfinite(a["simulated_contact_start"]):
        time, value = contact_force(record, "simulated")
        time = 1e3 * (time - a["simulated_contact_start"])
        last = 1.08 * end
        keep = (time >= 0) & (time < last)
        label = f"simulated: {impulse_text(summary.get('simulated', {}))}"
        # before contact there is no force, however coarsely an older record has it
        shown = np.concatenate([[-0.05 * end, 0.0], time[keep], [last]])
        value = np.concatenate([[0.0, 0.0], value[keep], [np.interp(last, time, value)]])
        axes.plot(shown, value, color=SIMULATED, label=label)
    axes.set(xlabel="time since contact [ms]", ylabel="force on the target [N]")
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))  # below zero if the plan is no solution
    if isinstance(place, Axes):
        place.legend(title="impulse")
        return
    # below the axes: no corner is free of curves for every contact
    place.legend(title="impulse", loc="outside lower center", ncols=2)


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
            title=f"{'contact' if k == 1 else PHASES[k]}\nat most {ratio.max():.2f}",
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


JOINT_COLOURS = COLOURS[:-1]  # the last one is black, of the simulation


@picture(height=4.6)
def motion(figure: FigureBase, record: Record) -> None:
    """Angles and velocities of the joints that move most."""
    a = record.arrays
    names, time, angle = a["joints"], a["reference_time"], a["reference_angle"]
    until = float(a["reference_end"])
    chosen = np.argsort(-np.ptp(angle, axis=0))[: len(JOINT_COLOURS)]
    rate = a["reference_v"][:, -len(names) :] / a["velocity_limit"]
    top, bottom = figure.subplots(2, 1, sharex=True)
    for j, colour in zip(chosen, JOINT_COLOURS, strict=False):
        top.plot(time, angle[:, j], color=colour, label=joint_label(names[j]))
        bottom.plot(time, rate[:, j], color=colour)
        if record.simulated:
            top.plot(a["simulated_time"], a["simulated_angle"][:, j], ":", color=BLACK, linewidth=1.2)
    for axes in (top, bottom):
        axes.axvspan(a["reference_contact_start"], a["reference_contact_end"], color="#bbbbbb", zorder=0)
    label = "angle or travel [rad or m]" if record.slides else "angle [rad]"
    top.set(ylabel=label, title=title(record, "joints that move most"), xlim=(0.0, until))
    bottom.set(xlabel="time [s]", ylabel="planned velocity / limit")
    handles, labels = top.get_legend_handles_labels()
    if record.simulated:
        handles.append(Line2D([], [], color=BLACK, linestyle=":", linewidth=1.2))
        labels.append("simulated")
    handles.append(Line2D([], [], color="#bbbbbb", linewidth=6))
    labels.append("contact")
    top.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)


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
