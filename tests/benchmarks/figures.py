"""`python -m benchmarks.figures [NAME ...]`: the figures of docs/ and README, each by its name.

Exit codes: 0 done, 2 bad input.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from benchmarks.report import Say
from impactopt.cli.command import plain_errors

if TYPE_CHECKING:
    from impactopt.report.pictures.style import Picture

# file name without .png: what makes it, and of what
FIGURES: dict[str, tuple[str, str]] = {
    "overview": ("plot", "punch"),
    "strobe": ("plot", "punch"),
    "force": ("plot", "punch"),
    "zmp": ("plot", "punch"),
    "torque": ("plot", "punch"),
    "motion": ("plot", "punch"),
    "ellipsoid": ("plot", "punch"),
    "iterations": ("plot", "punch"),
    "replay": ("plot", "punch"),
    "sheet_punch": ("sheet", "punch"),
    "sheet_kick_talos": ("sheet", "kick_talos"),
    "sheet_punch_step": ("sheet", "punch_step"),
    "sheet_nailing": ("sheet", "nailing"),
    "fig3": ("reproduce", "fig3"),
    "fig4": ("reproduce", "fig4"),
    "fig7": ("reproduce", "fig7"),
    "margins": ("bench", "margins"),
    "feedback": ("bench", "feedback"),
    "fidelity": ("bench", "fidelity"),
    "virtual_base": ("bench", "virtual-base"),
    "collision": ("bench", "collision"),
    "scaling": ("bench", "scaling"),
    "gains": ("bench", "gains"),
    "machine": ("bench", "machine"),
    "softness": ("bench", "softness"),
    "skip": ("bench", "skip"),
    "sweep_posture_speed": ("sweep", "collision_posture_speed"),
    "sweep_gains": ("sweep", "collision_gains"),
    "sweep_fidelity": ("sweep", "collision_fidelity"),
}
FOLDER = Path("docs/figures")
DEAR = ("bench", "sweep")  # what takes minutes is made when it is named


app = typer.Typer(name="figures")


@app.command()
def figures(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...", help="Figures; all but the benchmarks' and the sweeps' if left out."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Directory for them.")] = FOLDER,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """The figures of the documentation, made anew.

    Exit code: 0 done, 2 bad input.
    """
    with plain_errors("interrupted before all figures were made") as console:
        from impactopt.files.output import make_directory, write_file
        from impactopt.report.console import SolveConsole

        wanted = chosen(names or [name for name, (how, _) in FIGURES.items() if how not in DEAR])
        directory = make_directory(out)
        with SolveConsole(console, quiet=quiet) as progress:
            for name, picture in drawn(wanted, progress.say):
                write_file(directory / f"{name}.png", picture.write)
                progress.say(f"{directory / name}.png")


def chosen(names: Iterable[str]) -> list[str]:
    """The names in the order of FIGURES, so that what has one source is together.

    Raises
    ------
    InputError : there is no figure of that name.
    """
    from impactopt.errors import InputError, did_you_mean

    for name in (names := set(names)):
        if name not in FIGURES:
            raise InputError(
                f"there is no figure {name!r}{did_you_mean(name, FIGURES)}: {', '.join(FIGURES)}"
            )
    return [name for name in FIGURES if name in names]


def drawn(names: Iterable[str], say: Say) -> Iterator[tuple[str, Picture]]:
    """Each figure by its name."""
    for (how, source), group in groupby(names, key=FIGURES.__getitem__):
        say(f"{how} {source}")
        makers = _MAKERS[how](source, say)
        yield from ((name, makers(name)) for name in group)


Maker = Callable[[str], Any]


def _plot(problem: str, say: Say) -> Maker:
    """Pictures of a problem's plan beside its replays."""
    from impactopt.files.output import record_of
    from impactopt.files.problem_file import load_problem
    from impactopt.planning.solve import solve
    from impactopt.report.pictures import PICTURES, overview

    solution = solve(load_problem(problem), report=say)
    say("replaying the plan, on held and on free soles")
    free = solution.validate(engine="mujoco")
    record = record_of(solution, simulation=solution.validate(), replay=free)
    return lambda name: {"overview": overview, **PICTURES}[name](record)


def _sheet(problem: str, say: Say) -> Maker:
    """A problem's planned motion from three sides."""
    from impactopt.files.output import record_of
    from impactopt.files.problem_file import load_problem
    from impactopt.planning.solve import solve
    from impactopt.report.pictures.sheet import sheet

    solution = solve(load_problem(problem), report=say)
    return lambda _: sheet(record_of(solution), solution.problem)


def _reproduce(name: str, say: Say) -> Maker:
    from benchmarks.registry import reproduce

    made = reproduce(name, say).figures
    return lambda figure: made[figure]()


def _bench(name: str, say: Say) -> Maker:
    from benchmarks.registry import run_bench

    made = run_bench(name, say).figures
    return lambda figure: made[figure]()


def _sweep(name: str, say: Say) -> Maker:
    """Of a sweep that comes with the package."""
    from impactopt.report.pictures.sweep import drawn_table
    from impactopt.sweeps import read_sweep_file, sweep

    chosen = read_sweep_file(name)
    assert chosen.figure is not None  # for mypy: those that are named here have one
    with TemporaryDirectory() as place:
        picture = drawn_table(chosen.figure, sweep(chosen, place, report=say).table)
    return lambda figure: picture


_MAKERS: dict[str, Callable[[str, Say], Maker]] = {
    "plot": _plot,
    "sheet": _sheet,
    "reproduce": _reproduce,
    "bench": _bench,
    "sweep": _sweep,
}


if __name__ == "__main__":
    app()
