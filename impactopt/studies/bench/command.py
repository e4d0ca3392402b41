"""`impactopt bench NAME`: one command a bench.

Exit codes: 0 done, 2 bad input, or nothing to measure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from impactopt.studies.bench.report import Report, Say
from impactopt.studies.bench.running import show_reports

app = typer.Typer(
    name="bench",
    help="Measure plans and replays: is it true, does it stand, how exact is the replay?",
    no_args_is_help=True,
)

Json = Annotated[bool, typer.Option("--json", help="Print the numbers as JSON, no tables.")]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="DIR", help="Keep numbers and pictures there.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Draws = Annotated[int, typer.Option(min=1, help="Replays under drawn conditions.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the draws.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that replay.")]
FEW_DRAWS = 10  # of the bench margins among all others, which has a dozen plans to replay
FEW_PROBLEMS = 9  # of the bench zoo among all others


@app.command()
def truth(as_json: Json = False, out: Out = None, quiet: Quiet = False) -> None:
    """Every problem of problems/ and variants of the demo: planned, replayed on held and on free soles."""
    _run(["truth"], {}, as_json, out, quiet)


@app.command()
def robustness(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Problem file (default: problems/punch_robust.toml)."),
    ] = None,
    draws: Draws = 200,
    seed: Seed = 0,
    workers: Workers = 2,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """How often a plan stands, and how hard it hits, where target, servo and floor are not as planned."""
    options = {"file": file, "draws": draws, "seed": seed, "workers": workers}
    _run(["robustness"], {"robustness": options}, as_json, out, quiet)


@app.command()
def replay(as_json: Json = False, out: Out = None, quiet: Quiet = False) -> None:
    """The replay's own error: the demo's plan with other steps, solver settings and floors."""
    _run(["replay"], {}, as_json, out, quiet)


@app.command()
def baselines(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Problem file.")] = Path("problems/punch.toml"),
    draws: Draws = 50,
    seed: Seed = 0,
    workers: Workers = 2,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """What people do today, on the same robot and in the same limits, beside our plans."""
    options = {"file": file, "draws": draws, "seed": seed, "workers": workers}
    _run(["baselines"], {"baselines": options}, as_json, out, quiet)


@app.command()
def margins(
    draws: Draws = 40,
    seed: Seed = 0,
    workers: Workers = 2,
    few: Annotated[bool, typer.Option("--quick", help="Fewer values of each option.")] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """What planning with margin costs in impulse, and what it buys in robustness, one option at a time."""
    options = {"draws": draws, "seed": seed, "workers": workers, "quick": few}
    _run(["margins"], {"margins": options}, as_json, out, quiet)


@app.command()
def fidelity(
    workers: Annotated[int, typer.Option(min=1, help="Processes that compile and collide.")] = 2,
    few: Annotated[
        bool, typer.Option("--quick", help="Three collisions of the stand-in, up to four freezes.")
    ] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """How far each collision model is from full dynamics: 27 collisions on each of three robots."""
    _run(["fidelity"], {"fidelity": {"workers": workers, "quick": few}}, as_json, out, quiet)


@app.command()
def freezes(
    count: Annotated[int, typer.Option(min=1, help="Collisions that end, on each of three robots.")] = 10,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that compile and collide.")] = 2,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """What freezing costs in drawn collisions, over contact time, and whether its estimate holds."""
    options = {"count": count, "seed": seed, "workers": workers}
    _run(["freezes"], {"freezes": options}, as_json, out, quiet)


@app.command("virtual-base")
def virtual_base(as_json: Json = False, out: Out = None, quiet: Quiet = False) -> None:
    """The paper's mass M_g under the soles against soles held exactly: its error, and rounding's."""
    _run(["virtual-base"], {}, as_json, out, quiet)


@app.command()
def stability(
    seed: Seed = 0,
    workers: Workers = 2,
    few: Annotated[bool, typer.Option("--quick", help="A tenth of the cases, small robots only.")] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Collisions at the edges of what numbers can hold: is each right, or refused with a reason?"""
    options = {"quick": few, "seed": seed, "workers": workers}
    _run(["stability"], {"stability": options}, as_json, out, quiet)


