"""Overview of a plan: poses, force, ZMP in contact, torque."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import FigureBase

from impactopt.files.output import Record
from impactopt.report.pictures.force import draw_force
from impactopt.report.pictures.strobe import draw_strobe, strobe_height
from impactopt.report.pictures.style import PAGE, Picture, styled, title
from impactopt.report.pictures.torque import draw_torque, torque_height
from impactopt.report.pictures.zmp import draw_zmp

MIDDLE = 2.6  # [in] of force and ZMP


@styled
def overview(record: Record) -> Picture:
    """Poses above, force and ZMP side by side (the force alone for a robot without soles), torque below."""
    figure = Picture(PAGE, sum(_heights(record)) + 0.2)
    draw_overview(figure, record)
    return figure


def _heights(record: Record) -> list[float]:
    return [strobe_height(record), MIDDLE, torque_height(record)]


def draw_overview(figure: FigureBase, record: Record) -> None:
    """Draws the picture into a figure, or a part of one."""
    parts: Any = figure.subfigures(3, 1, height_ratios=_heights(record))
    above, middle, below = parts
    draw_strobe(above, record)
    stands = len(record.arrays["polygon"]) > 0
    if stands:
        left, right = middle.subfigures(1, 2)
        draw_force(left, record)
        draw_zmp(right, record, phases=(1,))
    else:
        draw_force(middle, record)
    draw_torque(below, record)
    figure.suptitle(title(record, f"poses, contact force, {'zero-moment point, ' * stands}torque"))
