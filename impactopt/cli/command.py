"""Base of all commands: options that several share, their class, plain messages on errors, and JSON."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shlex
import signal
import threading
import traceback
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand, TyperGroup

from impactopt.errors import InputError, did_you_mean, printable

if TYPE_CHECKING:
    from rich.console import Console

NO, BAD_INPUT, BUG, INTERRUPTED = 1, 2, 70, 130  # exit codes; 1: the answer is no


def complete_problem(incomplete: str) -> list[str]:
    """Completions of a problem's name or file, for the shell. It has to be quick."""
    return _complete(incomplete, "")


def complete_sweep(incomplete: str) -> list[str]:
    """Completions of a sweep's name or file, for the shell."""
    from impactopt.files.named_problems import SWEEPS

    return _complete(incomplete, SWEEPS)


def _complete(incomplete: str, folder: str) -> list[str]:
    from impactopt.files.named_problems import named_files

    typed = Path(incomplete)
    inside = typed if incomplete.endswith("/") else typed.parent
    beside = sorted(inside.iterdir()) if inside.is_dir() else []
    files = [f"{path}/" if path.is_dir() else str(path) for path in beside]
    fit = [file for file in files if file.endswith((".toml", "/"))]
    return [name for name in (*named_files(folder), *fit) if name.startswith(incomplete)]


def complete_setting(context: typer.Context, incomplete: str) -> list[str]:
    """Completions of a key, of the problem that the command names, or of any problem.

    Finding all keys takes seconds of imports. So they are cached, until the problem file or our sources
    change.
    """
    from impactopt.codegen.files import kept
    from impactopt.files.named_problems import named_files

    # if the option's value is still missing, click has not assigned the words before it to parameters
    name = str(context.params.get("file") or next(iter(context.args), ""))
    text = ""
    with contextlib.suppress(OSError, UnicodeDecodeError, ValueError):
        text = named_files().get(name, Path(name)).read_text(encoding="utf-8") if name else ""
    sources = sorted(Path(__file__).parents[1].rglob("*.py"))
    known = "\0".join([text, *(f"{path} {path.stat().st_mtime_ns}" for path in sources)])

    def make() -> bytes:
        return "\n".join(_setting_keys(text)).encode()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about a cache that cannot be used
        paths = kept("keys", hashlib.sha256(known.encode()).hexdigest(), make).decode().splitlines()
    return [f"{path}=" for path in paths if path.startswith(incomplete)]


def _setting_keys(text: str) -> list[str]:
    """Key paths of a problem file's text; of any problem if it is not valid TOML."""
    from impactopt.files.problem_file.reading import key_paths
    from impactopt.files.toml import TOMLError, read_toml

    data: dict[str, Any] = {}
    with contextlib.suppress(TOMLError):
        data = read_toml(text)
    return list(key_paths(data))


ProblemPath = Annotated[
    Path,
    typer.Argument(
        metavar="PROBLEM",
        help="A problem's name, as `impactopt problems` lists them, or its file.",
        autocompletion=complete_problem,
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key of the problem file, as target.mass=8; may be repeated.",
        autocompletion=complete_setting,
    ),
]

ResultPath = Annotated[
    Path,
    typer.Argument(metavar="RESULT", help="Directory that `impactopt solve` wrote, such as results/punch."),
]


def out_option(help_text: str, metavar: str = "DIR") -> Any:
    """Option for the place of the results."""
    return typer.Option("--out", "-o", metavar=metavar, help=help_text)


OtherProblem = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Problem file, instead of the one stored in RESULT.")
]
SolverName = Annotated[
    Literal["ipm", "sqp", "ipopt"] | None,
    typer.Option(help="Solver, instead of the one that the file names."),
]


def _positive(seconds: float | None) -> float | None:
    if seconds is not None and not seconds > 0:
        raise typer.BadParameter(f"{seconds:g}; give seconds > 0", param_hint="--time-limit")
    return seconds


TimeLimit = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS", help="Time limit of the solver, whose best iterate is kept.", callback=_positive
    ),
]
Starts = Annotated[
    int, typer.Option(min=1, help="Multistart: number of initial guesses; all but the first are random.")
]
Workers = Annotated[int, typer.Option(min=1, help="Number of parallel processes.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random starts.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, no tables.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="A line for every iteration, and the traceback of an error.")
]


class _Plain:
    """Mixin of commands whose help shows flags without a type."""

    def get_params(self, context: Any) -> Any:
        found = super().get_params(context)  # type: ignore[misc]
        for parameter in found:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = ""
        return found


class PlainCommand(_Plain, TyperCommand):
    """Command whose help shows flags without a type; it is quiet or verbose, not both."""

    def parse_args(self, context: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(context, args)
        except typer.BadParameter as error:
            # of typer: 'x' is not one of 'a', 'b'.
            given, one_of, choices = error.message.removeprefix("Value error, ").partition(" is not one of ")
            if one_of:
                near = did_you_mean(given.strip("'"), re.findall("'(.*?)'", choices))
                error.message = f"{given}{one_of}{choices.rstrip('.')}{near}"
            raise

    def invoke(self, context: Any) -> Any:
        if context.params.get("quiet") and context.params.get("verbose"):
            raise typer.BadParameter("give one of them", context, param_hint="--quiet, --verbose")
        return super().invoke(context)


class PlainGroup(_Plain, TyperGroup):
    """Group of commands whose help shows flags without a type."""


def command_line(context: typer.Context) -> str:
    """Command line of a command, for the record: its name, arguments, and the options that were given."""
    words = ["impactopt", str(context.info_name)]
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params[str(parameter.name)]
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE":
            continue
        if isinstance(value, bool):
            words.append((parameter.opts if value else parameter.secondary_opts)[0])
            continue
        option = max(parameter.opts, key=len)
        for each in value if isinstance(value, (list, tuple)) else [value]:
            words += [option, str(each)] if option.startswith("-") else [str(each)]
    return shlex.join(words)


def print_json(summary: Mapping[str, Any], ok: bool) -> None:
    """Prints the result of a command as JSON; its first key is `ok` for every command: exit code 0."""
    fields = {key: value for key, value in summary.items() if key != "ok"}
    typer.echo(json.dumps({"ok": ok} | fields, indent=2))


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Makes SIGTERM raise KeyboardInterrupt, in the main thread, unless it has another handler."""
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def plain_errors(
    interrupted: str, *, verbose: bool = False, keeps: bool = False, as_json: bool = False
) -> Iterator[Console]:
    """Context of a command's body, with a console on stderr.

    interrupted : printed on a Ctrl-C that the body does not catch.
    verbose : bad input prints a traceback.
    as_json : bad input is printed on stdout, too, as {"ok": false, "error"}.
    keeps : the body saves its results on Ctrl-C; then SIGTERM, as of a scheduler, has the same effect.
    """
    from rich.console import Console

    console = Console(stderr=True)
    on_sigterm = _terminated_as_interrupted() if keeps else contextlib.nullcontext()
    with warnings.catch_warnings(), on_sigterm:
        warnings.showwarning = lambda message, *_a, **_k: console.print(
            printable(f"warning: {message}"), markup=False
        )
        try:
            yield console
        except InputError as error:
            if verbose:
                traceback.print_exc()
            typer.echo(printable(f"error: {error}"), err=True)
            if as_json:
                print_json({"error": str(error)}, False)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            typer.echo(interrupted, err=True)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError):
            raise
        except Exception:
            # exit code 1 is a command's "no", on which a script may rely
            traceback.print_exc()
            typer.echo("error: this is a fault of impactopt; please report it with the lines above", err=True)
            raise typer.Exit(BUG) from None
