"""The contact force, planned and simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from impactopt.files.record import Record
from impactopt.report.histories import contact_force
from impactopt.report.pictures.style import COLUMN, PLANNED, SIMULATED, impulse_text, picture, title


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
