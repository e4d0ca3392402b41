"""Command `impactopt drive`: a series of blows on a nail until it is in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from impactopt.cli.command import (
    NO,
    AsJson,
    ProblemPath,
    Quiet,
    Settings,
    Verbose,
    out_option,
    plain_errors,
    print_json,
)


def drive(
    problem: ProblemPath,
    depth: Annotated[float, typer.Option(metavar="M", help="Depth to which the nail is driven.")] = 0.05,
    most: Annotated[int, typer.Option(metavar="N", help="Largest number of blows.", min=1)] = 20,
    out: Annotated[Path | None, out_option("Write blows.json there.")] = None,
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Plan a series of blows on a nail until it is in, each from the depth that the one before has reached.

    A series that ends earlier is written to DIR/failed if DIR has a complete one. Exit code: 0 the nail
    is in, 1 it is not, 2 bad input.
    """
    with plain_errors("interrupted before the nail was in", verbose=verbose, as_json=as_json) as console:
        from impactopt.errors import counted
        from impactopt.files.output import check_directory, keep_series, set_aside
        from impactopt.files.problem_file import parse_settings, read_problem_file
        from impactopt.files.record import plain
        from impactopt.planning.nail_driving import drive_nail
        from impactopt.report.console import SolveConsole, nail_driving_table, output

        read = read_problem_file(problem, parse_settings(settings or ()))
        directory = None if out is None else check_directory(out)
        with SolveConsole(console, quiet=quiet) as progress:
            series = drive_nail(
                read.build(), depth=depth, most=most, report=progress.say, **read.solver.arguments()
            )
        done = plain(series.describe())
        if directory is not None:
            keep_series(done, directory)
        if as_json:
            print_json(done, series.done)
        else:
            output().print(nail_driving_table(done))
            typer.echo(series.reason or f"the nail is in after {counted(len(series.blows), 'blow')}")
            if aside := set_aside(done):
                typer.echo(aside)
        if not series.done:
            raise typer.Exit(NO)
