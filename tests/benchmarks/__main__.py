"""`python -m benchmarks NAME`: one command a bench, with the bench's own options and those of all.

Exit codes: 0 done, 2 bad input, or nothing to measure.
"""

from __future__ import annotations

import enum
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.report import Report, Say
from benchmarks.running import show_reports


class ControllerName(str, enum.Enum):
    """servo: of the joints; wbc: a whole-body controller."""

    servo = "servo"
    wbc = "wbc"


app = typer.Typer(
    name="benchmarks",
    help="Measure plans and replays: is it true, does it stand, how exact is the replay?",
    no_args_is_help=True,
)

Json = Annotated[bool, typer.Option("--json", help="Print the numbers as JSON, no tables.")]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Write numbers and pictures there.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Problems = Annotated[
    list[str] | None,
    typer.Option("--problem", metavar="NAME", help="A problem's name or file; several times for several."),
]
Draws = Annotated[int, typer.Option(min=1, help="Replays under drawn perturbations.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the draws.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that replay.")]
Controller = Annotated[ControllerName, typer.Option(help="What moves the joints in the replay.")]
Compilers = Annotated[int, typer.Option(min=1, help="Processes that compile and collide.")]
FEW_DRAWS = 10  # of the bench margins among all others, which has a dozen plans to replay
FEW_PROBLEMS = 9  # of the bench zoo among all others


def _shown(as_json: Json = False, out: Out = None, quiet: Quiet = False) -> None:
    """What every command takes."""


def _command(name: str) -> Callable[[Callable[..., None]], None]:
    """A command of that name, of a function whose parameters are the bench's options."""

    def register(of: Callable[..., None]) -> None:
        def command(*, as_json: bool, out: Path | None, quiet: bool, **options: Any) -> None:
            _run([name], {name: options}, as_json, out, quiet)

        own, shared = (inspect.signature(f, eval_str=True).parameters.values() for f in (of, _shown))
        command.__signature__ = inspect.Signature([*own, *shared])  # type: ignore[attr-defined]
        command.__doc__ = of.__doc__
        app.command(name)(command)

    return register


@_command("truth")
def _truth(controller: Controller = ControllerName.servo) -> None:
    """Every problem of problems/ and variants of the demo: planned, replayed on held and on free soles."""


@_command("contacts")
def _contacts(
    count: Annotated[int, typer.Option(min=1, help="Number of problems.")] = 200, seed: Seed = 0
) -> None:
    """Solved, and true? Drawn boards, nails and masses on three arms, planned and replayed."""


@_command("robustness")
def _robustness(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Problem file (default: problems/punch_robust.toml)."),
    ] = None,
    draws: Draws = 200,
    seed: Seed = 0,
    workers: Workers = 2,
    controller: Controller = ControllerName.servo,
) -> None:
    """How often a plan stands, and how hard it hits, where target, servo and floor are not as planned."""


@_command("replay")
def _replay() -> None:
    """The replay's own error: the demo's plan with other steps, solver settings and floors."""


@_command("baselines")
def _baselines(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Problem file.")] = Path("problems/punch.toml"),
    draws: Draws = 50,
    seed: Seed = 0,
    workers: Workers = 2,
    controller: Controller = ControllerName.servo,
    crocoddyl: Annotated[
        Path | None,
        typer.Option(metavar="PYTHON", help="Interpreter with crocoddyl: a plan by it, too."),
    ] = None,
) -> None:
    """What people do today, on the same robot and in the same limits, beside our plans."""


@_command("margins")
def _margins(
    draws: Draws = 40,
    seed: Seed = 0,
    workers: Workers = 2,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer values of each option.")] = False,
) -> None:
    """What planning with margin costs in impulse, and what it buys in robustness, one option at a time."""


@_command("feedback")
def _feedback(
    problems: Problems = None,
    draws: Draws = 50,
    seed: Seed = 0,
    workers: Workers = 2,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume from results/bench/feedback.jsonl.")
    ] = False,
) -> None:
    """What feedback is worth to a plan: balance as stated and loosened, with servos and with a controller."""


@_command("gains")
def _gains(
    quick: Annotated[bool, typer.Option("--quick", help="The two arms only.")] = False,
) -> None:
    """From free joints to one rigid body: the impulse of the same blow with stiffer and stiffer servos."""


