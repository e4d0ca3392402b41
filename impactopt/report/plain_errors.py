"""Bad input and warnings as plain messages on stderr, without tracebacks, for every command."""

from __future__ import annotations

import contextlib
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
def plain_errors(interrupted: str, *, verbose: bool = False) -> Iterator[Console]:
    """A console on stderr, for a command's body.

    interrupted : what Ctrl-C prints, where the body does not catch it.  verbose : bad input has a traceback.
    """
    from rich.console import Console

    from impactopt.errors import InputError, printable

    console = Console(stderr=True)
    with warnings.catch_warnings():
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