@app.command()
def attack(
    context: typer.Context,
    seed: Seed = 0,
    workers: Annotated[
        int, typer.Option(min=1, help="Processes; with 1 a case that hangs is not given up.")
    ] = 2,
    few: Annotated[bool, typer.Option("--quick", help="Some hundred cases, a minute.")] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Files, URDFs, commands and calls with something wrong; collisions by an equation of their own."""
    options = {"quick": few, "seed": seed, "workers": workers, "program": context.obj}
    _run(["attack"], {"attack": options}, as_json, out, quiet)


@app.command()
def collision(
    few: Annotated[bool, typer.Option("--quick", help="The stand-in only, with few settings.")] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Run time of a collision against its error: ours, the paper's, Pinocchio, MuJoCo, CVODES."""
    _run(["collision"], {"collision": {"quick": few}}, as_json, out, quiet)


@app.command()
def scaling(
    workers: Annotated[int, typer.Option(min=1, help="Processes that compile.")] = 2,
    few: Annotated[bool, typer.Option("--quick", help="Up to 32 joints, and one humanoid.")] = False,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """What a collision costs over degrees of freedom, over the step, and over the size of a batch."""
    _run(["scaling"], {"scaling": {"workers": workers, "quick": few}}, as_json, out, quiet)


@app.command()
def skip(as_json: Json = False, out: Out = None, quiet: Quiet = False) -> None:
    """What leaving out what a scene does not need saves, one thing at a time."""
    _run(["skip"], {}, as_json, out, quiet)


@app.command()
def solve(
    problem: Annotated[
        str | None, typer.Option("--problem", metavar="NAME", help="One problem, or its file (default: all).")
    ] = None,
    starts: Annotated[int, typer.Option(min=1, help="Starts: the plain one, and perturbed ones.")] = 3,
    time_limit: Annotated[float, typer.Option(min=0.1, help="Of one solve [s].")] = 60.0,
    solver: Annotated[
        list[str] | None,
        typer.Option("--solver", metavar="NAME", help="One solver, as ipopt or sqp:piqp; may be repeated."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Take up what results/bench/solve.jsonl has.")
    ] = False,
    few: Annotated[bool, typer.Option("--quick", help="One start, our default solver and IPOPT.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Which solver solves which problem, how reliably and how fast: ours, IPOPT, CasADi's, SciPy's."""
    options = {
        "problem": problem,
        "starts": starts,
        "time_limit": time_limit,
        "solvers": tuple(solver or ()),
        "resume": resume,
        "quick": few,
        "seed": seed,
    }
    _run(["solve"], {"solve": options}, as_json, out, quiet)


@app.command()
def zoo(
    random: Annotated[
        int | None,
        typer.Option("--random", min=1, metavar="N", help="Draw N problems (default: those of problems/)."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="NAME", help="Problems of this robot only, as talos.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Take up what results/bench/zoo.jsonl has.")
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Problems that nobody has tuned, drawn at random: solved from one start, do they stand on free soles?"""
    options = {"random": random, "robot": robot, "resume": resume, "seed": seed}
    _run(["zoo"], {"zoo": options}, as_json, out, quiet)


@app.command("all")
def run_all(
    context: typer.Context,
    draws: Annotated[int, typer.Option(min=1, help="Of the bench robustness.")] = 200,
    seed: Seed = 0,
    workers: Workers = 2,
    as_json: Json = False,
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Every bench, one after the other; the JSON has each under its name."""
    from impactopt.studies.bench.registry import BENCHES

    drawn = {"seed": seed, "workers": workers}
    options: dict[str, dict[str, Any]] = {
        "robustness": {"draws": draws, **drawn},
        "baselines": drawn,
        "margins": {"draws": min(draws, FEW_DRAWS), "quick": True, **drawn},
        "fidelity": {"workers": workers, "quick": True},
        "freezes": drawn,
        "collision": {"quick": True},
        "scaling": {"workers": workers, "quick": True},
        "stability": {"quick": True, **drawn},
        "attack": {"quick": True, "program": context.obj, **drawn},
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
        from impactopt.studies.bench.registry import run_bench

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
