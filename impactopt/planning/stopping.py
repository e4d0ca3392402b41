"""Ctrl-C while a problem is solved: what is there is kept, wherever the work is just then."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

__all__ = ["Stop", "stopping"]


class Stop:
    """Flag by which a signal ends the work at its next step.

    armed : whether there is something to keep. Until then, and the second time, a signal raises
        KeyboardInterrupt at once.
    """

    def __init__(self) -> None:
        self.armed = self.asked = False

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Handler of a signal that asks to end."""
        if self.asked or not self.armed:
            raise KeyboardInterrupt
        self.asked = True


@contextlib.contextmanager
def stopping() -> Iterator[Stop]:
    """A `Stop` for SIGINT, and for SIGTERM where that raises KeyboardInterrupt too, as in commands.

    Handlers of a caller's own stay, and so do those of threads that are not the main one. Within another one
    it is that one's.
    """
    main = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGINT, signal.SIGTERM] if main else []
    for number in numbers:
        outer = getattr(signal.getsignal(number), "__self__", None)
        if isinstance(outer, Stop):
            yield outer
            return
    stop = Stop()
    mine = [n for n in numbers if signal.getsignal(n) is signal.default_int_handler]
    for number in mine:
        signal.signal(number, stop.on_signal)
    try:
        yield stop
    finally:
        for number in mine:
            signal.signal(number, signal.default_int_handler)
