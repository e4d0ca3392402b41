"""The IPOPT adapter on textbook programs, and what it does when things go wrong."""

from __future__ import annotations

import signal

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from support.textbook import CASES, Textbook, assert_optimal, infeasible

from impactopt import InputError, Status
from impactopt.solvers.ipopt import solve_ipopt


def overriding(case, **methods):
    """The case's program with some methods replaced; each is given the program first."""
    program = case.build()
    program.__class__ = type("Changed", (Textbook,), methods)
    return program


@pytest.mark.parametrize("name", CASES)
def test_textbook_programs(name):
    case = CASES[name]
    program = case.build()
    result = solve_ipopt(program, case.x0)
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, rel=1e-5, abs=1e-5)
    assert_optimal(program, result, tolerance=1e-4)
    assert result.kkt <= 1e-5
    assert result.iterations == len(result.history) - 1
    assert result.history[-1].kkt == pytest.approx(result.kkt, abs=1e-6)
    assert result.seconds >= result.seconds_functions > 0


def test_nothing_is_evaluated_twice_at_a_point():
    case, seen = CASES["HS100"], []

    def constraints(self, x):
        seen.append(tuple(x))
        return Textbook.constraints(self, x)

    solve_ipopt(overriding(case, constraints=constraints), case.x0)
    repeated = len(seen) - len(set(seen))
    assert repeated <= 2  # the start, before IPOPT; the solution, after it


def test_quasi_newton_needs_no_hessian():
    case = CASES["HS71"]
    program = case.build()
    result = solve_ipopt(program, case.x0, options={"hessian_approximation": "limited-memory"})
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, rel=1e-6)
    assert program.evaluations["hessian"] == 0


def test_unsorted_matrices_with_duplicates_are_the_same_matrices():
    case = CASES["HS43"]

    def messy(matrix):
        coo = matrix.tocoo()
        columns = np.concatenate([coo.col, coo.col[:2]])
        rows = np.concatenate([coo.row, coo.row[:2]])
        values = np.concatenate([coo.data, np.zeros(2)])
        values[:2], values[-2:] = values[:2] - 7, 7
        order = np.lexsort((-rows, columns))
        indptr = np.searchsorted(columns[order], np.arange(matrix.shape[1] + 1))
        return sp.csc_array((values[order], rows[order], indptr), shape=matrix.shape)

    program = overriding(
        case,
        jacobian=lambda self, x: messy(Textbook.jacobian(self, x)),
        hessian=lambda self, x, sigma, y: messy(Textbook.hessian(self, x, sigma, y)),
    )
    plain = solve_ipopt(case.build(), case.x0)
    result = solve_ipopt(program, case.x0)
    assert result.iterations == plain.iterations
    np.testing.assert_allclose(result.x, plain.x, atol=1e-9)


def test_a_changing_pattern_is_an_error():
    case = CASES["HS43"]

    def jacobian(self, x):
        J = Textbook.jacobian(self, x).tolil()
        if self.evaluations["jacobian"] > 2:
            J[0, 0] = 0
        return sp.csc_array(J)

    with pytest.raises(InputError, match="pattern"):
        solve_ipopt(overriding(case, jacobian=jacobian), case.x0)


def test_infeasible_programs_name_the_rows():
    program, x0 = infeasible()
    result = solve_ipopt(program, x0)
    assert result.status is Status.INFEASIBLE
    assert "row 1: by" in result.message
    assert "row 2: by" in result.message
    assert "row 3" not in result.message
    assert result.max_violation <= min(record.max_violation for record in result.history) + 1e-6


@pytest.mark.parametrize("x0", [[np.nan, 1], [1, 2, 3]])
def test_bad_starts_are_refused(x0):
    with pytest.raises(InputError, match="x0"):
        solve_ipopt(CASES["HS6"].build(), x0)


def test_bad_options_are_refused():
    case = CASES["HS6"]
    with pytest.raises(InputError, match="max_itre"):
        solve_ipopt(case.build(), case.x0, options={"max_itre": 3})


def test_an_options_file_in_the_working_directory_is_not_read(tmp_path, monkeypatch):
    planted = tmp_path / "ipopt.opt"
    planted.write_text("max_iter 0\noutput_file written.txt\nfile_print_level 5\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    case = CASES["HS71"]
    assert solve_ipopt(case.build(), case.x0).status is Status.SOLVED
    assert list(tmp_path.iterdir()) == [planted]


@pytest.mark.parametrize("how", ["raise", "return"])
def test_interruption_leaves_the_best_iterate(how):
    case, seen = CASES["HS100"], []

    def callback(record):
        seen.append(record)
        if record.iteration == 3:
            if how == "raise":
                raise KeyboardInterrupt
            return True
        return None

    result = solve_ipopt(case.build(), case.x0, callback=callback)
    assert result.status is Status.INTERRUPTED
    assert result.iterations == 3 == seen[-1].iteration
    assert result.max_violation <= min(record.max_violation for record in seen) + 1e-6
    assert result.history == tuple(seen)


def test_ctrl_c_within_a_function():
    case = CASES["HS7"]

    def hessian(self, x, sigma, y):
        if self.evaluations["hessian"] == 4:
            signal.raise_signal(signal.SIGINT)
        return Textbook.hessian(self, x, sigma, y)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        result = solve_ipopt(overriding(case, hessian=hessian), case.x0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.status is Status.INTERRUPTED
    assert 0 < result.iterations < 10


def test_limits():
    case = CASES["HS100"]
    result = solve_ipopt(case.build(), case.x0, options={"max_iter": 2})
    assert (result.status, result.iterations) == (Status.ITERATION_LIMIT, 2)
    result = solve_ipopt(case.build(), case.x0, time_limit=1e-6)
    assert result.status is Status.TIME_LIMIT
    assert np.isfinite(result.objective)


def test_errors_of_functions_surface():
    case = CASES["HS100"]

    def gradient(self, x):
        if self.evaluations["gradient"] == 3:
            raise RuntimeError("a bug")
        return Textbook.gradient(self, x)

    with pytest.raises(RuntimeError, match="a bug"):
        solve_ipopt(overriding(case, gradient=gradient), case.x0)

    def callback(record):
        raise LookupError("in the callback")

    with pytest.raises(LookupError, match="in the callback"):
        solve_ipopt(case.build(), case.x0, callback=callback)


def test_steps_to_where_functions_are_not_defined_are_shortened():
    class Fussy(Textbook):
        def objective(self, x):
            if x[0] <= 0:
                raise ZeroDivisionError
            return super().objective(x)

    result = solve_ipopt(Fussy(1, lambda x: x - ca.log(x)), [8.0])
    assert result.status is Status.SOLVED
    assert result.x[0] == pytest.approx(1, abs=1e-5)


def test_functions_not_finite_at_the_start_are_said_so():
    result = solve_ipopt(Textbook(1, lambda x: ca.log(x), lambda x: [(0, ca.sqrt(x), 1)]), [-1.0])
    assert result.status is Status.FAILED
    assert "not finite" in result.message


def test_functions_that_raise_at_the_start_are_said_so():
    class Fussy(Textbook):
        def objective(self, x):
            if x[0] <= 0:
                raise ZeroDivisionError
            return super().objective(x)

    result = solve_ipopt(Fussy(1, lambda x: x - ca.log(x)), [-8.0])
    assert result.status is Status.FAILED
    assert "not finite" in result.message
