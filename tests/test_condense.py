"""Condensed Newton systems against the whole ones, solved densely."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from small_plans import biped_problem, transcribed

from impactopt.nlp.start import first_iterate
from impactopt.sqp.condense import Condenser, Determined, Elimination, find_eliminations
from impactopt.sqp.newton import NewtonSystem
from impactopt.sqp.normal import NormalMatrix


def chained(seed, systems=4, own=2, shared=3):
    """Jacobian, Hessian and eliminations: each system's rows touch its own variables and the shared ones."""
    rng = np.random.default_rng(seed)
    n = systems * own + shared
    J = np.zeros((systems * own + 5, n))
    for k in range(systems):
        mine = slice(k * own, (k + 1) * own)
        J[mine, mine] = rng.normal(size=(own, own)) + 3 * np.eye(own)
        J[mine, systems * own :] = rng.normal(size=(own, shared))
    J[systems * own :, systems * own :] = rng.normal(size=(5, shared))
    J[systems * own, :own] = rng.normal(size=own)  # rows that touch what is eliminated
    J[systems * own + 1, own : 2 * own] = rng.normal(size=own)
    H = rng.normal(size=(n, n))
    H = H @ H.T + np.eye(n)
    for k in range(systems):  # coupled to the shared ones, not to each other
        mine = np.arange(k * own, (k + 1) * own)
        others = np.setdiff1d(np.arange(systems * own), mine)
        H[np.ix_(mine, others)] = 0.0
    H = sp.csc_array(H + 20 * np.eye(n))
    numbers = np.arange(systems * own).reshape(systems, own)
    return sp.csc_array(J), H, [Elimination(numbers, numbers)], rng


@given(seed=st.integers(0, 10**6), shift=st.sampled_from([0.0, 0.3]))
@settings(max_examples=20, deadline=None)
def test_the_condensed_step_is_the_whole_one(seed, shift):
    J, H, eliminations, rng = chained(seed)
    n = J.shape[1]
    bounded = np.zeros(n, dtype=bool)
    bounded[[0, n - 1]] = True
    c = Condenser(J, H, eliminations, bounded)
    assert c.bounded.tolist() == [0]
    gradient, residual = rng.normal(size=n), rng.normal(size=c.m)
    weights = np.abs(rng.normal(size=c.rows.size))
    system = c.condense(J, H, gradient, residual)
    M = c.identity()
    matrix = NormalMatrix(system.P, system.A, c.owner, None)
    newton = NewtonSystem(matrix, np.zeros(0, dtype=int))
    none = np.zeros(0, dtype=int)
    assert newton.factor(system, lambda _: weights, np.zeros(c.free.size), none, c.identity)
    assert newton.shift == 0.0
    d, y = newton.solve(system.q, system.r, np.zeros(c.rows.size))
    step = c.expand(d)
    multipliers = c.multipliers(step, y, 0.0)
    # the same, whole: equalities J_e d = -r_e, rows y = w (J d + r), stationarity
    everything = np.vstack([J.toarray(), np.eye(n)[[0]]])
    e, i = c.eliminated, c.rows
    whole = np.block(
        [
            [H.toarray() + everything[i].T * weights @ everything[i], everything[e].T],
            [everything[e], np.zeros((e.size,) * 2)],
        ]
    )
    right = np.concatenate([-gradient - everything[i].T @ (weights * residual[i]), -residual[e]])
    exact = np.linalg.solve(whole, right)
    np.testing.assert_allclose(step, exact[:n], atol=1e-9 * (1 + np.abs(exact).max()))
    np.testing.assert_allclose(multipliers[e], exact[n:], atol=1e-8 * (1 + np.abs(exact).max()))
    Z = np.array([c.expand(column) - c.expand(0 * column) for column in np.eye(c.free.size)]).T
    np.testing.assert_allclose(M.toarray(), Z.T @ Z, atol=1e-10 * np.abs(Z).max() ** 2)
    pulled = rng.normal(size=n)
    np.testing.assert_allclose(c.pull(pulled), Z.T @ pulled, atol=1e-10 * np.abs(Z).max())


def test_rows_of_two_systems_are_refused():
    J = sp.csc_array(np.array([[1.0, 0, 1], [0, 1, 1], [1, 1, 0]]))
    H = sp.csc_array(np.eye(3))
    systems = np.array([[0], [1]])
    with pytest.raises(ValueError, match="row 2 touches two systems"):
        Condenser(J, H, [Elimination(systems, systems)], np.zeros(3, dtype=bool))


