"""Contact sheet of a motion: the robot's meshes from three sides, at seven instants."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impactopt.arrays import Array
from impactopt.bodies.solids import Solid, simplified
from impactopt.bodies.visuals import LARGE, Part, surroundings_of
from impactopt.files.record import Record
from impactopt.problem.problem import ImpactProblem
from impactopt.report.pictures.style import BLUE, ORANGE, VERMILION, Picture, styled, title
from impactopt.report.stage import bodies_drawn
from impactopt.report.tracks import Track, tracks_of
from impactopt.robots.build import joints_to

CELL = 0.015  # [m] of the simplified meshes: a limb is 40 pixels wide
WIDTH = 11.0  # [in]
MAX_TRAVEL = 0.6  # [m] beyond which a target is not shown
LIGHT = np.array([0.45, -0.35, 0.82])
# of each view: name, and directions (3, 3) to the right, up, and to the viewer
VIEWS = (
    ("front", np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])),
    ("right side", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
    ("top", np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])),
)
PARTS = {"target": ORANGE, "held": "#b0b0b0", "obstacle": "#cccccc"}
Shown = tuple[Array, Array, Array]  # triangles (n, 3, 3) [m], their normals and colours (n, 3)
Drawn = tuple[int, Array, Array, Array]  # joint, triangles (k, 3, 3) [m] in its frame, normals, colour


@styled
def sheet(record: Record, problem: ImpactProblem) -> Picture:
    """The planned motion from the front, the right side and the top, at seven instants.

    The striking limb is blue. The target, its support and obstacles are drawn to scale.
    """
    track = tracks_of(record, problem)[0]
    chosen = _chosen(track)
    points = np.array([problem.point, *([] if problem.second is None else [problem.second.point])])
    solids, world = _solids(problem), [p for p in surroundings_of(problem.world) if not _hides(p)]
    robots = [_joined([_placed(track, k, solid) for solid in solids]) for k in chosen]
    around = [_around(track, k, world, problem.normal) for k in chosen]
    # a stray vertex of a mesh may lie anywhere
    within = [np.percentile(robot[0].reshape(-1, 3), [0.05, 99.95], axis=0) for robot in robots]
    edges = np.concatenate([*within, *(shown[0].reshape(-1, 3) for each in around for _, shown in each)])
    ends = np.array([edges.min(axis=0) - 0.04, edges.max(axis=0) + 0.04])
    ends[0, 2] = min(ends[0, 2], problem.ground_height or 0.0) - 0.02
    sizes = [[np.ptp(ends @ np.abs(direction)) for direction in view[:2]] for _, view in VIEWS]
    heights = [high for _, high in sizes]
    scale = (WIDTH - 0.4) / (len(chosen) * max(wide for wide, _ in sizes))  # [in/m]
    figure = Picture(WIDTH, scale * sum(heights) + 1.3)
    axes = figure.subplots(len(VIEWS), len(chosen), squeeze=False, gridspec_kw={"height_ratios": heights})
    for column, k in enumerate(chosen):
        for row, (name, view) in enumerate(VIEWS):
            ax = axes[row, column]
            beside = [shown for part, shown in around[column] if not _covers(part, problem.normal, view)]
            _draw(ax, *_joined([robots[column], *beside]), view)
            ax.plot(*(points @ view[:2].T).T, "o", color=VERMILION, markersize=2, zorder=5)
            (left, right), (low, high) = (np.sort(ends @ direction) for direction in view[:2])
            ax.set(xlim=(left, right), ylim=(low, high), aspect="equal")
            ax.axis("off")
            if row < 2 and problem.ground_height is not None:
                ax.axhline(problem.ground_height, color="#999999", linewidth=0.6, zorder=0)
            if column == 0:
                left_of = {"ha": "right", "va": "center", "rotation": 90}
                ax.text(-0.01, 0.5, name, transform=ax.transAxes, fontsize=7, **left_of)
        contact = abs(track.time[k] - track.contact_start) < 1e-6
        axes[0, column].set_title(f"{'contact, ' if contact else ''}{track.time[k]:.2f} s")
    figure.suptitle(title(record, "planned motion"))
    leaves = np.abs(track.travel[chosen]).max() >= MAX_TRAVEL
    until = f", until it has moved by {MAX_TRAVEL:g} m" if leaves else ""
    figure.legend(
        handles=[
            Patch(color=BLUE, label="limb that strikes"),
            Line2D([], [], color=VERMILION, marker="o", markersize=3, linestyle="", label="hit point"),
            Patch(color=ORANGE, label=f"target{until}"),
        ],
        loc="outside lower center",
        ncols=3,
    )
    return figure


def _hides(part: Part) -> bool:
    """True if a body would hide the robot, as a wall does."""
    return part.clear and part.kind != "obstacle"


def _covers(part: Part, normal: Array, view: Array) -> bool:
    """True if a target would cover the robot in a view, as a door ahead does from the front."""
    if part.kind != "target" or normal @ view[2] < 0.5:  # else the viewer is behind the target
        return False
    return float(np.ptp(part.solid.vertices @ view[:2].T, axis=0).min()) > LARGE


def _around(track: Track, k: int, world: list[Part], normal: Array) -> list[tuple[Part, Shown]]:
    """The parts of the world at an instant of a track."""
    shown = []
    for part in world:
        corners = part.placed(float(track.travel[k]), normal, track.aside[k])[part.solid.triangles]
        if abs(track.travel[k]) < MAX_TRAVEL or not part.moves:
            colours = np.tile(to_rgb(PARTS[part.kind]), (len(corners), 1))
            shown.append((part, (corners, _normals(corners), colours)))
    return shown


def _joined(shown: list[Shown]) -> Shown:
    triangles, normals, colours = (np.concatenate(parts) for parts in zip(*shown, strict=True))
    return triangles, normals, colours


def _chosen(track: Track) -> list[int]:
    """Indices of seven instants: three before contact beside the start, contact, its end, and two after."""
    start, end = track.contact_start, track.contact_end
    last = float(track.time[-1])
    wanted = [*np.linspace(0.0, start, 5), end + 0.25 * (last - end), last]
    return [int(np.argmin(np.abs(track.time - t))) for t in wanted]


def _solids(problem: ImpactProblem) -> list[Drawn]:
    """Solids of the robot: triangles of each joint, with their normals and colours."""
    robot = problem.robot
    striking = joints_to(robot.model, [robot.striker(name).model_frame for name in problem.strikers])
    standing = joints_to(robot.model, [sole.frame for sole in problem.stance.soles(robot)])
    out = []
    for body in bodies_drawn(robot):
        solid = simplified(body.solid, CELL) if len(body.solid.triangles) > 500 else body.solid
        corners = _corners(solid)
        own = to_rgb(BLUE) if body.joint in striking - standing else body.colour[:3]
        out.append((body.joint, corners, _normals(corners), np.tile(own, (len(corners), 1))))
    return out


def _corners(solid: Solid) -> Array:
    return np.asarray(solid.vertices[solid.triangles])


def _normals(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def _placed(track: Track, k: int, drawn: Drawn) -> Shown:
    joint, corners, normals, colours = drawn
    place = pin.XYZQUATToSE3(track.places[k, joint])
    return corners @ place.rotation.T + place.translation, normals @ place.rotation.T, colours


def _draw(ax: object, triangles: Array, normals: Array, colours: Array, view: Array) -> None:
    """Triangles that face the viewer, the farthest first."""
    facing = normals @ view[2] > 0
    flat, depth = triangles[facing] @ view[:2].T, (triangles[facing] @ view[2]).mean(axis=1)
    light = 0.45 + 0.55 * np.clip(normals[facing] @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
    order = np.argsort(depth)
    shaded = (colours[facing] * light[:, None])[order]
    ax.add_collection(  # type: ignore[attr-defined]
        PolyCollection(flat[order], facecolors=shaded, edgecolors=shaded, linewidths=0.4, rasterized=True)
    )
