"""Plain messages on stderr for bad input and warnings, without tracebacks, and the JSON of every command."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import traceback
import warnings
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

BAD_INPUT, BUG, INTERRUPTED = 2, 70, 130  # exit codes


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

    from impactopt.errors import InputError, printable

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
