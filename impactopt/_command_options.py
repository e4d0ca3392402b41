"""What several commands take."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

NOT_SOLVED = 1  # exit code
ProblemPath = Annotated[
    Path, typer.Argument(metavar="PROBLEM", help="Its name, as `impactopt problems` lists them, or its file.")
]


class Solver(str, enum.Enum):
    ipopt = "ipopt"
    sqp = "sqp"


SolverName = Annotated[Solver | None, typer.Option(help="Instead of the one that the file names.")]
TimeLimit = Annotated[
    float | None, typer.Option(metavar="SECONDS", help="Stop the solver then; keep its best iterate.")
]
Starts = Annotated[
    int, typer.Option(min=1, help="Solve from so many starts, drawn but for the first; keep the best.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of the starts that are drawn.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, no tables.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]


def check_time_limit(seconds: float | None) -> None:
    """BadParameter if it is none."""
    if seconds is not None and not seconds > 0:
        raise typer.BadParameter(f"{seconds:g}; give seconds > 0", param_hint="--time-limit")
