"""Pages served by viser on this machine."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import Any

from impactopt.errors import InputError, missing_package

__all__ = ["LOCAL", "address_of", "ended", "served"]

LOCAL = "127.0.0.1"


def address_of(server: Any, host: str) -> str:
    """Of its page."""
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def ended(server: Any) -> None:
    """Stop it."""
    with contextlib.redirect_stdout(io.StringIO()):  # it says that it has stopped
        server.stop()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def served(host: str, port: int) -> Any:
    """A `viser.ViserServer` there; port 0: one that is free.

    Raises
    ------
    InputError : viser is missing; host or port cannot be had.
    """
    try:
        import viser
    except ImportError as error:
        raise missing_package("a live look", "viser", "live") from error
    # viser would take another port than the one that is asked for
    try:
        with socket.create_server((host, port), family=_family(host)):
            pass
    except (OSError, OverflowError) as error:
        taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        mend = "give another --port, or none" if taken else "give another host or port"
        raise InputError(f"cannot serve a page at {host}:{port}: {error}; {mend}") from error
    with contextlib.redirect_stdout(io.StringIO()):  # it has a banner
        return viser.ViserServer(host=host, port=port, label="impactopt", verbose=False)
