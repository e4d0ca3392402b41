"""Pictures of a record: force, ZMP, torque, poses, joint motion, effective mass, iterations, replayed soles.

`histories`, `balance` and `poses` draw one record, all in the style of `style`. `hierarchy`, `compare` and
`sweep` draw several collisions, records or cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from impactopt.errors import InputError, check_choice, check_kind
from impactopt.files.output import record_of, remove_file, write_file
from impactopt.files.record import Record
from impactopt.planning.solution import Solution
from impactopt.report.pictures.balance import replay as _replay
from impactopt.report.pictures.balance import zero_moment_point as zero_moment_point
from impactopt.report.pictures.hierarchy import hierarchy as hierarchy
from impactopt.report.pictures.histories import draw_force
from impactopt.report.pictures.histories import force as force
from impactopt.report.pictures.histories import iterations as iterations
from impactopt.report.pictures.histories import motion as motion
from impactopt.report.pictures.histories import torque as torque
from impactopt.report.pictures.overview import overview as overview
from impactopt.report.pictures.poses import ellipsoid as ellipsoid
from impactopt.report.pictures.poses import strobe as strobe
from impactopt.report.pictures.style import Picture as Picture
from impactopt.report.pictures.style import RecordPicture, styled

# by file name without .png
PICTURES: Mapping[str, RecordPicture] = {
    "force": force,
    "zmp": zero_moment_point,
    "torque": torque,
    "strobe": strobe,
    "motion": motion,
    "ellipsoid": ellipsoid,
    "iterations": iterations,
    "replay": _replay,
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
        whose motion cannot be completed; simulations or axes of another type; axes that are no part of a
        grid, for several panels.
    """
    draws = {"overview": overview, **PICTURES}
    check_choice("there is no picture", what, draws)
    if ax is not None:
        check_kind("ax", ax, Axes)
    record = record_of(solution, simulation=simulation, replay=replay)
    if not record.completed:
        raise InputError(f"there is no motion to draw: {record.summary['note']}")
    drawn = draws[what](record)
    if drawn is None:
        raise InputError(f"of this solution there is nothing to draw as {what!r}: {draws[what].lacking}")
    return drawn if ax is None else _drawn_in(ax, draws[what], record)


@styled
def _drawn_in(ax: Axes, picture: RecordPicture, record: Record) -> Axes | list[Axes]:
    """Draws a picture in the place of axes; returns its axes."""
    if picture is force:
        draw_force(ax, record)
        return ax
    grid, figure = ax.get_subplotspec(), ax.figure
    if grid is None:
        raise InputError("ax is no part of a grid, which this picture needs: make it with plt.subplots()")
    ax.remove()
    part = figure.add_subfigure(grid)
    picture.draw(part, record)
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
            remove_file(path)
            continue
        write_file(path, picture.write)
        written.append(path)
    return written
