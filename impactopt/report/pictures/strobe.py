"""Motion in a few poses side by side, as under a strobe light."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.spatial import ConvexHull

from impactopt.files.record import Record
from impactopt.report.pictures.style import BLACK, BLUE, PAGE, VERMILION, Array, picture

GAP = 0.12  # [m] between poses
GREY = "#999999"
WORLD = {"target": ("#dddddd", "target when contact begins"), "obstacles": ("#f2f2f2", "obstacle")}


def strobe_height(record: Record) -> float:
    """Height [in] of the picture at the width of a page."""
    low, high, width = _extent(record)
    scale = (PAGE - 0.6) / (len(record.arrays["pose_time"]) * (width + GAP))  # [in/m]
    return min(float((high - low) * scale) + 0.75, PAGE)


@picture(
    height=lambda record: strobe_height(record) + 0.2, title=lambda record: f"seen from {_view(record)[1]}"
)
def strobe(figure: FigureBase, record: Record) -> None:
    """Robot as sticks at a few instants, and path of its striking point."""
    a = record.arrays
    view, _ = _view(record)
    low, high, width = _extent(record)
    axes = figure.subplots()
    links, path, time = a["pose_links"] @ view.T, a["pose_path"] @ view.T, a["pose_time"]
    across = _middle(record)
    places = (width + GAP) * np.arange(len(time))
    for k, (place, instant) in enumerate(zip(places, time, strict=True)):
        shift = np.array([place - across, 0.0])
        for kind, (face, _) in WORLD.items():
            for corners in _outlines(record, kind):
                axes.fill(*(corners + shift).T, facecolor=face, edgecolor=GREY, linewidth=0.6, zorder=1)
        gone = path[a["reference_time"] <= instant] + shift
        axes.plot(*gone.T, color=VERMILION, linewidth=0.8, zorder=2)
        for ends, strikes in zip(links[k], a["pose_strikes"], strict=True):
            style: Any = {"color": BLUE, "zorder": 4} if strikes else {"color": BLACK, "zorder": 3}
            axes.plot(*(ends + shift).T, linewidth=1.8, solid_capstyle="round", **style)
        axes.plot(*(links[k][0][1] + shift), "o", color=BLUE, markersize=3, zorder=5)
    for height in _ground(record):
        axes.axhline(height, color=GREY, linewidth=0.8, zorder=0)
    axes.set_aspect("equal")
    axes.set(xlim=(-0.5 * (width + GAP), places[-1] + 0.5 * (width + GAP)), ylim=(low, high))
    body = float(np.median(links[0][..., 0])) - across  # times stand below it
    axes.set_xticks(places + body, [f"{t:.2f}" for t in time])
    contact = int(a["pose_contact"])
    axes.get_xticklabels()[contact].set_fontweight("bold")
    axes.tick_params(axis="x", length=0)
    axes.spines["bottom"].set_visible(False)
    axes.grid(False)
    axes.set(xlabel="time [s]; bold: contact begins", ylabel="z [m]")
    figure.legend(handles=_key(record), loc="outside lower center", ncols=5)


def _key(record: Record) -> list[Line2D | Patch]:
    others = (
        []
        if record.arrays["pose_strikes"].all()
        else [Line2D([], [], color=BLACK, linewidth=1.8, label="the others")]
    )
    return [
        Line2D([], [], color=BLUE, linewidth=1.8, label="limb that strikes"),
        *others,
        Line2D([], [], color=VERMILION, linewidth=0.8, label="path of the striking point"),
        *[
            Patch(facecolor=face, edgecolor=GREY, label=label)
            for kind, (face, label) in WORLD.items()
            if _outlines(record, kind)
        ],
    ]


def _view(record: Record) -> tuple[Array, str]:
    """Projection (2, 3) of the world onto the picture, and the side from which it is seen.

    The side is chosen so that no strike goes to the left.
    """
    n = record.arrays["pose_normal"]
    if abs(n[1]) > abs(n[0]):
        sign = -1.0 if n[1] < 0 else 1.0
        return np.array([[0, sign, 0], [0, 0, 1.0]]), "the front" if sign > 0 else "behind"
    sign = -1.0 if n[0] < -1e-9 else 1.0
    return np.array([[sign, 0, 0], [0, 0, 1.0]]), "its right" if sign > 0 else "its left"


def _middle(record: Record) -> float:
    """Centre [m] of a pose's drawing across the picture."""
    points = _drawn(record)[:, 0]
    return float(points.max() + points.min()) / 2


def _extent(record: Record) -> tuple[float, float, float]:
    """Lowest and highest point, and width, of a pose's drawing [m]."""
    points = _drawn(record)
    (low, high), width = (points[:, 1].min(), points[:, 1].max()), np.ptp(points[:, 0])
    return min([float(low), *_ground(record)]) - 0.05, float(high) + 0.05, float(width)


def _ground(record: Record) -> Array:
    """Height (1,) [m] of the ground, (0,) without one; old results have none, and take 0."""
    return record.arrays.get("pose_ground", np.zeros(1))


def _drawn(record: Record) -> Array:
    """Points (k, 2) [m] of a drawing: links, path of the striking point, corners of the world's bodies."""
    a = record.arrays
    view, _ = _view(record)
    parts = [a["pose_links"].reshape(-1, 3), a["pose_path"]]
    outlines = [corners for kind in WORLD for corners in _outlines(record, kind)]
    return np.concatenate([np.concatenate(parts) @ view.T, *outlines])


def _outlines(record: Record, kind: str) -> list[Array]:
    """Outline (k, 2) [m] of each body of a kind; none in old results."""
    view, _ = _view(record)
    flat = [corners @ view.T for corners in record.arrays.get(f"pose_{kind}", ())]
    return [corners[ConvexHull(corners).vertices] for corners in flat]
