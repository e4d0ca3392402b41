"""Robot in its poses: motion as under a strobe light, and effective mass of the fist at contact."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, MultipleLocator
from scipy.spatial import ConvexHull

from impactopt.arrays import Array
from impactopt.files.record import Record
from impactopt.report.pictures.style import BLACK, BLUE, GREEN, PAGE, RIGHT, SKY, VERMILION, picture, title

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


# of each view: axes across and up, their labels, and its name
VIEWS = (
    (np.array([[1.0, 0, 0], [0, 0, 1.0]]), "x [m]", "z [m]", "from its right"),
    (np.array([[0, -1.0, 0], [1.0, 0, 0]]), RIGHT, "x [m]", "from above"),
)
REACH = 0.35  # [m] of the largest effective mass in the picture
MAX_RATIO = 4.0  # of the drawn masses to that along the normal; beyond, the curve is open
ANGLES = 181
FAINT = "#bbbbbb"


@picture(height=2.8)
def ellipsoid(figure: FigureBase, record: Record) -> None:
    """Robot at contact with its fist's effective mass, from two sides, and as a plot over the direction.

    The curve's distance from the fist is the effective mass along that direction, 1 / (n' J P J' n), with
    soles fixed and joints free. (An ellipsoid proper has its square root for a radius; a mass is easier to
    read.) The curve is open where the mass exceeds the scale, as across an arm that moves in a plane.
    """
    a = record.arrays
    inverse, normal = a["pose_inverse_mass"], a["pose_normal"]
    mass = float(effective_masses(inverse, normal[None])[0])
    largest = min(
        float(np.concatenate([_curve(inverse, view) for view, *_ in VIEWS]).max()), MAX_RATIO * mass
    )
    views = [v for v in VIEWS if np.isfinite(_within(_curve(inverse, v[0]), largest)).any()]
    panels: Any = figure.subplots(1, len(views) + 1, width_ratios=[1.0] * len(views) + [1.2])
    for axes, (view, across, up, place) in zip(panels, views, strict=False):
        _robot(axes, record, view, largest)
        axes.set(xlabel=across, ylabel=up, title=place)
    _over_angle(panels[-1], inverse, normal, largest)
    panels[-1].plot(0.0, mass, "o", color=VERMILION, markersize=4, zorder=4)
    figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    scale = f"drawn at {largest / REACH:.2g} kg/m"
    figure.suptitle(title(record, f"effective mass {mass:.1f} kg along the normal, {scale}"))


def _over_angle(axes: Any, inverse: Array, normal: Array, largest: float) -> None:
    """Effective mass over the direction, turned up and down, and from side to side."""
    side = np.cross([0.0, 0.0, 1.0], normal)
    side = side / np.linalg.norm(side) if np.linalg.norm(side) > 1e-3 else np.array([0.0, 1.0, 0.0])
    up = np.cross(normal, side)
    turn = np.linspace(-np.pi / 2, np.pi / 2, ANGLES)
    for towards, name, style in ((up, "turned up", "-"), (side, "turned to the left", "--")):
        directions = np.outer(np.cos(turn), normal) + np.outer(np.sin(turn), towards)
        masses = _within(effective_masses(inverse, directions), largest)
        if np.isfinite(masses).sum() > 1:
            axes.plot(np.degrees(turn), masses, style, color=BLUE if style == "-" else GREEN, label=name)
    axes.set(xlabel="angle to the normal [deg]", ylabel="effective mass [kg]", ylim=(0.0, 1.05 * largest))
    axes.set_xticks([-90, -45, 0, 45, 90])


def effective_masses(inverse: Array, directions: Array) -> Array:
    """1 / (n' L n) [kg] of unit directions (k, 3); inverse L (3, 3) [1/kg]; infinite where nothing moves."""
    moved = np.einsum("ki,ij,kj->k", directions, inverse, directions)
    return np.asarray(1.0 / np.maximum(moved, 1e-12))


def _curve(inverse: Array, view: Array) -> Array:
    return effective_masses(inverse, _circle(view))


def _within(masses: Array, largest: float) -> Array:
    """Masses, with nan (a gap) beyond the scale."""
    return np.where(masses <= 1.001 * largest, masses, np.nan)


def _circle(view: Array) -> Array:
    """Unit directions (k, 3) of the world around a view's plane."""
    turn = np.linspace(0.0, 2 * np.pi, ANGLES)
    return np.column_stack([np.cos(turn), np.sin(turn)]) @ view


def _robot(axes: Any, record: Record, view: Array, largest: float) -> None:
    """Draws the robot at contact, the curve about the fist, and an arrow along the normal of its mass."""
    a = record.arrays
    inverse, normal = a["pose_inverse_mass"], a["pose_normal"]
    links = a["pose_links"][int(a["pose_contact"])] @ view.T
    for ends, strikes in zip(links, a["pose_strikes"], strict=True):
        axes.plot(*ends.T, color=BLACK if strikes else FAINT, linewidth=1.6, solid_capstyle="round", zorder=2)
    fist = links[0][1]
    around = _circle(view)
    scale = REACH / largest
    masses = _within(effective_masses(inverse, around), largest)
    curve = fist + scale * masses[:, None] * (around @ view.T)
    if np.isfinite(curve).all():
        axes.fill(*curve.T, facecolor=SKY, alpha=0.2, zorder=1)
    axes.plot(*curve.T, color=SKY, zorder=3)
    tip = fist + scale * effective_masses(inverse, normal[None])[0] * (view @ normal)
    if np.linalg.norm(tip - fist) > 1e-3:
        arrow = {"arrowstyle": "-|>", "color": VERMILION, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, fist, arrowprops=arrow, zorder=4)
    axes.margins(0.08)
    axes.set_aspect("equal")
    # the same spacing on both axes: in a narrow view, ticks with a spacing of its own would overlap
    largest_span = max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    spacing = np.diff(MaxNLocator(4).tick_values(0.0, largest_span))[0]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(spacing))
