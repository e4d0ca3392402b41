"""Command `impactopt collide`: one collision, from a posture or from the contact of a saved result."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from impactopt.cli.command import (
    NO,
    AsJson,
    Quiet,
    Settings,
    Verbose,
    complete_problem,
    plain_errors,
    print_json,
)

RESULT_FREEZES = 16  # default for a saved result, as the contacts of plans are long
Model = Literal["sdc", "sdc-paper", "virtual-mass", "rigid", "full"]


def collide(
    what: Annotated[
        Path,
        typer.Argument(
            metavar="PROBLEM|RESULT",
            help="A problem's name or file, or a directory of `impactopt solve` or `strike`.",
            autocompletion=complete_problem,
        ),
    ],
    speed: Annotated[
        float | None,
        typer.Option(
            metavar="M/S", help="Speed of the striking point along the normal; a result has its own."
        ),
    ] = None,
    posture: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A posture of the robot by name, on soles as it has them, whatever steps the stances have; "
            "left out: a reach to the problem's point.",
        ),
    ] = None,
    model: Annotated[Model, typer.Option(help="Model of the collision.")] = "sdc",
    freezes: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=0,
            help=f"Further freezes of the sdc (default: {RESULT_FREEZES} for a result, else 0).",
        ),
    ] = None,
    accuracy: Annotated[
        float,
        typer.Option(
            metavar="PCT",
            help="Warn if the estimated error of freezing is above this percentage of the impulse.",
        ),
    ] = 1.0,
    horizon: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="Longest contact (default: 0.2; more for a result whose contact is longer)."
        ),
    ] = None,
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compute one collision, from a posture or as in a saved plan or strike, without a motion.

    Prints impulse, peak force, duration, ZMP margin and torques. For the sdc it also prints the estimated
    error of freezing, with advice if that is above --accuracy. With a posture, the striking point moves
    along the normal at --speed with the least kinetic energy, the soles are at rest, and the servo's
    reference keeps the joint velocities. A result has its own reference, which keeps the soles in place; its
    planned numbers are printed too. Sections of a problem file that are about plans, such as swing and
    terms, are not checked. Exit code: 0 done, 1 there is no such collision (out of reach, beyond a
    limit, no separation), 2 bad input.
    """
    with plain_errors(
        "interrupted before the collision was over", verbose=verbose, as_json=as_json
    ) as console:
        from impactopt.collide.single_collision import collide_once, problem_of_result
        from impactopt.files.sections.reading import CollisionFile, parse_settings
        from impactopt.report.console import SolveConsole

        if not 0 < accuracy < math.inf:
            raise typer.BadParameter(f"{accuracy:g}; give a number > 0", param_hint="--accuracy")
        saved = os.path.isdir(what)  # False also for names that are too long
        if saved and posture is not None:
            raise typer.BadParameter("a result has its own; leave it out", param_hint="--posture")
        changes = parse_settings(settings or ())
        read = problem_of_result(what).changed(changes) if saved else CollisionFile.read(what, changes)
        if not saved and speed is None:
            raise typer.BadParameter("missing; only a result has a speed of its own", param_hint="--speed")
        if freezes is None and saved and model == "sdc":
            freezes = RESULT_FREEZES
        given = {"model": model, "freezes": freezes, "posture": posture, "speed_m_s": speed}
        given["horizon_s"] = horizon
        given["result"] = str(what.resolve()) if saved else None
        at_contact = {key: value for key, value in given.items() if value is not None}
        with SolveConsole(console, quiet=quiet) as progress:
            progress.say(f"{read.path} is read; computing the collision (compiles the first time)")
            found = collide_once(read, at_contact, accuracy=accuracy / 100)
        if as_json:
            print_json(found, "reason" not in found)
        else:
            from impactopt.report.console import collision_table, output, torques_table

            if "reason" in found:
                typer.echo(f"no collision: {found['reason']}")
            else:
                shown = output()
                shown.print(collision_table(found))
                if found["joints"]:
                    shown.print(torques_table(found["joints"]))
        if "reason" in found:
            raise typer.Exit(NO)
