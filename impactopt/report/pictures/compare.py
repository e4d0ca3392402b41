"""Predictions of several plans in one picture: force, ZMP margin, torque; one colour each."""

from __future__ import annotations

from collections.abc import Mapping

from impactopt.errors import InputError
from impactopt.files.record import Record
from impactopt.report.comparison import histories_of
from impactopt.report.pictures.style import PAGE, Picture, impulse_text, styled

AROUND = 0.25  # time shown before and after contact, over its duration
# name of each history, its label, its limit, and whether it is shown near contact only
PANELS = (
    ("force", "force on the target [N]", None, True),
    ("margin", "ZMP margin [mm]", 0.0, False),
    ("ratio", "largest torque / limit", 1.0, False),
)


@styled
def comparison_picture(records: Mapping[str, Record]) -> Picture:
    """Planned histories of results, by name, over the time since contact.

    Raises
    ------
    InputError : none of them has a motion.
    """
    known = {name: histories_of(record) for name, record in records.items()}
    panels = [panel for panel in PANELS if any(panel[0] in histories for histories in known.values())]
    if not panels:
        raise InputError("none of these results has a motion to draw")
    figure = Picture(PAGE, 2.9)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    longest = max(float(record.summary.get("contact_ms") or 0.0) for record in records.values())
    for ax, (which, label, limit, near) in zip(axes, panels, strict=True):
        for k, (name, histories) in enumerate(known.items()):
            if which in histories:
                time, values = histories[which]
                style = {
                    "color": f"C{k}",
                    "linewidth": 1.3,
                    "label": f"{name}: {impulse_text(records[name].summary)}",
                }
                ax.plot(1e3 * time if near else time, values, **style)
        if limit is not None:
            ax.axhline(limit, color="#666666", linewidth=0.8, linestyle="--")
        if near:
            ax.set_xlim(-AROUND * longest, (1 + AROUND) * longest)
        ax.set(xlabel=f"time since contact [{'ms' if near else 's'}]", title=label)
        if limit != 0.0:
            ax.set_ylim(bottom=min(0.0, ax.dataLim.y0))
    # every result has torques, the last panel
    handles, labels = axes[-1].get_legend_handles_labels()
    figure.legend(
        handles, labels, title="planned impulse", loc="outside lower center", ncols=min(3, len(labels))
    )
    return figure
