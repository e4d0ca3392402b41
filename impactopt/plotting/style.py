"""One style for all pictures.

Okabe and Ito's colours, and cividis for scales: any kind of colour vision tells them apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.output import Record

Array = NDArray[np.float64]

BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, BLACK = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
    "#000000",
)

PLANNED, SIMULATED, OVER = BLUE, VERMILION, VERMILION
PHASES = ("swing", "collision", "follow-through")

STYLE: Any = {
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 11,
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


def title(record: Record, what: str) -> str:
    """The problem's name, and what is drawn."""
    name = record.summary.get("problem", {}).get("name", "")
    return f"{name}: {what}" if name else what


def joint_label(name: object) -> str:
    """A joint's name as a reader wants it."""
    return str(name).removesuffix("_joint").replace("_", " ")


def simulated_phases(record: Record) -> NDArray[np.intp]:
    """Of the simulated instants (k,): 0 before, 1 in, 2 after contact; planned contact if there was none."""
    a = record.arrays
    kind = "simulated" if np.isfinite(a["simulated_contact_start"]) else "reference"
    start, end = (float(a[f"{kind}_contact_{which}"]) for which in ("start", "end"))
    # nan, for a contact that did not end, compares false
    return (a["simulated_time"] >= start).astype(int) + (a["simulated_time"] >= end).astype(int)
