"""Pictures of a record: force, ZMP, torque and joint motion, planned beside simulated; soles in a replay.

One picture a file. Figures are made with matplotlib's objects and Agg: no display is needed, and no global
state is touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from impactopt.output import Record, write_file
from impactopt.plotting.force import force
from impactopt.plotting.motion import motion
from impactopt.plotting.replay import replay
from impactopt.plotting.style import STYLE
from impactopt.plotting.torque import torque
from impactopt.plotting.zmp import zero_moment_point

__all__ = ["PICTURES", "force", "motion", "replay", "save_pictures", "torque", "zero_moment_point"]

# file name without .png: what draws it, or gives None where there is nothing to draw
PICTURES: Mapping[str, Callable[[Record], Figure | None]] = {
    "force": force,
    "zmp": zero_moment_point,
    "torque": torque,
    "motion": motion,
    "replay": replay,
}


def save_pictures(record: Record, directory: Path, names: Iterable[str] = tuple(PICTURES)) -> list[Path]:
    """Write the record's pictures as PNG into the directory; what an earlier record left there goes.

    names : of PICTURES; all of them if left out.

    Raises
    ------
    InputError : they cannot be written.
    """
    written = []
    for name in names:
        draw = PICTURES[name]
        path = directory / f"{name}.png"
        with matplotlib.rc_context(STYLE):
            figure = draw(record) if record.completed else None
            if figure is None:
                path.unlink(missing_ok=True)
                continue
            canvas = FigureCanvasAgg(figure)
            write_file(path, canvas.print_png)
        written.append(path)
    return written
