"""Commands about problem files, problems and robots: `check`, `new`, `problems`, `robots`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from impactopt.cli.command import (
    BAD_INPUT,
    ProblemPath,
    Quiet,
    Settings,
    Verbose,
    complete_problem,
    out_option,
    plain_errors,
    print_json,
)

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

Motion = Literal["punch", "kick", "chop", "nail"]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def check(
    file: ProblemPath, settings: Settings = None, as_json: AsJson = False, verbose: Verbose = False
) -> None:
    """Check that a problem file is sound and its target within reach; list every mistake with its fix.

    The mistake to fix first comes first. With --json {"ok", "file", "hash", "problem", "doubts"}, or {"ok",
    "file", "mistakes"}. Exit code: 0 sound, 2 not.
    """
    with plain_errors("interrupted", verbose=verbose, as_json=as_json):
        from impactopt.errors import InputError, Mistakes, printable
        from impactopt.files.problem_file import parse_settings, read_problem_file
        from impactopt.problem import feasibility
        from impactopt.problem.plausibility import doubts

        try:
            problem = read_problem_file(file, parse_settings(settings or ()), names=True).build()
            found = Mistakes()
            found.found += feasibility.hopeless(problem)
            found.raise_if_any(str(file))
            told = (
                *feasibility.blocked(problem),
                feasibility.too_weak(problem),
                feasibility.overlapping(problem),
                *feasibility.unusual(problem),
                *feasibility.without_effect(problem),
                *feasibility.sticks_out(problem),
                *doubts(problem.robot),
            )
            warnings = [text for text in told if text]
        except InputError as error:
            if not as_json:
                raise
            first, *rest = str(error).splitlines()
            summary = {"sound": False, "file": str(file), "mistakes": [m.strip() for m in rest] or [first]}
            print_json(summary, False)
            raise typer.Exit(BAD_INPUT) from None
        if as_json:
            summary = {"sound": True, "file": str(file), "hash": problem.hash, "problem": problem.describe()}
            print_json(summary | {"doubts": warnings}, True)
            return
        typer.echo(printable(f"{file} is sound:"))
        plain = {"target": _with_units(problem.target), "law": _with_units(problem.law)}
        for name, value in (problem.describe() | plain).items():
            for text in value if name in ("inertias", "notes", "followers") else [_as_text(value)]:
                typer.echo(printable(f"  {name:<11} {text}"))
        if strength := _strength(problem):
            typer.echo(printable(f"  {'strength':<11} {strength}"))
        for warning in warnings:
            typer.echo(printable(f"  {'doubt':<11} {warning}"))


def _strength(problem: ImpactProblem) -> str:
    """Estimated impulse as a percentage of the hardest impact nearby, as a message; "" if it is not known."""
    from impactopt.problem.strength import best_share

    found = best_share(problem)
    if found is None:
        return ""
    share, best = found
    where = f"point_m = {best.point.round(2).tolist()}, normal = {best.normal.tolist()}"
    return f"{100 * share:.0f} % of the hardest impact nearby, by a rough estimate; that one: {where}"


def _with_units(thing: Any) -> str:
    """Law or target as text, such as `SpringDamper, stiffness 10000 N/m, damping 300 N s/m`."""
    from impactopt.contact.fields import abouts

    numbers = [(field.name, getattr(thing, field.name), about.unit) for field, about in abouts(type(thing))]
    parts = [f"{name} {value:g} {unit}".rstrip() for name, value, unit in numbers if isinstance(value, float)]
    return ", ".join([type(thing).__name__, *parts]) if parts else repr(thing)


def _as_text(value: Any) -> str:
    """Value of `ImpactProblem.describe` as readable text."""
    if isinstance(value, list):
        return ("; " if value and isinstance(value[0], str) else ", ").join(_as_text(one) for one in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def new(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME",
            help="Name of the problem to start from; or a .urdf, or the .xml of an MJCF.",
            autocompletion=complete_problem,
        ),
    ] = None,
    urdf: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Draft it for this URDF, or a robot of example-robot-data."),
    ] = None,
    mjcf: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draft it for the robot of this MJCF.")
    ] = None,
    out: Annotated[Path | None, out_option("Write it there, and do not print it.", "FILE")] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Print all sections and keys instead, as Markdown.")
    ] = False,
    bolted: Annotated[
        bool, typer.Option("--bolted", help="Draft it bolted to the ground, even if it has legs.")
    ] = False,
    motion: Annotated[
        Motion | None,
        typer.Option(help="Draft this motion (default: a kick of a robot without arms, else a punch)."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Print a problem file to start from, with a comment on each key; without a name, list the problems.

    Keys that the problem leaves out are included as comments with their defaults. With --urdf or --mjcf the
    file is drafted for that robot: soles, strikers, a posture, a target, and guesses for what its description
    lacks. --json prints the file as `toml` and its tables as `data`, or the list.
    """
    with plain_errors("interrupted", as_json=as_json):
        if sum(x is not None for x in (name, urdf, mjcf)) + reference > 1:
            raise typer.BadParameter("give one of NAME, --urdf, --mjcf and --reference")
        if name is not None and Path(name).suffix.lower() in (".urdf", ".xacro"):
            urdf, name = name, None
        elif name is not None and Path(name).suffix.lower() == ".xml":
            mjcf, name = Path(name), None
        for option, given in (("--bolted", bolted), ("--motion", motion)):
            if given and urdf is None and mjcf is None:
                raise typer.BadParameter("it is for a draft: give --urdf or --mjcf", param_hint=option)
        if reference and as_json:
            raise typer.BadParameter("the reference is Markdown; leave --json out", param_hint="--json")
        _check_free(out)  # before a draft, which takes a while
        if reference:
            from impactopt.files.problem_file.reference import reference as page

            _give(page(), out)
        elif urdf is not None or mjcf is not None:
            _draft(str(mjcf if urdf is None else urdf), urdf is None, bolted, motion, out, as_json, quiet)
        elif name is not None:
            from impactopt.files.problem_file.reference import problem_template

            _give(problem_template(name), out, as_json)
        elif out is not None:
            raise typer.BadParameter("name what to write: NAME, --urdf or --mjcf", param_hint="--out")
        else:
            problems(as_json)


