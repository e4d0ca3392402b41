"""Command `impactopt show`: a page for the browser of a result or of a robot's bodies, static or live."""

from __future__ import annotations

import os
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from impactopt.cli.command import OtherProblem, out_option, plain_errors

if TYPE_CHECKING:
    from impactopt.files.replay import Planned
    from impactopt.live.collision_page import CollisionPage
    from impactopt.live.plan_page import PlanPage
    from impactopt.report.page import Page

PAGE = "report.html"
BODIES = "results"  # default directory of a robot's page


def show(
    what: Annotated[
        Path,
        typer.Argument(
            metavar="RESULT|ROBOT",
            help="Directory of `impactopt solve`, such as results/punch; or a robot, as `impactopt robots` "
            "lists them; or a problem file (.toml), for its robot and its world.",
        ),
    ],
    out: Annotated[
        Path | None, out_option(f"The page (default: RESULT/{PAGE}, or {BODIES}/ROBOT.html).", "FILE.html")
    ] = None,
    open_: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    sheet: Annotated[
        Path | None,
        typer.Option(
            "--sheet",
            metavar="FILE.png",
            help="Write a picture instead: the planned motion from three sides at seven instants.",
        ),
    ] = None,
    problem: OtherProblem = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Serve a page on this machine until Ctrl-C: its sliders and hit point make new plans; of a "
            "problem file: posture and speed of one collision.",
        ),
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, metavar="PORT", help="Of the live page, on 127.0.0.1 (default: a free one)."
        ),
    ] = None,
) -> None:
    """Write a result as one page with numbers, plots, motion, problem and command; it needs no network.

    For a robot the page shows its bodies: hulls over its meshes, and the pairs that may touch.

    Exit code: 0 written, 2 bad input, 130 Ctrl-C, which ends a live page.
    """
    if port is not None and not live:
        raise typer.BadParameter("it is for --live alone", param_hint="--port")
    if sheet is not None:
        if live or out is not None:
            raise typer.BadParameter("it is a picture of a result, no page", param_hint="--sheet")
        _sheet(what, problem, sheet)
        return
    if live:
        if out is not None:
            raise typer.BadParameter("a live page is not written: leave one of them out", param_hint="--out")
        _live(what, problem, port, open_)
        return
    with plain_errors("interrupted before the page was written"):
        from impactopt.errors import printable
        from impactopt.files.output import make_directory

        made, usual, caution = _bodies(what, problem) if _is_robot(what) else _result(what, problem)
        page = out if out is not None else usual
        make_directory(page.parent)
        written = made.save(page)
        typer.echo(printable(str(written)))
        if caution:
            typer.echo(printable(f"caution: {caution}"))
        if open_:
            webbrowser.open(written.resolve().as_uri())


def _sheet(result: Path, problem: Path | None, file: Path) -> None:
    """Writes the contact sheet of a result."""
    with plain_errors("interrupted before the picture was written"):
        from impactopt.errors import printable
        from impactopt.files.output import check_ending, make_directory, write_file
        from impactopt.files.replay import load_planned
        from impactopt.report.pictures.sheet import sheet

        check_ending("a sheet is a PNG", file, ".png")
        make_directory(file.parent)
        planned = load_planned(result, problem_file=problem)
        write_file(file, sheet(planned.record, planned.problem).write)
        typer.echo(printable(str(file)))
        if caution := _caution(planned, problem):
            typer.echo(printable(f"caution: {caution}"))


def _caution(planned: Planned, problem: Path | None) -> str:
    """Caution about a given problem that is not the plan's; "" if there is none."""
    if not planned.of_other_problem:
        return ""
    return (
        f"{problem} is not the problem of this plan: robot, target, ground and limits are drawn of it, the "
        "motion and its numbers are the plan's"
    )


def _live(what: Path, problem: Path | None, port: int | None, open_: bool) -> None:
    """Serves the live page of a result or of a problem file."""
    with plain_errors("the live page has ended"), _page(what, problem, port or 0) as page:
        typer.echo(f"{page.address} (Ctrl-C ends it)")
        if open_:
            webbrowser.open(page.address)
        page.run()


def _page(what: Path, problem: Path | None, port: int) -> PlanPage | CollisionPage:
    """Live page of a result, or of a problem file's collision."""
    from impactopt.errors import InputError
    from impactopt.files.problem_file import read_problem_file
    from impactopt.files.replay import load_planned, resumed
    from impactopt.live.collision_page import CollisionPage
    from impactopt.live.plan_page import PlanPage

    if not _is_robot(what):
        planned = load_planned(what, problem_file=problem)
        again = resumed(planned.record, planned.problem, other=planned.of_other_problem)
        return PlanPage(again, port=port)
    if what.suffix != ".toml" or problem is not None:
        raise InputError(f"--live is for a result, or for a problem file alone: {str(what)!r} has no target")
    return CollisionPage(read_problem_file(what).build(), port=port)


def _is_robot(what: Path) -> bool:
    """True for a problem file, and for a robot's name that no file or directory has."""
    from impactopt.robots.presets import robot_names

    return what.suffix == ".toml" or (str(what) in robot_names() and not os.path.exists(what))


def _result(result: Path, problem: Path | None) -> tuple[Page, Path, str]:
    """Page of a result, its default path, and a caution about a problem that is not the plan's."""
    from impactopt.errors import InputError, did_you_mean
    from impactopt.files.record import load_record, near_result
    from impactopt.files.replay import load_planned
    from impactopt.report.report import report_of
    from impactopt.robots.presets import robot_names

    if not os.path.exists(result):
        robots = robot_names()
        near = near_result(result) or did_you_mean(str(result), robots)
        raise InputError(
            f"there is no result {str(result)!r}{near}; give a directory that `impactopt solve` wrote, "
            f"a problem file, or one of the robots {', '.join(robots)}"
        )
    record = load_record(result)
    about, caution = None, ""
    if problem is not None and not record.completed:
        raise InputError(f"--problem is for a whole motion, and {str(result)!r} holds none: leave it out")
    if record.completed:
        planned = load_planned(result, problem_file=problem)
        about, caution = planned.problem, _caution(planned, problem)
        notes = "; ".join(filter(None, [record.summary.get("caution"), caution]))
        record.summary.update({"caution": notes} if notes else {})
    return report_of(record, about), (result if os.path.isdir(result) else result.parent) / PAGE, caution


def _bodies(what: Path, problem: Path | None) -> tuple[Page, Path, str]:
    """Page of a robot's bodies, its default path, and no caution."""
    from impactopt.errors import InputError
    from impactopt.files.problem_file import read_problem_file
    from impactopt.report.robot_page import bodies_page, bodies_page_of_problem
    from impactopt.robots.presets import load_robot

    if problem is not None:
        raise InputError(f"--problem is for a result, and {str(what)!r} is none: leave it out")
    page = Path(BODIES) / f"{what.stem}.html"
    if what.suffix == ".toml":
        return bodies_page_of_problem(read_problem_file(what).build()), page, ""
    return bodies_page(load_robot(str(what))), page, ""
