"""Angles and velocities of the joints that move most."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D

from impactopt.files.record import Record
from impactopt.report.pictures.style import BLACK, COLOURS, joint_label, picture, title

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
