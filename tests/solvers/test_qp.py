"""The QP solvers, against the optimality conditions written out anew."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from impactopt import InputError
from impactopt.solvers.options import SQPOptions
from impactopt.solvers.qp.osqp_solver import OsqpSolver
from impactopt.solvers.sqp import QP_SOLVERS, QPStatus, QuadraticProgram, make_qp_solver

INF = np.inf
SOLVERS = sorted(QP_SOLVERS)


def qp(P, q, A=None, lower=(), upper=(), x_lower=-INF, x_upper=INF):
    n = len(q)
    A = np.zeros((0, n)) if A is None else np.atleast_2d(np.array(A, float))
    return QuadraticProgram(
        P=np.array(P, float),
        q=np.array(q, float),
        A=A,
        lower=np.array(lower, float),
        upper=np.array(upper, float),
        x_lower=np.broadcast_to(np.array(x_lower, float), n).copy(),
        x_upper=np.broadcast_to(np.array(x_upper, float), n).copy(),
    )


def random_qp(seed, n, rows, equalities):
    """Feasible QP with gradients of very different norms, some bounds missing, some equal."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(n, n))
    A = rng.normal(size=(rows, n)) * 10 ** rng.uniform(-2, 2, size=(rows, 1))
    inside = rng.normal(size=n)
    v = A @ inside
    span = np.abs(v) + 1e-3
    lower = np.where(rng.random(rows) < 0.3, -INF, v - rng.random(rows) * span)
    upper = np.where(rng.random(rows) < 0.3, INF, v + rng.random(rows) * span)
    equal = np.arange(rows) < min(equalities, n - 1, rows)
    lower, upper = np.where(equal, v, lower), np.where(equal, v, upper)
    x_lower = np.where(rng.random(n) < 0.5, -INF, inside - rng.random(n))
    x_upper = np.where(rng.random(n) < 0.5, INF, inside + rng.random(n))
    return qp(F @ F.T + 0.1 * np.eye(n), rng.normal(size=n) * 5, A, lower, upper, x_lower, x_upper)


def assert_solves(problem, solution, tolerance=1e-5):
    x, y, z = solution.x, solution.y, solution.z
    A, P = problem.A, problem.P
    norms = np.concatenate([np.linalg.norm(A, axis=1), np.ones(x.size)])
    v, multipliers = np.concatenate([A @ x, x]) / norms, np.concatenate([y, z]) * norms
    lower = np.concatenate([problem.lower, problem.x_lower]) / norms
    upper = np.concatenate([problem.upper, problem.x_upper]) / norms
    scale = 1 + np.abs(problem.q).max() + np.abs(multipliers).max()
    assert (v >= lower - tolerance).all()
    assert (v <= upper + tolerance).all()
    assert np.abs(P @ x + problem.q + A.T @ y + z).max() <= tolerance * scale
    assert (v[multipliers > tolerance * scale] >= (upper - 1e-3)[multipliers > tolerance * scale]).all()
    assert (v[multipliers < -tolerance * scale] <= (lower + 1e-3)[multipliers < -tolerance * scale]).all()


@pytest.mark.parametrize("name", SOLVERS)
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 8), rows=st.integers(0, 12), equalities=st.integers(0, 4))
def test_random_qps_are_solved(name, seed, n, rows, equalities):
    problem = random_qp(seed, n, rows, equalities)
    solution = make_qp_solver(name).solve(problem)
    assert solution.status is QPStatus.SOLVED
    assert_solves(problem, solution)


@pytest.mark.parametrize("name", SOLVERS)
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), wrong=st.integers(0, 10**6))
def test_the_guess_does_not_change_the_answer(name, seed, wrong):
    problem = random_qp(seed, 6, 8, 2)
    rng = np.random.default_rng(wrong)
    guess = tuple(rng.normal(size=k) * (rng.random(k) < 0.5) for k in (6, 8, 6))
    solver = make_qp_solver(name)
    cold, warm = solver.solve(problem), solver.solve(problem, start=guess)
    assert warm.status is QPStatus.SOLVED
    np.testing.assert_allclose(warm.x, cold.x, atol=1e-6 * (1 + np.abs(cold.x).max()))


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("seed", range(6))
def test_small_qps_are_solved_to_rounding_and_told_what_holds(name, seed):
    problem = random_qp(seed, 20, 30, 4)
    exact, found = make_qp_solver("active_set").solve(problem), make_qp_solver(name).solve(problem)
    assert problem.error(found.x, found.y, found.z) < 1e-9
    np.testing.assert_array_equal(found.y != 0, exact.y != 0)
    np.testing.assert_array_equal(found.z != 0, exact.z != 0)


