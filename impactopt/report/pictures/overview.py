"""Overview of a plan: poses, force, ZMP in contact, torque."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import FigureBase

from impactopt.files.record import Record
from impactopt.report.pictures.balance import draw_zmp
from impactopt.report.pictures.histories import draw_force, draw_torque, torque_height
from impactopt.report.pictures.poses import strobe, strobe_height
from impactopt.report.pictures.style import picture, title

MIDDLE = 2.6  # [in] of force and ZMP


def _heights(record: Record) -> list[float]:
    return [strobe_height(record), MIDDLE, torque_height(record)]


@picture(height=lambda record: sum(_heights(record)) + 0.2)
def overview(figure: FigureBase, record: Record) -> None:
    """Poses above, force and ZMP side by side (the force alone for a robot without soles), torque below."""
    parts: Any = figure.subfigures(3, 1, height_ratios=_heights(record))
    above, middle, below = parts
    strobe.draw(above, record)
    stands = len(record.arrays["polygon"]) > 0
    if stands:
        left, right = middle.subfigures(1, 2)
        draw_force(left, record)
        draw_zmp(right, record, phases=(1,))
    else:
        draw_force(middle, record)
    draw_torque(below, record)
    figure.suptitle(title(record, f"poses, contact force, {'zero-moment point, ' * stands}torque"))
