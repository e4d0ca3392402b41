"""Pages served by viser on this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import http
import io
import secrets
import socket
from collections.abc import Iterator
from typing import Any, TypeVar
from urllib.parse import urlsplit

from impactopt.errors import InputError, missing_package
from impactopt.live.requests import LatestRequest

__all__ = ["LOCAL", "LivePage", "served"]

LOCAL = "127.0.0.1"


Page = TypeVar("Page", bound="LivePage")


class LivePage:
    """A page that answers the latest request of its watcher, until it is closed."""

    _server: Any
    _latest: LatestRequest[Any, Any]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the newest answer; False after so long [s]."""
        return self._latest.wait(timeout)

    def close(self) -> None:
        """End all work and the page."""
        self._latest.close(timeout=1.0)
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it has stopped
            self._server.stop()

    def __enter__(self: Page) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def served(host: str, port: int) -> tuple[Any, str]:
    """A `viser.ViserServer` there, and the address of its page; port 0: one that is free.

    The address ends in a random token. Without it, and from a page of another origin in the same browser,
    every request is refused: the page is for those alone who were given its address.

    Raises
    ------
    InputError : viser is missing, or lets no request be checked; host or port cannot be had.
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
        fix = "give another --port, or none" if taken else "give another host or port"
        raise InputError(f"cannot serve a page at {host}:{port}: {error}; {fix}") from error
    token = secrets.token_hex(16)
    with _guarded(token) as guards, contextlib.redirect_stdout(io.StringIO()):  # it has a banner
        server = viser.ViserServer(host=host, port=port, label="impactopt", verbose=False)
        if not guards:
            server.stop()
            raise InputError(f"viser {viser.__version__} lets no request be checked; install viser 1.1")
    return server, f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}/{token}"


@contextlib.contextmanager
def _guarded(token: str) -> Iterator[list[bool]]:
    """A context in which websockets' servers check requests before they answer: viser has no such option.

    Yields a list with an item for each server that was made.
    """
    import websockets.asyncio.server as library

    usual, made = library.serve, list[bool]()

    def serve(*args: Any, process_request: Any, **more: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not _allowed(request, token):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "open the address that was printed\n")
            path = request.path.replace(f"/{token}", "", 1) or "/"
            return process_request(connection, dataclasses.replace(request, path=path))

        made.append(True)
        return usual(*args, process_request=checked, **more)

    library.serve = serve  # type: ignore[assignment,misc]
    try:
        yield made
    finally:
        library.serve = usual  # type: ignore[misc]


def _allowed(request: Any, token: str) -> bool:
    """True if a request has the token, and comes from no page of another origin."""
    first = request.path.partition("?")[0].lstrip("/").partition("/")[0]
    if not secrets.compare_digest(first.encode(), token.encode()):
        return False
    origins, hosts = request.headers.get_all("Origin"), request.headers.get_all("Host")
    return all([urlsplit(origin).netloc] == hosts for origin in origins)
