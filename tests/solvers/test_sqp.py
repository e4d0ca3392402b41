"""The SQP on textbook programs, and what it does when things go wrong."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from support.textbook import CASES, INF, Textbook, assert_optimal, infeasible, solve_by

from impactopt import InputError, Status
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.sqp import QP_SOLVERS, QPSolution, QPStatus, SQPOptions, solve_sqp

WAYS = {
    "default": IPMOptions(),
    "active_set": SQPOptions(qp_solver="active_set"),
    "osqp": SQPOptions(qp_solver="osqp"),
    "bfgs": SQPOptions(qp_solver="active_set", hessian="bfgs"),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CASES)
def test_textbook_programs(name, way):
    case = CASES[name]
    program = case.build()
    options = WAYS[way]
    # HS10 starts 20 units from its optimum: steps that suit orders of one are many
    if name == "HS10" and isinstance(options, SQPOptions):
        options = dataclasses.replace(options, radius=10.0)
    result = solve_by(program, case.x0, options)
    # HS26 has a singular Hessian at its optimum: quasi-Newton creeps
    singular = name == "HS26" and way == "bfgs"
    assert result.status is Status.SOLVED or (singular and result.status is Status.ACCEPTABLE)
    assert result.objective == pytest.approx(case.optimum, rel=1e-5, abs=1e-5)
    assert_optimal(program, result, tolerance=1e-4 if singular else 1e-5)
    assert result.objective == program.objective(result.x)
    assert result.iterations == len(result.history) - 1
    if way != "bfgs":
        assert result.iterations <= 30
    else:
        assert program.evaluations["hessian"] == 0


def test_iterates_stay_within_the_variables_bounds():
    # log x is not defined left of its bound, and the unbounded step leads there
    program = Textbook(1, lambda x: x - 1e-3 * ca.log(x), lower=1e-6)
    result = solve_ipm(program, [10.0])
    assert result.status is Status.SOLVED
    assert result.x[0] == pytest.approx(1e-3, rel=1e-3)


def test_steps_to_where_functions_are_not_finite_are_shortened():
    program = Textbook(1, lambda x: x - ca.log(x))  # nan at x <= 0
    result = solve_ipm(program, [8.0])
    assert result.status is Status.SOLVED
    assert result.x[0] == pytest.approx(1, abs=1e-5)


def test_arithmetic_errors_count_as_not_finite_and_others_surface():
    class Fussy(Textbook):
        def objective(self, x):
            if x[0] <= 0:
                raise ZeroDivisionError
            return super().objective(x)

    program = Fussy(1, lambda x: x - ca.log(x))
    assert solve_ipm(program, [8.0]).status is Status.SOLVED
    assert solve_ipm(program, [-1.0]).status is Status.FAILED

    class Broken(Textbook):
        def hessian(self, x, sigma, multipliers):
            raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        solve_ipm(Broken(1, lambda x: x**2), [1.0])


def test_full_steps_are_taken_along_a_circle():
    # the Maratos effect: a full Newton step along the circle raises both the objective and the violation
    case = CASES["Maratos"]
    result = solve_sqp(case.build(), case.x0, options=SQPOptions(qp_solver="active_set"))
    assert result.status is Status.SOLVED
    assert result.iterations <= 8
    assert all("step 1," in record.note for record in result.history[1:])


def test_second_order_correction_cures_the_maratos_effect():
    # the same outside a disk: an inequality is no curve to step back to
    program = Textbook(2, lambda x, y: 2 * (x**2 + y**2 - 1) - x, lambda x, y: [(1, x**2 + y**2, INF)])
    options = SQPOptions(qp_solver="active_set", radius=4.0)
    x0 = [np.cos(1.5), np.sin(1.5)]
    full = solve_sqp(program, x0, options=options)
    without = solve_sqp(program, x0, options=dataclasses.replace(options, second_order_correction=False))
    assert full.status is without.status is Status.SOLVED
    assert any("corrected" in record.note for record in full.history)
    assert full.iterations < without.iterations


def test_constraints_enter_only_when_needed():
    # the farthest point of a polygon of 300 sides in a direction: a corner, found with few of the constraints
    angles = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    program = Textbook(
        2,
        lambda x, y: -x - 0.3 * y + 1e-3 * (x**2 + y**2),
        lambda x, y: [(-INF, np.cos(a) * x + np.sin(a) * y, 1) for a in angles],
    )
    result = solve_sqp(program, [0.1, 0.2], options=SQPOptions(qp_solver="active_set"))
    assert result.status is Status.SOLVED
    assert_optimal(program, result)
    assert all(int(record.note.split("constraints ")[1].split()[0]) < 100 for record in result.history[1:])


@pytest.mark.slow
def test_infeasible_programs_name_the_constraints():
    program, x0 = infeasible()
    for options in WAYS.values():
        result = solve_by(program, x0, options)
        assert result.status is Status.INFEASIBLE
        assert "row 1: by" in result.message
        assert "row 2: by" in result.message
        assert "row 3" not in result.message
        assert result.max_violation == pytest.approx(min(record.max_violation for record in result.history))


def test_infeasible_against_bounds():
    program = Textbook(2, lambda x, y: x**2, lambda x, y: [(4, x * y, INF)], lower=0, upper=1)
    result = solve_ipm(program, [0.5, 0.5])
    assert result.status is Status.INFEASIBLE
    assert "row 1: by 3" in result.message
    np.testing.assert_allclose(result.x, 1, atol=1e-6)


def test_a_low_price_still_finds_the_feasible_region():
    case = CASES["HS40"]
    result = solve_ipm(case.build(), case.x0, options=IPMOptions(price=1e-3))
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, abs=1e-5)


@pytest.mark.parametrize("x0", [[np.nan, 1], [1, 2, 3]])
def test_bad_starts_are_refused(x0):
    with pytest.raises(InputError, match="x0"):
        solve_ipm(CASES["HS6"].build(), x0)


def test_bad_options_are_refused_when_written():
    with pytest.raises(InputError, match=r"'exakt' \(did you mean 'exact'\?\)"):
        SQPOptions(hessian="exakt")
    with pytest.raises(InputError, match="qp_solver"):
        SQPOptions(qp_solver="qpoases")
    with pytest.raises(InputError, match="kkt_tolerance"):
        IPMOptions(kkt_tolerance=0.0)
    with pytest.raises(InputError, match="price"):
        IPMOptions(price=2.0, price_max=1.0)
    with pytest.raises(TypeError):
        IPMOptions(max_iter=3)


@pytest.mark.parametrize("how", ["raise", "return"])
def test_interruption_leaves_the_best_iterate(how):
    case = CASES["HS100"]
    program, seen = case.build(), []

    def callback(record):
        seen.append(record)
        if record.iteration == 3:
            if how == "raise":
                raise KeyboardInterrupt
            return True
        return None

    result = solve_ipm(program, case.x0, callback=callback)
    assert result.status is Status.INTERRUPTED
    assert result.iterations == 3
    best = min(seen, key=lambda record: (max(record.max_violation, 1e-6), record.objective))
    assert result.objective == best.objective
    assert result.max_violation == best.max_violation


def test_interruption_within_a_function():
    case = CASES["HS100"]

    class Interrupted(Textbook):
        def jacobian(self, x):
            if self.evaluations["jacobian"] == self.after:
                self.evaluations["jacobian"] += 1
                raise KeyboardInterrupt
            return super().jacobian(x)

    for after in (0, 3):
        program = case.build()
        program.__class__, program.after = Interrupted, after
        result = solve_ipm(program, case.x0)
        assert result.status is Status.INTERRUPTED
        assert np.isfinite(result.x).all()


def test_limits():
    case = CASES["HS100"]
    result = solve_ipm(case.build(), case.x0, options=IPMOptions(max_iterations=2))
    assert (result.status, result.iterations) == (Status.ITERATION_LIMIT, 2)
    result = solve_ipm(case.build(), case.x0, options=IPMOptions(max_iterations=0))
    assert (result.status, result.iterations) == (Status.ITERATION_LIMIT, 0)
    np.testing.assert_array_equal(result.x, case.x0)
    result = solve_ipm(case.build(), case.x0, options=IPMOptions(time_limit=1e-9))
    assert (result.status, result.iterations) == (Status.TIME_LIMIT, 0)


def test_functions_not_finite_at_the_start_are_said_so():
    result = solve_ipm(Textbook(1, lambda x: ca.log(x), lambda x: [(0, ca.sqrt(x), 1)]), [-1.0])
    assert result.status is Status.FAILED
    assert "not finite" in result.message


def test_solutions_start_the_next_solve():
    case = CASES["HS71"]
    first = solve_ipm(case.build(), case.x0)
    again = solve_ipm(
        case.build(), first.x, multipliers=first.multipliers, bound_multipliers=first.bound_multipliers
    )
    assert again.iterations == 0
    with pytest.raises(InputError, match="multipliers"):
        solve_ipm(case.build(), case.x0, multipliers=[1.0])


def test_own_qp_solvers_can_be_added_and_may_fail():
    class Hopeless:
        def solve(self, qp, *, start=None, time_limit=None):
            zero = np.zeros(qp.n)
            return QPSolution(x=zero, y=np.zeros(qp.m), z=zero, status=QPStatus.FAILED, iterations=0)

    QP_SOLVERS["hopeless"] = lambda tolerance: Hopeless()
    try:
        case = CASES["HS71"]
        result = solve_sqp(case.build(), case.x0, options=SQPOptions(qp_solver="hopeless"))
    finally:
        del QP_SOLVERS["hopeless"]
    assert result.status is Status.FAILED
    np.testing.assert_array_equal(result.x, case.x0)
