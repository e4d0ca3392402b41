"""What several commands take."""

from __future__ import annotations

import enum
import shlex
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


def command_line(context: typer.Context) -> str:
    """The command as it was given, for the record: its name, arguments, and options that were set."""
    words = ["impactopt", str(context.info_name)]
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params[str(parameter.name)]
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE":
            continue
        if isinstance(value, bool):
            words.append((parameter.opts if value else parameter.secondary_opts)[0])
            continue
        option = max(parameter.opts, key=len)
        words += [option] if option.startswith("-") else []
        words.append(str(value.value if isinstance(value, enum.Enum) else value))
    return shlex.join(words)
