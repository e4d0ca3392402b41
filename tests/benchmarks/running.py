"""Reports, run one after the other: progress, tables on the console, files, JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import typer

from benchmarks.report import Report, Say
from impactopt.cli.command import plain_errors


def show_reports(
    names: Sequence[str],
    run: Callable[[str, Say], Report],
    *,
    as_json: bool,
    out: Path | None,
    quiet: bool,
    together: bool = False,
    interrupted: str = "interrupted before it was done",
) -> None:
    """Run reports by name and show each when it is done; bad input ends in a message and exit code 2.

    run : makes the report of a name, and says what it does.
    as_json : print the numbers alone, and nothing else on stdout; with `together`, each under its name.
    out : directory where numbers and pictures are kept.
    """
    with plain_errors(interrupted) as console:
        from benchmarks.report import save_report
        from impactopt.files.output import make_directory
        from impactopt.files.record import plain
        from impactopt.report.console import SolveConsole, output

        directory = make_directory(out) if out is not None else None
        found = {}
        for name in names:
            with SolveConsole(console, quiet=quiet) as progress:
                report = run(name, progress.say)
                written = save_report(report, directory) if directory is not None else []
            found[name] = plain(report.numbers)
            if as_json:
                continue
            screen = output()
            for table in report.tables:
                screen.print(table)
            if written:
                files = ", ".join(path.name for path in written)
                screen.print(f"{written[0].parent}: {files}", highlight=False, soft_wrap=True)
        if as_json:
            typer.echo(json.dumps(found if together else found[names[0]], indent=2))
