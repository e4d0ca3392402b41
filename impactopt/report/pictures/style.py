"""Style of all pictures: Okabe and Ito's colours, and cividis for scales, which suit any colour vision."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from textwrap import fill
from typing import IO, Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase
from matplotlib.rcsetup import cycler

from impactopt.arrays import Array
from impactopt.files.record import Record

Given = ParamSpec("Given")
Drawn = TypeVar("Drawn")

# in the order in which lines get them
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, BLACK = COLOURS

# of collision models, in all pictures
MODELS = {
    "virtual-mass": ORANGE,
    "sdc-paper": VERMILION,
    "sdc": GREEN,
    "freezes": BLUE,
    "full": BLACK,
    "mujoco": SKY,
    "auto": PURPLE,
}
PLANNED, SIMULATED, OVER = BLUE, VERMILION, VERMILION
RIGHT = "-y, to the right [m]"  # axis label of views from above and behind, where y points left
PHASES = ("swing", "collision", "follow-through")

# [in] widths of a paper's column and page; pictures of these widths are printed unscaled
COLUMN, PAGE = 3.5, 7.2
DPI = 200
LETTERS = 14  # of a title that fit an inch

STYLE: Any = {
    "text.usetex": False,  # safety: a matplotlibrc in the working directory could have LaTeX run commands
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "figure.constrained_layout.use": True,
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.prop_cycle": cycler(color=COLOURS),
    "figure.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "image.cmap": "cividis",
}


class Picture(Figure):
    """Figure in our style, which notebooks show; needs no display and changes no global state."""

    def __init__(self, width: float, height: float) -> None:
        with matplotlib.rc_context(STYLE):
            super().__init__(figsize=(width, height))
            FigureCanvasAgg(self)

    def add_subplot(self, *args: Any, **options: Any) -> Any:  # subplots come through here too
        with matplotlib.rc_context(STYLE):
            return super().add_subplot(*args, **options)

    def legend(self, *args: Any, **options: Any) -> Any:
        with matplotlib.rc_context(STYLE):
            return super().legend(*args, **options)

    def draw(self, renderer: Any) -> None:
        with matplotlib.rc_context(STYLE):  # ticks are made when they are drawn
            super().draw(renderer)

    def write(self, file: IO[bytes]) -> None:
        """Writes the picture as PNG."""
        with matplotlib.rc_context(STYLE):
            self.savefig(file, format="png")

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """PNG for notebooks: half as many pixels on the page as in the file, which is sharp on any screen."""
        width, height = (int(side * DPI / 2) for side in self.get_size_inches())
        memory = io.BytesIO()
        self.write(memory)
        return memory.getvalue(), {"width": width, "height": height}


def styled(draw: Callable[Given, Drawn]) -> Callable[Given, Drawn]:
    """Function that draws in our style."""

    @wraps(draw)
    def in_style(*args: Given.args, **options: Given.kwargs) -> Drawn:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **options)

    return in_style


@dataclass(frozen=True, kw_only=True)
class RecordPicture:
    """Picture of a record; used as a decorator of the function that draws it.

    draw : draws it into a figure, or a part of one.  width, height [in] : as a figure of its own.
    title : of the same, after the problem's name.
    exists : False for records of which there is nothing to draw.  lacking : what they lack.
    """

    draw: Callable[[FigureBase, Record], None]
    width: float = PAGE
    height: float | Callable[[Record], float]
    title: str | Callable[[Record], str] = ""
    exists: Callable[[Record], bool] = lambda record: True
    lacking: str = ""

    def __call__(self, record: Record) -> Picture | None:
        """The picture as a figure of its own; None if there is nothing to draw."""
        if not self.exists(record):
            return None
        with matplotlib.rc_context(STYLE):
            figure = Picture(self.width, self.height(record) if callable(self.height) else self.height)
            self.draw(figure, record)
            if self.title:
                text = title(record, self.title(record) if callable(self.title) else self.title)
                figure.suptitle(fill(text, round(LETTERS * self.width)))
        return figure


def picture(**settings: Any) -> Callable[[Callable[[FigureBase, Record], None]], RecordPicture]:
    """Decorator of a function that draws a picture; settings : of a `RecordPicture`."""
    return lambda draw: RecordPicture(draw=draw, **settings)


def impulse_text(summary: Mapping[str, Any]) -> str:
    """Impulse with its unit."""
    value = summary.get("impulse_Ns")
    return "unknown" if value is None else f"{value:.2f} N s"


def title(record: Record, what: str) -> str:
    """Title with the problem's name."""
    name = record.summary.get("problem", {}).get("name", "")
    return f"{name}: {what}" if name else what


def model_colour(model: str, freezes: float = 0) -> str:
    """Colour of a collision model by its name in a file, and its number of freezes."""
    return MODELS["freezes" if freezes else model]


def joint_label(name: object) -> str:
    """Joint's name without "_joint" and underscores."""
    return str(name).removesuffix("_joint").replace("_", " ")


def simulated_parts(record: Record, values: Array) -> list[tuple[Array, Array]]:
    """Times ([s]; [ms] since contact in the collision) and values (k, ...) of the simulation's three phases.

    Without a simulated contact, the phases are those of the plan.
    """
    a = record.arrays
    kind = "simulated" if np.isfinite(a["simulated_contact_start"]) else "reference"
    start, end = (float(a[f"{kind}_contact_{which}"]) for which in ("start", "end"))
    time = a["simulated_time"]
    # nan, for a contact that did not end, compares false
    phase = (time >= start).astype(int) + (time >= end).astype(int)
    before, contact, after = (time[phase == k] for k in range(3))
    times = (before, 1e3 * (contact - contact[:1]), after)
    return [(times[k], values[phase == k]) for k in range(3)]
