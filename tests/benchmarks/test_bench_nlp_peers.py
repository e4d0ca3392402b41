"""Uno and POUNCE as peers in the bench of solvers: our functions, signs, clock and errors."""

from __future__ import annotations

import itertools
import sys
import time
from typing import Any

import numpy as np
import pytest
from support.hock_schittkowski import BOOK
from support.textbook import Textbook, assert_optimal, infeasible

from benchmarks.attempts import judged
from benchmarks.solvers import SOLVERS
from impactopt import InputError, Status
from impactopt.solvers.program import max_violation

PEERS = {"uno-filtersqp": "unopy", "uno-ipopt": "unopy", "pounce": "pounce"}  # and what they are imported as


def banana(x: Any, y: Any) -> Any:
    return 100 * (y - x**2) ** 2 + (1 - x) ** 2


@pytest.mark.parametrize("solver", PEERS)
def test_without_its_package_it_is_told_what_brings_it(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, PEERS[solver], None)
    with pytest.raises(InputError, match=r"(Uno|POUNCE) needs the package .*\.\[peers\]"):
        SOLVERS[solver].run(Textbook(2, banana), np.zeros(2), 1.0)


# rows on either side and equalities; bounds that hold; no rows; ten variables
@pytest.mark.parametrize("name", ["HS1", "HS15", "HS34", "HS78", "HS113"])
@pytest.mark.parametrize("solver", PEERS)
def test_they_solve_what_is_asked(solver: str, name: str) -> None:
    pytest.importorskip(PEERS[solver])
    case = BOOK[name]
    program = case.build()
    result = SOLVERS[solver].run(program, np.array(case.x0), 20.0)
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, rel=1e-5, abs=1e-5)
    assert_optimal(program, result, tolerance=1e-5)
    assert judged(program, result).kkt < 1e-4
    assert 0 < result.iterations < program.evaluations["gradient"] < 100
    assert program.evaluations["hessian"] > 0
    assert 0 < result.seconds_functions < result.seconds


@pytest.mark.parametrize("solver", PEERS)
def test_it_stops_in_time_with_the_best_point(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(PEERS[solver])
    case = BOOK["HS15"]
    program, x0 = case.build(), np.array(case.x0)
    ticks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: 0.01 * next(ticks))  # each look takes 10 ms
    result = SOLVERS[solver].run(program, x0, 0.3)
    assert result.status is Status.TIME_LIMIT
    assert result.seconds < 0.4
    assert sum(program.evaluations.values()) < 25
    assert result.max_violation < max_violation(program, x0, program.constraints(x0))


@pytest.mark.parametrize("solver", PEERS)
def test_what_cannot_be_computed_shortens_the_step(solver: str) -> None:
    pytest.importorskip(PEERS[solver])

    class Narrow(Textbook):
        """Not defined where x is above 1.5, where the first Newton step ends; best at x = 1."""

        refused = 0

        def objective(self, x: Any) -> float:
            if x[0] > 1.5:
                self.refused += 1
                raise FloatingPointError
            return super().objective(x)

    program = Narrow(1, lambda x: (x**2 - 1) ** 2)
    result = SOLVERS[solver].run(program, np.array([0.6]), 10.0)
    assert program.refused
    assert result.status is Status.SOLVED
    assert result.x == pytest.approx([1.0], abs=1e-5)


@pytest.mark.parametrize("solver", PEERS)
def test_a_bug_in_the_program_is_not_hidden(solver: str) -> None:
    pytest.importorskip(PEERS[solver])

    class Faulty(Textbook):
        def hessian(self, x: Any, sigma: float, y: Any) -> Any:
            if self.evaluations["hessian"] == 2:
                raise KeyError("a bug")
            return super().hessian(x, sigma, y)

    with pytest.raises(KeyError, match="a bug"):
        SOLVERS[solver].run(Faulty(2, banana), np.array([-1.2, 1.0]), 10.0)


@pytest.mark.parametrize("solver", PEERS)
def test_it_tells_an_infeasible_program(solver: str) -> None:
    pytest.importorskip(PEERS[solver])
    program, x0 = infeasible()
    assert SOLVERS[solver].run(program, x0, 10.0).status is Status.INFEASIBLE
