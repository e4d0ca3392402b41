"""Command line application: the command `impactopt solve`, and the registration of all others.

Heavy packages (Pinocchio, CasADi, matplotlib) are imported in the commands that need them, so that `--help`
is quick. Exit codes: 0 done; 1 the answer is no: not solved, fallen in a replay, no such collision; 2 bad
input; 70 a fault of ours; 130 Ctrl-C.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from impactopt.cli.collide import collide
from impactopt.cli.command import (
    NO,
    AsJson,
    PlainCommand,
    PlainGroup,
    ProblemPath,
    Quiet,
    Seed,
    Settings,
    SolverName,
    Starts,
    TimeLimit,
    Verbose,
    Workers,
    command_line,
    out_option,
    plain_errors,
    print_json,
)
from impactopt.cli.compare import compare
from impactopt.cli.drive import drive
from impactopt.cli.export import export
from impactopt.cli.files import check, new, problems, robots
from impactopt.cli.identify import identify
from impactopt.cli.show import show
from impactopt.cli.strike import strike
from impactopt.cli.sweep import sweep
from impactopt.cli.validate import validate
from impactopt.cli.verify import verify

if TYPE_CHECKING:
    from impactopt.files.record import Record

app = typer.Typer(
    name="impactopt",
    cls=PlainGroup,
    help="Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done; 1 the answer is no: not solved, fallen, no such collision; 2 bad input; 70 a "
    "fault of impactopt; 130 Ctrl-C. Each command's own help has examples; docs/command_line.md has more.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Entry point of the command `impactopt`."""
    app()


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        from impactopt import __version__

        typer.echo(__version__)
        raise typer.Exit


def solve(
    context: typer.Context,
    file: ProblemPath,
    out: Annotated[Path | None, out_option("Where results go (default: results/NAME).")] = None,
    solver: SolverName = None,
    start: Annotated[
        Literal["reach", "strike"],
        typer.Option(help="Initial guess: a plain reach, or the hardest strike near it."),
    ] = "reach",
    starts: Starts = 1,
    workers: Workers = 1,
    seed: Seed = 0,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Warm start from the nearest plan stored there; store this one too."
        ),
    ] = None,
    time_limit: TimeLimit = None,
    settings: Settings = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    validate: Annotated[bool, typer.Option(help="Replay the plan in full dynamics.")] = True,
    baseline: Annotated[
        bool,
        typer.Option(
            "--baseline",
            help="Also find the hardest minimum-jerk reach, with the ZMP up to the soles' edges.",
        ),
    ] = False,
) -> None:
    """Plan the motion of a problem, replay it in full dynamics, write numbers and pictures.

    Ctrl-C, or SIGTERM, stops the solver; its best iterate is kept. A failed result goes to DIR/failed if
    there is a good one in DIR. Exit code: 0 solved, 1 not solved, 2 bad input.
    """
    interrupted = "interrupted before there was a plan to keep"
    with plain_errors(interrupted, verbose=verbose, keeps=True, as_json=as_json) as console:
        from impactopt.cli.replays import compared_record
        from impactopt.errors import printable
        from impactopt.files.output import check_directory, keep_record, set_aside
        from impactopt.files.problem_file import parse_settings, read_problem_file
        from impactopt.files.solution_library import SolvedFolder
        from impactopt.planning.solve import solve as plan
        from impactopt.report.console import SolveConsole

        read = read_problem_file(file, parse_settings(settings or ()))
        chosen = read.solver.arguments(solver, time_limit)
        with SolveConsole(console, quiet=quiet, verbose=verbose) as progress:
            progress.say(f"{read.path} is read; building the robot")
            problem = read.build()
            directory = check_directory(out if out is not None else Path("results") / file.stem)
            progress.say("building the nonlinear program (compiles for some ten seconds the first time)")
            processes = workers if starts > 1 else 1
            chosen |= {"start": start, "starts": starts, "workers": processes, "seed": seed}
            chosen |= {"report": progress.say, "callback": progress.iteration if processes == 1 else None}
            if store is None:
                solution = plan(problem, **chosen)
            else:
                kept = SolvedFolder(check_directory(store))
                solution, near = kept.solve(problem, read, **chosen)
                kept.keep(solution, read)
                progress.say(f"warm start from {near}" if near else f"no plan in {store} is near enough")
            progress.say(f"after {solution.result.iterations} iterations: {solution.status.message}")
            if solution.caution:
                progress.say(solution.caution)
            record = compared_record(
                solution, read, progress, validate=validate, baseline=baseline, workers=workers
            )
            record.summary.update(command=command_line(context), ok=solution.status.usable)
            written = [*keep_record(record, directory)]
        _show(record, as_json, solution.status.usable)
        from impactopt.report.pictures import save_pictures  # loads matplotlib

        with progress:
            progress.say("drawing pictures")
            written += save_pictures(record, written[0].parent)
        if not as_json:
            names = ", ".join(path.name for path in written)
            typer.echo(printable(f"{written[0].parent}: {names}"))
            if aside := set_aside(record.summary):
                typer.echo(printable(aside))
        if not solution.status.usable:
            raise typer.Exit(NO)


