"""Server of live pages: viser, with a token in the address; and the base class of pages."""

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

LOCAL = "127.0.0.1"


Page = TypeVar("Page", bound="LivePage")


class LivePage:
    """Base class of pages that answer the latest request of their user until they are closed."""

    _server: Any
    _latest: LatestRequest[Any, Any]

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the latest request is answered; False after ``timeout`` [s]."""
        return self._latest.wait(timeout)

    def close(self) -> None:
        """End all work and the page."""
        self._latest.close(timeout=1.0)
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it has stopped
            self._server.stop()

    def __enter__(self: Page) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def served(port: int) -> tuple[Any, str]:
    """`viser.ViserServer` on this machine at a port (0: a free one), and the address of its page.

    The address ends in a random token. Requests without it, and those from a page of another origin in the
    same browser, are refused: only those who know the address can see the page.

    Raises
    ------
    InputError : viser is missing, or has no check of requests; the port is not available.
    """
    try:
        import viser
    except ImportError as error:
        raise missing_package("a live look", "viser", "live") from error
    # viser would silently take another port if this one is in use
    try:
        with socket.create_server((LOCAL, port)):
            pass
    except (OSError, OverflowError) as error:
        taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        fix = "give another --port, or none" if taken else "give another --port"
        raise InputError(f"cannot serve a page at {LOCAL}:{port}: {error}; {fix}") from error
    token = secrets.token_hex(16)
    with _guarded(token) as guards, contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = viser.ViserServer(host=LOCAL, port=port, label="impactopt", verbose=False)
        if not guards:
            server.stop()
            raise InputError(f"viser {viser.__version__} lets no request be checked; install viser 1.1")
    return server, f"http://{LOCAL}:{server.get_port()}/{token}"


@contextlib.contextmanager
def _guarded(token: str) -> Iterator[list[bool]]:
    """Context in which servers of websockets check requests before they answer, as viser has no such option.

    It replaces `websockets.asyncio.server.serve`. Yields a list with an item for each server that was made.
    """
    import websockets.asyncio.server as library

    original, made = library.serve, list[bool]()

    def serve(*args: Any, process_request: Any, **more: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not _allowed(request, token):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "open the address that was printed\n")
            # viser sees the path without the token
            path = request.path.replace(f"/{token}", "", 1) or "/"
            return process_request(connection, dataclasses.replace(request, path=path))

        made.append(True)
        return original(*args, process_request=checked, **more)

    library.serve = serve  # type: ignore[assignment,misc]
    try:
        yield made
    finally:
        library.serve = original  # type: ignore[misc]


def _allowed(request: Any, token: str) -> bool:
    """True if a request has the token, and does not come from a page of another origin."""
    first = request.path.partition("?")[0].lstrip("/").partition("/")[0]
    if not secrets.compare_digest(first.encode(), token.encode()):
        return False
    origins, hosts = request.headers.get_all("Origin"), request.headers.get_all("Host")
    return all([urlsplit(origin).netloc] == hosts for origin in origins)
