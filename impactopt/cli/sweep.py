"""Command `impactopt sweep`: many cases of one problem."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from impactopt.cli.command import NO, AsJson, Quiet, complete_sweep, out_option, plain_errors, print_json

if TYPE_CHECKING:
    from impactopt.sweeps import SweepResult


def sweep(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="SWEEP",
            help="A sweep file, or the name of one that comes with the package; see docs/sweeps.md.",
            autocompletion=complete_sweep,
        ),
    ],
    out: Annotated[Path, out_option("Directory of the results; give it again to resume.")],
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes on this machine (default: one a core).")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of a Dask scheduler, tcp://host:port, whose workers compute the cases.",
        ),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Repeat cases that crashed or ran out of time before.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a key of the sweep file, as draw.count=100, or of the problem, as "
            "set.target.mass=8; may be repeated.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="A line after every case, and the traceback of an error.")
    ] = False,
) -> None:
    """Compute all cases of a sweep file, and write them as one table: DIR/table.parquet, and DIR/figure.png.

    Each finished case is saved at once: after Ctrl-C, a kill or a power cut the same command resumes. A
    case that fails is a row with its reason. Exit code: 0 done, 1 no case has a usable result, 2 bad input.
    """
    interrupted = f"interrupted; finished cases are in {out}, and the same command resumes the sweep"
    with plain_errors(interrupted, verbose=verbose, as_json=as_json) as console:
        from impactopt.files.problem_file import parse_settings
        from impactopt.sweeps import read_sweep_file
        from impactopt.sweeps import sweep as run
        from impactopt.sweeps.progress import SweepConsole

        chosen = read_sweep_file(file, parse_settings(settings or ()))
        with SweepConsole(console, quiet=quiet, verbose=verbose) as shown:
            callbacks: dict[str, Any] = {"report": shown.say, "progress": shown.progress}
            result = run(chosen, out, workers=workers, scheduler=scheduler, again=again, **callbacks)
        if as_json:
            print_json(result.summary(), result.failed < result.done)
        else:
            _show(result)
        if result.failed == result.done:
            raise typer.Exit(NO)
        if chosen.figure is not None:
            from impactopt.report.console import say
            from impactopt.report.pictures.sweep import save_sweep_picture

            picture = save_sweep_picture(chosen, result.table)
            if not (as_json or quiet):
                say(console, picture)


def _show(result: SweepResult) -> None:
    from rich.table import Table

    from impactopt.report.console import output, say
    from impactopt.sweeps.progress import words_for_time

    table = Table(title=f"{result.done} of {result.cases} cases", title_justify="left", show_header=False)
    rows = {
        "without a usable result": str(result.failed),
        "from an earlier run": str(result.resumed),
        "this run": f"{words_for_time(result.seconds)}, {result.rate_per_second:.3g} cases a second",
        "most memory of a worker": f"{result.peak_worker_mb:.0f} MB",
    }
    if result.best is not None:
        rows["largest impulse"] = f"{result.best:.2f} N s, in case {result.best_case}"
    if result.iterations:
        iterations = (f"{n:.0f} from a {guess}" for guess, n in result.iterations.items())
        rows["iterations"] = ", ".join(iterations)
    for name, value in rows.items():
        table.add_row(name, value)
    console = output()
    console.print(table)
    say(console, *(f"{count} x {reason}" for reason, count in result.reasons.items()), result.table)
