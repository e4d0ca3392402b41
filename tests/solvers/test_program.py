"""Checks and measures that both solvers share."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from support.textbook import CASES, Textbook, infeasible

from impactopt import InputError, Status
from impactopt.solvers.program import (
    BestIterate,
    NonlinearProgram,
    Violation,
    check_program,
    complementarity,
    is_stationary_violation,
    max_violation,
    stationarity,
    worst_violations,
)


def test_a_textbook_program_fulfils_the_protocol():
    assert isinstance(CASES["HS71"].build(), NonlinearProgram)


@pytest.mark.parametrize("x0", [[np.nan, 1], [np.inf, 1], [1, 2, 3], [[1, 2]], "no"])
def test_bad_starts_are_refused(x0):
    with pytest.raises(InputError, match="x0"):
        check_program(CASES["HS6"].build(), x0)


@pytest.mark.parametrize("kind", ["x", "g"])
@pytest.mark.parametrize(("lower", "upper"), [(1.0, 0.0), (np.inf, np.inf), (-np.inf, -np.inf)])
def test_bounds_that_leave_no_value_are_named(kind, lower, upper):
    program = CASES["HS14"].build()
    getattr(program, f"{kind}_lower")[1], getattr(program, f"{kind}_upper")[1] = lower, upper
    with pytest.raises(InputError, match={"x": "x2", "g": "row 2"}[kind]):
        check_program(program, [0, 0])


def test_bounds_of_the_wrong_shape_or_nan_are_refused():
    program = CASES["HS14"].build()
    program.g_lower = np.zeros(3)
    with pytest.raises(InputError, match="g_lower"):
        check_program(program, [0, 0])
    program.g_lower = np.array([0, np.nan])
    with pytest.raises(InputError, match="g_lower"):
        check_program(program, [0, 0])


def test_violations_count_rows_and_bounds_and_nan():
    program = Textbook(2, lambda x, y: x, lambda x, y: [(0, x, 1)], lower=-1)
    assert max_violation(program, np.array([0.5, 0]), np.array([0.5])) == 0
    assert max_violation(program, np.array([3.0, -1.5]), np.array([3.0])) == 2
    assert max_violation(program, np.array([0.5, -4]), np.array([0.5])) == 3
    assert max_violation(program, np.array([0.5, 0]), np.array([np.nan])) == np.inf
    assert worst_violations(program, np.array([3.0, -4]), np.array([3.0]), tolerance=1e-6) == [
        Violation("bound of x2", "by 3", 3.0),
        Violation("row 1", "by 2", 2.0),
    ]


def test_stationarity_is_scaled_by_large_multipliers_only():
    J = sp.csc_array(np.array([[1.0, 0.0]]))
    gradient, z = np.array([2.0, 0.0]), np.zeros(2)
    assert stationarity(gradient, J, np.array([-1.0]), z) == pytest.approx(1)
    # s = max(100, 3000 / 3) / 100 = 10
    assert stationarity(gradient, J, np.array([-3000.0]), z) == pytest.approx(2998 / 10)


def test_complementarity_looks_at_the_bound_of_the_multipliers_sign():
    program = Textbook(1, lambda x: x, lambda x: [(0, x, 1)])
    x, g, z = np.array([0.25]), np.array([0.25]), np.zeros(1)
    assert complementarity(program, x, g, np.array([2.0]), z) == pytest.approx(1.5)
    assert complementarity(program, x, g, np.array([-2.0]), z) == pytest.approx(0.5)
    assert complementarity(program, x, g, np.array([0.0]), np.array([3.0])) == 3.0


def test_stationary_violations_are_told_from_others():
    program, _ = infeasible()
    t = 0.75 ** (1 / 3)  # (t, t) minimizes (2 t^2 - 1)^2 + (3 - 2 t)^2, where 8 t^3 = 6
    for x, stationary in (([t, t], True), ([t, t + 0.1], False)):
        x = np.array(x)
        g, J = program.constraints(x), program.jacobian(x)
        assert is_stationary_violation(program, x, g, J) is stationary


def test_the_best_iterate_is_feasible_first_then_low():
    program = Textbook(1, lambda x: x, lambda x: [(0, x, 1)])
    best = BestIterate(program, tolerance=1e-6)
    for x, f, kept in ((3.0, 0.0, True), (2.0, 5.0, True), (2.5, -9.0, False), (0.5, 7.0, True)):
        assert best.consider(np.array([x]), f, np.array([x])) is kept
    assert not best.consider(np.array([0.6]), np.nan, np.array([0.6]))
    assert best.consider(np.array([1 + 1e-7]), 6.0, np.array([1 + 1e-7]))  # within the tolerance, lower
    assert best.objective == 6.0


def test_every_status_has_a_sentence():
    assert all(status.message.endswith(".") for status in Status)
    assert Status("time_limit") is Status.TIME_LIMIT
    assert [s for s in Status if s.usable] == [Status.SOLVED, Status.ACCEPTABLE]
