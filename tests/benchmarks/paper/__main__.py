"""`python -m benchmarks.paper NAME`: the paper's table or figure of that name, ours beside it.

Exit codes: 0 done, 2 bad input.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.running import show_reports
from impactopt.cli.command import plain_errors

app = typer.Typer(name="reproduce")


@app.command()
def reproduce(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="table1, table2, table3, fig3, fig4, fig7, or all.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON, no tables.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Write numbers and pictures there.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """The paper's tables and figures beside ours, row by row.

    Robots are the stand-in for the paper's HRP-2, and TALOS; the reference is full dynamics. Exit code: 0
    done, 2 bad input.
    """
    with plain_errors("interrupted"):
        from benchmarks.registry import names_of
        from benchmarks.registry import reproduce as run

        names = names_of(name)
    show_reports(
        names,
        run,
        as_json=as_json,
        out=out,
        quiet=quiet,
        together=name == "all",
        interrupted="interrupted before it was reproduced",
    )


if __name__ == "__main__":
    app()
