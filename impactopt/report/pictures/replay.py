"""Contact of the soles in a replay: centre of pressure, normal force, slip and lift."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D

from impactopt.files.record import Record
from impactopt.kinematics.stance import zmp
from impactopt.report.pictures.style import BLACK, GREEN, ORANGE, PHASES, Array, picture
from impactopt.report.pictures.zmp import draw_soles
from impactopt.robots.loads import MIN_LOAD_FRACTION

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
