"""Pictures of a record: force, ZMP, torque, poses, joint motion, effective mass, iterations, replayed soles.

One picture a file, all in the style of `style.py`. `hierarchy.py`, `compare.py` and `sweep.py` draw several
collisions, records or cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from impactopt.errors import InputError, check_choice
from impactopt.files.output import Record, record_of, write_file
from impactopt.planning.solution import Solution
from impactopt.report.pictures.ellipsoid import draw_ellipsoid, ellipsoid
from impactopt.report.pictures.force import draw_force, force
from impactopt.report.pictures.hierarchy import hierarchy
from impactopt.report.pictures.iterations import draw_iterations, iterations
from impactopt.report.pictures.motion import draw_motion, motion
from impactopt.report.pictures.overview import draw_overview, overview
from impactopt.report.pictures.replay import draw_replay
from impactopt.report.pictures.replay import replay as _replay
from impactopt.report.pictures.strobe import draw_strobe, strobe
from impactopt.report.pictures.style import Picture, styled
from impactopt.report.pictures.torque import draw_torque_and_gears, torque
from impactopt.report.pictures.zmp import draw_zmp, zero_moment_point

__all__ = [
    "PICTURES",
    "Picture",
    "ellipsoid",
    "force",
    "hierarchy",
    "iterations",
    "motion",
    "overview",
    "plot",
    "save_pictures",
    "strobe",
    "torque",
    "zero_moment_point",
]

# functions that draw a picture, by its file name without .png; they return None if there is nothing to draw
PICTURES: Mapping[str, Callable[[Record], Picture | None]] = {
    "force": force,
    "zmp": zero_moment_point,
    "torque": torque,
    "strobe": strobe,
    "motion": motion,
    "ellipsoid": ellipsoid,
    "iterations": iterations,
    "replay": _replay,
}
# functions that draw the same into a figure or a part of one
DRAWN: Mapping[str, Callable[[Any, Record], None]] = {
    "overview": draw_overview,
    "force": draw_force,
    "zmp": draw_zmp,
    "torque": draw_torque_and_gears,
    "strobe": draw_strobe,
    "motion": draw_motion,
    "ellipsoid": draw_ellipsoid,
    "iterations": draw_iterations,
    "replay": draw_replay,
}
# reasons why a picture may be None
_WHY = {
    "zmp": "the robot stands on no soles",
    "iterations": "the solver kept no history",
    "replay": "it needs replay=solution.validate(engine='mujoco') of a robot on soles",
}


def plot(
    solution: Solution,
    what: str = "overview",
    *,
    ax: Axes | None = None,
    simulation: Any | None = None,
    replay: Any | None = None,
) -> Picture | Axes | list[Axes]:
    """Picture of a solution, which a notebook shows, and ``savefig`` writes: ``Solution.plot``.

    what : "overview" (poses, force, ZMP, torque), or one of PICTURES.
    ax : matplotlib axes of your own figure to draw in; several panels replace them. Then the axes are
        returned, or the list of them.
    simulation : of ``solution.validate()``, drawn with the plan.
    replay : of ``solution.validate(engine="mujoco")``, for the picture "replay".

    Raises
    ------
    InputError : an unknown picture; one that the solution does not have, such as the ZMP of an arm; a plan
        whose motion cannot be completed; axes that are no part of a grid, for several panels.
    """
    draws = {"overview": overview, **PICTURES}
    check_choice("there is no picture", what, draws)
    record = record_of(solution, simulation=simulation, replay=replay)
    if not record.completed:
        raise InputError(f"there is no motion to draw: {record.summary['note']}")
    picture = draws[what](record)
    if picture is None:
        raise InputError(f"of this solution there is nothing to draw as {what!r}: {_WHY[what]}")
    return picture if ax is None else _drawn_in(ax, what, record)


@styled
def _drawn_in(ax: Axes, what: str, record: Record) -> Axes | list[Axes]:
    """Draws a picture in the place of axes; returns its axes."""
    if what == "force":
        draw_force(ax, record)
        return ax
    grid, figure = ax.get_subplotspec(), ax.figure
    if grid is None:
        raise InputError(f"ax is no part of a grid, which {what!r} needs: make it with plt.subplots()")
    ax.remove()
    part = figure.add_subfigure(grid)
    DRAWN[what](part, record)
    panels = _panels(part)
    return panels[0] if len(panels) == 1 else panels


def _panels(part: FigureBase) -> list[Axes]:
    """Axes of a part of a figure, and of the parts in it."""
    whole: Any = part  # matplotlib's types lack subfigs
    return [*whole.axes, *(axes for inner in whole.subfigs for axes in _panels(inner))]


def save_pictures(record: Record, directory: Path, names: Iterable[str] = tuple(PICTURES)) -> list[Path]:
    """Writes a record's pictures as PNG into a directory; deletes outdated ones of an earlier record.

    names : of PICTURES; default: all.

    Raises
    ------
    InputError : a file cannot be written.
    """
    written = []
    for name in names:
        path = directory / f"{name}.png"
        picture = PICTURES[name](record) if record.completed else None
        if picture is None:
            path.unlink(missing_ok=True)
            continue
        write_file(path, picture.write)
        written.append(path)
    return written