def _draft(
    given: str, mjcf: bool, bolted: bool, motion: Motion | None, out: Path | None, as_json: bool, quiet: bool
) -> None:
    from rich.console import Console

    from impactopt.errors import printable
    from impactopt.files.draft.drafting import draft_problem
    from impactopt.files.draft.robot import find_description
    from impactopt.report.console import SolveConsole

    path = Path(given) if mjcf else find_description(given)
    folder = Path() if out is None else out.parent
    with SolveConsole(Console(stderr=True), quiet=quiet) as progress:
        draft = draft_problem(
            path, folder=folder, mjcf=mjcf, bolted=bolted, motion=motion, report=progress.say
        )
    _give(draft.text, out, as_json)
    for line in draft.said:
        typer.echo(printable(line), err=True)
    if out is not None:
        file = shlex.quote(str(out))
        typer.echo(printable(f"next: impactopt check {file}; then impactopt solve {file}"), err=True)


def _check_free(out: Path | None) -> None:
    """InputError if there is a file already."""
    from impactopt.errors import InputError

    if out is not None and out.exists():
        raise InputError(f"there is a file {out} already; give another --out, or delete it")


def _give(text: str, out: Path | None, as_json: bool = False) -> None:
    """Prints a file's text, or writes it to a new file; as JSON also its data."""
    from impactopt.files.output import write_file
    from impactopt.files.toml import read_toml

    if out is not None:
        _check_free(out)
        write_file(out, lambda file: file.write(text.encode()))
    if as_json:
        path = None if out is None else str(out)
        print_json({"file": path, "toml": text, "data": read_toml(text)}, True)
    elif out is None:
        typer.echo(text, nl=False)


def problems(as_json: AsJson = False) -> None:
    """List the problems that come with the package: `impactopt solve NAME`."""
    with plain_errors("interrupted", as_json=as_json):
        from impactopt.files.named_problems import problem_file, problem_names, problem_summary

        found = {name: problem_summary(name) for name in problem_names()}
        if as_json:
            rows = [{"name": n, "about": about, "file": str(problem_file(n))} for n, about in found.items()]
            print_json({"problems": rows}, True)
            return
        for name, about in found.items():
            typer.echo(f"{name:<{max(map(len, found))}}  {about}")


def robots(as_json: AsJson = False) -> None:
    """List the robots that problem files can name, with their strikers, soles and postures."""
    with plain_errors("interrupted", as_json=as_json):
        from impactopt.errors import InputError
        from impactopt.robots.presets import robot_names

        rows: list[dict[str, Any]] = []
        for name in robot_names():
            try:
                rows.append(_robot(name))
            except InputError as error:
                rows.append({"name": name, "error": str(error)})
        ok = not any("error" in row for row in rows)
        if as_json:
            print_json({"robots": rows}, ok)
            raise typer.Exit(0 if ok else BAD_INPUT)
        for row in rows:
            if "error" in row:
                typer.echo(f"{row['name']}: {row['error']}")
                continue
            typer.echo(f"{row['name']}: {row['joints']} joints, {row['mass_kg']:.0f} kg")
            for kind in ("strikers", "soles", "postures"):
                if row[kind]:
                    typer.echo(f"  {kind:<9} {', '.join(row[kind])}")
        if not ok:
            raise typer.Exit(BAD_INPUT)


def _robot(name: str) -> dict[str, Any]:
    from impactopt.robots.presets import load_robot

    robot = load_robot(name)
    return {
        "name": name,
        "joints": robot.n,
        "mass_kg": sum(float(body.mass) for body in robot.model.inertias),
        "strikers": list(robot.strikers),
        "soles": [sole.name for sole in robot.soles],
        "postures": list(robot.postures),
    }
