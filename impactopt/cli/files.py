"""The commands about problem files and what they can name: `check`, `new`, `problems`, `robots`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from impactopt.cli.options import ProblemPath, Settings, Verbose, complete_problem
from impactopt.report.plain_errors import BAD_INPUT, plain_errors

if TYPE_CHECKING:
    from impactopt.robots.robot import Robot

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def check(
    file: ProblemPath, settings: Settings = None, as_json: AsJson = False, verbose: Verbose = False
) -> None:
    """Say whether a problem file is sound and its target within reach; else every mistake, and its mend.

    With --json {"sound", "file", "hash", "problem"}, or {"sound", "file", "mistakes"}. Exit code: 0 sound, 2
    not.
    """
    with plain_errors("interrupted", verbose=verbose):
        from impactopt.errors import InputError, printable
        from impactopt.files.problem_file import parse_settings, read_problem_file

        try:
            problem = read_problem_file(file, parse_settings(settings or ())).build()
        except InputError as error:
            if not as_json:
                raise
            first, *rest = str(error).splitlines()
            found = {"sound": False, "file": str(file), "mistakes": [m.strip() for m in rest] or [first]}
            typer.echo(json.dumps(found, indent=2))
            raise typer.Exit(BAD_INPUT) from None
        if as_json:
            found = {"sound": True, "file": str(file), "hash": problem.hash, "problem": problem.describe()}
            typer.echo(json.dumps(found, indent=2))
            return
        typer.echo(printable(f"{file} is sound:"))
        plain = {"target": _with_units(problem.target), "law": _with_units(problem.law)}
        for name, value in (problem.describe() | plain).items():
            typer.echo(printable(f"  {name:<10} {_in_words(value)}"))
        if lost := _lost_meshes(problem.robot):
            typer.echo(printable(f"  {'meshes':<10} {lost}"))


def _lost_meshes(robot: Robot) -> str:
    """Which meshes of a robot are nowhere, and what that means; "" if all are there."""
    from impactopt.bodies.urdf import lost_meshes, urdf_root

    root = None if robot.urdf is None else urdf_root(Path(robot.urdf))
    found = {} if root is None or robot.urdf is None else lost_meshes(robot.model, root, Path(robot.urdf))
    names = sorted({name for several in found.values() for name in several})
    if not names:
        return ""
    return (
        f"{len(names)} are not found, such as {names[0]}: boxes of inertia stand for links without any; put "
        "them into a folder above the URDF, or name the folder of their package in ROS_PACKAGE_PATH"
    )


def _with_units(thing: Any) -> str:
    """`SpringDamper, stiffness 10000 N/m, damping 300 N s/m` of a law or target."""
    from impactopt.contact.fields import abouts

    numbers = [(field.name, getattr(thing, field.name), told.unit) for field, told in abouts(type(thing))]
    parts = [f"{name} {value:g} {unit}".rstrip() for name, value, unit in numbers if isinstance(value, float)]
    return ", ".join([type(thing).__name__, *parts]) if parts else repr(thing)


def _in_words(value: Any) -> str:
    """A value of `ImpactProblem.describe` as a person writes it."""
    if isinstance(value, list):
        return ("; " if value and isinstance(value[0], str) else ", ").join(_in_words(one) for one in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def new(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="Name of the problem to start from.", autocompletion=complete_problem
        ),
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Print all sections and keys instead, as Markdown.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print a problem file to start from, with a comment to each key; without a name, list the problems.

    Keys that the problem leaves out stand there as comments with their defaults. --json is for the list.
    """
    if reference:
        with plain_errors("interrupted"):
            from impactopt.files.problem_file.reference import reference as page

            typer.echo(page(), nl=False)
    elif name is None:
        problems(as_json)
    else:
        with plain_errors("interrupted"):
            from impactopt.files.problem_file.template import problem_template

            typer.echo(problem_template(name), nl=False)


def problems(as_json: AsJson = False) -> None:
    """List the problems that come with the package: `impactopt solve NAME`."""
    with plain_errors("interrupted"):
        from impactopt.files.problem_file.names import problem_file, problem_names, problem_summary

        found = {name: problem_summary(name) for name in problem_names()}
        if as_json:
            rows = [{"name": n, "about": about, "file": str(problem_file(n))} for n, about in found.items()]
            typer.echo(json.dumps(rows, indent=2))
            return
        for name, about in found.items():
            typer.echo(f"{name:<{max(map(len, found))}}  {about}")


def robots(as_json: AsJson = False) -> None:
    """List the robots that problem files can name, with their strikers, soles and postures."""
    with plain_errors("interrupted"):
        from impactopt.errors import InputError
        from impactopt.robots.presets import robot_names

        rows: list[dict[str, Any]] = []
        for name in robot_names():
            try:
                rows.append(_robot(name))
            except InputError as error:
                rows.append({"name": name, "error": str(error)})
        if as_json:
            typer.echo(json.dumps(rows, indent=2))
            return
        for row in rows:
            if "error" in row:
                typer.echo(f"{row['name']}: {row['error']}")
                continue
            typer.echo(f"{row['name']}: {row['joints']} joints, {row['mass_kg']:.0f} kg")
            for kind in ("strikers", "soles", "postures"):
                if row[kind]:
                    typer.echo(f"  {kind:<9} {', '.join(row[kind])}")


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
