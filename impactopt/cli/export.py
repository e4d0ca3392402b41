"""Command `impactopt export`: a saved plan as files for other programs."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from impactopt.cli.command import AsJson, OtherProblem, ResultPath, out_option, plain_errors, print_json

# commands that use the files, printed after writing them
NEXT = {
    "ros2": "ros2 action send_goal --stdin /joint_trajectory_controller/follow_joint_trajectory "
    "control_msgs/action/FollowJointTrajectory < {directory}/motion.yaml",
    "mujoco": "python {directory}/play.py",
}
Target = Literal["csv", "ros2", "mcap", "mujoco", "mjlab"]


def export(
    result: ResultPath,
    to: Annotated[
        Target,
        typer.Option(
            help="csv: tables; ros2: action goals; mcap: ROS 2 messages; mujoco: a scene and the lines that "
            "play it; mjlab: a motion for policies to track."
        ),
    ],
    out: Annotated[Path | None, out_option("Where the files go (default: RESULT_FORMAT).")] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rows a second (default: 1000; mjlab: 50).")
    ] = None,
    joints: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C", help="Order of the joints, each of the robot's once (default: the robot's own)."
        ),
    ] = None,
    gravity: Annotated[
        bool,
        typer.Option(
            "--gravity/--no-gravity",
            help="Include gravity compensation in effort; leave it out if the controller adds its own.",
        ),
    ] = True,
    smooth: Annotated[
        str | None,
        typer.Option(
            metavar="A,J|terms",
            help="Smooth: the nearest motion with at most A rad/s^2 and J rad/s^3, or with the limits in the "
            "problem's joint_acceleration and joint_jerk, for bolted arms whose controllers refuse more.",
        ),
    ] = None,
    problem: OtherProblem = None,
    as_json: AsJson = False,
) -> None:
    """Write a plan for other programs: reference, feed-forward, gains, contact, abort motion.

    Contents and losses of each format, and how to use it: docs/howto/export.md. An earlier export to the
    same format in DIR is replaced.

    Exit code: 0 written, 2 bad input.
    """
    with plain_errors("interrupted before the files were written", as_json=as_json):
        from impactopt.errors import printable
        from impactopt.files.export import export_planned
        from impactopt.files.replay import load_planned

        planned = load_planned(result, problem_file=problem)
        folder = result if result.is_dir() else result.parent
        parent = folder.parent if folder.name.strip(".") else folder.resolve().parent  # also for "." and ".."
        directory = out if out is not None else parent / f"{folder.resolve().name}_{to}"
        names = None if joints is None else [name.strip() for name in joints.split(",")]
        limits = None if smooth is None else _limits(smooth)
        written = export_planned(
            planned, to, directory, rate=rate, joints=names, gravity=gravity, smooth=limits
        )
        cost = None if limits is None else json.loads(written[0].read_text(encoding="utf-8"))["smooth"]
        caution = None
        if planned.of_other_problem:
            plans = "motion and what is expected are" if limits is None else "motion is"
            caution = (
                f"{problem} is not the problem of this plan: gains, limits, target and contact law in the "
                f"files are of it, the {plans} the plan's"
            )
        if as_json:
            summary = {"to": to, "directory": str(directory), "files": [str(path) for path in written]}
            summary |= {} if caution is None else {"caution": caution}
            print_json(summary | ({} if cost is None else {"smooth": cost}), True)
            return
        for path in written:
            typer.echo(printable(str(path)))
        if caution is not None:
            typer.echo(printable(f"caution: {caution}"))
        if cost is not None:
            meets = f"; it meets other bodies {cost['touches']} times" if cost["touches"] else ""
            if cost["pressing_ms"] >= 1:
                meets = (
                    f", and presses on the target for {cost['pressing_ms']:.0f} ms after the impact, with "
                    f"{cost['pressing_Ns']:.3g} N s{meets}"
                )
            change = 100 * (cost["impulse_Ns"] / cost["planned_impulse_Ns"] - 1)
            typer.echo(
                f"smoothed: {cost['impulse_Ns']:.3g} N s in our replay, {abs(change):.1f} % "
                f"{'less' if change < 0 else 'more'} than the {cost['planned_impulse_Ns']:.3g} planned{meets}"
            )
            if cost["feed_forward_ratio"] > 1:
                typer.echo(
                    f"caution: its feed-forward is up to {cost['feed_forward_ratio']:.3g} times a torque "
                    "limit; give smaller limits, or plan with a smaller fraction in [terms.torque_limit]"
                )
        if to in NEXT:
            typer.echo(printable(NEXT[to].format(directory=shlex.quote(str(directory)))))


def _limits(given: str) -> Literal["terms"] | tuple[float, float]:
    """Acceleration and jerk of `--smooth A,J`."""
    if given == "terms":
        return "terms"
    try:
        acceleration, jerk = (float(word) for word in given.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"{given!r}; give two numbers, such as 15,5000, or terms", param_hint="--smooth"
        ) from None
    return acceleration, jerk