# in the order of the help
COMMANDS = (
    *(solve, strike, collide, validate, verify, show, compare, export, identify, drive, sweep, new, check),
    *(problems, robots),
)
# for the end of the help of the command that each line names
EXAMPLES = """
impactopt solve punch --out results/punch
impactopt solve my.toml --set target.mass=8 --set swing.duration=[0.6,0.9]
impactopt solve punch --start strike --starts 4 --json --quiet
impactopt strike punch --starts 8
impactopt strike my.toml --json --out results/s
impactopt collide punch --speed 0.5
impactopt collide punch --speed 0.5 --set target.mass=20 --model full --json
impactopt collide results/punch
impactopt validate results/punch
impactopt validate results/punch --missing --json
impactopt validate results/punch --animation punch.gif
impactopt verify results/punch
impactopt verify results/punch --json
impactopt show results/punch --open
impactopt show talos --open
impactopt show results/punch --live --port 8080
impactopt show my.toml --live
impactopt compare results/punch results/punch_robust
impactopt compare results/a results/b results/c --out results/compared --json
impactopt export results/punch --to csv
impactopt export results/punch --to ros2 --rate 200 --out goals
impactopt export results/punch --to mujoco
impactopt identify blow.csv
impactopt identify blows.npz --target-mass 2 --out contact.toml
impactopt identify joints.csv --problem arm7 --law Hunt-Crossley --json
impactopt drive arm7 --depth 0.05
impactopt sweep my.toml --out results/s
impactopt sweep collision_target --out results/t
impactopt new
impactopt new punch > my.toml
impactopt new --reference
impactopt check my.toml
impactopt check punch --set problem.point.0=0.7
impactopt problems --json
impactopt robots --json
""".strip().splitlines()

for _command in COMMANDS:
    # typer keeps the line breaks of a docstring beside those that fit the terminal
    _paragraphs = inspect.cleandoc(str(_command.__doc__)).split("\n\n")
    _examples = [f"  {line}" for line in EXAMPLES if line.split()[1] == _command.__name__]
    app.command(
        cls=PlainCommand,
        help="\n\n".join(text.replace("\n", " ") for text in _paragraphs),
        epilog="\n\n".join(["Examples:", *_examples]),
    )(_command)


def _show(record: Record, as_json: bool, ok: bool) -> None:
    if as_json:
        print_json(record.summary, ok)
        return
    from impactopt.report.console import output, result_table, say, say_outcome

    console, summary = output(), record.summary
    if record.completed:
        console.print(result_table(summary))
    reach = summary.get("baseline", {})
    if "impulse_Ns" in reach:
        say(
            console,
            f"hardest minimum-jerk reach: {reach['impulse_Ns']:.2f} N s at "
            f"{reach['hand_speed_m_s']:.2f} m/s (simulated)",
        )
    say_outcome(console, summary)


if __name__ == "__main__":
    main()