@_command("machine")
def _machine(
    problems: Problems = None,
    limits: Annotated[
        list[str] | None,
        typer.Option("--limit", metavar="N", help="Of gears over torque limits, or 'none'; for all five."),
    ] = None,
    armatures: Annotated[
        list[float] | None,
        typer.Option("--armature", metavar="FACTOR", help="Times the robot's armature, such as 0.5."),
    ] = None,
) -> None:
    """What gears cost a blow: each problem with gear limits of 3, 2, 1.5 and 1, and without."""


@_command("softness")
def _softness(
    problems: Problems = None,
    joints: Annotated[
        list[str] | None,
        typer.Option("--joint", metavar="NAME", help="Whose stiffness: a name or pattern; may be repeated."),
    ] = None,
    factors: Annotated[
        list[float] | None,
        typer.Option("--factor", metavar="FACTOR", help="On the stiffness, such as 0.5; may be repeated."),
    ] = None,
) -> None:
    """What soft grips and soft gains bring: stiffer and stiffer joints, and what a plan chooses."""


@_command("models")
def _models(
    quick: Annotated[bool, typer.Option("--quick", help="The two arms only.")] = False,
) -> None:
    """Plan time against plan truth: every model of the collision in a push, a hammer's blow, G1, an arm."""


@_command("moved")
def _moved(
    shifts: Annotated[int, typer.Option(min=1, help="Number of shifts of each problem.")] = 200,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="The planar arm only.")] = False,
) -> None:
    """Plans bent for other points, masses and stiffnesses: first order, and polished by the solver."""


@_command("rounding")
def _rounding(
    problems: Problems = None,
    draws: Annotated[int, typer.Option(min=1, help="Runs of each problem.")] = 5,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume from results/bench/rounding.jsonl.")
    ] = False,
    seed: Seed = 0,
) -> None:
    """Does rounding decide which plan comes out? Hit points moved by 1e-10 m."""


@_command("causes")
def _causes(draws: Draws = 26, seed: Seed = 0) -> None:
    """Drawn variants of the arms that ask too much: is there a plan where the message says there is?"""


@_command("fidelity")
def _fidelity(
    workers: Compilers = 2,
    quick: Annotated[
        bool, typer.Option("--quick", help="Three collisions of the stand-in, up to four freezes.")
    ] = False,
) -> None:
    """How far each collision model is from full dynamics: 27 collisions on each of three robots."""


@_command("freezes")
def _freezes(
    count: Annotated[
        int, typer.Option(min=1, help="Number of collisions that end, on each of three robots.")
    ] = 10,
    seed: Seed = 0,
    workers: Compilers = 2,
) -> None:
    """What freezing costs in drawn collisions, over contact time, and whether its estimate holds."""


@_command("virtual-base")
def _virtual_base() -> None:
    """The paper's mass M_g under the soles against soles held exactly: its error, and rounding's."""


@_command("stability")
def _stability(
    seed: Seed = 0,
    workers: Workers = 2,
    quick: Annotated[bool, typer.Option("--quick", help="A tenth of the cases, small robots only.")] = False,
) -> None:
    """Collisions at the edges of what numbers can hold: is each right, or refused with a reason?"""


@_command("attack")
def _attack(
    seed: Seed = 0,
    workers: Annotated[
        int, typer.Option(min=1, help="Processes; with 1 a case that hangs is not given up.")
    ] = 2,
    quick: Annotated[bool, typer.Option("--quick", help="Some hundred cases, a minute.")] = False,
) -> None:
    """Files, URDFs, commands and calls with something wrong; collisions by an equation of their own."""


@_command("collision")
def _collision(
    quick: Annotated[bool, typer.Option("--quick", help="The stand-in only, with few settings.")] = False,
) -> None:
    """Run time of a collision against its error: ours, the paper's, Pinocchio, MuJoCo, CVODES."""


@_command("scaling")
def _scaling(
    workers: Annotated[int, typer.Option(min=1, help="Processes that compile.")] = 2,
    quick: Annotated[bool, typer.Option("--quick", help="Up to 32 joints, and one humanoid.")] = False,
) -> None:
    """What a collision costs over degrees of freedom, over the step, and over the size of a batch."""


@_command("skip")
def _skip() -> None:
    """What leaving out what a scene does not need saves, one thing at a time."""


