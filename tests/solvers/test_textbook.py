"""Our SQP and the QP solvers on programs of the literature, and where theory promises little."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from support.degenerate import DEPENDENT, INFEASIBLE, NO_MULTIPLIERS, UNBOUNDED
from support.hock_schittkowski import BOOK, OUT_OF_SCALE
from support.maros_meszaros import QPS, quadratic
from support.textbook import assert_optimal, solve_by

from impactopt import Status
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.sqp import QP_SOLVERS, QPStatus, SQPOptions, make_qp_solver

# bounds as they are: relaxed by 1e-8, as IPOPT does, optima with large multipliers change in the fifth digit
EXACT = {"tol": 1e-9, "bound_relax_factor": 0.0}
# for six digits of an objective however many bounds hold
SHARP = IPMOptions(complementarity_tolerance=1e-8)
SHARP_SQP = SQPOptions(qp_solver="ipm", kkt_tolerance=1e-8)
WAYS = {"default": IPMOptions(), "osqp": SQPOptions(qp_solver="osqp"), "sqp_ipm": SQPOptions(qp_solver="ipm")}


@functools.cache
def optimum(name: str) -> float:
    """Of a QP: as printed, or IPOPT's."""
    case = QPS[name]
    if case.optimum is not None:
        return case.optimum
    return solve_ipopt(case.build(), case.x0, options=EXACT).objective


# ---------------------------------------------------------------- Hock and Schittkowski
@pytest.mark.parametrize("name", BOOK)
def test_the_books_optima_are_optima(name):
    case = BOOK[name]
    result = solve_ipopt(case.build(), case.x0, options={"tol": 1e-9})
    assert result.status.usable
    assert result.objective == pytest.approx(case.optimum, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", [name for name in BOOK if name not in OUT_OF_SCALE])
@pytest.mark.parametrize("options", [SHARP, SHARP_SQP], ids=["ipm", "sqp_ipm"])
def test_the_books_optima_are_found(name, options):
    case = BOOK[name]
    program = case.build()
    result = solve_by(program, case.x0, options)
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, rel=1e-5, abs=1e-5)
    assert_optimal(program, result)


@pytest.mark.parametrize("name", OUT_OF_SCALE)
def test_programs_out_of_scale_are_solved_or_said_not_to_be(name):
    case = BOOK[name]
    result = solve_ipm(case.build(), case.x0, options=IPMOptions(max_iterations=60))
    assert result.status is not Status.INFEASIBLE
    assert not result.status.usable or result.objective == pytest.approx(case.optimum, rel=1e-5)


# ---------------------------------------------------------------- convex QPs
@pytest.mark.parametrize("solver", sorted(QP_SOLVERS))
@pytest.mark.parametrize("name", QPS)
def test_convex_qps(name, solver):
    program = QPS[name].build()
    qp = quadratic(program)
    solution = make_qp_solver(solver).solve(qp)
    if not solution.usable:  # of all these, only our active-set method may fail, and on a singular P only
        assert (solver, solution.status) == ("active_set", QPStatus.FAILED)
        assert np.linalg.cond(qp.P) > 1e12
        return
    if solution.status is QPStatus.SOLVED:
        assert qp.error(solution.x, solution.y, solution.z) <= 1e-6
    else:
        assert solver == "osqp" or name == "CVXQP1_S"
    assert program.objective(solution.x) == pytest.approx(optimum(name), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", [name for name in QPS if name not in ("CVXQP1_S", "CVXQP2_S")])
def test_the_sqp_on_convex_qps(name):
    case = QPS[name]
    program = case.build()
    result = solve_ipm(program, case.x0, options=SHARP)
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(optimum(name), rel=1e-6, abs=1e-6)
    assert_optimal(program, result)


# ---------------------------------------------------------------- degenerate ones
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", DEPENDENT)
def test_dependent_constraints(name, way):
    case = DEPENDENT[name]
    program = case.build()
    result = solve_by(program, case.x0, WAYS[way])
    assert result.status.usable
    assert result.objective == pytest.approx(case.optimum, abs=1e-4)
    assert_optimal(program, result, tolerance=1e-4)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", NO_MULTIPLIERS)
def test_optima_without_multipliers_are_approached(name, way):
    case = NO_MULTIPLIERS[name]
    result = solve_by(case.build(), case.x0, WAYS[way])
    assert result.status is not Status.INFEASIBLE
    assert result.max_violation <= 1e-6
    # on the way to the cusp, multipliers of 1e4 meet the KKT conditions to 1e-6 where f is 1.7 % off
    assert result.objective == pytest.approx(case.optimum, abs=2e-2)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", INFEASIBLE)
def test_infeasible_constraints_are_named(name, way):
    case, constraints = INFEASIBLE[name]
    result = solve_by(case.build(), case.x0, WAYS[way])
    assert result.status is Status.INFEASIBLE
    listed = result.message.split("Constraints that cannot be met: ")[1].split("; ")
    named = {part.split(":")[0] for part in listed}
    assert named
    assert named <= set(constraints)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", UNBOUNDED)
def test_unbounded_programs_end_far_out(name, way):
    case = UNBOUNDED[name]
    options = dataclasses.replace(WAYS[way], max_iterations=50)
    if isinstance(options, SQPOptions):
        options = dataclasses.replace(options, radius=100.0)
    result = solve_by(case.build(), case.x0, options)
    assert not result.status.usable
    assert result.status is not Status.INFEASIBLE
    assert result.max_violation <= 1e-6
    assert result.objective < -1e3
