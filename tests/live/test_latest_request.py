"""Wishes that come faster than they are worked on: the newest counts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from impactopt.live.requests import LatestRequest

LONG = 30.0  # [s] nothing here takes so long


class Slow:
    """Work that waits until it is let go, or is stale."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.stale: list[int] = []
        self.told: list[tuple[int, Any]] = []
        self.at_work, self.go = threading.Semaphore(0), threading.Semaphore(0)

    def __call__(self, request: int, stale: Callable[[], bool]) -> int:
        self.begun.append(request)
        self.at_work.release()
        assert self.go.acquire(timeout=LONG)
        if stale():
            self.stale.append(request)
        if request < 0:
            raise ValueError("below zero")
        return 10 * request

    def tell(self, request: int, outcome: int | Exception) -> None:
        self.told.append((request, outcome))


@pytest.fixture
def slow() -> Slow:
    return Slow()


@pytest.fixture
def newest(slow: Slow) -> Iterator[LatestRequest[int, int]]:
    made = LatestRequest(slow, slow.tell)
    yield made
    slow.go.release(100)
    made.close(LONG)


def test_a_request_is_answered(slow: Slow, newest: LatestRequest[int, int]) -> None:
    assert newest.wait(0.0)  # nothing is asked for
    slow.go.release()
    newest.ask(1)
    assert newest.wait(LONG)
    assert slow.told == [(1, 10)]


def test_of_requests_that_come_during_work_the_last_alone_is_worked_on(
    slow: Slow, newest: LatestRequest[int, int]
) -> None:
    newest.ask(1)
    assert slow.at_work.acquire(timeout=LONG)
    for request in (2, 3, 4):
        newest.ask(request)
    assert not newest.wait(0.0)
    slow.go.release(2)
    assert newest.wait(LONG)
    assert (slow.begun, slow.stale, slow.told) == ([1, 4], [1], [(4, 40)])


def test_an_error_is_told_and_ends_nothing(slow: Slow, newest: LatestRequest[int, int]) -> None:
    slow.go.release(2)
    newest.ask(-1)
    assert newest.wait(LONG)
    newest.ask(2)
    assert newest.wait(LONG)
    (request, error), after = slow.told
    assert request == -1
    assert str(error) == "below zero"
    assert after == (2, 20)


def test_what_is_worked_on_at_the_end_is_not_told(slow: Slow, newest: LatestRequest[int, int]) -> None:
    newest.ask(1)
    assert slow.at_work.acquire(timeout=LONG)
    closing = threading.Thread(target=newest.close)
    closing.start()
    while not newest._closed:
        closing.join(1e-3)
    slow.go.release()
    closing.join(LONG)
    assert not closing.is_alive()
    assert (slow.stale, slow.told) == ([1], [])
