"""Answers the latest request alone, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["LatestRequest"]

Request = TypeVar("Request")
Outcome = TypeVar("Outcome")


class LatestRequest(Generic[Request, Outcome]):
    """Answers requests one after the other. One that comes while another is worked on takes its place.

    work : from a request to its outcome. Its second argument says whether a newer request is there: then it
        may stop, as nobody will ask for what it returns.
    tell : is given each outcome that is still requested, or what the work raised, in the same thread.
    """

    def __init__(
        self,
        work: Callable[[Request, Callable[[], bool]], Outcome],
        tell: Callable[[Request, Outcome | Exception], object],
    ) -> None:
        self._work, self._tell = work, tell
        self._changed = threading.Condition()
        self._asked, self._answered, self._closed = 0, 0, False
        self._request: Request
        self._thread = threading.Thread(target=self._run, name="newest request", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Take this request in place of all before it."""
        with self._changed:
            self._request, self._asked = request, self._asked + 1
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until nothing is asked for any more; False after so long [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._answered == self._asked, timeout)

    def close(self, timeout: float | None = None) -> None:
        """Stop: what is worked on is reported no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._answered != self._asked)
                if self._closed:
                    return
                number, request = self._asked, self._request

            def stale(number: int = number) -> bool:
                return self._closed or self._asked != number

            outcome: Outcome | Exception
            try:
                outcome = self._work(request, stale)
            except Exception as error:
                outcome = error
            if not stale():
                self._tell(request, outcome)
            with self._changed:
                self._answered = number
                self._changed.notify_all()
