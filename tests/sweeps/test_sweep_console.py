"""Who looks on is told how far a sweep is, and nobody else."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from impactopt.sweeps import SweepProgress
from impactopt.sweeps import progress as console

NOW = SweepProgress(
    cases=8, done=2, failed=1, resumed=0, seconds=3.0, rate=0.5, remaining=12.0, best=4.5, best_case=1
)


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    text = io.StringIO()
    monkeypatch.setattr(console, "_console", lambda always: Console(file=text, width=200))
    return text


def test_by_default_a_person_sees_words_and_progress(screen: io.StringIO) -> None:
    with console.receivers(None, None) as (tell, count):
        tell("building")
        count(NOW)
    assert screen.getvalue().splitlines() == [
        "building",
        "2 of 8, 0.5 a second, 12 s left, 1 failed, best 4.50 N s (case 1)",
    ]


def test_false_and_functions_of_ones_own_leave_the_screen_alone(screen: io.StringIO) -> None:
    said, counted = list[str](), list[SweepProgress]()
    with console.receivers(None, False) as (tell, count):
        tell("building")
        count(NOW)
    with console.receivers(said.append, counted.append) as (tell, count):
        tell("building")
        count(NOW)
    with console.receivers(said.append, None) as (tell, count):
        count(NOW)
    assert screen.getvalue() == "" and said == ["building"] and counted == [NOW]


def test_without_a_terminal_nobody_looks() -> None:
    assert console._console(always=False) is None
    assert console._console(always=True) is not None