@_command("solve")
def _solve(
    problem: Annotated[
        str | None, typer.Option("--problem", metavar="NAME", help="A problem's name or file (default: all).")
    ] = None,
    kind: Annotated[
        str, typer.Option(metavar="KIND", help="motion, clear (of bodies), or strike: the blow alone.")
    ] = "motion",
    starts: Annotated[int, typer.Option(min=1, help="Starts: the plain one, and perturbed ones.")] = 3,
    time_limit: Annotated[float, typer.Option(min=0.1, help="Time limit of one solve, in seconds.")] = 60.0,
    solvers: Annotated[
        list[str] | None,
        typer.Option("--solver", metavar="NAME", help="One solver, as ipopt or sqp:osqp; may be repeated."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume from results/bench/solve.jsonl.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="One start, our default solver and IPOPT.")] = False,
    seed: Seed = 0,
) -> None:
    """Which solver solves which problem, how reliably and how fast: ours, IPOPT, Uno, CasADi's, SciPy's."""


@_command("zoo")
def _zoo(
    random: Annotated[
        int | None,
        typer.Option("--random", min=1, metavar="N", help="Draw N problems (default: those of problems/)."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="NAME", help="Problems of this robot only, as talos.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume from results/bench/zoo.jsonl.")] = False,
    seed: Seed = 0,
) -> None:
    """Problems that nobody has tuned, drawn at random: solved from one start, do they stand on free soles?"""


@_command("robots")
def _robots(
    names: Annotated[
        list[str] | None,
        typer.Option("--robot", metavar="NAME", help="One of the robots; several times for several."),
    ] = None,
    targets: Annotated[
        int,
        typer.Option(min=0, metavar="N", help="Compare an arm's motion with the best to N random targets."),
    ] = 0,
    motion: Annotated[
        str | None, typer.Option(metavar="NAME", help="Motion that is drafted, as of `impactopt new`.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume from results/bench/robots.jsonl.")] = False,
    seed: Seed = 0,
) -> None:
    """Robots of example-robot-data, from the file to a plan and its replays without an edit."""


@app.command("all")
def _all(
    draws: Annotated[int, typer.Option(min=1, help="Number of draws, as of the bench robustness.")] = 200,
    seed: Seed = 0,
    workers: Workers = 2,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Every bench, one after the other; the JSON has each under its name."""
    from benchmarks.registry import BENCHES

    drawn = {"seed": seed, "workers": workers}
    options: dict[str, dict[str, Any]] = {
        "contacts": {"count": FEW_PROBLEMS, "seed": seed},
        "robustness": {"draws": draws, **drawn},
        "baselines": drawn,
        "margins": {"draws": min(draws, FEW_DRAWS), "quick": True, **drawn},
        "feedback": {"problems": ["punch"], "draws": min(draws, FEW_DRAWS), **drawn},
        "models": {"quick": True},
        "moved": {"shifts": min(draws, FEW_DRAWS), "quick": True, "seed": seed},
        "causes": {"seed": seed},
        "fidelity": {"workers": workers, "quick": True},
        "freezes": drawn,
        "gains": {"quick": True},
        "machine": {"problems": ["arm_planar", "arm7", "chop_arm"]},
        "softness": {"problems": ["arm7"]},
        "collision": {"quick": True},
        "scaling": {"workers": workers, "quick": True},
        "stability": {"quick": True, **drawn},
        "attack": {"quick": True, **drawn},
        "solve": {"quick": True, "seed": seed},
        "zoo": {"random": FEW_PROBLEMS, "seed": seed},
    }
    _run(list(BENCHES), options, as_json, out, quiet, together=True)


def _run(
    names: list[str],
    options: dict[str, dict[str, Any]],
    as_json: bool,
    out: Path | None,
    quiet: bool,
    *,
    together: bool = False,
) -> None:
    """Run benches by name, show each when it is done; ``options`` by bench."""

    def run(name: str, say: Say) -> Report:
        from benchmarks.registry import run_bench

        return run_bench(name, say, **options.get(name, {}))

    show_reports(
        names,
        run,
        as_json=as_json,
        out=out,
        quiet=quiet,
        together=together,
        interrupted="interrupted before the bench was done",
    )


if __name__ == "__main__":
    app()