def test_the_right_guess_needs_no_iteration():
    problem = random_qp(3, 6, 8, 2)
    solver = make_qp_solver("active_set")
    first = solver.solve(problem)
    assert np.count_nonzero(first.y) + np.count_nonzero(first.z) > 2
    assert solver.solve(problem, start=(first.x, first.y, first.z)).iterations == 0


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize(
    "problem",
    [
        qp(np.eye(2), [1, 1], [[1, 1], [1, 1]], [1, -INF], [INF, 0]),
        qp(np.eye(2), [1, 1], [[1, 0], [0, 1], [1, 1]], [1, 1, -INF], [INF, INF, 1.5]),
        qp(np.eye(2), [0, 0], [[1, 1]], [3], [INF], x_upper=1),
        qp(np.eye(3), [0, 0, 0], [[1, 1, 0], [2, 2, 0]], [1, 3], [1, 3]),
    ],
    ids=["parallel", "three", "constraint and bounds", "equalities"],
)
def test_infeasible_qps_are_a_status(name, problem):
    assert make_qp_solver(name).solve(problem).status is QPStatus.INFEASIBLE


@pytest.mark.parametrize("name", SOLVERS)
def test_dependent_rows(name):
    problem = qp(np.eye(3), [-1, -2, -3], [[1, 1, 0], [2, 2, 0], [1, 1, 0]], [1, 2, -INF], [1, 2, 1])
    solution = make_qp_solver(name).solve(problem)
    assert solution.status is QPStatus.SOLVED
    np.testing.assert_allclose(solution.x, [0, 1, 3], atol=1e-6)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("seed", range(4))
def test_an_equality_that_others_imply(name, seed):
    free = random_qp(seed, 40, 30, 12)
    A = free.A
    extra, value = A[:3].sum(axis=0), free.lower[:3].sum()
    lower, upper = np.append(free.lower, value), np.append(free.upper, value)
    bounds = free.x_lower, free.x_upper
    problem = qp(free.P, free.q, np.vstack([A, extra]), lower, upper, *bounds)
    solution = make_qp_solver(name).solve(problem)
    assert solution.status is QPStatus.SOLVED
    assert_solves(problem, solution)
    np.testing.assert_allclose(solution.x, make_qp_solver("active_set").solve(free).x, atol=1e-6)


@pytest.mark.parametrize("name", SOLVERS)
def test_nonconvex_qps_fail_without_an_exception(name):
    assert not make_qp_solver(name).solve(qp(np.diag([1, -1]), [0, 0], [[1, 1]], [0], [0])).usable


@pytest.mark.parametrize("make", [OsqpSolver])
def test_solvers_are_updated_in_place_while_the_pattern_stays(make):
    solver = make()
    for seed in range(4):
        problem = random_qp(seed, 6, 8, 0)
        assert_solves(problem, solver.solve(problem))
    assert solver.setups == 1
    assert_solves(other := random_qp(0, 5, 8, 0), solver.solve(other))
    assert solver.setups == 2


@pytest.mark.parametrize("make", [OsqpSolver])
def test_large_qps_are_solved_to_the_tolerance(make):
    n = 400  # beyond the active-set method
    rng = np.random.default_rng(0)
    D = sp.diags_array([np.ones(n - 1), -np.ones(n - 1)], offsets=[1, 0], shape=(n - 1, n))
    problem = QuadraticProgram(
        P=(D.T @ D).toarray() + 0.01 * np.eye(n),
        q=rng.normal(size=n),
        A=D.toarray(),
        lower=np.full(n - 1, -0.5),
        upper=np.full(n - 1, 0.5),
        x_lower=np.full(n, -2.0),
        x_upper=np.full(n, 2.0),
    )
    solution = make().solve(problem)
    assert solution.status is QPStatus.SOLVED
    assert np.count_nonzero(solution.y) > 20
    assert_solves(problem, solution, tolerance=1e-7)


def test_residuals_are_those_of_the_kkt_conditions():
    problem = qp([[2, 0], [0, 2]], [1, 0], [[3, 4]], [-INF], [5], x_lower=-1)
    # 3*1 + 4*1 = 7 is 2 above 5: 0.4 of a normalized constraint; P x + q + A'y + z = (2 + 1 + 3, 2 + 4 - 1)
    primal, dual, gap = problem.residuals(np.ones(2), np.array([1.0]), np.array([0.0, -1.0]))
    assert primal == pytest.approx(0.4)
    assert dual == pytest.approx(6)
    assert gap == pytest.approx(2)  # both: 5 (normalized) * 0.4, and 1 * 2


def test_unknown_solvers_are_named():
    with pytest.raises(InputError, match=r"'osqq' \(did you mean 'osqp'\?\)"):
        make_qp_solver("osqq")


@pytest.mark.parametrize("name", ["daqp", "piqp"])
def test_solvers_that_are_gone_name_their_replacement(name):
    for ask in (make_qp_solver, lambda name: SQPOptions(qp_solver=name)):
        with pytest.raises(InputError, match=rf"'{name}' is no longer supported; give 'osqp'"):
            ask(name)


@pytest.mark.parametrize("name", ["osqp"])
def test_no_time_is_no_answer(name):
    assert not make_qp_solver(name).solve(random_qp(0, 60, 90, 8), time_limit=0.0).usable


@pytest.mark.parametrize("name", ["P", "A"])
def test_a_sparse_matrix_is_named(name):
    """NumPy's message was of an array element that is a sequence."""
    dense = random_qp(0, 3, 2, 1)
    with pytest.raises(InputError, match=f"{name} of a quadratic program is a csc_matrix; give a dense"):
        dataclasses.replace(dense, **{name: sp.csc_matrix(getattr(dense, name))})