def test_systems_that_the_hessian_couples_are_refused():
    J, H = sp.csc_array(np.eye(2)), sp.csc_array(np.ones((2, 2)))
    systems = np.array([[0], [1]])
    with pytest.raises(ValueError, match="couples"):
        Condenser(J, H, [Elimination(systems, systems)], np.zeros(2, dtype=bool))


def test_variables_without_rows_of_their_own_stay_free():
    J = sp.csc_array(np.array([[1.0, 1, 0], [0, 0, 1]]))
    equal = np.array([True, False])
    wanted = [Determined(0, np.array([0, 1])), Determined(0, np.array([2])), Determined(1, np.array([1]))]
    (found,) = find_eliminations(J, equal, wanted)
    assert (found.rows.tolist(), found.variables.tolist()) == ([[0]], [[1]])


@given(seed=st.integers(0, 10**6), n=st.integers(1, 40), wide=st.integers(0, 2))
@settings(max_examples=30, deadline=None)
def test_the_bordered_band_against_dense_algebra(seed, n, wide):
    rng = np.random.default_rng(seed)
    rows = [np.bincount([k, (k + 1) % n], rng.normal(size=2), n) for k in range(n)]
    for k in range(0, n - 6, 3):  # panels of neighbours, all of which may touch the wide ones
        for _ in range(3):
            row = np.zeros(n)
            row[k : k + 6] = rng.normal(size=6)
            row[:wide] = rng.normal(size=min(wide, n))
            rows.append(row)
    A = sp.csr_array(np.array(rows))
    owner = np.array([-1] * n + [k // 3 for k in range(A.shape[0] - n)])
    P = sp.csr_array(sp.diags_array(1.0 + rng.random(n)))
    weights, diagonal = rng.random(A.shape[0]), rng.random(n)
    matrix = NormalMatrix(P, A, owner, np.arange(n, dtype=float))
    matrix.load(P, A)
    none = np.zeros(0, dtype=int)
    dense = P.toarray() + A.toarray().T * weights @ A.toarray() + np.diag(diagonal)
    assert matrix.factor(matrix.weighed(weights), diagonal, none)
    right = rng.normal(size=(n, 2))
    np.testing.assert_allclose(matrix.solve(right), np.linalg.solve(dense, right), atol=1e-8)
    np.testing.assert_allclose(matrix.solve(right[:, 0]), np.linalg.solve(dense, right[:, 0]), atol=1e-8)
    assert not matrix.factor(matrix.weighed(weights), diagonal - 1e3, none)
    held = np.array([0])
    assert matrix.factor(matrix.weighed(weights), diagonal, held)
    assert abs(matrix.solve(right[:, 0])[0]) < 1e-12


def test_a_motions_own_rows_are_found_and_its_step_is_the_whole_one():
    t = transcribed(biped_problem())
    p = t.program
    rng = np.random.default_rng(0)
    x = first_iterate(t) + 1e-3 * rng.normal(size=p.n)
    y = rng.normal(size=p.m)
    J, H = p.jacobian(x), p.hessian(x, 1.0, y)
    equal = p.g_lower == p.g_upper
    wanted = [Determined(*w) for w in p.determined if len(w[1])]
    eliminations = find_eliminations(J, equal, wanted)
    c = Condenser(J, H, eliminations, np.zeros(p.n, dtype=bool))
    assert c.eliminated.size == sum(w.variables.size for w in wanted)
    left = np.flatnonzero(equal[c.rows])
    assert left.size < 60  # of the hundreds there are
    system = c.condense(J, H, p.gradient(x), rng.normal(size=p.m))
    # what is left of a random step is what all rows and the Hessian make of it
    step = rng.normal(size=c.free.size)
    at_zero, d = c.expand(0 * step), c.expand(step)
    np.testing.assert_allclose((J @ (d - at_zero))[c.eliminated], 0, atol=1e-7 * np.abs(d).max())
    np.testing.assert_allclose(system.A @ step, (J @ (d - at_zero))[c.rows], atol=1e-7 * np.abs(d).max())
    curvature = (d - at_zero) @ (H @ (d - at_zero))
    assert step @ (system.P @ step) == pytest.approx(curvature, rel=1e-6)
