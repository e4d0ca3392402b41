"""Command `impactopt identify`: contact laws from a measured log of impacts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from impactopt.cli.command import AsJson, Verbose, complete_problem, out_option, plain_errors, print_json


def identify(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="CSV with a header, or npz: time_s, force_N, and hand_speed_m_s or joint positions "
            "(JOINT_rad, with --problem).",
        ),
    ],
    law: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A contact law, by its name in problem files; may be repeated (default: all of them).",
        ),
    ] = None,
    target_mass: Annotated[
        float | None,
        typer.Option(metavar="KG", help="Mass of a free target (default: it is fixed, as a load cell)."),
    ] = None,
    problem: Annotated[
        Path | None,
        typer.Option(
            metavar="PROBLEM",
            help="Problem with the robot, striker and normal of the joint positions.",
            autocompletion=complete_problem,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        out_option("Write the law that fits best there, as a section for a problem file.", "FILE"),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Find stiffness, damping and effective mass from a log of one or more impacts, with 95 % intervals.

    Each contact law is fitted by least squares to the collision of two masses. Prints the laws, the best
    first, and cautions. Exit code: 0 done, 2 bad input.
    """
    with plain_errors("interrupted before the laws were fitted", verbose=verbose, as_json=as_json):
        import numpy as np

        from impactopt.contact.laws import LAWS
        from impactopt.errors import InputError
        from impactopt.files.output import write_file
        from impactopt.files.problem_file import load_problem
        from impactopt.identification import identify as fit
        from impactopt.identification import read_log

        if problem is None:
            measured = read_log(log)
        else:
            of = load_problem(problem)
            if of.friction is not None:
                raise InputError(
                    f"{problem}: [friction]: laws are fitted to impacts without it: leave it out"
                )
            measured = read_log(log, robot=of.robot, striker=of.striker, normal=of.normal)
        mass = np.inf if target_mass is None else target_mass
        found = fit(measured, target_mass=mass, laws=law or LAWS)
        if out is not None:
            text = found.best.toml()
            write_file(out, lambda file: file.write(text.encode()))
        if as_json:
            print_json(found.describe(), True)
            return
        from impactopt.report.console import identified_table, output, say

        console = output()
        console.print(identified_table(found.describe()))
        say(console, *(f"caution: {caution}" for caution in found.cautions), out)
