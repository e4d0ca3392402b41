"""Balance of a motion: path of the zero-moment point in the support polygon, and the soles in a replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impactopt.arrays import Array, Index
from impactopt.files.record import Record
from impactopt.kinematics.stance import zmp
from impactopt.report.histories import footprints
from impactopt.report.pictures.style import (
    BLACK,
    GREEN,
    ORANGE,
    OVER,
    PHASES,
    RIGHT,
    picture,
    simulated_parts,
)
from impactopt.robots.loads import MIN_LOAD_FRACTION


@picture(
    height=3.1,
    title="zero-moment point, from above",
    exists=lambda record: len(record.arrays["polygon"]) > 0,
    lacking="the robot stands on no soles",
)
def zero_moment_point(figure: FigureBase, record: Record) -> None:
    """Path of the ZMP in the support polygon, seen from above."""
    draw_zmp(figure, record)


def draw_zmp(figure: FigureBase, record: Record, phases: Sequence[int] = (0, 1, 2)) -> None:
    """Draws the picture into a figure, or a part of one, with a panel for each of the phases."""
    a = record.arrays
    paths = _zmp_paths(record)
    panels: Any = figure.subplots(1, len(phases), sharex=True, sharey=True, squeeze=False)[0]
    for axes, k in zip(panels, phases, strict=True):
        draw_soles(axes, record)
        closed = np.vstack([a["polygon"], a["polygon"][:1]])
        axes.plot(-closed[:, 1], closed[:, 0], "--", color=BLACK, linewidth=1.0)
        norm = None
        for kind in ("simulated", "planned"):
            if (kind, k) not in paths:
                continue
            time, points = paths[kind, k]
            norm = norm or Normalize(*_span(time, k))
            if kind == "simulated":
                _coloured_line(axes, time, points, norm)
            else:
                marks = _stations(time, 25) if k != 1 else np.arange(len(time))
                axes.scatter(
                    -points[marks, 1],
                    points[marks, 0],
                    c=time[marks],
                    norm=norm,
                    s=13,
                    edgecolors=BLACK,
                    linewidths=0.5,
                    zorder=4,
                )
        if norm is not None:
            place: Any = {"location": "bottom", "aspect": 25} if len(phases) > 1 else {"shrink": 0.8}
            bar = figure.colorbar(matplotlib.cm.ScalarMappable(norm), ax=axes, **place)
            bar.set_label("time since contact [ms]" if k == 1 else "time [s]")
        margin = _margin(record, k)
        text = "" if margin is None else f": margin {1e3 * margin:.0f} mm"
        what = PHASES[k] if len(phases) > 1 else f"ZMP, {PHASES[k]}"
        axes.set_title(what + text, color=BLACK if margin is None or margin >= 0 else OVER)
    panels[0].set_ylabel("x, forward [m]")
    figure.legend(handles=_zmp_key(record), loc="outside lower center", ncols=4 if len(phases) > 1 else 2)


def _zmp_paths(record: Record) -> dict[tuple[str, int], tuple[Array, Array]]:
    """Times ([s]; [ms] since contact in the collision) and points (k, 2) by kind and phase."""
    a, out = record.arrays, {}
    for k in (0, 2):
        keep = (a["reference_phase"] == k) & (a["reference_time"] <= a["reference_end"])
        out["planned", k] = a["reference_time"][keep], zmp(a["reference_ground"][keep])
    if len(a["collision_ground"]):  # no path of an impact without duration
        out["planned", 1] = 1e3 * a["collision_time"][1:], zmp(a["collision_ground"])
    if record.simulated:
        for k, (time, wrench) in enumerate(simulated_parts(record, a["simulated_sole_ground"].sum(axis=1))):
            if len(time):
                out["simulated", k] = time, zmp(wrench)
    return out


def _zmp_key(record: Record) -> list[Line2D | Patch]:
    grey = matplotlib.colormaps["cividis"](0.5)
    polygon = "support polygon at contact" if record.summary.get("stances") else "support polygon"
    key: list[Line2D | Patch] = [
        Line2D([], [], linestyle="", marker="o", color=grey, markeredgecolor=BLACK, label="planned"),
        Line2D([], [], linestyle="--", color=BLACK, linewidth=1.0, label=polygon),
        Patch(facecolor="#eeeeee", edgecolor="#999999", label="sole"),
    ]
    if record.simulated:
        key.insert(1, Line2D([], [], color=grey, linewidth=1.8, label="simulated"))
    return key


def _span(time: Array, phase: int) -> tuple[float, float]:
    return (0.0, float(time[-1])) if phase == 1 else (float(time[0]), float(time[-1]))


def _stations(time: Array, count: int) -> Index:
    """Indices of about evenly spaced instants."""
    return np.searchsorted(time, np.linspace(time[0], time[-1], count)).clip(0, len(time) - 1)


def draw_soles(axes: Any, record: Record, *, toes: bool = False) -> None:
    """Draws soles from above, forward up; their names are at their heels, or above their toes."""
    for name, corners in footprints(record).items():
        axes.fill(-corners[:, 1], corners[:, 0], facecolor="#eeeeee", edgecolor="#999999", linewidth=1.0)
        axes.annotate(
            name.removeprefix("sole_").partition(",")[0].replace("_", " "),
            (-corners[:, 1].mean(), corners[:, 0].max() if toes else corners[:, 0].min()),
            (0, 2 if toes else 3),
            textcoords="offset points",
            ha="center",
            va="baseline" if toes else "bottom",
            color="#666666",
            fontsize=6.5,
        )
    axes.set_aspect("equal")
    axes.set_xlabel(RIGHT)
    axes.grid(False)


def _coloured_line(axes: Any, time: Array, points: Array, norm: Normalize) -> None:
    path = np.column_stack([-points[:, 1], points[:, 0]])
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    lines = LineCollection(list(pieces), cmap="cividis", norm=norm, linewidth=1.8, zorder=3)
    lines.set_array(time[:-1])
    axes.add_collection(lines, autolim=True)
    axes.autoscale_view()


def _margin(record: Record, phase: int) -> float | None:
    """ZMP margin [m] of a phase, of the simulation if there is one."""
    source = record.summary.get("simulated", record.summary)
    value: float | None = source.get("zmp_margin_m", {}).get(("swing", "collision", "follow")[phase])
    return value


PHASE_COLOURS = (ORANGE, BLACK, GREEN)


@picture(
    height=4.2,
    title=lambda record: f"soles in the replay ({_stands(record)})",
    exists=lambda record: record.replayed and len(record.arrays["replayed_soles"]) > 0,
    lacking="it needs replay=solution.validate(engine='mujoco') of a robot on soles",
)
def replay(figure: FigureBase, record: Record) -> None:
    """Centres of pressure on the soles, normal forces, slip and lift."""
    a = record.arrays
    places: Any = figure.subplot_mosaic([["cop", "force"], ["cop", "move"]], width_ratios=[2, 3])
    _centres(figure, places["cop"], record)
    time, start = a["replayed_time"], float(a["replayed_contact_start"])
    names = [str(name).replace("_", " ") for name in a["replayed_soles"]]
    for k, name in enumerate(names):
        colour = f"C{k}"
        places["force"].plot(
            time, a["replayed_sole_ground"][:, k, 2], color=colour, label=name, linewidth=1.1
        )
        places["move"].plot(time, 1e3 * a["replayed_slip"][:, k], color=colour, label=f"{name}, slip")
        places["move"].plot(time, 1e3 * a["replayed_lift"][:, k], ":", color=colour, label=f"{name}, lift")
    for which in ("force", "move"):
        if np.isfinite(start):
            end = float(a["replayed_contact_end"])
            places[which].axvspan(start, end if np.isfinite(end) else time[-1], color="#bbbbbb", zorder=0)
        places[which].set(xlim=(0.0, time[-1]))
        places[which].set_ylim(bottom=0.0)
        places[which].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)
    places["force"].tick_params(labelbottom=False)
    places["force"].set(ylabel="normal force [N]", title="force on each sole; grey: contact")
    places["move"].set(xlabel="time [s]", ylabel="slip, lift [mm]", title="the corner that moved most")


def _stands(record: Record) -> str:
    """Text about the robot at the end."""
    report = record.summary.get("replayed", {})
    stands, reason = report.get("standing"), report.get("reason", "")
    return "stands at the end" if stands else str(reason).split(":")[0] if stands is None else str(reason)


def _centres(figure: FigureBase, axes: Any, record: Record) -> None:
    """Draws the paths of the centres of pressure by phase, from above; forward is up."""
    a = record.arrays
    time, start, end = a["replayed_time"], a["replayed_contact_start"], a["replayed_contact_end"]
    phase = (time >= start).astype(int) + (time >= end).astype(int)  # nan compares false
    draw_soles(axes, record, toes=True)
    normal = a["replayed_sole_ground"][:, :, 2]
    for k in range(normal.shape[1]):
        # the median is the weight, because most of the motion is slow
        loaded = normal[:, k] >= MIN_LOAD_FRACTION * np.median(normal.sum(axis=1))
        for which, colour in enumerate(PHASE_COLOURS):
            keep = loaded & (phase == which)
            points: Array = zmp(a["replayed_sole_ground"][keep, k])
            axes.plot(-points[:, 1], points[:, 0], ".", color=colour, markersize=2.5, zorder=3 + (which == 1))
    axes.set(ylabel="x, forward [m]", title="centre of pressure\n")
    key = [
        Line2D([], [], linestyle="", marker="o", color=colour, label=name)
        for name, colour in zip(PHASES, PHASE_COLOURS, strict=True)
    ]
    figure.legend(handles=key, loc="outside lower left", ncols=3)
