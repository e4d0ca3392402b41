"""The time limit of a case that does not keep it by itself."""

from __future__ import annotations

import signal
from typing import Any

__all__ = ["ENDED_BY_WATCHDOG", "Watchdog"]

ENDED_BY_WATCHDOG = -int(signal.SIGALRM)  # exit code of a process that it ended
BUILDING = 900.0  # [s]: the longest that one step of building functions may take


class Watchdog:
    """Ends this process where a case takes much longer than its time; news from the case put it off.

    The kernel does, by SIGALRM: nothing else stops compiled code.

    limit [s] : None for none.  grace [s] : how much longer.
    """

    def __init__(self, limit: float | None, grace: float) -> None:
        self._seconds = 0.0 if limit is None else limit + grace
        self._set(self._seconds)

    def building(self, line: str) -> None:
        """A solve's `report`: functions may be compiled, which is no part of a case's time."""
        self._set(max(BUILDING, self._seconds))

    def iteration(self, record: Any) -> None:
        """A solve's `callback`."""
        self._set(self._seconds)

    def off(self) -> None:
        self._set(0.0)

    def _set(self, seconds: float) -> None:
        if self._seconds:  # without a limit a timer of the caller's own is left alone
            signal.setitimer(signal.ITIMER_REAL, seconds)
