"""Command `impactopt validate`: replay of a result, as planned or with perturbations."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

import typer

from impactopt.cli.command import (
    NO,
    AsJson,
    OtherProblem,
    Quiet,
    ResultPath,
    Settings,
    Verbose,
    out_option,
    plain_errors,
    print_json,
)


def validate(
    context: typer.Context,
    result: ResultPath,
    engine: Annotated[
        Literal["mujoco", "pinocchio"],
        typer.Option(help="mujoco: free robot, soles can slip and lift; pinocchio: fixed soles."),
    ] = "mujoco",
    out: Annotated[Path | None, out_option("Write replay.json and replay.png there.")] = None,
    animation: Annotated[
        Path | None, typer.Option(metavar="FILE.gif", help="Draw the robot's motion, slow around contact.")
    ] = None,
    controller: Annotated[
        Literal["servo", "wbc"],
        typer.Option(
            help="servo: PD control of the joints; wbc: whole-body controller, set up by the problem file."
        ),
    ] = "servo",
    contact: Annotated[
        Literal["point", "link"],
        typer.Option(
            help="link: the striking link's hull meets the target's body; point: its striking point."
        ),
    ] = "point",
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    problem: OtherProblem = None,
    step: Annotated[float | None, typer.Option(metavar="S", help="Step of the simulation.")] = None,
    settle: Annotated[
        float | None, typer.Option(metavar="S", help="Time that is simulated after the motion's end.")
    ] = None,
    mass: Annotated[float, typer.Option(help="Mass of the target, as a factor of the planned one.")] = 1.0,
    stiffness: Annotated[float, typer.Option(help="Stiffness of the contact, as a factor.")] = 1.0,
    damping: Annotated[float, typer.Option(help="Damping of the contact, as a factor.")] = 1.0,
    distance: Annotated[
        float, typer.Option(metavar="M", help="Offset of the target, away from the robot; < 0: nearer.")
    ] = 0.0,
    missing: Annotated[bool, typer.Option("--missing", help="Replay without the target.")] = False,
    payload: Annotated[float, typer.Option(metavar="KG", help="Unplanned mass at the striking point.")] = 0.0,
    friction: Annotated[float, typer.Option(help="Friction coefficient between soles and floor.")] = 0.9,
    floor_time: Annotated[
        float,
        typer.Option(metavar="S", help="Time constant of the contact of floor and soles: their softness."),
    ] = 2e-3,
    kp: Annotated[float, typer.Option(help="Stiffness of the servo, as a factor.")] = 1.0,
    kd: Annotated[float, typer.Option(help="Damping of the servo, as a factor.")] = 1.0,
    torque_limit: Annotated[float, typer.Option(help="Torque limits of the joints, as a factor.")] = 1.0,
    period: Annotated[
        float, typer.Option(metavar="S", help="Sampling period of the servo; 0: every step.")
    ] = 0.0,
    delay: Annotated[
        float, typer.Option(metavar="S", help="Delay from reading joints to setting torques.")
    ] = 0.0,
    push: Annotated[float, typer.Option(metavar="N", help="Level push on the base.")] = 0.0,
    push_start: Annotated[float, typer.Option(metavar="S", help="Start of the push.")] = 0.0,
    push_time: Annotated[float, typer.Option(metavar="S", help="Duration of the push.")] = 0.1,
    push_way: Annotated[
        float, typer.Option(metavar="RAD", help="Direction of the push: angle from x, to the left.")
    ] = 0.0,
) -> None:
    """Replay a result on free soles, as planned or with perturbations: does the robot stand?

    Exit code: 0 stands (or the engine fixes the soles), 1 fell, 2 bad input.
    """
    with plain_errors("interrupted before the replay was done", verbose=verbose, as_json=as_json) as stderr:
        from impactopt.files.output import (
            check_directory,
            check_ending,
            make_directory,
            remove_file,
            write_file,
        )
        from impactopt.files.problem_file import parse_settings
        from impactopt.files.replay import load_planned, replay
        from impactopt.report.console import SolveConsole
        from impactopt.simulation import Perturbation

        # an option for each of its fields
        world = Perturbation(**{field.name: context.params[field.name] for field in fields(Perturbation)})
        directory = None if out is None else check_directory(out)
        if animation is not None:
            check_ending("an animation is a GIF", animation, ".gif")
            check_directory(animation.parent)
        options = {name: value for name, value in (("step", step), ("settle", settle)) if value is not None}
        changes, written = parse_settings(settings or ()), []
        with SolveConsole(stderr, quiet=quiet, verbose=verbose) as progress:
            planned = load_planned(result, problem_file=problem, settings=changes)
            progress.say(f"{result} is read; replaying it in {engine}")
            done = replay(
                planned, engine=engine, perturbation=world, controller=controller, contact=contact, **options
            )
            ok = done.report["standing"] is not False
            if directory is not None:
                from impactopt.report.pictures import save_pictures

                text = f"{json.dumps({'ok': ok, **done.report}, indent=2)}\n".encode()
                written.append(make_directory(directory) / "replay.json")
                old_picture = directory / "replay.png"  # of an earlier replay
                write_file(written[0], lambda file: file.write(text), before=lambda: remove_file(old_picture))
                written += save_pictures(done.record, directory, ["replay"])
            if animation is not None:
                progress.say("drawing the motion")
                from impactopt.report.pictures.animation import save_animation

                make_directory(animation.parent)
                written.append(save_animation(done, animation))
        other = ""
        if planned.of_other_problem:
            given = f"{problem}{' with --set' if changes else ''}"
            other = f"{given} is not the problem of this plan: it is replayed with its robot, target and law"
        if as_json:
            print_json(done.report | ({"caution": other} if other else {}), ok)
        else:
            from impactopt.report.console import (
                output,
                reason_message,
                replay_table,
                replayed_touches_message,
                say,
                touch_message,
            )

            console, summary = output(), planned.record.summary
            console.print(replay_table(done.report, summary))
            hit = world.missing or done.report["impulse_error_pct"] is not None
            other = f"caution: {other}" if other else ""
            say(console, other, reason_message(summary), "" if hit else "the target is not hit")
            caution = done.record.summary.get("gear_caution")
            say(console, replayed_touches_message(done.report), caution, touch_message(done.report), *written)
        if not ok:
            raise typer.Exit(NO)
