"""The command `impactopt collide`: one collision, from a posture or from the contact of a saved result."""

from __future__ import annotations

import enum
import json
import math
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from impactopt.cli.options import AsJson, Quiet, Settings, Verbose, check_loudness, complete_problem
from impactopt.report.plain_errors import plain_errors

NO_COLLISION = 1  # exit code
OFTEN = 16  # freezes of a saved result: a plan's contacts are long


class Model(str, enum.Enum):
    sdc = "sdc"
    paper = "sdc-paper"
    virtual_mass = "virtual-mass"
    full = "full"


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
        typer.Option(metavar="M/S", help="Of the striking point along the normal; a result has its own."),
    ] = None,
    posture: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of the robot; left out: a reach to the problem's point."),
    ] = None,
    model: Annotated[Model, typer.Option(help="Of the collision.")] = Model.sdc,
    freezes: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, help=f"Of the sdc, on the way; left out: {OFTEN} of a result, else none."
        ),
    ] = None,
    accuracy: Annotated[
        float,
        typer.Option(metavar="PCT", help="Of the impulse: freezing that may cost more of it is told."),
    ] = 1.0,
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Let the robot hit at a posture, or as a saved plan or strike does: the collision alone, no motion.

    Impulse, peak force, duration, ZMP margin and torques; of the sdc also what freezing may have cost of the
    impulse, and where that is more than --accuracy what to do. With a posture, the striking point moves along
    the normal at --speed with the least kinetic energy, soles at rest, and the servo's reference keeps the
    joint velocities. A result has a reference of its own, whose soles stay in place, and its numbers stand
    beside the model's. Exit code: 0 done, 1 there is no such collision (out of reach, beyond a limit, no
    separation), 2 bad input.
    """
    with plain_errors("interrupted before the collision was over", verbose=verbose) as console:
        from impactopt.files.problem_file import parse_settings, read_problem_file
        from impactopt.report.console import Progress
        from impactopt.sweeps.single import collide_once, problem_of_result

        check_loudness(quiet, verbose)
        if not 0 < accuracy < math.inf:
            raise typer.BadParameter(f"{accuracy:g}; give a number > 0", param_hint="--accuracy")
        saved = os.path.isdir(what)  # also of names that are too long for one
        if not saved and speed is None:
            raise typer.BadParameter("missing; only a result has a speed of its own", param_hint="--speed")
        if saved and posture is not None:
            raise typer.BadParameter("a result has its own; leave it out", param_hint="--posture")
        changes = parse_settings(settings or ())
        read = problem_of_result(what).changed(changes) if saved else read_problem_file(what, changes)
        at_contact: dict[str, Any] = {"model": model.value}
        if freezes is None and saved and model is Model.sdc:
            freezes = OFTEN
        at_contact |= {} if freezes is None else {"freezes": freezes}
        at_contact |= {"result": str(what.resolve())} if saved else {}
        at_contact |= {} if posture is None else {"posture": posture}
        with Progress(console, quiet=quiet) as progress:
            progress.say(f"{read.path} is read; colliding (compiles for a minute the first time)")
            at_contact |= {} if speed is None else {"speed_m_s": speed}
            found = collide_once(read, at_contact, accuracy=accuracy / 100)
        if as_json:
            typer.echo(json.dumps(found, indent=2))
        else:
            from rich.console import Console

            from impactopt.report.console import collision_table, torques_table

            if "reason" in found:
                typer.echo(f"no collision: {found['reason']}")
            else:
                shown = Console()
                shown.print(collision_table(found))
                if found["joints"]:
                    shown.print(torques_table(found["joints"]))
        if "reason" in found:
            raise typer.Exit(NO_COLLISION)
