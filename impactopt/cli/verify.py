"""Command `impactopt verify`: check of a saved result, whose program is evaluated again."""

from __future__ import annotations

import typer

from impactopt.cli.command import (
    NO,
    AsJson,
    OtherProblem,
    Quiet,
    ResultPath,
    Verbose,
    plain_errors,
    print_json,
)


def verify(
    result: ResultPath,
    problem: OtherProblem = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Recompute all constraints, the objective and the KKT residual of a result, independently of the solver.

    Exit code: 0 all agree, 1 some do not, or could not be computed, 2 bad input.
    """
    with plain_errors(
        "interrupted before the result was verified", verbose=verbose, as_json=as_json
    ) as stderr:
        from impactopt.files.record import plain
        from impactopt.files.verify import verify as verified
        from impactopt.report.console import SolveConsole, verdict_table

        with SolveConsole(stderr, quiet=quiet, verbose=verbose) as progress:
            progress.say(f"{result}: evaluating its program again")
            verdict = verified(result, problem_file=problem)
        if as_json:
            print_json(plain(verdict.describe()), verdict.ok)
        else:
            from impactopt.report.console import output, say

            console = output()
            console.print(verdict_table(verdict.describe()))
            say(console, verdict.reason)
        if not verdict.ok:
            raise typer.Exit(NO)
