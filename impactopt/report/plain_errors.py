"""Bad input and warnings as plain messages on stderr, without tracebacks, for every command."""

from __future__ import annotations

import contextlib
import signal
import threading
import traceback
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["BAD_INPUT", "BUG", "INTERRUPTED", "plain_errors"]

BAD_INPUT, BUG, INTERRUPTED = 2, 70, 130  # exit codes


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, in the main thread and where nobody else handles it."""
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
def plain_errors(interrupted: str, *, verbose: bool = False, keeps: bool = False) -> Iterator[Console]:
    """A console on stderr, for a command's body.

    interrupted : what Ctrl-C prints, where the body does not catch it.  verbose : bad input has a traceback.
    keeps : the body keeps what it has on Ctrl-C, and is to do so on SIGTERM, as of a scheduler, too.
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
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            typer.echo(interrupted, err=True)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError):
            raise
        except Exception:
            # 1 is a command's "no", which a script may count on
            traceback.print_exc()
            typer.echo("error: this is a fault of impactopt; please report it with the lines above", err=True)
            raise typer.Exit(BUG) from None
