"""The command `impactopt show`: a result as one page for a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from impactopt.plain_errors import plain_errors

PAGE = "report.html"


def show(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="What `impactopt solve` wrote, such as results/punch.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE.html", help=f"The page (default: RESULT/{PAGE})."),
    ] = None,
    open_: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    problem: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Problem file, instead of the one kept in RESULT.")
    ] = None,
) -> None:
    """Put a result on one page: numbers, plots, the robot's motion, how it was made. It needs no network.

    Exit code: 0 written, 2 bad input.
    """
    with plain_errors("interrupted before the page was written"):
        from impactopt.errors import printable
        from impactopt.output import load_record, make_directory
        from impactopt.replay import load_planned
        from impactopt.report import report_of

        record = load_record(result)
        about = load_planned(result, problem_file=problem).problem if record.completed else None
        page = out if out is not None else (result if result.is_dir() else result.parent) / PAGE
        make_directory(page.parent)
        written = report_of(record, about).save(page)
        typer.echo(printable(str(written)))
        if open_:
            webbrowser.open(written.resolve().as_uri())
