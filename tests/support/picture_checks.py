"""What a person would frown at in a picture, found by the extents of its texts and lines."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

from impactopt.report.pictures.style import styled

EDGE = 1.0  # [px] that a text may stand over the picture's edge: rounding
TOUCH = 1.0  # [px] by which extents may meet, as they have some air around their letters


@styled  # how many ticks there are depends on the style's font
def frowns(figure: Figure) -> list[str]:
    """What is cut by the picture's edge, which texts lie over each other, which legends over data."""
    # as saving does: a layout of axes of equal scales needs two passes
    equal = any(axes.get_aspect() != "auto" for axes in figure.axes)
    if equal and (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in _texts(figure)]
    whole = figure.bbox
    found = [
        f"cut: {text!r}"
        for text, box in boxes
        if box.x0 < -EDGE or box.y0 < -EDGE or box.x1 > whole.x1 + EDGE or box.y1 > whole.y1 + EDGE
    ]
    for (one, a), (other, b) in combinations(boxes, 2):
        wide = min(a.x1, b.x1) - max(a.x0, b.x0)
        high = min(a.y1, b.y1) - max(a.y0, b.y0)
        if wide > TOUCH and high > TOUCH:
            found.append(f"{one!r} lies over {other!r}")
    return found + [f"a legend of {name!r} lies over data" for name in _covered(figure, renderer)]


def _texts(figure: Figure) -> Iterator[Text]:
    """Those that are drawn: ticks outside the limits keep labels that are not."""
    hidden: set[Text] = set()
    for axes in figure.axes:
        if not axes.get_visible():
            hidden |= set(axes.findobj(Text))
        for axis in (axes.xaxis, axes.yaxis):
            drawn = axis._update_ticks()
            for tick in {*axis.majorTicks, *axis.minorTicks} - set(drawn):
                hidden |= {tick.label1, tick.label2}
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and text not in hidden:
            yield text


def _covered(figure: Figure, renderer: Any) -> Iterator[str]:
    """Titles of axes in which a line runs below a legend."""
    for legend in figure.findobj(Legend):
        box = legend.get_window_extent(renderer)
        for axes in figure.axes:
            for line in axes.lines:
                points = np.asarray(line.get_xydata(), dtype=float)
                if line.get_transform() != axes.transData or len(points) < 2:
                    continue
                fine = np.linspace(points[:-1], points[1:], 20).reshape(-1, 2)
                x, y = axes.transData.transform(fine[np.isfinite(fine).all(axis=1)]).T
                inside = (x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)
                shown = (x > axes.bbox.x0) & (x < axes.bbox.x1) & (y > axes.bbox.y0) & (y < axes.bbox.y1)
                if (inside & shown).any():
                    yield axes.get_title(loc="left") or axes.get_title()
                    break
