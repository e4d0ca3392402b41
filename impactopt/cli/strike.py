"""Command `impactopt strike`: the hardest impact by itself, without a motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from impactopt.cli.command import (
    NO,
    AsJson,
    ProblemPath,
    Quiet,
    Seed,
    Settings,
    SolverName,
    Starts,
    TimeLimit,
    Verbose,
    Workers,
    command_line,
    out_option,
    plain_errors,
    print_json,
)


def strike(
    context: typer.Context,
    file: ProblemPath,
    out: Annotated[Path | None, out_option("Directory for the numbers.")] = None,
    starts: Starts = 4,
    workers: Workers = 1,
    seed: Seed = 0,
    solver: SolverName = None,
    time_limit: TimeLimit = None,
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find the posture and velocity at contact that hit hardest, without a motion that leads to them.

    It starts from several initial guesses, as local optima differ much. A failed result goes to DIR/failed if
    there is a good one in DIR. Exit code: 0 solved, 1 not solved, 2 bad input.
    """
    with plain_errors(
        "interrupted before there was a strike to keep", verbose=verbose, as_json=as_json
    ) as console:
        from impactopt.errors import counted, printable
        from impactopt.files.output import check_directory, keep_record, record_of_strike, set_aside
        from impactopt.files.problem_file import parse_settings, read_problem_file
        from impactopt.planning.strike import optimize_strike
        from impactopt.report.console import SolveConsole

        read = read_problem_file(file, parse_settings(settings or ()))
        chosen = read.solver.arguments(solver, time_limit)
        with SolveConsole(console, quiet=quiet, verbose=verbose) as progress:
            progress.say(f"{read.path} is read; building the robot")
            problem = read.build()
            directory = None if out is None else check_directory(out)
            progress.say("building the nonlinear program (compiles for some ten seconds the first time)")
            solution = optimize_strike(
                problem,
                starts=starts,
                workers=workers,
                seed=seed,
                report=progress.say,
                callback=progress.iteration if workers == 1 else None,
                **chosen,
            )
            progress.say(f"best of {counted(len(solution.attempts), 'start')}: {solution.status.message}")
            if solution.caution:
                progress.say(solution.caution)
        record = record_of_strike(solution, problem=read.text, problem_path=read.path)
        record.summary.update(command=command_line(context), ok=solution.status.usable)
        written = [] if directory is None else keep_record(record, directory)
        if as_json:
            print_json(record.summary, solution.status.usable)
        else:
            from impactopt.report.console import output, say, say_outcome, strike_table

            shown, s = output(), record.summary
            shown.print(strike_table(s))
            say_outcome(shown, s)
            say(shown, *written)
            if aside := set_aside(s):
                typer.echo(printable(aside))
        if not solution.status.usable:
            raise typer.Exit(NO)
