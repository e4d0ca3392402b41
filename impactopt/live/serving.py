"""Pages served by viser on this machine."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import Any, TypeVar

from impactopt.errors import InputError, missing_package
from impactopt.live.newest import Newest

__all__ = ["LOCAL", "LivePage", "address_of", "served"]

LOCAL = "127.0.0.1"


def address_of(server: Any, host: str) -> str:
    """Of its page."""
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


Page = TypeVar("Page", bound="LivePage")


class LivePage:
    """A page that answers the newest wish of its watcher, until it is closed."""

    _server: Any
    _newest: Newest[Any, Any]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the newest answer; False after so long [s]."""
        return self._newest.wait(timeout)

    def close(self) -> None:
        """End all work and the page."""
        self._newest.close(timeout=1.0)
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it has stopped
            self._server.stop()

    def __enter__(self: Page) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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
